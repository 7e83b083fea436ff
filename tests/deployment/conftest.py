"""Policies with random weights, as checkpoints and as ONNX."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from cotap.agents.actors import DualActorCritic
from cotap.agents.checkpoint import save_checkpoint
from cotap.agents.runner import layout_of
from cotap.compliance.laws import LawConfig
from cotap.configs import BaseTraining, to_plain
from cotap.deployment.graph import export_policy
from cotap.deployment.policy import OnnxPolicy
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.actions import ActionConfig
from cotap.envs.modulation import ModulationConfig
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluation.policy import shipped_checkpoint


def save_random_policy(path: Path, robot: str = "h1", output_gain: float = 0.01, **fields: Any) -> None:
    """A checkpoint of fresh networks, `output_gain` on their last layers; `fields` are of HumanoidEnvConfig."""
    training = BaseTraining(env=HumanoidEnvConfig(robot=robot, num_envs=1, num_threads=1, **fields))
    training.ppo.hidden = (32, 16)
    env = HumanoidEnv(training.env)
    torch.manual_seed(0)
    model = DualActorCritic(layout_of(env), training.ppo.hidden, 1.0)
    state = model.state_dict()
    for name, value in state.items():
        if name.endswith("output_weight"):
            value *= output_gain / 0.01
        elif name.endswith("_mean"):
            value.normal_(0.0, 0.2)
        elif name.endswith("_std"):
            value.uniform_(0.7, 1.5)
    content = {
        "kind": "base", "layout": env.layout(), "agents": model.layout.to_plain(),
        "config": {"training": to_plain(training)}, "model": state,
    }  # fmt: skip
    save_checkpoint(path, content)


def modulated_laws(kind: str) -> UpperBodyConfig:
    """Arms whose laws the policy sets, one of them through an energy store."""
    left = LawConfig("cotap", (400.0, 300.0, 200.0), alpha=0.4, passive=True)
    right = LawConfig("cotap", alpha=0.6, error="task")
    return UpperBodyConfig(left, right, modulation=ModulationConfig(kind))


@pytest.fixture
def save_policy() -> Callable[..., None]:
    return save_random_policy


@pytest.fixture(scope="session")
def random_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """The checkpoint of a policy with random weights, made once per kind."""
    folder, made = tmp_path_factory.mktemp("checkpoints"), {}

    def make(
        robot: str = "h1", upper_mode: str = "residual", output_gain: float = 0.01, modulation: str = "none"
    ) -> Path:
        kind = f"{robot}-{upper_mode}-{output_gain}-{modulation}"
        if kind not in made:
            made[kind] = folder / f"{kind}.pt"
            fields: dict[str, Any] = {"actions": ActionConfig(upper_mode=upper_mode)}
            if modulation != "none":
                fields["upper_body"] = modulated_laws(modulation)
            save_random_policy(made[kind], robot, output_gain, **fields)
        return made[kind]

    return make


@pytest.fixture(scope="session")
def random_policy(random_checkpoint: Callable[..., Path]) -> Callable[..., Path]:
    """The same as ONNX."""

    def make(**kind: Any) -> Path:
        checkpoint = random_checkpoint(**kind)
        path = checkpoint.with_suffix(".onnx")
        if not path.exists():
            export_policy(checkpoint, path, checks=20)
        return path

    return make


@pytest.fixture(scope="session")
def policy_file(random_policy: Callable[..., Path]) -> Path:
    """An H1 that does next to nothing: it stands for a while."""
    return random_policy()


@pytest.fixture(scope="session")
def shipped_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that walks."""
    path = tmp_path_factory.mktemp("shipped") / "h1-base.onnx"
    export_policy(shipped_checkpoint("h1-base"), path, checks=20)
    return path


@pytest.fixture(scope="session")
def policy(policy_file: Path) -> OnnxPolicy:
    return OnnxPolicy(policy_file)
