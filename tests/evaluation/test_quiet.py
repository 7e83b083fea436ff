"""No protocol lets through what a training may have left in its config."""

from __future__ import annotations

import pytest

from cotap.configs import to_plain
from cotap.envs import H1EnvConfig
from cotap.envs.forces import ForceProfile
from cotap.envs.punches import PunchConfig
from cotap.evaluate import PROTOCOLS
from cotap.play.session import play_config

KINDS = [options for name, (options, _) in PROTOCOLS.items() if name != "recording"]


def lively() -> H1EnvConfig:
    """Everything on that a training may have on."""
    cfg = H1EnvConfig(unevenness_m=0.05, punches=PunchConfig(400.0, 0.1, 2.0))
    cfg.force = ForceProfile((3.0, 0.0, 0.0), "both", 0.5, 2.0, 0.7, True, "base")
    for part in (cfg.assist, cfg.hand_forces, cfg.blows, cfg.randomization, cfg.observations.noise):
        part.enabled = True
    cfg.impedance.share = cfg.retries.share = 0.5
    cfg.hand_forces.hold_s, cfg.hand_forces.most_turning_of, cfg.hand_forces.episode_share = (1.0, 2.0), 3, 0.5
    return cfg


@pytest.mark.parametrize("options", KINDS, ids=lambda kind: kind.__name__)
def test_a_protocol_is_the_same_whatever_the_training_had_on(options):
    bare = H1EnvConfig()
    assert to_plain(options().protocol.configure(lively())) == to_plain(options().protocol.configure(bare))


def test_so_is_the_page():
    assert to_plain(play_config(lively())) == to_plain(play_config(H1EnvConfig()))


@pytest.mark.parametrize("options", KINDS, ids=lambda kind: kind.__name__)
def test_what_a_protocol_asks_for_is_there(options):
    cfg = options().protocol.configure(lively())
    name = options.__name__.removesuffix("Options")
    assert any(cfg.force.force) == (name not in ("VelocityTracking", "Stability", "Modulation", "Punches"))
    assert (cfg.punches.force_n > 0.0) == (name == "Punches")
    assert cfg.randomization.enabled == (name not in ("StaticStiffness", "Fidelity", "Stability"))
