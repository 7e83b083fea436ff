"""What robots look like: colours, and shapes from where they begin and end."""

from __future__ import annotations

import numpy as np

from cotap.robots.spec import GeomSpec, Vec3

COLORS = {
    "dark": (0.16, 0.17, 0.20),
    "shell": (0.88, 0.89, 0.91),
    "left": (0.13, 0.45, 0.80),
    "right": (0.88, 0.42, 0.13),
    "visor": (0.05, 0.06, 0.09),
}
"""Of the robots that ship, each between 0 and 1: red, green, blue."""


def capsule(a: Vec3, b: Vec3, radius: float, color: str) -> GeomSpec:
    """A capsule around the line from `a` to `b`, two different points in the body's frame [m]."""
    delta = np.subtract(b, a)
    length = float(np.linalg.norm(delta))
    x, y, z = delta / (length if delta[2] >= 0.0 else -length)  # upwards: a capsule's ends are alike
    quat = np.array([1.0 + z, -y, x, 0.0]) / np.sqrt(2.0 + 2.0 * z)
    middle = np.add(a, b) / 2.0
    return GeomSpec("capsule", (radius, length / 2.0, 0.0), tuple(middle.tolist()), tuple(quat.tolist()), color)
