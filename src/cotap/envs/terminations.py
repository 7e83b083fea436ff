"""When an episode ends."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.checks import require_range


@dataclass
class TerminationConfig:
    """Falls end an episode early; its length ends it as a time-out."""

    episode_s: float = 20.0
    """Longest episode [s]."""
    min_height_m: float = 0.5
    """A torso lower than this has fallen [m]."""
    max_tilt_rad: float = 1.0
    """A torso tilted further than this from upright has fallen [rad]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("terminations.episode_s", self.episode_s, 0.02, 1e6)
        require_range("terminations.min_height_m", self.min_height_m, 0.0, 10.0)
        require_range("terminations.max_tilt_rad", self.max_tilt_rad, 0.0, 3.15)


def fallen(cfg: TerminationConfig, height: torch.Tensor, projected_gravity_t: torch.Tensor) -> torch.Tensor:
    """Worlds (N,) whose torso is too low or too tilted."""
    upright = torch.cos(torch.tensor(cfg.max_tilt_rad))
    return (height < cfg.min_height_m) | (-projected_gravity_t[:, 2] < upright)


def diverged(qpos: torch.Tensor, qvel: torch.Tensor, velocity_limit: float = 1e3) -> torch.Tensor:
    """Worlds (N,) whose state is not finite, or moves faster than anything physical [rad/s or m/s]."""
    return ~(torch.isfinite(qpos).all(1) & (qvel.abs() < velocity_limit).all(1))
