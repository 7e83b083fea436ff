"""Stiffness and alpha cover their whole range, by steps and by ramps."""

from __future__ import annotations

import pytest
import torch

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import main
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.modulation import Modulation, sweep
from cotap.evaluation.rollout import idle, record_rollout


def test_sweep_by_hand():
    cycles = torch.tensor([0.0, 0.25, 0.49, 0.5, 0.75, 1.25])
    assert sweep(cycles, torch.tensor(True)).tolist() == [0.0, 0.0, 0.0, 1.0, 1.0, 0.0]
    assert sweep(cycles, torch.tensor(False)).tolist() == pytest.approx([0.0, 0.5, 0.98, 1.0, 0.5, 0.5])


def test_every_arm_goes_through_the_whole_range():
    protocol = Modulation(num_envs=4, pelvis="fixed", window=(0.0, 2.5), fall_seconds=2.5, episode_seconds=3.5)
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(method="cotap").configure()
    env = HumanoidEnv(cfg)
    protocol.prepare(env)
    seen = []

    def watch(env, step):
        protocol.before_step(env, step)
        p = env.upper_body.parameters
        seen.append((p.stiffness.clone(), p.alpha.clone()))

    t = record_rollout(env, idle(env), 175, progress=False, before_step=watch)
    stiffness, alpha = (torch.stack(x) for x in zip(*seen, strict=True))
    torch.testing.assert_close(stiffness.amin((0, 3)), torch.full((4, 2), 80.0), atol=6.0, rtol=0)
    torch.testing.assert_close(stiffness.amax((0, 3)), torch.full((4, 2), 1200.0), atol=70.0, rtol=0)
    assert float(alpha.amin(0).max()) < 0.05
    assert float(alpha.amax(0).min()) > 0.95
    assert sorted(stiffness[:, 0, 0, 0].unique().tolist()) == pytest.approx([80.0, 1200.0], rel=1e-4)  # steps
    assert len(stiffness[:, 1, 0, 0].unique()) > 30  # ramps
    result = protocol.measure(t, env)
    assert result["by_change"]["step"]["peak_torque"]["n"] == 2
    assert result["metrics"]["energy"]["mean"] > 0.0
    assert "recovery_s" not in result["metrics"]


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--change", "leap"], "change 'leap' is unknown"), (["--method", "pd"], "needs a law with a stiffness"),
     (["--method", "soft-pd"], "got soft-pd, soft-pd"), (["--left", "pd", "--right", "soft-pd"], "got pd, soft-pd"),
     (["--stiffness-range", "0", "5"], "stiffness_range[0]"), (["--alpha-range", "0", "2"], "alpha_range[1]")],
)  # fmt: skip
def test_bad_options_are_named(options, message, capsys, shipped):  # noqa: ARG001
    assert main(["modulation", "--num-envs", "1", *options]) == 2
    assert message in capsys.readouterr().err
