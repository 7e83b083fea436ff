"""An environment without physics that offers all that agents ask of `HumanoidEnv`: two agents, each with a target.

Each env holds one number per action. Actions push those numbers about; each agent is paid for how close its own
share of the actions comes to its own target. Observations have scales and offsets far from 1 and 0, so that
normalisers have work to do.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from cotap.agents.dual_ppo import DualPPOConfig
from cotap.agents.runner import DualRunner, check_run_dir
from cotap.agents.runner_config import RunnerConfig

TARGETS = {"lower": (0.8, -0.5, 0.3), "upper": (-0.7, 0.6)}
TINY = {"hidden": (8, 8), "steps": 6, "epochs": 2, "mini_batches": 2, "precision": "fp32", "std_half_life": 0.0}


class DummyEnv(VecEnv):
    """N envs. `on_step`, where given, is called with the number of steps taken so far, before each step."""

    reward_groups = ("lower", "upper")

    def __init__(self, num_envs: int = 8, seed: int = 0, max_episode_length: int = 10, robot: str = "dummy") -> None:
        self.cfg: dict[str, Any] = {}
        self.device = "cpu"
        self.num_envs = num_envs
        self.num_actions = 5
        self.action_slices = {"lower": slice(0, 3), "upper": slice(3, 5)}
        self.obs_groups = {"actor": ["policy"], "critic": ["policy", "privileged"]}
        self.max_episode_length = max_episode_length
        self.on_step: Callable[[int], None] | None = None
        self.target = torch.tensor(TARGETS["lower"] + TARGETS["upper"])
        self.rng = torch.Generator().manual_seed(seed)
        self.samples = 0
        self.steps = 0
        self.robot = robot
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self.x = torch.zeros(num_envs, self.num_actions)
        self._observe()

    def layout(self) -> dict[str, Any]:
        return {"robot": self.robot, "actions": {"scale": 0.25}, "slices": {"lower": (0, 3), "upper": (3, 5)}}

    def get_observations(self) -> TensorDict:
        return self._observations

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        if self.on_step is not None:
            self.on_step(self.steps)
        self.steps += 1
        self.samples += self.num_envs
        self.episode_length_buf += 1
        noise = torch.randn(self.x.shape, generator=self.rng)
        self.x = 0.9 * self.x + 0.1 * actions + 0.3 * noise
        falls = torch.rand(self.num_envs, generator=self.rng) < 0.02
        time_outs = (self.episode_length_buf >= self.max_episode_length) & ~falls
        error = (actions - self.target).square()
        rewards = torch.stack([-error[:, part].mean(1) for part in self.action_slices.values()], 1)
        done = falls | time_outs
        self.x[done] = 0.0
        self.episode_length_buf[done] = 0
        self._observe()
        log = {"/lower/target": rewards[:, 0].mean(), "/upper/target": rewards[:, 1].mean()}
        extras = {"time_outs": time_outs, "falls": falls, "group_rewards": rewards, "log": log}
        return self._observations, rewards.sum(1), done, extras

    def state_dict(self) -> dict[str, Any]:
        return {
            "x": self.x.clone(),
            "episode_length": self.episode_length_buf.clone(),
            "steps": self.steps,
            "samples": self.samples,
            "rng": self.rng.get_state(),
            "ballast": torch.zeros(20_000),  # as a simulator's state, larger than tiny networks
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.x = state["x"].clone()
        self.episode_length_buf = state["episode_length"].clone()
        self.steps, self.samples = state["steps"], state["samples"]
        self.rng.set_state(state["rng"])
        self._observe()

    def _observe(self) -> None:
        policy = torch.cat((5.0 + 3.0 * self.x, torch.ones(self.num_envs, 1)), 1)
        privileged = torch.stack((100.0 * self.x[:, 0], self.episode_length_buf.float()), 1)
        self._observations = TensorDict({"policy": policy, "privileged": privileged}, batch_size=[self.num_envs])


def make_runner(
    run_dir: Path, iterations: int, save_interval: int = 2, seed: int = 0, env: VecEnv | None = None, **ppo: Any
) -> DualRunner:
    """A runner with tiny networks on `env`, by default a `DummyEnv`; `ppo` are fields of `DualPPOConfig`."""
    torch.manual_seed(seed)
    run_dir.mkdir(parents=True, exist_ok=True)
    cfg = RunnerConfig(iterations=iterations, save_interval=save_interval)
    return DualRunner(env or DummyEnv(), cfg, DualPPOConfig(**(TINY | ppo)), run_dir, {"stage": "base"})


if __name__ == "__main__":  # RUN_DIR ITERATIONS SIGNAL STEP: train, and send oneself SIGNAL at STEP
    torch.set_num_threads(1)
    folder, count, number, at = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    check_run_dir(folder)
    runner = make_runner(folder, count)
    runner.env.on_step = lambda step: os.kill(os.getpid(), signal.Signals(number)) if step == at else None
    runner.learn()
