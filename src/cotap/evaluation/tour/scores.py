"""What a run of the tour is worth, from what happens at every control step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from cotap.evaluation.metrics import outcome, summarize


@dataclass(frozen=True)
class TourMeasures:
    """N runs."""

    survival_s: torch.Tensor
    """(N,) time on the feet [s]."""
    completed: torch.Tensor
    """(N,) bool: never fell."""
    position_error: torch.Tensor
    """(N, W) distance of the pelvis from the waypoint at each segment's end, or at the fall [m]; NaN after that."""
    yaw_error: torch.Tensor
    """(N, W) [rad]; the same."""
    energy: torch.Tensor
    """(N,) work of all joints, `sum |torque x rate| dt` [J]."""
    vibration: torch.Tensor
    """(N,) total variation of all joints' accelerations from one control step to the next [rad/s^2]."""

    @staticmethod
    def join(parts: list[TourMeasures]) -> TourMeasures:
        """All runs of several."""
        names = TourMeasures.__dataclass_fields__
        return TourMeasures(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})

    def report(self, segment_s: float, dt: float, seed: int, per_env: bool = False) -> dict[str, Any]:
        """The measured part of the evaluation's JSON. Errors are means over all waypoints of all runs; energy and
        vibration are of runs that were completed. `per_env` adds what a run has one figure of."""
        steps = round(segment_s * self.position_error.shape[1] / dt)
        time = dt * torch.arange(1, steps + 1)
        upright = (self.survival_s > time.unsqueeze(1) + 0.5 * dt) | self.completed
        nothing = torch.full_like(self.survival_s, math.nan)
        measures = {
            "survival_s": self.survival_s,
            "completed_fraction": self.completed,
            "position_error": self.position_error,
            "yaw_error": self.yaw_error,
            "energy": torch.where(self.completed, self.energy, nothing),
            "vibration": torch.where(self.completed, self.vibration, nothing),
        }
        ends = [
            {"end_s": segment_s * (k + 1)}
            | {name: summarize(getattr(self, name)[:, k], seed) for name in ("position_error", "yaw_error")}
            for k in range(self.position_error.shape[1])
        ]
        return {
            "num_falls": int((~self.completed).sum()),
            **outcome(measures, self.completed, seed, per_env),
            "window": {"start": 0.0, "end": segment_s * len(ends)},
            "segments": ends,
            "curve": {"time": time.tolist(), "upright": upright.float().mean(1).tolist()},
        }


class TourScorer:
    """Adds up the measures of N runs, step by step; what follows a fall does not count.

    Args:
        num_runs: N.
        num_joints: J.
        segments: W.
        segment_steps: Control steps in a segment.
        dt: Control step [s].
        fallen_height_m: A pelvis lower than this has fallen.
        device: Where the runs are.
    """

    def __init__(
        self, num_runs: int, num_joints: int, segments: int, segment_steps: int, dt: float, fallen_height_m: float,
        device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        self._segment_steps, self._dt, self._fallen_m = segment_steps, dt, fallen_height_m
        self.standing = torch.ones(num_runs, dtype=torch.bool, device=device)
        """(N,) who has not fallen."""
        self._survived, self._energy, self._vibration = (torch.zeros(num_runs, device=device) for _ in range(3))
        self._rate, self._acceleration = torch.zeros(2, num_runs, num_joints, device=device)
        self._position_error, self._yaw_error = torch.full((2, num_runs, segments), math.nan, device=device)
        self._steps = 0

    def step(
        self, height: torch.Tensor, rate: torch.Tensor, torque: torch.Tensor, way: torch.Tensor, turn: torch.Tensor,
        broken: torch.Tensor,
    ) -> None:  # fmt: skip
        """Take in a control step.

        Args:
            height: (N,) of the pelvis at its end [m].
            rate: (N, J) joint rates [rad/s].
            torque: (N, J) [Nm].
            way: (N, 2) from the pelvis to the waypoint of the segment [m].
            turn: (N,) yaw error [rad].
            broken: (N,) bool: the simulation has diverged; that is a fall.
        """
        segment = self._steps // self._segment_steps
        known = self.standing & ~broken  # until the fall: the last one is that of the segment's end, or of the fall
        for errors, error in ((self._position_error, way.norm(dim=1)), (self._yaw_error, turn.abs())):
            errors[:, segment] = torch.where(known, error, errors[:, segment])
        self._survived = self._survived + self.standing  # steps
        self.standing = self.standing & (height >= self._fallen_m) & ~broken
        acceleration = (rate - self._rate) / self._dt
        work = self._dt * (torque * rate).abs().sum(1)
        if self._steps >= 2:  # the acceleration before is known
            shaken = (acceleration - self._acceleration).abs().sum(1)
            self._vibration = self._vibration + torch.where(self.standing, shaken, 0.0)
        self._energy = self._energy + torch.where(self.standing, work, 0.0)
        self._rate, self._acceleration = rate.clone(), acceleration
        self._steps += 1

    def measures(self) -> TourMeasures:
        """Of all steps so far, on the CPU."""
        errors = self._position_error, self._yaw_error
        values = (self._dt * self._survived, self.standing, *errors, self._energy, self._vibration)
        return TourMeasures(*(value.cpu() for value in values))
