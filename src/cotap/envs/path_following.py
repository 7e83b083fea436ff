"""Lower-body impedance (paper, section III-A): a torso position target becomes a velocity command."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from cotap.checks import require_range
from cotap.persistence import Stateful
from cotap.rotations import rotate_inverse, yaw_of


@dataclass
class PathConfig:
    """A horizontal virtual mass-spring-damper between the torso and its target."""

    mass_kg: float = 10.0
    """Virtual mass [kg]."""
    stiffness: float = 20.0
    """Virtual stiffness [N/m]."""
    damping: float = 28.0
    """Virtual damping [Ns/m]; 2 sqrt(k m) is critical."""
    speed_limit: float = 1.0
    """Largest commanded speed [m/s]."""
    share: float = 0.0
    """Share of envs whose torso is led along the root path of the clip that their arms follow, or else held."""
    yaw_gain: float = 1.5
    """Yaw rate per error of heading [1/s]."""
    yaw_rate_limit: float = 0.9
    """Largest commanded yaw rate [rad/s]."""
    leash_m: float = 0.5
    """The target waits when it is further ahead than this [m]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("path.mass_kg", self.mass_kg, 1e-3, 1e6)
        require_range("path.stiffness", self.stiffness, 0.0, 1e6)
        require_range("path.damping", self.damping, 0.0, 1e6)
        require_range("path.speed_limit", self.speed_limit, 0.0, 10.0)
        require_range("path.share", self.share, 0.0, 1.0)
        require_range("path.yaw_gain", self.yaw_gain, 0.0, 100.0)
        require_range("path.yaw_rate_limit", self.yaw_rate_limit, 0.0, 10.0)
        require_range("path.leash_m", self.leash_m, 0.01, 100.0)


class TorsoImpedance(Stateful):
    """Integrates `m a = K (target - x) + D (target velocity - v)` and commands v in the heading frame."""

    STATE = ("_velocity_w",)

    def __init__(self, cfg: PathConfig, num_envs: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt = cfg, dt
        self._velocity_w = torch.zeros(num_envs, 2)

    def reset(self, mask: torch.Tensor) -> None:
        """Start at rest in the envs of `mask`."""
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


class PathFollower(Stateful):
    """Leads torsos along paths: a target moves as a clip's root does, and the impedance makes it a velocity command."""

    STATE = ("active", "target_w", "heading")

    def __init__(self, cfg: PathConfig, num_envs: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt = cfg, dt
        self.impedance = TorsoImpedance(cfg, num_envs, dt)
        self.active = torch.zeros(num_envs, dtype=torch.bool)
        """(N,) which envs are led."""
        self.target_w = torch.zeros(num_envs, 2)
        """(N, 2) where the torso should be [m]."""
        self.heading = torch.zeros(num_envs)
        """(N,) and which way it should face [rad]."""

    def reset(
        self, mask: torch.Tensor, position_w: torch.Tensor, heading_w: torch.Tensor, rng: torch.Generator
    ) -> None:
        """The paths of the envs in `mask` begin where their torso is, (N, 2) and (N, 3, 3)."""
        if self.cfg.share == 0.0:
            return
        self.impedance.reset(mask)
        self.active[mask] = torch.rand(int(mask.sum()), generator=rng, device=rng.device) < self.cfg.share
        self.target_w = torch.where(mask.unsqueeze(1), position_w, self.target_w)
        self.heading = torch.where(mask, yaw_of(heading_w), self.heading)

    def step(
        self, position_w: torch.Tensor, heading_w: torch.Tensor, root_velocity: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Velocity (N, 2) in the heading frame and yaw rate (N,) to command.

        Args:
            position_w: (N, 2) the torso's position.
            heading_w: (N, 3, 3) its heading frame.
            root_velocity: (N, 3) forward and leftward velocity and turning rate of the path, in its own heading frame.
        """
        cfg = self.cfg
        waits = (self.target_w - position_w).norm(dim=1) > cfg.leash_m
        path = torch.where(waits.unsqueeze(1), torch.zeros_like(root_velocity), root_velocity)
        c, s = self.heading.cos(), self.heading.sin()
        velocity_w = torch.stack((c * path[:, 0] - s * path[:, 1], s * path[:, 0] + c * path[:, 1]), 1)
        self.target_w = self.target_w + self._dt * velocity_w
        self.heading = self.heading + self._dt * path[:, 2]
        velocity = self.impedance.step(position_w, heading_w, self.target_w, velocity_w)
        error = (self.heading - yaw_of(heading_w) + math.pi).remainder(2.0 * math.pi) - math.pi
        return velocity, (path[:, 2] + cfg.yaw_gain * error).clamp(-cfg.yaw_rate_limit, cfg.yaw_rate_limit)

    def state_dict(self) -> dict[str, Any]:
        """Its own state and the impedance's."""
        return super().state_dict() | {"impedance": self.impedance.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned. Raises ValueError for another size or a missing name."""
        own = dict(state)
        self.impedance.load_state_dict(own.pop("impedance", {}))
        super().load_state_dict(own)
