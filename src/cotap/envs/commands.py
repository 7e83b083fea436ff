"""What the lower body is asked to do: velocity, yaw rate, stand, torso height."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from cotap.checks import require_interval, require_range
from cotap.envs.gait_phase import GaitConfig, GaitPhase
from cotap.persistence import Stateful, uniform


@dataclass
class CommandConfig:
    """Ranges that commands are drawn from, uniformly."""

    velocity_x: tuple[float, float] = (-1.1, 1.1)
    """Forward velocity [m/s]."""
    velocity_y: tuple[float, float] = (-0.6, 0.6)
    """Leftward velocity [m/s]."""
    yaw_rate: tuple[float, float] = (-0.9, 0.9)
    """Turning rate, positive to the left [rad/s]."""
    height_offset: tuple[float, float] = (-0.22, 0.02)
    """Torso height relative to nominal while standing [m]. It is approached at once: a robot that stops goes down
    while it still steps on the spot, and one that starts to walk comes up as it does."""
    stand_probability: float = 0.25
    """Share of commands that ask the robot to stand."""
    axis_zero_probability: float = 0.2
    """Chance that each of the three velocities of a walking command is zero."""
    resample_s: tuple[float, float] = (4.0, 8.0)
    """Time between commands [s]."""
    height_rate: float = 0.25
    """Fastest change of the height command [m/s]."""
    acceleration: float = 1.5
    """Fastest change of each velocity command [m/s^2]."""
    yaw_acceleration: float = 3.0
    """Fastest change of the yaw rate command [rad/s^2]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("velocity_x", "velocity_y", "yaw_rate", "height_offset", "resample_s"):
            require_interval(f"commands.{name}", getattr(self, name))
        require_range("commands.resample_s[0]", self.resample_s[0], 0.02, math.inf)
        require_range("commands.stand_probability", self.stand_probability, 0.0, 1.0)
        require_range("commands.axis_zero_probability", self.axis_zero_probability, 0.0, 1.0)
        require_range("commands.height_rate", self.height_rate, 1e-3, 10.0)
        require_range("commands.acceleration", self.acceleration, 1e-2, 1e3)
        require_range("commands.yaw_acceleration", self.yaw_acceleration, 1e-2, 1e3)


@dataclass(frozen=True)
class Command:
    """Commands of N envs, and the gait's phase."""

    velocity_h: torch.Tensor
    """(N, 2) horizontal velocity in the heading frame [m/s]."""
    yaw_rate: torch.Tensor
    """(N,) [rad/s]."""
    stand: torch.Tensor
    """(N,) 1 to stand, 0 to walk."""
    height: torch.Tensor
    """(N,) height of the torso link above the ground [m]."""
    phase: torch.Tensor
    """(N,) of the gait, in [0, 1); it rests at 0 or 0.5, both feet down, while standing."""


