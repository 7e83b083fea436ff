"""What the lower body is asked to do: velocity, yaw rate, stand, torso height; and the gait clock that goes with it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.checks import require_interval, require_range
from cotap.envs.persistence import Stateful, uniform


@dataclass
class CommandConfig:
    """Ranges that commands are drawn from, uniformly."""

    velocity_x: tuple[float, float] = (-1.1, 1.1)
    """Forward velocity [m/s]."""
    velocity_y: tuple[float, float] = (-0.6, 0.6)
    """Leftward velocity [m/s]."""
    yaw_rate: tuple[float, float] = (-0.9, 0.9)
    """Turning rate, positive to the left [rad/s]."""
    height_offset: tuple[float, float] = (-0.2, 0.0)
    """Torso height relative to nominal while standing [m]."""
    stand_probability: float = 0.2
    """Share of commands that ask the robot to stand."""
    axis_zero_probability: float = 0.2
    """Chance that each of the three velocities of a walking command is zero."""
    resample_s: tuple[float, float] = (4.0, 8.0)
    """Time between commands [s]."""
    height_rate: float = 0.25
    """Fastest change of the height command [m/s]."""
    gait_period_s: float = 0.8
    """Duration of a stride [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("velocity_x", "velocity_y", "yaw_rate", "height_offset", "resample_s"):
            require_interval(f"commands.{name}", getattr(self, name))
        require_range("commands.resample_s[0]", self.resample_s[0], 0.02, math.inf)
        require_range("commands.stand_probability", self.stand_probability, 0.0, 1.0)
        require_range("commands.axis_zero_probability", self.axis_zero_probability, 0.0, 1.0)
        require_range("commands.height_rate", self.height_rate, 1e-3, 10.0)
        require_range("commands.gait_period_s", self.gait_period_s, 0.1, 10.0)


@dataclass(frozen=True)
class Command:
    """Commands of N worlds, and the gait's phase."""

    velocity_h: torch.Tensor
    """(N, 2) horizontal velocity in the heading frame [m/s]."""
    yaw_rate: torch.Tensor
    """(N,) [rad/s]."""
    stand: torch.Tensor
    """(N,) 1 to stand, 0 to walk."""
    height: torch.Tensor
    """(N,) height of the torso link above the ground [m]."""
    phase: torch.Tensor
    """(N,) in [0, 1); 0 while standing. The left foot leads, the right follows half a period later."""


class CommandSource(Stateful):
    """Random commands, held for a random time. `override` puts fixed ones in their place.

    A velocity source (such as the torso-position impedance) may replace the velocities at every step.
    """

    STATE = ("_target", "_height", "_phase", "_remaining_s")

    def __init__(self, cfg: CommandConfig, num_envs: int, nominal_height: float, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt, self._nominal = cfg, dt, nominal_height
        # Columns: vx, vy, yaw rate, stand, height.
        self._target = torch.zeros(num_envs, 5)
        self._target[:, 4] = nominal_height
        self._height = torch.full((num_envs,), nominal_height)
        self._phase = torch.zeros(num_envs)
        self._remaining_s = torch.zeros(num_envs)
        self.resample = True

    def override(
        self, velocity: torch.Tensor, yaw_rate: torch.Tensor, stand: torch.Tensor, height: torch.Tensor
    ) -> None:
        """Hold these commands, (N, 2), (N,), (N,), (N,), until further notice; the height is reached at its rate."""
        self.resample = False
        self._target = torch.cat((velocity, torch.stack((yaw_rate, stand.float(), height), 1)), 1)

    def set_velocity(self, velocity: torch.Tensor, yaw_rate: torch.Tensor) -> None:
        """Replace the velocities (N, 2) and yaw rates (N,) of this step."""
        self._target[:, :2], self._target[:, 2] = velocity, yaw_rate

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """New commands for the worlds in `mask`; the height command starts at nominal."""
        self._draw(mask, rng)
        self._height[mask] = self._nominal
        # A random start in the stride, so that worlds are not in step with each other.
        n = int(mask.sum())
        self._phase[mask] = torch.rand(n, generator=rng) * (1.0 - self._target[mask, 3])

    def step(self, rng: torch.Generator) -> None:
        """Advance clocks by one control step and resample what is due."""
        self._remaining_s -= self._dt
        self._draw(self._remaining_s <= 0.0, rng)
        limit = self.cfg.height_rate * self._dt
        self._height = self._height + (self._target[:, 4] - self._height).clamp(-limit, limit)
        walking = 1.0 - self._target[:, 3]
        self._phase = (self._phase + self._dt / self.cfg.gait_period_s).remainder(1.0) * walking

    def current(self) -> Command:
        """The commands now."""
        t = self._target
        return Command(t[:, :2].clone(), t[:, 2].clone(), t[:, 3].clone(), self._height.clone(), self._phase.clone())

    def _draw(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        n = int(mask.sum())
        if n == 0 or not self.resample:
            return
        cfg = self.cfg
        velocity = torch.stack(
            [uniform(rng, *bounds, n) for bounds in (cfg.velocity_x, cfg.velocity_y, cfg.yaw_rate)], 1
        )
        velocity *= torch.rand(n, 3, generator=rng) >= cfg.axis_zero_probability
        stand = (torch.rand(n, generator=rng) < cfg.stand_probability).float()
        offset = uniform(rng, *cfg.height_offset, n)
        # Height is commanded in stance only; half of the stances are at nominal height.
        offset *= stand * (torch.rand(n, generator=rng) < 0.5)
        self._target[mask] = torch.cat(
            (velocity * (1.0 - stand).unsqueeze(1), torch.stack((stand, self._nominal + offset), 1)), 1
        )
        self._remaining_s[mask] = uniform(rng, *cfg.resample_s, n)


def desired_contact(
    phase: torch.Tensor, stand: torch.Tensor, num_feet: int, stance_share: float = 0.58
) -> torch.Tensor:
    """Which feet should be on the ground, (N, num_feet) bool: foot i is i / num_feet ahead."""
    shift = torch.arange(num_feet, dtype=phase.dtype) / num_feet
    return ((phase.unsqueeze(1) + shift).remainder(1.0) < stance_share) | (stand.unsqueeze(1) > 0.5)


def swing_progress(phase: torch.Tensor, num_feet: int, stance_share: float = 0.58) -> torch.Tensor:
    """How far each foot is through its swing, (N, num_feet) in [0, 1]; 0 during stance."""
    shift = torch.arange(num_feet, dtype=phase.dtype) / num_feet
    foot_phase = (phase.unsqueeze(1) + shift).remainder(1.0)
    return ((foot_phase - stance_share) / (1.0 - stance_share)).clamp(0.0, 1.0)
