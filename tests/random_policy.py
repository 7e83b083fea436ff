"""Checkpoints of policies that have learned nothing, for tests that need some policy."""

from __future__ import annotations

from pathlib import Path

import torch

from cotap.agents.runner import DualRunner
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES, to_plain
from cotap.envs import HumanoidEnv


def save_random_policy(path: Path, stage: str = "base", robot: str = "h1", seed: int = 0) -> Path:
    """A checkpoint of the recipe `default` of a stage with tiny random networks, as training saves it."""
    training = BASE_RECIPES["default"](robot)
    training.env.num_envs, training.env.num_threads = 2, 1
    training.ppo.hidden, training.ppo.steps, training.seed = (8, 8), 4, seed
    if stage == "distill":
        training = DISTILL_RECIPES["default"](training)
    torch.manual_seed(seed)
    config = {"stage": stage, "training": to_plain(training), "commit": "-", "command": "-", "machine": "-"}
    runner = DualRunner(HumanoidEnv(training.env), training.runner, training.ppo, path.parent, config)
    runner.save(str(path))
    return path
