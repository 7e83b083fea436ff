"""Courses of waypoints, and how a robot is steered along them."""

from __future__ import annotations

import torch

from cotap.persistence import uniform
from cotap.rotations import rotate, rotate_inverse

STEERING = 1.5
"""Turning rate per radian of heading error [1/s]."""
YAW_RATE = 0.8
"""Fastest turning [rad/s]."""


def steer(ahead_h: torch.Tensor, speed: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Velocity commands (N, 2) [m/s] and yaw rates (N,) [rad/s] towards points (N, 2) [m], in the heading frame.

    A robot turns on the spot towards what is behind it, and walks at full `speed` only towards what is ahead.
    """
    angle = torch.atan2(ahead_h[:, 1], ahead_h[:, 0])
    forward = speed * angle.cos().clamp_min(0.0)
    return torch.stack((forward, torch.zeros_like(forward)), 1), (STEERING * angle).clamp(-YAW_RATE, YAW_RATE)


class Course:
    """Waypoints of N envs, each `leg` from the one before in a direction that changes by up to `turn`.

    Args:
        count: Number of waypoints.
        leg: [m].
        turn: [rad].
        radius: Distance at which one is reached [m].
        num_envs: N.
        rng: Draws the turns.
        device: Where the envs are.
    """

    def __init__(
        self, count: int, leg: float, turn: float, radius: float, num_envs: int, rng: torch.Generator,
        device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
        direction = uniform(rng, -turn, turn, num_envs, count).cumsum(1).to(device)
        self._legs = leg * torch.stack((direction.cos(), direction.sin(), torch.zeros_like(direction)), 2)
        self._radius = radius
        self._points_w = torch.zeros(num_envs, count, 2, device=device)
        self.reached = torch.zeros(num_envs, dtype=torch.long, device=device)
        """(N,) how many waypoints each env has reached."""
        self.over = torch.zeros(num_envs, dtype=torch.bool, device=device)
        """(N,) envs that reach no more."""

    def start(self, position_w: torch.Tensor, heading_w: torch.Tensor) -> None:
        """Lay the course out from positions (N, 2), its first direction about the headings (N, 3, 3)."""
        steps_w = rotate(heading_w.unsqueeze(1), self._legs)[..., :2]
        self._points_w = position_w.unsqueeze(1) + steps_w.cumsum(1)

    def leave(self, fell: torch.Tensor) -> None:
        """Envs (N,) bool that are out of it from now on."""
        self.over = self.over | fell

    def step(self, position_w: torch.Tensor, heading_w: torch.Tensor) -> torch.Tensor:
        """Count who has arrived at (N, 2). Returns the next waypoint (N, 2) relative to it, in the heading frame."""
        last = self._points_w.shape[1] - 1
        to = self._next(last) - position_w
        arrived = (to.norm(dim=1) < self._radius) & ~self.over & (self.reached <= last)
        self.reached = self.reached + arrived.long()
        to = self._next(last) - position_w
        return rotate_inverse(heading_w, torch.nn.functional.pad(to, (0, 1)))[:, :2]

    def _next(self, last: int) -> torch.Tensor:
        row = self.reached.clamp_max(last)[:, None, None].expand(-1, 1, 2)
        return self._points_w.gather(1, row).squeeze(1)
