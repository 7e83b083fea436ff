"""Arms in nobody's way: a reference that would put a hand into the robot's own legs goes outward instead."""

from __future__ import annotations

import torch

from cotap.robots import RobotSpec
from cotap.robots.chains import arm_chains

RAMP_M = 0.08
"""Hands are led outward over this depth below the legs' top [m]."""
ITERATIONS = 2
"""Newton steps; the second takes out what the first leaves by the arm's curvature."""


class LegClearance:
    """Moves reference poses, by the least change of joint angles, so that low hands are beside the legs.

    Legs are taken to be anywhere below `RobotSpec.legs_below_m` and within `RobotSpec.legs_within_m` of the middle,
    whatever they do at the moment, so a reference stays a function of time alone. [ours]
    """

    def __init__(self, spec: RobotSpec) -> None:
        self._chains = arm_chains(spec)
        self._below, self._within = spec.legs_below_m, spec.legs_within_m
        defaults = torch.tensor([[spec.joints[i].default_rad for i in spec.indices(a.joints)] for a in spec.arms])
        self._outward = self._chains.pose(defaults.unsqueeze(0)).tip[0, :, 1].sign()

    def __call__(self, position: torch.Tensor) -> torch.Tensor:
        """Joint angles (N, U) [rad] near `position`; unchanged where hands are clear. Joint limits are not kept."""
        q = position.unflatten(1, (len(self._outward), -1))
        for _ in range(ITERATIONS):
            pose = self._chains.pose(q)
            depth = ((self._below - pose.tip[..., 2]) / RAMP_M).clamp(0.0, 1.0)
            missing = depth * (self._within - self._outward * pose.tip[..., 1]).clamp_min(0.0)
            if not missing.any():  # most often so where few worlds restart
                break
            arm = pose.tip.unsqueeze(2) - pose.anchors
            sideways = pose.axes[..., 2] * arm[..., 0] - pose.axes[..., 0] * arm[..., 2]  # [m/rad]
            # What little is added keeps an arm that cannot move its hand sideways from turning over.
            share = self._outward * missing / (sideways.square().sum(-1) + 1e-3)
            q = q + share.unsqueeze(-1) * sideways
        return q.flatten(1)
