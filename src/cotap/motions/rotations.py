"""Rotations of motion files: quaternions in either order, axis-angle, headings; all for whole clips at once."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From x forward, y up, z right to x forward, y left, z up."""
_UPSIDE_DOWN = -0.3
"""Cosine of the tilt beyond which a body counts as having no heading."""


def from_wxyz(quaternions: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of quaternions (T, 4), scalar first. Raises ValueError for one that is nowhere near length 1."""
    return from_xyzw(quaternions[:, [1, 2, 3, 0]])


def from_xyzw(quaternions: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of quaternions (T, 4), scalar last. Raises ValueError for one that is nowhere near length 1."""
    _require_lengths("quaternion", quaternions, 0.1, 10.0)
    return Rotation.from_quat(quaternions).as_matrix()


def from_axis_angle(vectors: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of rotation vectors (T, 3) [rad]. Raises ValueError for one of more than 1000 rad."""
    _require_lengths("rotation vector", vectors, 0.0, 1e3)
    return Rotation.from_rotvec(vectors).as_matrix()


def _require_lengths(what: str, vectors: np.ndarray, low: float, high: float) -> None:
    lengths = np.hypot.reduce(vectors, axis=1)  # squares could be beyond floats
    wrong = ~((lengths >= low) & (lengths <= high))
    if wrong.any():
        frame = int(wrong.argmax())
        raise ValueError(f"a {what} has length {lengths[frame]:g} at frame {frame}; it must lie in [{low:g}, {high:g}]")


def change_basis(basis: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Rotations (T, 3, 3) as seen in the frame that `basis` (3, 3) leads to."""
    return basis @ rotations @ basis.T


def heading(rotations: np.ndarray) -> np.ndarray:
    """(T,) angle about z of rotations (T, 3, 3), without their tilt, unwrapped [rad].

    A body that lies down or rolls over keeps its heading, which the direction of its x axis would not. Upside down
    there is none; there it goes straight from the one before to the one after.
    """
    angle = np.arctan2(rotations[:, 1, 0] - rotations[:, 0, 1], rotations[:, 0, 0] + rotations[:, 1, 1])
    frames = np.arange(len(rotations))
    known = frames[rotations[:, 2, 2] > _UPSIDE_DOWN]
    return np.interp(frames, known, np.unwrap(angle[known])) if len(known) else np.zeros(len(rotations))
