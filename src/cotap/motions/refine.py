"""Passages that are too fast for the robot's joints, replaced by slower ones that bring hands and elbows as close.

Near the shoulder's singularity a closed form turns joints fast for little motion of the arm. Over a whole clip at once,
joints are moved so that hands and elbows stay where they were while no joint exceeds its speed.
"""

from __future__ import annotations

import numpy as np
import torch

from cotap.motions.elbow import elbow_index
from cotap.motions.library import FPS
from cotap.robots import RobotSpec
from cotap.robots.chains import arm_chains

_ITERATIONS = 400
_STEP_RAD = 0.02
_SPEED_WEIGHT = 2.0
_ELBOW_WEIGHT = 0.5
_FLEXION_WEIGHT = 0.2
"""Of the elbows' own angles, [m^2/rad^2]: a passage at the shoulder is not paid for with a bent arm."""
_MARGIN = 0.97
"""Share of the speed limit aimed at, so that little is left to be cut off."""


def slow_down(spec: RobotSpec, arms: np.ndarray) -> np.ndarray:
    """Joints (T, U) near `arms` (T, U), both at 50 Hz, within position limits and nearly within velocity limits."""
    joints = spec.upper_joint_specs
    low, high = torch.tensor([j.range_rad for j in joints], dtype=torch.float32).unbind(1)
    largest = _MARGIN / FPS * torch.tensor([j.velocity_limit_rad_s for j in joints], dtype=torch.float32)
    chains = arm_chains(spec)
    each, elbows = range(len(spec.arms)), [elbow_index(spec, arm) for arm in spec.arms]

    def points(q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        pose = chains.pose(q.unflatten(1, (len(spec.arms), -1)))
        return pose.tip, pose.anchors[:, each, elbows]

    def flexions(q: torch.Tensor) -> torch.Tensor:
        return q.unflatten(1, (len(spec.arms), -1))[:, each, elbows]

    start = torch.as_tensor(arms, dtype=torch.float32)
    hand, elbow = points(start)
    q = start.clone().requires_grad_(True)
    optimizer = torch.optim.Adam([q], lr=_STEP_RAD)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _ITERATIONS, 0.05 * _STEP_RAD)
    for _ in range(_ITERATIONS):
        optimizer.zero_grad()
        new_hand, new_elbow = points(q)
        step = q.diff(dim=0)
        error = (new_hand - hand).square().sum() + _ELBOW_WEIGHT * (new_elbow - elbow).square().sum()
        error = error + _FLEXION_WEIGHT * flexions(q - start).square().sum()
        (error + _SPEED_WEIGHT * (step.abs() - largest).clamp_min(0.0).square().sum()).backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            q.clamp_(low, high)
    return q.detach().double().numpy()
