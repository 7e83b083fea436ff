"""When an episode ends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.checks import require_range
from cotap.robots import RobotSpec

_FASTEST = 1e3
"""Nothing physical moves faster [rad/s or m/s]."""


@dataclass
class TerminationConfig:
    """Falls end an episode early; its length ends it as a time-out."""

    episode_s: float = 20.0
    """Longest episode [s]."""
    min_height: float = 0.5
    """A torso lower than this share of its nominal height has fallen."""
    max_tilt_rad: float = 1.0
    """A torso tilted further than this from upright has fallen [rad]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("terminations.episode_s", self.episode_s, 0.02, 1e6)
        require_range("terminations.min_height", self.min_height, 0.0, 1.0)
        require_range("terminations.max_tilt_rad", self.max_tilt_rad, 0.0, 3.15)

    def min_height_m(self, spec: RobotSpec) -> float:
        """Height of the torso below which this robot has fallen [m]."""
        return self.min_height * spec.nominal_height_m


def fallen(height: torch.Tensor, projected_gravity_t: torch.Tensor, min_height_m: float, tilt: float) -> torch.Tensor:
    """Envs (N,) whose torso, at `height` (N,) [m] and with gravity (N, 3) in its frame, is lower than `min_height_m`
    or tilted further than `tilt` [rad]."""
    return (height < min_height_m) | (-projected_gravity_t[:, 2] < math.cos(tilt))


def diverged(qpos: torch.Tensor, qvel: torch.Tensor) -> torch.Tensor:
    """Envs (N,) whose state is not finite, or moves faster than anything physical."""
    return ~(torch.isfinite(qpos).all(1) & (qvel.abs() < _FASTEST).all(1))
