"""Lower-body impedance (paper, section III-A): a torso position target becomes a velocity command."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.checks import require_range
from cotap.envs.persistence import Stateful
from cotap.rotations import rotate_inverse


@dataclass
class ImpedanceConfig:
    """A horizontal virtual mass-spring-damper between the torso and its target."""

    mass_kg: float = 10.0
    """Virtual mass [kg]."""
    stiffness: float = 20.0
    """Virtual stiffness [N/m]."""
    damping: float = 28.0
    """Virtual damping [Ns/m]; 2 sqrt(k m) is critical."""
    speed_limit: float = 1.0
    """Largest commanded speed [m/s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("impedance.mass_kg", self.mass_kg, 1e-3, 1e6)
        require_range("impedance.stiffness", self.stiffness, 0.0, 1e6)
        require_range("impedance.damping", self.damping, 0.0, 1e6)
        require_range("impedance.speed_limit", self.speed_limit, 0.0, 10.0)


class TorsoImpedance(Stateful):
    """Integrates `m a = K (target - x) + D (target velocity - v)` and commands v in the heading frame."""

    STATE = ("_velocity_w",)

    def __init__(self, cfg: ImpedanceConfig, num_envs: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt = cfg, dt
        self._velocity_w = torch.zeros(num_envs, 2)

    def reset(self, mask: torch.Tensor) -> None:
        """Start at rest in the worlds of `mask`."""
        self._velocity_w[mask] = 0.0

    def step(
        self, position_w: torch.Tensor, heading_w: torch.Tensor, target_w: torch.Tensor, target_velocity_w: torch.Tensor
    ) -> torch.Tensor:
        """Velocity command (N, 2) in the heading frame from the torso's position (N, 2) and its target (N, 2).

        Damping is integrated implicitly, so that any gain is stable at any step.
        """
        c = self.cfg
        force = c.stiffness * (target_w - position_w) + c.damping * target_velocity_w
        velocity = (self._velocity_w + self._dt / c.mass_kg * force) / (1.0 + self._dt * c.damping / c.mass_kg)
        speed = velocity.norm(dim=1, keepdim=True)
        self._velocity_w = velocity * (c.speed_limit / speed.clamp_min(1e-6)).clamp_max(1.0)
        return rotate_inverse(heading_w[:, :2, :2], self._velocity_w)
