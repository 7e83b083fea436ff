"""Gently uneven ground: bumps about a step apart, the same for everyone."""

from __future__ import annotations

import numpy as np

HALF_EXTENT_M = 20.0
"""The bumps cover a square from minus to plus this along x and y."""
SPACING_M = 0.1
_WAVELENGTHS_M = (0.6, 3.0)
_WAVES = 24


def bumps() -> np.ndarray:
    """Heights (rows along y, columns along x) in [0, 1] of a sum of waves in random directions."""
    rng = np.random.default_rng(0)
    count = round(2.0 * HALF_EXTENT_M / SPACING_M) + 1
    x, y = np.meshgrid(*[np.linspace(-HALF_EXTENT_M, HALF_EXTENT_M, count)] * 2)
    height = np.zeros_like(x)
    for _ in range(_WAVES):
        wavelength, direction, phase = rng.uniform(*_WAVELENGTHS_M), rng.uniform(0.0, np.pi), rng.uniform(0, 2 * np.pi)
        along = np.cos(direction) * x + np.sin(direction) * y
        height += np.sin(2.0 * np.pi * along / wavelength + phase)
    return (height - height.min()) / (height.max() - height.min())
