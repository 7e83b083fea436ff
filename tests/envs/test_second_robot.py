"""A robot of one's own, registered by its name alone: built, stepped, mirrored and trained."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import pytest
import torch
from env_tools import zeros

from cotap.agents.checkpoint import CheckpointError, load_checkpoint
from cotap.agents.runner import DualRunner
from cotap.agents.runner_config import RunnerConfig
from cotap.configs import BASE_RECIPES
from cotap.configs.base import BaseTraining
from cotap.configs.serialization import to_plain
from cotap.envs import HumanoidEnv

NUM_ENVS, STEPS = 6, 4


def training(robot: str = "made-up") -> BaseTraining:
    """The recipe that ships, pushes, loads and assistance included, on another robot and tiny."""
    out = BASE_RECIPES["default"](robot)
    out.env.num_envs, out.env.num_threads = NUM_ENVS, 1
    out.ppo = dataclasses.replace(out.ppo, steps=STEPS, hidden=(16,), epochs=1, mini_batches=2)
    return out


def runner_of(cfg: BaseTraining, run_dir: Path, iterations: int = 2) -> DualRunner:
    torch.manual_seed(0)
    run_dir.mkdir(parents=True, exist_ok=True)
    env = HumanoidEnv(copy.deepcopy(cfg.env))
    return DualRunner(env, RunnerConfig(iterations=iterations), cfg.ppo, run_dir, to_plain(cfg))


def test_it_is_unlike_the_h1(make_env):
    own, h1 = make_env(1, robot="made-up"), make_env(1)
    assert own.num_actions != h1.num_actions
    assert own.num_lower != h1.num_lower
    assert len(own.spec.arms[0].joints) != len(h1.spec.arms[0].joints)
    assert own.spec.torso_body != h1.spec.torso_body
    assert own.spec.base_height_m < own.spec.nominal_height_m


def test_it_stands_for_a_second(make_env):
    env = make_env(4, robot="made-up")
    env.commands.override(torch.zeros(4, 2), torch.zeros(4), torch.ones(4), torch.full((4,), env.spec.nominal_height_m))
    env.motions.hold(env.motions.default)
    env.reset()
    for _ in range(50):
        _, reward, done, extras = env.step(zeros(env))
        assert not done.any()
        assert torch.isfinite(reward).all()
    assert (env.state.height / env.spec.nominal_height_m - 1.0).abs().max() < 0.05
    assert env.state.foot_contact.all()
    assert float(extras["log"]["/lower/track_height"]) > 0.3 * 0.75 * env.dt


def test_its_mirror_image_is_its_own(make_env, rng):
    env = make_env(2, robot="made-up")
    a = torch.randn(2, env.num_actions, generator=rng)
    mirrored = env.symmetry.actions(a)
    waist = env.spec.indices(["waist_yaw", "waist_roll", "waist_pitch"])
    assert torch.equal(mirrored[:, waist], a[:, waist] * torch.tensor([-1.0, -1.0, 1.0]))
    left, right = env.spec.indices(["left_wrist_yaw", "right_wrist_yaw"])
    assert torch.equal(mirrored[:, left], -a[:, right])
    assert torch.equal(env.symmetry.actions(mirrored), a)


@pytest.mark.parametrize("name", ["g1", "made-up"])
def test_it_trains_and_goes_on_exactly(name, tmp_path):
    cfg = training(name)
    straight = runner_of(cfg, tmp_path / "straight")
    begin = {k: v.clone() for k, v in straight.alg.model.state_dict().items()}
    straight.learn()
    learned = straight.alg.model.state_dict()
    assert all(v.isfinite().all() for v in learned.values())
    assert any(not torch.equal(v, begin[k]) for k, v in learned.items())
    assert straight.env.samples == 2 * STEPS * NUM_ENVS
    content = load_checkpoint(tmp_path / "straight" / "checkpoint_000002.pt")
    assert content["layout"]["robot"] == name
    assert content["layout"]["joints"] == list(straight.env.spec.joint_names)
    runner_of(cfg, tmp_path / "parts", 1).learn()
    resumed = runner_of(cfg, tmp_path / "parts")
    resumed.load(str(tmp_path / "parts" / "checkpoint_000001.pt"))
    assert resumed.env.samples == STEPS * NUM_ENVS
    resumed.learn()
    for name, value in resumed.alg.model.state_dict().items():
        assert torch.equal(value, learned[name]), name


def test_its_policies_are_not_for_the_h1(tmp_path):
    cfg = training()
    runner_of(cfg, tmp_path, 1).learn()
    cfg.env.robot = "h1"
    with pytest.raises(CheckpointError, match="made-up"):
        runner_of(cfg, tmp_path / "h1").load(str(tmp_path / "checkpoint_000001.pt"))
