"""Hands under a slowly swinging load, each arm under a law of its own, beside what statics asks for (paper, Fig. 7)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch

from cotap.checks import require_finite, require_range
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.evaluation.disturbance import falls_by_time, window_measures
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.metrics import outcome
from cotap.evaluation.report import pyplot, save_figure
from cotap.evaluation.rollout import Trajectory
from cotap.evaluation.scenario import Scenario
from cotap.motions.elbow import elbow_index
from cotap.robots import RobotSpec


@dataclass
class PeriodicLoad(Scenario):
    """A load on both hands that swings, 30 N up and down in 4 s: torques of each arm beside what statics asks for.

    A policy that was trained under PD has its left arm compliant and the right one under PD, unless laws are named.
    """

    laws: ClassVar[LawOptions] = LawOptions(left="cotap:alpha=0.7,stiffness=500", right="pd")

    force: tuple[float, float, float] = (0.0, 0.0, 30.0)
    """Amplitude along x, y, z of the heading frame [N]."""
    hand: str = "both"
    """left, right or both."""
    period: float = 4.0
    """Period of the load [s]."""
    periods: int = 3
    """Number of periods. All but the first are measured."""
    onset: float = 1.0
    """When the load begins [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        for i, value in enumerate(self.force):
            require_finite(f"force[{i}]", value)
        require_range("period", self.period, 0.2, 600.0)
        require_range("periods", self.periods, 2, 1000)
        require_range("onset", self.onset, 0.02, 3600.0)

    @property
    def seconds(self) -> float:
        """Length of the evaluation [s]."""
        return self.onset + self.periods * self.period

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        env_cfg.forces.scripted = ForceProfile(self.force, self.hand, self.onset, self.seconds, self.period)
        return env_cfg

    def measured_steps(self, dt: float) -> range:
        """Control steps of all periods but the first."""
        return range(*(round(s / dt) for s in (self.onset + self.period, self.seconds)))

    def before_step(self, env: HumanoidEnv, step: int) -> None:
        """Follow the arms through these steps."""
        self.watch.see(env, step, self.measured_steps(env.dt))

    def measure(self, trajectory: Trajectory, env: HumanoidEnv) -> dict[str, Any]:
        """The measured part of the evaluation's JSON, the number of falls aside."""
        t = trajectory
        measured = self.measured_steps(t.dt)
        begin, end = measured.start, measured.stop
        elbows, sides = elbow_joints(env.spec), [arm.side for arm in env.spec.arms]
        hit = [i for i, side in enumerate(sides) if self.hand in (side, "both")]
        measures = window_measures(t, begin, end, hit) | swing_measures(t, begin, end, self.period, elbows, sides)
        for i, side in enumerate(sides):
            measures |= self.watch.measures(t.alive()[begin:end], [i], f"_{side}")
        return {
            "falls": falls_by_time(t, round(self.onset / t.dt), end),
            **outcome(measures, ~t.fell.any(0), self.seed, self.per_env),
            "window": {"start": self.onset + self.period, "end": self.seconds},
            "curve": swing_curve(t, round(self.onset / t.dt), elbows, sides),
        }

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Elbow torques with the static prediction, and the hands' height, over time."""
        plt = pyplot()

        curves, law = result["curve"], result["settings"]["env"]["upper_body"]
        figure, (torque, height) = plt.subplots(1, 2, figsize=(10.5, 3.6), constrained_layout=True)
        for side, color, width in (("left", "#6baed6", 3.5), ("right", "#cb181d", 1.2)):
            if not curves["time"]:
                break
            label = f"{side}: {law[side]['name']}"
            torque.plot(curves["time"], curves[f"elbow_{side}"], color=color, lw=width, label=label)
            torque.plot(curves["time"], curves[f"elbow_static_{side}"], color="0.2", ls=":", lw=0.5 * width,
                        label=f"{side}: statics")  # fmt: skip
            height.plot(curves["time"], curves[f"hand_z_{side}"], color=color, lw=width, label=label)
        torque.set(xlabel="time since the load set in [s]", ylabel="elbow torque [Nm]")
        height.set(xlabel="time since the load set in [s]", ylabel="hand height less reference [m]")
        for axis in (torque, height):
            axis.grid(alpha=0.2)
            if curves["time"]:
                axis.legend(frameon=False, fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        save_figure(figure, path)


def elbow_joints(spec: RobotSpec) -> list[int]:
    """Each arm's elbow among the arm joints (U)."""
    return [i * len(arm.joints) + elbow_index(spec, arm) for i, arm in enumerate(spec.arms)]


def swing_measures(
    t: Trajectory, begin: int, end: int, period_s: float, elbows: list[int], sides: list[str]
) -> dict[str, torch.Tensor]:
    """How far elbow torques and hands swing from step `begin` to before `end`, whole periods; per env, (N,) each.

    Amplitudes are those of the load's frequency (least squares); `rms` and `peak` are of everything. `_static_` is the
    same of `arm_static_torque`: gravity and the load, whatever the law. NaN for envs that fall before the end.
    """
    upright = t.alive()[end - 1]
    arms = t.arm_torque.shape[2] // len(sides)
    out: dict[str, torch.Tensor] = {}
    for i, (side, elbow) in enumerate(zip(sides, elbows, strict=True)):
        for kind, torque in (("", t.arm_torque), ("static_", t.arm_static_torque)):
            part = torque[begin:end]
            arm = part[..., i * arms : (i + 1) * arms]
            out[f"elbow_amplitude_{kind}{side}"] = amplitude(part[..., elbow], period_s, t.dt)
            out[f"elbow_rms_{kind}{side}"] = part[..., elbow].square().mean(0).sqrt()
            out[f"elbow_peak_{kind}{side}"] = part[..., elbow].abs().amax(0)
            out[f"arm_rms_{kind}{side}"] = arm.square().sum(2).mean(0).sqrt()
        power = (t.arm_torque * t.arm_velocity)[begin:end, :, i * arms : (i + 1) * arms].abs().sum((0, 2))
        out[f"energy_{side}"] = power * t.dt
        out[f"hand_swing_{side}"] = amplitude(t.hand_offset[begin:end, :, i, 2], period_s, t.dt)
    for name in ("elbow_amplitude", "elbow_rms", "arm_rms"):
        for kind in ("", "static_"):
            left, right = (out[f"{name}_{kind}{side}"] for side in sides)
            out[f"{name}_{kind}ratio"] = left / right
    return {name: torch.where(upright, value, torch.full_like(value, math.nan)) for name, value in out.items()}


def amplitude(values: torch.Tensor, period_s: float, dt: float) -> torch.Tensor:
    """Amplitude (N,) of the part of `values` (T, N) that swings with this period, beside offset and drift, by least
    squares."""
    angle = 2.0 * math.pi * dt / period_s * torch.arange(values.shape[0])
    basis = torch.stack((torch.ones_like(angle), angle, angle.sin(), angle.cos()), 1)
    # In double precision, for how lstsq rounds differs from run to run.
    solution = torch.linalg.lstsq(basis.double(), values.double()).solution
    return solution[2:].norm(dim=0).to(values.dtype)


def swing_curve(t: Trajectory, onset: int, elbows: list[int], sides: list[str]) -> dict[str, list[float]]:
    """Means over the envs that stood, over time from the onset."""
    stood = ~t.fell.any(0)
    if not stood.any():
        return {"time": []}
    rows = {"time": (torch.arange(onset, len(t.fell)) - onset + 1) * t.dt}
    for i, (side, elbow) in enumerate(zip(sides, elbows, strict=True)):
        rows[f"elbow_{side}"] = t.arm_torque[onset:, stood, elbow].mean(1)
        rows[f"elbow_static_{side}"] = t.arm_static_torque[onset:, stood, elbow].mean(1)
        rows[f"hand_z_{side}"] = t.hand_offset[onset:, stood, i, 2].mean(1)
    return {name: values.tolist() for name, values in rows.items()}
