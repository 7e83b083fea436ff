"""Foresight: falls out of standing are told ahead, and robots step before they come."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from cotap.envs import H1Env, H1EnvConfig, foresight
from cotap.envs.foresight import SURE, Foresight, StandingRisk
from cotap.envs.step_timing import feature_reflection
from cotap.evaluation.metrics import tracking_measures
from cotap.evaluation.policy import load_policy, shipped_checkpoint
from cotap.evaluation.protocols import VelocityTracking
from cotap.evaluation.rollout import record_rollout
from cotap.robots import ROBOTS

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
import fit_foresight


@pytest.fixture(scope="module")
def env() -> H1Env:
    cfg = H1EnvConfig(num_envs=4, num_threads=1)
    cfg.commands.foresee_falls, cfg.commands.stand_probability = True, 1.0
    env = H1Env(cfg)
    env.reset()
    return env


def states(env: H1Env, lean: list[float], rate: list[float]):
    """Default poses that lean forward [rad], and turn further that way [rad/s]."""
    n = len(lean)
    angle, zero = torch.tensor(lean), torch.zeros(n)
    return dataclasses.replace(
        env.state,
        joint_pos=torch.tensor([[j.default_rad for j in env.spec.joints]]).expand(n, -1),
        joint_vel=torch.zeros(n, env.num_actions),
        projected_gravity_t=torch.stack((angle.sin(), zero, -angle.cos()), 1),
        torso_angular_velocity_t=torch.stack((zero, torch.tensor(rate), zero), 1),
    )


def told(env: H1Env, n: int, stand: float):
    """The command to stand, or to walk on the spot."""
    zero = torch.zeros(n)
    current = env.commands.current()
    return dataclasses.replace(current, velocity_h=torch.zeros(n, 2), yaw_rate=zero, stand=zero + stand)


def test_mirror_images_are_judged_alike(env: H1Env) -> None:
    reflection = feature_reflection(env.spec)
    model, x = StandingRisk(reflection), torch.randn(8, 9 + 2 * env.num_actions)
    torch.testing.assert_close(model(reflection(x)), model(x))
    assert model(x).std() > 0.0


def test_who_stands_is_told_from_who_falls(env: H1Env) -> None:
    """Random weights would say the same of all; one leans forward and further, one back."""
    see = Foresight(env.spec)
    state = states(env, [0.0, 0.25, -0.25], [0.0, 0.8, -0.8])
    assert see.falling(state, told(env, 3, stand=1.0)).tolist() == [False, True, True]


def test_a_robot_that_is_foreseen_to_fall_steps(env: H1Env, monkeypatch: pytest.MonkeyPatch) -> None:
    env.reset()
    chosen = torch.tensor([True, False, True, False])
    assert env.foresight is not None
    monkeypatch.setattr(env.foresight, "falling", lambda *_: chosen)
    env.step(torch.zeros(4, env.num_actions))
    assert (env.commands.current().stand < 0.5).tolist() == chosen.tolist()


def test_a_standing_robot_that_does_not_fall_may_lean(env: H1Env, monkeypatch: pytest.MonkeyPatch) -> None:
    """But not far; and of one that steps, lean alone tells when it is steady."""
    see = Foresight(env.spec)
    lean, state = torch.tensor([0.25, 0.35, 0.05]), states(env, [0.0] * 3, [0.0] * 3)
    for falls, expected in ((False, [0.0, math.inf, 0.0]), (True, [math.inf] * 3)):
        monkeypatch.setattr(see, "falling", lambda *_, falls=falls: torch.full((3,), falls))
        assert see.lean(lean, state, told(env, 3, stand=1.0)).tolist() == expected
        torch.testing.assert_close(see.lean(lean, state, told(env, 3, stand=0.0)), lean)


def test_without_it_only_lean_counts() -> None:
    assert H1Env(H1EnvConfig(num_envs=1, num_threads=1)).foresight is None


def test_weights_of_another_robot_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = ROBOTS["h1"]()
    monkeypatch.setattr(foresight, "feature_reflection", lambda _: feature_reflection(spec).part(slice(0, 6)))
    with pytest.raises(ValueError, match="fitted for another robot than 'h1'"):
        Foresight(spec)


def test_time_to_a_fall_counts_from_standing_only() -> None:
    """Four worlds, five steps of 0.5 s: stands and falls; falls while stepping; steps, then stands and falls; never."""
    stands = torch.tensor([[1, 1, 0, 1], [1, 1, 0, 1], [1, 0, 1, 1], [1, 0, 1, 1], [1, 1, 1, 1]]).bool()
    falls = torch.zeros(5, 4).bool()
    falls[2, 0] = falls[3, 1] = falls[4, 2] = True
    never = fit_foresight.NEVER_S
    expected = [[1.0, never, never, never], [0.5, never, never, never], [0.0, never, 1.0, never],
                [never, never, 0.5, never], [never, never, 0.0, never]]  # fmt: skip
    torch.testing.assert_close(fit_foresight.time_to_fall(stands, falls, 0.5), torch.tensor(expected))


def test_recordings_and_weights_are_written_and_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """End to end, tiny: the weights that `fit` writes are ones that `Foresight` takes."""
    recording, weights = tmp_path / "standing.npz", tmp_path / "weights.npz"
    collect = ["", "collect", "--num-envs", "8", "--seconds", "4", "--disturbance", "loads", "--size", "40", "--output",
               str(recording)]  # fmt: skip
    monkeypatch.setattr(sys, "argv", collect)
    assert fit_foresight.main() == 0
    with np.load(recording) as seen:
        assert seen["seen"].shape == (len(seen["until_s"]), 9 + 2 * 19)
        assert (seen["until_s"] < 1.5).any()
        assert seen["world"].max() < 8
    monkeypatch.setattr(sys, "argv", ["", "fit", str(recording), "--steps", "5", "--output", str(weights)])
    assert fit_foresight.main() == 0
    with np.load(weights) as fitted:
        model = StandingRisk(feature_reflection(ROBOTS["h1"]()))
        model.net.load_state_dict({k: torch.tensor(fitted[k].astype(np.float32)) for k in fitted.files})
    assert "taken for falls" in capsys.readouterr().out


def test_recordings_of_which_nothing_can_be_learned_are_told(tmp_path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    output = str(tmp_path / "weights.npz")
    monkeypatch.setattr(sys, "argv", ["", "collect", "--seconds", "2", "--output", output])
    with pytest.raises(SystemExit):
        fit_foresight.main()
    assert "--seconds 2 must be more than 2.4" in capsys.readouterr().err
    nobody_fell = {"seen": np.zeros((9, 47), np.float16), "until_s": np.full(9, 1e3), "world": np.arange(9)}
    np.savez(tmp_path / "calm.npz", **nobody_fell)
    monkeypatch.setattr(sys, "argv", ["", "fit", str(tmp_path / "calm.npz"), "--output", output])
    with pytest.raises(SystemExit, match="no robots that are about to fall"):
        fit_foresight.main()
    assert not Path(output).exists()


@pytest.mark.slow
def test_falls_are_seen_a_second_ahead_and_few_that_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The shipped weights on robots that were not recorded for them."""
    recording = tmp_path / "standing.npz"
    monkeypatch.setattr(
        sys, "argv", ["", "collect", "--num-envs", "256", "--seconds", "12", "--seed", "77", "--output", str(recording)]
    )
    fit_foresight.main()
    with np.load(recording) as file:
        x, until_s, world = (torch.from_numpy(file[k]) for k in ("seen", "until_s", "world"))
    sure = Foresight(ROBOTS["h1"]()).model(x.float()) > SURE
    ahead = (until_s > 0.7) & (until_s < 1.0)
    assert len(world[ahead].unique()) > 20
    assert len(world[ahead & sure].unique()) > 0.9 * len(world[ahead].unique())
    assert sure[until_s > fit_foresight.SAFE_S].float().mean() < 0.01


@pytest.mark.slow
def test_it_keeps_standing_robots_on_their_feet() -> None:
    """The shipped base told to stand most of the time: without any stepping, and with foresight alone."""
    policy = load_policy(shipped_checkpoint("base"))
    falls, drift = {}, {}
    for foresees in (True, False):
        protocol = VelocityTracking(num_envs=256, stand_probability=0.8, steady_rad=10.0, seed=5)
        cfg = protocol.configure(policy.env_config)
        cfg.commands.foresee_falls, cfg.commands.step_timing = foresees, False
        record = record_rollout(H1Env(cfg), policy, 600, progress=False)
        falls[foresees] = int(record.fell.any(0).sum())
        drift[foresees] = tracking_measures(record, cfg.commands.gait_period_s)["stand_drift"].nanmean()
    assert falls[True] < 0.3 * falls[False]
    assert drift[True] < drift[False]
