"""What rewards must know of a robot, so that they fit any."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.compliance.dynamics import GRAVITY_M_S2
from cotap.robots import RobotSpec


@dataclass(frozen=True)
class RobotScales:
    """What rewards must know of a robot, so that they fit any. J joints of which L lower, U upper."""

    joint_low: torch.Tensor
    """(J,) soft lower limits [rad]."""
    joint_high: torch.Tensor
    """(J,) soft upper limits [rad]."""
    default_position: torch.Tensor
    """(J,) [rad]."""
    num_lower: int
    """L; the first L joints are the lower agent's."""
    hip_waist: tuple[int, ...]
    """Lower joints that straight walking does not need: those that do not pitch, ankles aside."""
    foot_clearance_m: float
    """Least height of the sole at mid-swing that is asked for: 0.07 of the torso's nominal height."""
    foot_distance_m: float
    """Sideways distance of the soles below which feet are too close: 0.45 of that in the default pose."""
    torso_ahead_m: float
    """How far ahead of the middle of the soles the torso's origin is when the robot stands in its default pose."""
    falling_time_s: float
    """Time constant of an inverted pendulum of nine tenths of the torso's nominal height."""

    @classmethod
    def of(cls, spec: RobotSpec) -> RobotScales:
        """The scales of a robot. Soft limits leave a twentieth of each joint's range."""
        joints, num_lower = spec.joints, len(spec.lower_joints)
        low, high = torch.tensor([j.range_rad for j in joints]).unbind(1)
        center, half = (low + high) / 2, 0.95 * (high - low) / 2
        ankles = {body.joint for foot in spec.feet for body in spec.bodies if body.name == foot.body}
        hip_waist = (i for i, j in enumerate(joints[:num_lower]) if j.name not in ankles and not spec.pitches(j.name))
        default = torch.tensor([j.default_rad for j in joints])
        clearance, distance = 0.07 * spec.nominal_height_m, 0.45 * spec.sole_distance_m
        low, high = center - half, center + half
        falling_time = math.sqrt(0.9 * spec.nominal_height_m / GRAVITY_M_S2)
        return cls(
            low, high, default, num_lower, tuple(hip_waist), clearance, distance, spec.torso_ahead_m, falling_time
        )
