"""Where the tour leads: waypoints, and the proportional controller on the pelvis that commands a robot to them."""

from __future__ import annotations

import math

import numpy as np
import torch

from cotap.envs.commands import CommandConfig
from cotap.rotations import rotate_inverse

CENTER_M = (0.3, 0.0)
"""Middle of the disc of waypoints, in the frame of the pelvis at release [m]."""
RADIUS_M = 1.0
"""Its radius [m]."""
GAIN = 1.5
"""Velocity per position error, yaw rate per yaw error [1/s]."""
POSITION_REACHED_M, POSITION_LEFT_M = 0.10, 0.20
"""A position is reached under the first distance, and left beyond the second [m]."""
YAW_REACHED_RAD, YAW_LEFT_RAD = 0.05, 0.12
"""The same of a yaw [rad]."""


def draw_waypoints(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) x, y [m], uniform over the disc, and yaw [rad], uniform over the circle."""
    radius, (bearing, yaw) = RADIUS_M * np.sqrt(rng.uniform(size=count)), rng.uniform(-math.pi, math.pi, (2, count))
    return np.stack((CENTER_M[0] + radius * np.cos(bearing), CENTER_M[1] + radius * np.sin(bearing), yaw), 1)


class Pilot:
    """Commands for N robots, each on its way along waypoints, from where their pelvises are.

    Args:
        waypoints: (N, W, 3) x, y [m] and yaw [rad] in the frame of the pelvis at release.
        segment_s: Time for each [s].
        limits: Ranges of commands that the policy was trained with.
        speed_limit: Fastest velocity that is commanded, whatever its direction [m/s].
        position_w: (N, 2) of the pelvis at release [m].
        yaw: (N,) of the pelvis at release [rad].
    """

    def __init__(
        self, waypoints: torch.Tensor, segment_s: float, limits: CommandConfig, position_w: torch.Tensor,
        yaw: torch.Tensor, speed_limit: float,
    ) -> None:  # fmt: skip
        c, s = yaw.cos().unsqueeze(1), yaw.sin().unsqueeze(1)
        x, y, turn = waypoints.to(position_w).unbind(2)
        offset_w = torch.stack((c * x - s * y, s * x + c * y), 2)
        self.waypoints_w = torch.cat((position_w.unsqueeze(1) + offset_w, (yaw.unsqueeze(1) + turn).unsqueeze(2)), 2)
        """(N, W, 3) x, y [m] and yaw [rad] in the world."""
        self._segment_s, self._limits, self._speed_limit, self._segment = segment_s, limits, speed_limit, -1
        self._at_position = torch.zeros(len(waypoints), dtype=torch.bool, device=position_w.device)
        self._at_yaw = torch.zeros_like(self._at_position)

    def error(self, segment: int, position_w: torch.Tensor, yaw: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """From pelvises at (N, 2) [m] and (N,) [rad] to the waypoint of a segment: (N, 2) [m], (N,) [rad]."""
        goal = self.waypoints_w[:, segment]
        return goal[:, :2] - position_w, (goal[:, 2] - yaw + math.pi).remainder(2.0 * math.pi) - math.pi

    def command(
        self, time_s: float, position_w: torch.Tensor, yaw: torch.Tensor, heading_w: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """What to ask of the robots now.

        Args:
            time_s: Since release [s].
            position_w: (N, 2) of the pelvises [m].
            yaw: (N,) [rad].
            heading_w: (N, 3, 3) the frames that velocity commands are in.

        Returns:
            Velocities (N, 2) [m/s], yaw rates (N,) [rad/s]; and who is to stand (N,) bool: who needs neither.
        """
        segment = int(time_s / self._segment_s + 1e-6)
        if segment != self._segment:
            self._segment = segment
            self._at_position, self._at_yaw = torch.zeros_like(self._at_position), torch.zeros_like(self._at_yaw)
        way_w, turn = self.error(segment, position_w, yaw)
        distance = way_w.norm(dim=1)
        self._at_position = distance < torch.where(self._at_position, POSITION_LEFT_M, POSITION_REACHED_M)
        self._at_yaw = turn.abs() < torch.where(self._at_yaw, YAW_LEFT_RAD, YAW_REACHED_RAD)
        limits = self._limits
        velocity = GAIN * rotate_inverse(heading_w[:, :2, :2], way_w)
        velocity = torch.stack((velocity[:, 0].clamp(*limits.velocity_x), velocity[:, 1].clamp(*limits.velocity_y)), 1)
        velocity = velocity * (self._speed_limit / velocity.norm(dim=1, keepdim=True)).clamp_max(1.0)
        yaw_rate = (GAIN * turn).clamp(*limits.yaw_rate)
        velocity = velocity.masked_fill(self._at_position.unsqueeze(1), 0.0)
        return velocity, yaw_rate.masked_fill(self._at_yaw, 0.0), self._at_position & self._at_yaw
