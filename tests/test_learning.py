"""A short training run makes a better policy, and makes it again when asked again."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cotap import train
from cotap.agents.actors import DualActorCritic, as_dict
from cotap.agents.checkpoint import load_checkpoint
from cotap.agents.runner import layout_of
from cotap.configs import BaseTraining, from_plain
from cotap.envs import HumanoidEnv

pytestmark = pytest.mark.slow

SIZE = ["--num-envs", "256", "--ppo.hidden", "64", "64", "--ppo.precision", "fp32"]
ENVS, STEPS = 128, 250


def learn(run_dir: Path, iterations: int, threads: int, *options: str) -> Path:
    """Run the command and return its last checkpoint."""
    common = ["--iterations", str(iterations), "--threads", str(threads), "--run-dir", str(run_dir)]
    before = torch.get_num_threads()
    try:
        assert train.main(["base", *SIZE, *common, *options]) == 0
    finally:
        torch.set_num_threads(before)
    return max(run_dir.glob("checkpoint_*.pt"))


@torch.no_grad()
def judge(checkpoint: Path, trained: bool) -> dict[str, float]:
    """Each agent's reward per second in a deterministic rollout from a seed of its own; untrained: of the networks that
    the run began with."""
    content = load_checkpoint(checkpoint)
    training = from_plain(BaseTraining, content["config"]["training"])
    training.env.num_envs, training.env.seed = ENVS, 1234
    env = HumanoidEnv(training.env)
    torch.manual_seed(training.seed)
    model = DualActorCritic(layout_of(env), training.ppo.hidden, training.ppo.initial_std)
    if trained:
        model.load_state_dict(content["model"])
    model.eval()
    rewards = torch.zeros(2)
    for _ in range(STEPS):
        *_, extras = env.step(model(as_dict(env.get_observations())))
        rewards += extras["group_rewards"].mean(0)
    return dict(zip(env.reward_groups, (rewards / (STEPS * env.dt)).tolist(), strict=True))


def test_the_quick_recipe_learns_under_the_wrench_that_assists(tmp_path: Path):
    """The first quarter of a million of its samples, all of them under the whole wrench."""
    checkpoint = learn(tmp_path / "run", 40, 1, "--recipe", "quick", "--runner.save-interval", "40")
    start, end = judge(checkpoint, trained=False), judge(checkpoint, trained=True)
    report = f"from {start} to {end}"
    assert end["lower"] > start["lower"] + 0.5, report
    assert end["upper"] > start["upper"] + 0.03, report  # arms begin at their reference: there is little to gain


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_and_threads_give_the_same_checkpoint(tmp_path: Path, threads: int):
    a, b = (load_checkpoint(learn(tmp_path / name, 4, threads)) for name in ("a", "b"))
    for part in ("model", "learner", "env"):
        assert_same(a[part], b[part], part)
    assert torch.equal(a["rng"], b["rng"])


def assert_same(a: object, b: object, where: str) -> None:
    """Nested data are equal, tensors bit for bit."""
    if isinstance(a, dict) and isinstance(b, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}/{key}")
    elif isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        assert torch.equal(a, b), where
    elif isinstance(a, list) and isinstance(b, list):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}/{i}")
    else:
        assert a == b, where
