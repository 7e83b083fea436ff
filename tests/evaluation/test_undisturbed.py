"""No protocol lets through what a training may have left in its config."""

from __future__ import annotations

import pytest

from cotap.configs import to_plain
from cotap.envs import HumanoidEnvConfig
from cotap.envs.punches import PunchConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.evaluate import PROTOCOLS
from cotap.evaluation.undisturbed import disable_disturbances


def lively() -> HumanoidEnvConfig:
    """Everything on that a training may have on."""
    cfg = HumanoidEnvConfig(unevenness_m=0.05)
    cfg.forces.scripted = ForceProfile((3.0, 0.0, 0.0), "both", 0.5, 2.0, 0.7, True, "base")
    cfg.forces.punches = PunchConfig(400.0, 0.1, 2.0)
    for part in (cfg.assist, cfg.forces.hand_loads, cfg.forces.pushes, cfg.randomization, cfg.observations.noise):
        part.enabled = True
    cfg.path.share, cfg.curriculum.arm_motion_samples = 0.5, 1e6
    cfg.forces.hand_loads.hold_s, cfg.forces.hand_loads.ramp.full_samples = (1.0, 2.0), 1e9
    cfg.terminations.max_tilt_rad = 2.0
    return cfg


def test_all_is_off():
    assert to_plain(disable_disturbances(lively()).forces) == to_plain(HumanoidEnvConfig().forces)


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=PROTOCOLS)
def test_a_protocol_is_the_same_whatever_the_training_had_on(protocol):
    bare = HumanoidEnvConfig()
    assert to_plain(protocol().configure(lively())) == to_plain(protocol().configure(bare))


@pytest.mark.parametrize("protocol", [p for name, p in PROTOCOLS.items() if name != "tour"])
def test_quicker_controllers_are_late_by_a_step_of_theirs_at_most(protocol):
    cfg = protocol().configure(HumanoidEnvConfig(control_dt=0.01))
    cfg.check()
    assert cfg.randomization.delay_s == (0.0, 0.01)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_what_a_protocol_asks_for_is_there(name):
    cfg = PROTOCOLS[name]().configure(lively())
    assert any(cfg.forces.scripted.force) == (name not in ("velocity-tracking", "modulation", "task", "tour"))
    assert (cfg.forces.punches.force_n > 0.0) == (name == "tour")
    undisturbed = ("static-stiffness", "fidelity", "stability", "passivity", "tour")
    assert cfg.randomization.enabled == (name not in undisturbed)
    assert any(source.enabled for source in (cfg.forces.pushes, cfg.forces.hand_loads)) == (name == "task")
