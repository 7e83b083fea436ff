"""Policies with random weights, saved as training saves them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from cotap.agents.actors import DualActorCritic
from cotap.agents.checkpoint import save_checkpoint
from cotap.agents.runner import layout_of
from cotap.configs import to_plain
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluation import policy

HIDDEN = (16,)


def save_policy(path: Path, cfg: HumanoidEnvConfig, gain: float = 1.0) -> Path:
    """Save a policy for the robot and the environment of `cfg`; `gain` scales its random weights."""
    torch.manual_seed(0)
    env = HumanoidEnv(cfg)
    agents = layout_of(env)
    weights = DualActorCritic(agents, HIDDEN, 1.0).state_dict()
    training = {"env": to_plain(cfg), "ppo": {"hidden": list(HIDDEN)}}
    content = {
        "kind": "base", "layout": env.layout(), "agents": agents.to_plain(), "config": {"training": training},
        "model": {k: gain * v if k.startswith("actors") else v for k, v in weights.items()},
    }  # fmt: skip
    save_checkpoint(path, content)
    return path


@pytest.fixture
def save() -> Callable[[Path, HumanoidEnvConfig], Path]:
    """Saves a policy for a config. Tests import nothing from here: there is a `conftest` in other folders, too."""
    return save_policy


@pytest.fixture(scope="session")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A checkpoint by its robot's name; made once."""
    folder = tmp_path_factory.mktemp("checkpoints")

    def find(robot: str) -> Path:
        path = folder / f"{robot}.pt"
        return path if path.is_file() else save_policy(path, HumanoidEnvConfig(robot, num_envs=1, num_threads=1))

    return find


@pytest.fixture
def checkpoint(checkpoints: Callable[[str], Path]) -> Path:
    """Of the H1."""
    return checkpoints("h1")


@pytest.fixture
def shipped(monkeypatch: pytest.MonkeyPatch, checkpoint: Path) -> Path:
    """As if this H1 policy came with the package, under all names."""
    monkeypatch.setattr(policy, "checkpoint_path", lambda _: checkpoint)
    return checkpoint
