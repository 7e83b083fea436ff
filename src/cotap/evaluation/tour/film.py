"""What a film of the tour shows beside the robot: the waypoint that it is sent to, and the punches that it takes."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco
import numpy as np
import torch

from cotap.envs.punches import Punches
from cotap.evaluation.render import add_arrow, add_ball, add_force
from cotap.robots import RobotSpec

SHOWN_S = 0.4
"""How long a punch is shown, which is over sooner than an eye takes it in [s]."""
WAYPOINT_RGBA = (0.95, 0.65, 0.1, 1.0)
_HEADING_M = 0.35
_ABOVE_FLOOR_M = 0.03


class TourMarks:
    """Marks for the pictures of a tour's first run, as `film_frames` asks for them.

    Args:
        spec: The robot.
        waypoints: (W, 3) x, y [m] and yaw [rad] in the world.
        segment_s: Time for each [s].
        punches: Of one run.
        frame_s: Time from one picture to the next [s].
    """

    def __init__(
        self, spec: RobotSpec, waypoints: torch.Tensor, segment_s: float, punches: Punches, frame_s: float
    ) -> None:  # fmt: skip
        self._joints, self._waypoints, self._segment_s = spec.joint_names, waypoints.double().numpy(), segment_s
        self._punches, self._frame_s = punches, frame_s

    def __call__(self, scene: mujoco.MjvScene, data: mujoco.MjData, number: int) -> None:
        """Draw them into the scene of picture `number`."""
        time_s = number * self._frame_s
        segment = min(int(time_s / self._segment_s + 1e-6), len(self._waypoints) - 1)
        x, y, yaw = self._waypoints[segment]
        place = np.array([x, y, _ABOVE_FLOOR_M])
        add_ball(scene, place, WAYPOINT_RGBA, 0.06)
        add_arrow(scene, place, place + _HEADING_M * np.array([np.cos(yaw), np.sin(yaw), 0.0]), WAYPOINT_RGBA)
        since = time_s - segment * self._segment_s - self._punches.cfg.first_s
        if self._punches.active and -1e-6 <= since < SHOWN_S:
            anchor = data.joint(self._joints[self._punches.joint[0, segment]]).xanchor
            add_force(scene, anchor, self._punches.force_w[0, segment].double().numpy())
