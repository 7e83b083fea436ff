"""How hard a push robots survive: fall rate against impulse, and the impulse at which half of the robots fall."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cotap.checks import require_range
from cotap.envs import HumanoidEnv
from cotap.evaluation.disturbance import Impact
from cotap.evaluation.metrics import summarize
from cotap.evaluation.report import pyplot, save_figure
from cotap.evaluation.rollout import Trajectory


@dataclass
class FallCurve(Impact):
    """Fall rate against impulse, from nothing to --impulse, and the impulse at which half of the envs fall."""

    force: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Direction, heading frame. Its length does not count."""
    random_direction: bool = True
    """Turn the force randomly about the vertical."""
    duration: float = 0.1
    """How long the force lasts [s]."""
    impulse: float = 75.0
    """Largest impulse [N s]."""
    levels: int = 16
    """Number of impulses, from zero to the largest. Envs are dealt to them evenly."""
    window: tuple[float, float] = (0.0, 3.0)
    """Measured time, from the onset [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        if not any(self.force):
            raise ValueError(f"force must not be zero along all axes, got {self.force}")
        require_range("impulse", self.impulse, 1e-3, 1e5)
        require_range("levels", self.levels, 2, 1000)
        require_range("duration", self.duration, 1e-3, 100.0)
        if self.num_envs < self.levels:
            raise ValueError(f"num_envs must be at least levels ({self.levels}), got {self.num_envs}")

    def impulses(self) -> torch.Tensor:
        """(levels,) [N s]."""
        return torch.linspace(0.0, self.impulse, self.levels)

    def prepare(self, env: HumanoidEnv) -> None:
        """Give every env its push."""
        super().prepare(env)
        force = self.impulses()[self._level()] / (self.duration * math.hypot(*self.force))
        env.forces.scripted.amplitude_h = env.forces.scripted.amplitude_h * force[:, None, None].to(env.device)

    def _level(self) -> torch.Tensor:
        """(N,) which impulse each env takes."""
        return torch.arange(self.num_envs) % self.levels

    def measure(self, trajectory: Trajectory, env: HumanoidEnv) -> dict[str, Any]:
        """The measured part of the evaluation's JSON; envs that fell before the onset are left out of the curve."""
        common = super().measure(trajectory, env)
        t, onset = trajectory, round(self.onset / trajectory.dt)
        end = onset + round(self.fall_seconds / t.dt)
        stood, fell = ~t.fell[:onset].any(0), t.fell[onset:end].any(0)
        level = self._level()
        rates = [summarize(fell[stood & (level == k)], self.seed) for k in range(self.levels)]
        half = half_point(self.impulses(), level[stood], fell[stood], self.seed)
        return common | {
            "fall_curve": {"impulse": self.impulses().tolist(), "fall_rate": rates},
            "impulse_50": half,
        }

    def table(self, result: dict[str, Any]) -> str:
        """Measures, then fall rates by impulse, as Markdown."""
        lines = ["| impulse [N s] | fall rate | 95 % interval |", "|---|---|---|"]
        for x, rate, low, high in curve_points(result):
            lines.append(f"| {x:g} | {rate:.1%} | {low:.1%} to {high:.1%} |")
        half = result["impulse_50"]
        found = half["reason"] if half["mean"] is None else f"half fall at {half['mean']:.1f} N s"
        return "\n".join([*lines, "", super().table(result), "", found])

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Fall rate with its interval against impulse."""
        plt = pyplot()

        figure, axis = plt.subplots(figsize=(5.2, 3.8), constrained_layout=True)
        draw_fall_curve(axis, result, "#2171b5", result["method"])
        axis.set(xlabel="impulse [N s]", ylabel="share of envs that fell", ylim=(-0.02, 1.02))
        axis.grid(alpha=0.2)
        axis.legend(frameon=False)
        save_figure(figure, path)


def curve_points(result: dict[str, Any]) -> list[tuple[float, float, float, float]]:
    """Impulse [N s], fall rate and its interval, wherever an env was left to fall."""
    found = zip(result["fall_curve"]["impulse"], result["fall_curve"]["fall_rate"], strict=True)
    return [(x, r["mean"], *r["ci95"]) for x, r in found if r["mean"] is not None]


def draw_fall_curve(axis: Any, result: dict[str, Any], color: str, label: str) -> None:
    """Add one result's curve to a matplotlib axis."""
    if not (points := curve_points(result)):
        return
    x, mean, low, high = zip(*points, strict=True)
    axis.plot(x, mean, "o-", color=color, ms=3, label=label)
    axis.fill_between(x, low, high, color=color, alpha=0.2, lw=0)


def half_point(
    impulse: torch.Tensor, level: torch.Tensor, fell: torch.Tensor, seed: int = 0, resamples: int = 500
) -> dict[str, Any]:
    """Impulse at which half of the robots fall, with a bootstrap 95 % interval over envs.

    The fall rate is taken to grow with the impulse (isotonic regression) and to be linear between levels.

    Args:
        impulse: (L,) ascending [N s].
        level: (N,) which of them each env took.
        fell: (N,) bool.
        seed: Of the bootstrap.
        resamples: Of the bootstrap.
    """
    if not len(level):
        return {"mean": None, "ci95": None, "reason": "no env stood until the push"}
    found = _crossing(impulse, level, fell)
    if math.isinf(found):
        beyond = f"fewer than half fall at {float(impulse[-1]):g} N s"
        return {"mean": None, "ci95": None, "reason": beyond if found > 0.0 else "half or more fall without a push"}
    rng = torch.Generator().manual_seed(seed)
    n = len(level)
    draws = (torch.randint(0, n, (n,), generator=rng) for _ in range(resamples))
    crossings = sorted(_crossing(impulse, level[d], fell[d]) for d in draws)
    low, high = (crossings[k] for k in (math.floor(0.025 * (resamples - 1)), math.ceil(0.975 * (resamples - 1))))
    if math.isinf(low) or math.isinf(high):
        return {"mean": found, "ci95": None, "reason": "the interval reaches beyond the impulses that were tried"}
    return {"mean": found, "ci95": [low, high]}


def _crossing(impulse: torch.Tensor, level: torch.Tensor, fell: torch.Tensor) -> float:
    """Where half fall; minus infinity where they do at the least impulse, infinity where they do at none."""
    count = torch.bincount(level, minlength=len(impulse))
    seen = count > 0
    rate = torch.bincount(level, fell.double(), minlength=len(impulse))[seen] / count[seen]
    from scipy.optimize import isotonic_regression  # half a second, which no other protocol needs

    x, y = impulse[seen].double(), torch.from_numpy(isotonic_regression(rate.numpy(), weights=count[seen].numpy()).x)
    above = (y >= 0.5).nonzero().flatten()
    i = int(above[0]) if len(above) else len(y)
    if i in (0, len(y)):
        return -math.inf if i == 0 else math.inf
    return float(x[i - 1] + (0.5 - y[i - 1]) / (y[i] - y[i - 1]) * (x[i] - x[i - 1]))