class CommandSource(Stateful):
    """Random commands, held for a random time. `override` puts fixed ones in their place.

    What is commanded approaches what was drawn at limited rates, as a pilot's stick does. A robot that is asked to
    stand slows down and walks on the spot for a stride: then the stand flag is raised, once both feet should be down;
    where the gait rested at once, robots fell.
    A velocity source (such as the torso-position impedance) may replace the velocities at every step.
    """

    STATE = ("_target", "_velocity", "_height", "_remaining_s")

    def __init__(self, cfg: CommandConfig, gait: GaitConfig, num_envs: int, nominal_height_m: float, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt, self._nominal = cfg, dt, nominal_height_m
        # Columns: vx, vy, yaw rate, stand, height.
        self._target = torch.zeros(num_envs, 5)
        self._target[:, 4] = nominal_height_m
        self._velocity = torch.zeros(num_envs, 3)
        self._walking_ranges = torch.tensor([cfg.velocity_x, cfg.velocity_y, cfg.yaw_rate]).unbind(1)
        self._rate = dt * torch.tensor([cfg.acceleration, cfg.acceleration, cfg.yaw_acceleration])
        self._height = torch.full((num_envs,), nominal_height_m)
        self._remaining_s = torch.zeros(num_envs)
        self.gait = GaitPhase(gait, num_envs, dt)
        self.resample = True

    @property
    def asked_to_stand(self) -> torch.Tensor:
        """(N,) bool: to stand is what was drawn, whether or not the robot still slows down or ends its step."""
        return self._target[:, 3] > 0.5

    @property
    def asked_velocity(self) -> torch.Tensor:
        """(N, 3) velocity x, y in the heading frame [m/s] and yaw rate [rad/s] that were drawn, rates of change
        aside."""
        return self._target[:, :3]

    @property
    def asked_height(self) -> torch.Tensor:
        """(N,) height of the torso link [m] that was drawn, its rate of change aside."""
        return self._target[:, 4]

    def override(
        self, velocity: torch.Tensor, yaw_rate: torch.Tensor, stand: torch.Tensor, height: torch.Tensor
    ) -> None:
        """Hold these commands, (N, 2), (N,), (N,), (N,), until further notice; each is approached at its rate."""
        self.resample = False
        target = torch.cat((velocity, torch.stack((yaw_rate, stand.float(), height), 1)), 1)
        self._target = target.to(self._velocity.device)

    def set_velocity(self, velocity: torch.Tensor, yaw_rate: torch.Tensor, mask: torch.Tensor) -> None:
        """In the envs of `mask` (N,), walk at these velocities (N, 2) and yaw rates (N,), at once; where they are
        beyond the ranges that commands are drawn from, at those ranges' ends."""
        low, high = self._walking_ranges
        walk = torch.cat((velocity, yaw_rate.unsqueeze(1)), 1).clamp(low, high)
        still = torch.tensor([0.0, self._nominal], device=walk.device).expand(len(walk), 2)
        self._target = torch.where(mask.unsqueeze(1), torch.cat((walk, still), 1), self._target)
        self._velocity = torch.where(mask.unsqueeze(1), walk, self._velocity)
        self.gait.stand = torch.where(mask, torch.zeros_like(self.gait.stand), self.gait.stand)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """New commands for the envs in `mask`, approached from rest at nominal height."""
        self._draw(mask, rng)
        self._height[mask] = self._nominal
        self._velocity[mask] = 0.0
        self.gait.reset(mask, self._target[mask, 3], rng)

    def step(self, rng: torch.Generator) -> None:
        """Advance by one control step: draw what is due, approach it, and run the gait's phase."""
        self._remaining_s = self._remaining_s - self._dt
        due = self._remaining_s <= 0.0
        if self.resample and due.any():
            self._draw(due, rng)
        self._velocity = self._velocity + (self._target[:, :3] - self._velocity).clamp(-self._rate, self._rate)
        step = self.cfg.height_rate * self._dt
        self._height = self._height + (self._target[:, 4] - self._height).clamp(-step, step)
        self.gait.step(self.asked_to_stand & (self._velocity == 0.0).all(1))

    def current(self) -> Command:
        """The commands now; later steps do not change what is returned."""
        v = self._velocity.clone()
        return Command(v[:, :2], v[:, 2], self.gait.stand.clone(), self._height.clone(), self.gait.phase.clone())

    def state_dict(self) -> dict[str, Any]:
        """Its own state and the gait's."""
        return super().state_dict() | {"gait": self.gait.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned. Raises ValueError for another size or a missing name."""
        own = dict(state)
        self.gait.load_state_dict(own.pop("gait", {}))
        super().load_state_dict(own)

    def _draw(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        n = int(mask.sum())
        if n == 0 or not self.resample:
            return
        cfg = self.cfg
        velocity = torch.stack(
            [uniform(rng, *bounds, n) for bounds in (cfg.velocity_x, cfg.velocity_y, cfg.yaw_rate)], 1
        )
        velocity *= torch.rand(n, 3, generator=rng, device=rng.device) >= cfg.axis_zero_probability
        stand = (torch.rand(n, generator=rng, device=rng.device) < cfg.stand_probability).float()
        offset = stand * uniform(rng, *cfg.height_offset, n)
        self._target[mask] = torch.cat(
            (velocity * (1.0 - stand).unsqueeze(1), torch.stack((stand, self._nominal + offset), 1)), 1
        )
        self._remaining_s[mask] = uniform(rng, *cfg.resample_s, n)
