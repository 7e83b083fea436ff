"""A random walk of the arms in joint space, the right one the mirror image of the left."""

from __future__ import annotations

import numpy as np
import torch

from cotap.evaluation.tour.stance import TourStance
from cotap.robots import RobotSpec
from cotap.robots.chains import arm_chains

INTERVAL_S = 0.5
"""Time from one target to the next, which is approached linearly [s]."""
STEPS = 25
"""Steps of the walk from one target to the next."""
STEP_RAD = 0.06
"""Largest step of a joint [rad]."""
DRAWS = 8
"""Walks that are tried before a target is kept."""


class ArmWalk:
    """Draws targets that keep hands in front of where they are in the stance, and below the chin.

    Args:
        spec: The robot.
        stance: How it begins.
    """

    def __init__(self, spec: RobotSpec, stance: TourStance) -> None:
        left = [spec.joint(name) for name in spec.arms[0].joints]
        self._low, self._high = torch.tensor([j.range_rad for j in left], dtype=torch.float64).unbind(1)
        self._start = stance.angles[spec.indices(spec.arms[0].joints)].double()
        self._chains, self._arms = arm_chains(spec, torch.float64), len(spec.arms)
        names = spec.arms[0].joints
        upper = spec.upper_joint_specs
        own = [j.name if j.name in names else j.mirror_name for j in upper]
        self._source = torch.tensor([names.index(name) for name in own])
        self._sign = torch.tensor([1.0 if j.name in names else j.mirror_sign for j in upper], dtype=torch.float64)
        self._chin_m = stance.chin_height_m
        self._front_m = float(self._hands(self._start)[:, 0].min())

    def both(self, left: torch.Tensor) -> torch.Tensor:
        """Joints of all arms (..., U) for those of the left (..., n) [rad]."""
        return left[..., self._source] * self._sign

    def allowed(self, left: torch.Tensor) -> torch.Tensor:
        """Which poses (..., n) of the left arm leave no hand behind its place in the stance, or above the chin."""
        hands = self._hands(left)
        return ((hands[..., 0] >= self._front_m - 1e-9) & (hands[..., 2] <= self._chin_m)).all(-1)

    def draw(self, count: int, rngs: list[np.random.Generator]) -> torch.Tensor:
        """Targets (N, count + 1, U) [rad] of N runs, one after the other, from the stance on."""
        present = self._start.expand(len(rngs), -1)
        targets = [present]
        for _ in range(count):
            shape = (DRAWS, STEPS, len(self._start))
            steps = torch.from_numpy(np.stack([rng.uniform(-STEP_RAD, STEP_RAD, shape) for rng in rngs]))
            present = self._next(present, steps)
            targets.append(present)
        return self.both(torch.stack(targets, 1)).float()

    def _next(self, present: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
        """From (N, n), the end of the first walk of `steps` (N, draws, steps, n) that is allowed, or where it was."""
        ends = present.unsqueeze(1).expand(-1, steps.shape[1], -1)
        for step in steps.unbind(2):
            ends = torch.minimum(torch.maximum(ends + step, self._low), self._high)
        allowed = self.allowed(ends)
        first = ends[torch.arange(len(ends)), allowed.long().argmax(1)]
        return torch.where(allowed.any(1, keepdim=True), first, present)

    def _hands(self, left: torch.Tensor) -> torch.Tensor:
        """Hand points (..., A, 3) in the torso frame [m]."""
        joints = self.both(left).unflatten(-1, (self._arms, -1))
        return self._chains.pose(joints.reshape(-1, *joints.shape[-2:])).tip.reshape(*left.shape[:-1], self._arms, 3)


def arms_at(targets: torch.Tensor, time_s: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions [rad] and velocities [rad/s], (N, U) each, at a time on the way along targets (N, K + 1, U)."""
    phase = min(time_s / INTERVAL_S, targets.shape[1] - 1.0)
    # The velocity at a target is that of the way to it.
    index = max(int(np.ceil(phase - 1e-6)) - 1, 0)
    before, after = targets[:, index], targets[:, index + 1]
    return torch.lerp(before, after, phase - index), (after - before) / INTERVAL_S
