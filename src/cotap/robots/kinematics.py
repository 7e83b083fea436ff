"""Where a robot's bodies are for given joint angles, in plain numpy."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from cotap.robots.spec import Quat, RobotSpec, Vec3


def default_angles(spec: RobotSpec) -> np.ndarray:
    """The default pose, (J,) [rad]."""
    return np.array([j.default_rad for j in spec.joints])


def body_frame(spec: RobotSpec, body: str, root: str, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) [m] and orientation (3, 3) of `body` in the frame of `root`, all joints at `angles` (J,) [rad].

    Raises:
        ValueError: `body` is not below `root`.
    """
    position, rotation = np.zeros(3), np.eye(3)
    for link in spec.chain(body, root):
        index = spec.indices([link.joint or ""])[0]
        position = position + rotation @ link.pos
        rotation = rotation @ _matrix(link.quat) @ _turn(spec.joints[index].axis, angles[index])
    return position, rotation


def _matrix(quat: Quat) -> np.ndarray:
    """The rotation matrix of a quaternion (w, x, y, z)."""
    w, *xyz = np.array(quat) / np.linalg.norm(quat)
    skew = _skew(np.array(xyz))
    return np.eye(3) + 2.0 * w * skew + 2.0 * skew @ skew


def _turn(axis: Vec3, angle: float) -> np.ndarray:
    """Rotation matrix of a turn by `angle` [rad] about `axis`, by Rodrigues' formula."""
    skew = _skew(np.array(axis) / np.linalg.norm(axis))
    return np.eye(3) + np.sin(angle) * skew + (1.0 - np.cos(angle)) * skew @ skew


def _skew(v: np.ndarray) -> np.ndarray:
    """The matrix that takes a vector to `v x` it."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
