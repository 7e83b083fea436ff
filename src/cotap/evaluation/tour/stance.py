"""How a robot begins the tour: its stance, the heights that belong to it, and the gains of its arms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from cotap.robots import RobotSpec, g1
from cotap.robots.kinematics import body_frame

# Parts of the names of the left joints, and angles [rad]; of several that fit the longest counts.
_ANGLES = {
    "hip_pitch": -0.312, "knee": 0.669, "ankle": -0.363, "ankle_roll": 0.0,
    "shoulder_pitch": 0.2, "shoulder_roll": 0.2, "elbow": 0.6,
}  # fmt: skip
# Gains of the arms are made of what a joint feels of its rotor.
_NATURAL_RAD_S = 2.0 * math.pi * 10.0
_DAMPING_RATIO = 2.0
# The G1's heights [m]; those of other robots are as many times larger as they stand higher in the stance.
_CRANE_M = 0.793
_FALLEN_M = 0.20
_CHIN_M = 0.10


@dataclass(frozen=True)
class TourStance:
    """J joints, in the robot's order; U of the arms."""

    angles: torch.Tensor
    """(J,) [rad]."""
    crane_height_m: float
    """Height of the base at which a crane lets go."""
    fallen_height_m: float
    """A base lower than this has fallen."""
    chin_height_m: float
    """Height of the chin above the torso link's origin."""
    arm_kp: torch.Tensor
    """(U,) position gains of arms that no law drives [Nm/rad]."""
    arm_kd: torch.Tensor
    """(U,) their damping gains [Nms/rad]."""

    def start(self) -> torch.Tensor:
        """`qpos` (7 + J,) in which a crane lets go, at rest.

        The published crane resets the pelvis before every physics step: nothing but its motors acts on a joint then, so
        that after any time under it all joints are where they began.
        """
        return torch.cat((torch.tensor([0.0, 0.0, self.crane_height_m, 1.0, 0.0, 0.0, 0.0]), self.angles))


def tour_stance(spec: RobotSpec) -> TourStance:
    """The published stance, heights and gains for the G1; for others the same angles and rule of gains, and heights to
    scale.

    A chin lies 0.10 m, to scale, above the first joint of the arms.
    """
    angles = _angles(spec)
    scale = _standing_height_m(spec, angles) / _standing_height_m(g1(), _angles(g1()))
    shoulder, _ = body_frame(spec, spec.chain(spec.arms[0].hand_body, spec.torso_body)[0].name, spec.torso_body, angles)
    arms = spec.upper_joint_specs
    inertia = torch.tensor([j.armature_kg_m2 for j in arms])
    kp, kd = inertia * _NATURAL_RAD_S**2, 2.0 * _DAMPING_RATIO * inertia * _NATURAL_RAD_S
    return TourStance(
        torch.tensor(angles, dtype=torch.float32), scale * _CRANE_M, scale * _FALLEN_M,
        float(shoulder[2]) + scale * _CHIN_M, kp, kd,
    )  # fmt: skip


def _longest(name: str, parts: dict[str, float]) -> str:
    """The longest of `parts` that is in `name`; empty if none is."""
    return max((part for part in parts if part in name), key=len, default="")


def _angles(spec: RobotSpec) -> np.ndarray:
    """(J,) [rad]; joints that no part names are at their default."""
    out = np.array([_ANGLES.get(_longest(j.name, _ANGLES), j.default_rad) for j in spec.joints])
    for i, joint in enumerate(spec.joints):
        mirror = spec.indices([joint.mirror_name])[0]
        if mirror < i:  # of a pair the left joint comes first
            out[i] = joint.mirror_sign * out[mirror]
    return out


def _standing_height_m(spec: RobotSpec, angles: np.ndarray) -> float:
    """Height of the base above the lower sole."""
    soles = []
    for foot in spec.feet:
        position, rotation = body_frame(spec, foot.body, spec.base_body, angles)
        soles.append((position + rotation @ foot.sole)[2])
    return -float(min(soles))
