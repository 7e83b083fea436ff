"""Rotations of motion files: quaternions in either order, axis-angle, headings; all for whole clips at once."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From x forward, y up, z right to x forward, y left, z up."""


def from_wxyz(quaternions: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of quaternions (T, 4), scalar first. Raises ValueError for one of zero length."""
    return from_xyzw(quaternions[:, [1, 2, 3, 0]])


def from_xyzw(quaternions: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of quaternions (T, 4), scalar last. Raises ValueError for one of zero length."""
    return Rotation.from_quat(quaternions).as_matrix()


def from_axis_angle(vectors: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of rotation vectors (T, 3) [rad]."""
    return Rotation.from_rotvec(vectors).as_matrix()


def change_basis(basis: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Rotations (T, 3, 3) as seen in the frame that `basis` (3, 3) leads to."""
    return basis @ rotations @ basis.T


def heading(rotations: np.ndarray) -> np.ndarray:
    """(T,) angle about z of the rotated x axis, unwrapped [rad]."""
    return np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
