"""The task of learned modulation: what a policy, or a constant law, gets for it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch

from cotap.checks import require_range
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.arm_task import TASK_WEIGHTS, task_forces
from cotap.envs.rewards import UpperRewards
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.metrics import masked_mean, outcome
from cotap.evaluation.protocol import RolloutProtocol
from cotap.evaluation.report import pyplot, save_figure
from cotap.evaluation.rollout import Trajectory

PARTS = tuple(TASK_WEIGHTS)


@dataclass
class Task(RolloutProtocol):
    """Free hands, loads and pushes as in the recipe `modulated`: the return of that task and of each of its parts, for
    laws that the policy sets or for constant ones (--alpha, --stiffness)."""

    laws: ClassVar[LawOptions] = LawOptions(method="cotap")

    episode_seconds: float = 20.0
    """Length of the evaluation [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        require_range("episode_seconds", self.episode_seconds, 0.1, 3600.0)

    @property
    def seconds(self) -> float:
        """Length of the evaluation [s]."""
        return self.episode_seconds

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        env_cfg.forces = task_forces()
        return env_cfg

    def prepare(self, env: HumanoidEnv) -> None:
        """Nothing is recorded yet."""
        super().prepare(env)
        self._steps: list[torch.Tensor] = []

    def before_step(self, env: HumanoidEnv, step: int) -> None:
        """Keep what the last step was worth."""
        if step:
            self._steps.append(step_figures(env))

    def measure(self, trajectory: Trajectory, env: HumanoidEnv) -> dict[str, Any]:
        """The measured part of the evaluation's JSON, falls aside."""
        figures = torch.stack([*self._steps, step_figures(env)]).cpu()
        fell = trajectory.fell.any(0)
        measures = task_measures(figures, trajectory.alive()) | {"fall_fraction": fell}
        return {
            **outcome(measures, ~fell, self.seed, self.per_env),
            "window": {"start": 0.0, "end": self.seconds},
        }

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """The return and its parts, as bars."""
        plt = pyplot()

        shown = {name: m for name, m in result["metrics"].items() if name.startswith("return")}
        figure, axis = plt.subplots(figsize=(6, 3.4), constrained_layout=True)
        for name, m in shown.items():
            low, high = m["ci95"] or (m["mean"], m["mean"])
            axis.bar(name, m["mean"], yerr=[[m["mean"] - low], [high - m["mean"]]], color="#2171b5", capsize=4)
        axis.set(ylabel="per second", title=f"{result['protocol']}, {result['method']}")
        axis.tick_params("x", rotation=20)
        save_figure(figure, path)


def step_figures(env: HumanoidEnv) -> torch.Tensor:
    """What the last step was worth: the task's terms, unweighted, the shares of hands in each state, and the laws'
    alpha and stiffness, means over arms, (8, N)."""
    record, p = env.record, env.upper_body.parameters
    terms = [UpperRewards.TERMS[name].function(record) for name in PARTS]  # pyright: ignore[reportAttributeAccessIssue]
    states = (record.free_hands, record.loaded_hands, record.pushed_hands)
    shares = [hands.float().mean(1) for hands in states]
    return torch.stack((*terms, *shares, p.alpha.mean(1), p.stiffness.log().mean((1, 2)).exp()))


def task_measures(figures: torch.Tensor, alive: torch.Tensor) -> dict[str, torch.Tensor]:
    """Measures (N,) of figures (T, 8, N) as `step_figures` has them, over the steps that are `alive` (T, N).

    The return and its parts are per second. Errors and resistance are means over the hands and the time that they are
    of; NaN where there is none.
    """
    mean = [masked_mean(figure, alive) for figure in figures.unbind(1)]
    parts = {f"return_{name}": TASK_WEIGHTS[name] * value for name, value in zip(PARTS, mean[:3], strict=True)}
    when = {
        name: torch.where(share > 0.0, value / share, math.nan)
        for name, value, share in zip(PARTS, mean[:3], mean[3:6], strict=True)
    }
    return {"return": sum(parts.values(), torch.zeros(())), **parts, **when, "alpha": mean[6], "stiffness": mean[7]}
