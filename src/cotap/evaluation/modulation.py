"""Stiffness and blend stepped and ramped over their whole range, while the robot walks or bears a load."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch

from cotap.checks import require_interval, require_one_of, require_range
from cotap.compliance.laws import WITHOUT_STIFFNESS, reads
from cotap.envs import HumanoidEnv
from cotap.evaluation.disturbance import ConstantLoad, window_measures
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.metrics import outcome, summaries
from cotap.evaluation.report import pyplot, save_figure
from cotap.evaluation.rollout import Trajectory
from cotap.evaluation.stores import StoreRecord, curve
from cotap.evaluation.stores import measures as store_measures

CHANGES = ("step", "ramp", "both")


@dataclass
class Modulation(ConstantLoad):
    """Stiffness and alpha stepped and ramped over their whole range, each env and arm in its own time: falls, torque,
    energy."""

    laws: ClassVar[LawOptions] = LawOptions(method="cotap")
    drives: ClassVar[dict[str, str]] = {"stiffness": "--stiffness-range", "alpha": "--alpha-range"}

    change: str = "both"
    """step, ramp or both. step goes from one end to the other at once, ramp there and back evenly; both gives every
    other env one of them."""
    stiffness_range: tuple[float, float] = (80.0, 1200.0)
    """Softest and stiffest hand [N/m]. All axes are alike; a ramp is even in the logarithm."""
    alpha_range: tuple[float, float] = (0.0, 1.0)
    """Least and largest share of compliance."""
    period: float = 1.0
    """Time from one end of the stiffness and back [s]. Alpha takes the golden ratio of it, so that all pairs occur."""
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Load that is held, heading frame [N]. Zero for none."""
    window: tuple[float, float] = (0.0, 9.0)
    """Measured time, from the onset [s]."""
    fall_seconds: float = 9.0
    """Falls count for this long from the onset [s]."""
    episode_seconds: float = 10.0
    """Length of the evaluation [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        require_one_of("change", self.change, CHANGES)
        require_interval("stiffness_range", self.stiffness_range)
        require_range("stiffness_range[0]", self.stiffness_range[0], 1.0, 1e5)
        require_range("stiffness_range[1]", self.stiffness_range[1], 1.0, 1e5)
        require_interval("alpha_range", self.alpha_range)
        for i, value in enumerate(self.alpha_range):
            require_range(f"alpha_range[{i}]", value, 0.0, 1.0)
        require_range("period", self.period, 0.04, 3600.0)

    def prepare(self, env: HumanoidEnv) -> None:
        """Draw where in the cycle every env and arm begins."""
        super().prepare(env)
        laws = [env.cfg.upper_body.of(arm.side).name for arm in env.spec.arms]
        if all(law in WITHOUT_STIFFNESS for law in laws):
            raise ValueError(f"modulation needs a law with a stiffness, such as --method cotap; got {', '.join(laws)}")
        if not any(reads(law, "alpha") for law in laws):
            self.require_default("alpha_range", f"under {', '.join(laws)}")
        rng = torch.Generator().manual_seed(self.seed)
        self.phase = torch.rand(env.num_envs, len(env.spec.arms), 2, generator=rng).to(env.device)
        self.stores, self.commands = StoreRecord(), []

    def before_step(self, env: HumanoidEnv, step: int) -> None:
        """Set stiffness and alpha of this step."""
        if step:
            self.stores.add(env)
        pace = torch.tensor([1.0, 2.0 / (1.0 + math.sqrt(5.0))], device=env.device)
        cycles = step * env.dt / self.period * pace + self.phase
        stepped = {"step": True, "ramp": False}.get(self.change)
        number = torch.arange(env.num_envs, device=env.device)
        mask = number % 2 == 0 if stepped is None else torch.full_like(number, stepped, dtype=torch.bool)
        stiffness, alpha = sweep(cycles, mask[:, None, None]).unbind(2)
        low, high = (math.log(bound) for bound in self.stiffness_range)
        p = env.upper_body.parameters
        p.stiffness[:] = (low + (high - low) * stiffness).exp().unsqueeze(2)
        p.alpha[:] = self.alpha_range[0] + (self.alpha_range[1] - self.alpha_range[0]) * alpha
        self.commands.append(torch.cat((p.stiffness, p.alpha.unsqueeze(2)), 2).cpu())

    def measure(self, trajectory: Trajectory, env: HumanoidEnv) -> dict[str, Any]:
        """The measured part of the evaluation's JSON; with both kinds of change, also of each by itself."""
        result = super().measure(trajectory, env) | {
            "effective_stiffness": {"commanded": None, "measured": None, "reason": "stiffness changes all the time"}
        }
        # Nor is there one stiffness to err from, or a rest to overshoot.
        for part in ("metrics", "metrics_without_falls", "per_env"):
            for name in ("impedance_error", "load_overshoot"):
                result.get(part, {}).pop(name, None)
        steps = torch.full((env.num_envs,), self.change == "step")
        if self.change == "both":
            steps = torch.arange(env.num_envs) % 2 == 0
        self.stores.add(env)
        if self.stores.level:
            self._measure_stores(result, trajectory, steps)
        if self.change == "both":
            onset = round(self.onset / trajectory.dt)
            begin, end = (onset + round(bound / trajectory.dt) for bound in self.window)
            measures = window_measures(trajectory, begin, end, self.hit(env))
            result["by_change"] = {
                name: summaries(measures, mask, self.seed) for name, mask in (("step", steps), ("ramp", ~steps))
            }
        return result

    def _measure_stores(self, result: dict[str, Any], trajectory: Trajectory, stepped: torch.Tensor) -> None:
        """Add what the arms' energy stores did, and the delay of steps in the envs of `stepped` (N,)."""
        dt, commands = trajectory.dt, torch.stack(self.commands)
        changed = torch.zeros(commands.shape[:3], dtype=torch.bool)
        changed[1:] = (commands[1:] != commands[:-1]).any(-1) & stepped.unsqueeze(-1)
        begin, end = (round((self.onset + bound) / dt) for bound in self.window)
        counted = trajectory.alive()
        counted[:begin], counted[end:] = False, False
        found, more = store_measures(self.stores, changed, counted, dt)
        for part, figures in outcome(found, ~trajectory.fell.any(0), self.seed, self.per_env).items():
            result[part] |= figures
        result["reaching"] = curve(
            self.stores, changed | ~counted.unsqueeze(-1), more, dt, self.period / 2.0, self.seed
        )

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """With an energy store, the stiffness asked for and in force since a step to more; else as a load's."""
        curves = result.get("reaching")
        if not curves or not curves["time"]:
            super().plot(path, result)
            return
        figure, (stiffness, share) = pyplot().subplots(1, 2, figsize=(9.5, 3.4), constrained_layout=True)
        stiffness.plot(curves["time"], curves["asked"], color="0.6", label="asked for")
        stiffness.plot(curves["time"], curves["in_force"], color="#2171b5", label="in force")
        stiffness.set(ylabel="mean joint stiffness [Nm/rad]", ylim=(0.0, None))
        stiffness.legend(frameon=False)
        low, high = zip(*curves["ci95"], strict=True)
        share.fill_between(curves["time"], low, high, color="#2171b5", alpha=0.3, lw=0.0)
        share.plot(curves["time"], curves["ratio"], color="#2171b5", label="in force over asked for")
        share.axhline(1.0, color="0.6", lw=0.8)
        share.plot(curves["time"], curves["store_energy"], color="#238b45", label="store [J]")
        share.set(ylim=(0.0, None))
        share.legend(frameon=False)
        for axis in (stiffness, share):
            axis.set(xlabel="time since more was asked for [s]")
            axis.grid(alpha=0.2)
        figure.suptitle(f"{result['protocol']}, {self.mode}, {result['method']}")
        save_figure(figure, path)


def sweep(cycles: torch.Tensor, stepped: torch.Tensor) -> torch.Tensor:
    """Between 0 and 1 and back once a cycle: at once where `stepped`, else evenly."""
    phase = cycles.remainder(1.0)
    triangle = 1.0 - (2.0 * phase - 1.0).abs()
    return torch.where(stepped, (phase >= 0.5).float(), triangle)
