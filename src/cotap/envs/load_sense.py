"""Balance under loads: what a robot that something pulls at should take for the vertical.

A force F at height z has the moment about the feet that the robot's weight W has where its centre of mass is z F / W
further on. A robot that keeps upright under it tips over; one that leans against it by that way over the height of its
centre of mass stands in balance. So the direction of gravity is tilted by that much before steps, standing and policies
read it, and they lean by themselves. How large the tilt is, joints, their torques and the IMU tell together.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from torch import nn

from cotap.envs.commands import Command
from cotap.envs.judgement import load_shipped, perceptron
from cotap.envs.persistence import Stateful
from cotap.envs.state import RobotState
from cotap.envs.step_timing import feature_reflection, features
from cotap.envs.symmetry import joint_reflection
from cotap.reflection import Reflection, join
from cotap.robots import RobotSpec

COM_HEIGHT_M = 0.9
"""About the height of the centre of mass above the soles [m]."""
LARGEST_TILT = 0.2
"""Nothing that a robot stands under for long asks for more."""
MEAN_S = 0.12
"""Of the running mean that the network reads beside the present: an arm that swings is no load [s]."""
TILT_S = 0.1
"""Of the low pass of what it says [s]."""
LEAST_TILT = 0.01
"""Robots lean by this much less than they are told, or not at all: no estimate is exact, and most often nothing pulls
[rad]."""
HIDDEN = (128, 64)
RELEASE = 0.6
"""A robot braces itself until the tilt is less than this share of what made it: loads that hardly do must not make it
stop and go."""


def load_tilt(s: RobotState, points_w: torch.Tensor, force_w: torch.Tensor, weight_n: float) -> torch.Tensor:
    """By how much loads tilt the vertical, (N, 2) along x and y of the torso frame, small angles [rad].

    Args:
        s: The state.
        points_w: (N, P, 3) where forces act [m].
        force_w: (N, P, 3) [N].
        weight_n: Of the robot [N].
    """
    below = torch.nn.functional.pad(s.torso_pos_w[:, :2], (0, 1)).unsqueeze(1)
    moment = torch.linalg.cross(points_w - below, force_w).sum(1)
    way_w = torch.stack((moment[:, 1], -moment[:, 0], torch.zeros_like(moment[:, 0])), 1) / weight_n
    tilt = (s.torso_rotation_w.transpose(1, 2) @ way_w.unsqueeze(-1)).squeeze(-1)[:, :2] / COM_HEIGHT_M
    return tilt.clamp(-LARGEST_TILT, LARGEST_TILT)


def load_features(s: RobotState, command: Command, default: torch.Tensor, torque: torch.Tensor) -> torch.Tensor:
    """What loads are told by, (N, 12 + 3 J): `features`, torques, and where in its stride the robot is.

    Args:
        s: The state; only joints, gravity's direction and angular velocity are used.
        command: What is commanded, and the gait's phase.
        default: (J,) the default pose [rad].
        torque: (N, J) of the motors, as computed [Nm].
    """
    angle, walks = 2.0 * math.pi * command.phase, 1.0 - command.stand
    stride = torch.stack((walks * angle.sin(), walks * angle.cos(), command.stand), 1)
    return torch.cat((features(s, command, default), 0.02 * torque, stride), 1).float()


def load_reflection(spec: RobotSpec) -> Reflection:
    """The mirror image of `load_features`: the other foot is half a stride ahead."""
    stride = Reflection(torch.arange(3), torch.tensor((-1.0, -1.0, 1.0)))
    return join([feature_reflection(spec), joint_reflection(spec, spec.joint_names), stride])


class TiltEstimate(nn.Module):
    """From the present and the mean of `load_features` (N, 2 W) to the tilt (N, 2) that loads ask for [rad].

    Left-right symmetric: the mean of what it says of a state and of the mirror image of what it says of its mirror
    image.
    """

    def __init__(self, reflection: Reflection) -> None:
        super().__init__()
        self.reflection = join([reflection, reflection])
        self._sign = torch.tensor((1.0, -1.0))
        self.net = perceptron(self.reflection.index.numel(), *HIDDEN, 2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Tilts (N, 2)."""
        return 0.1 * 0.5 * (self.net(x) + self._sign * self.net(self.reflection(x)))


class LoadSense(Stateful):
    """Keeps, per world, the tilt that the shipped `TiltEstimate` tells (fitted to simulated loads by
    `scripts/fit_load_sense.py`).

    Args:
        spec: The robot.
        num_envs: Number of worlds.
        dt: Control step [s].
        brace_rad: Tilt from which a robot braces itself; 0 for never [rad].

    Raises:
        ValueError: the shipped weights are for another number of joints.
    """

    STATE = ("_mean", "_fresh", "tilt", "braces")

    def __init__(self, spec: RobotSpec, num_envs: int, dt: float, brace_rad: float = 0.0) -> None:
        self._brace_rad = brace_rad or math.inf
        self._default = torch.tensor([j.default_rad for j in spec.joints])
        self.model = TiltEstimate(load_reflection(spec)).eval()
        load_shipped(self.model.net, "load_sense.npz", "load sense", spec)
        self._mean_share, self._tilt_share = (1.0 - math.exp(-dt / time_s) for time_s in (MEAN_S, TILT_S))
        self._mean = torch.zeros(num_envs, self.model.reflection.index.numel() // 2)
        self._fresh = torch.ones(num_envs, dtype=torch.bool)
        self.tilt = torch.zeros(num_envs, 2)
        """(N, 2) along x and y of the torso frame [rad]."""
        self.braces = torch.zeros(num_envs, dtype=torch.bool)
        """(N,) who is pulled at so hard that it should stop and stand."""
        self.awake = torch.ones(num_envs, dtype=torch.bool)
        """(N,) whose loads are sensed at all; the others stay upright, and go on."""

    def reset(self, mask: torch.Tensor) -> None:
        """Worlds of `mask` (N,) start with nothing that pulls at them."""
        self._fresh, self.tilt = self._fresh | mask, self.tilt.masked_fill(mask.unsqueeze(1), 0.0)
        self.braces = self.braces & ~mask

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As of any `Stateful`; in states that were saved before robots braced themselves, none does."""
        super().load_state_dict({"braces": torch.zeros_like(self.braces), **state})

    @torch.no_grad()
    def step(self, s: RobotState, command: Command, torque: torch.Tensor) -> None:
        """Take in a control step.

        Args:
            s: The state at its end; only joints, gravity's direction and angular velocity are used.
            command: What was commanded in it.
            torque: (N, J) of the motors, as computed [Nm].
        """
        told = self.model(self.remember(s, command, torque)).clamp(-LARGEST_TILT, LARGEST_TILT)
        told = told.masked_fill(~self.awake.unsqueeze(1), 0.0)
        self.tilt = torch.lerp(self.tilt, told, self._tilt_share)
        size = self.tilt.norm(dim=1)
        self.braces = torch.where(self.braces, size > RELEASE * self._brace_rad, size > self._brace_rad)

    def remember(self, s: RobotState, command: Command, torque: torch.Tensor) -> torch.Tensor:
        """Take the present into the mean; what the network reads then, (N, 2 W). Arguments as of `step`."""
        # A world that has diverged is about to restart; what it said must not outlast it.
        present = torch.nan_to_num(load_features(s, command, self._default, torque), 0.0, 0.0, 0.0)
        mean = torch.where(self._fresh.unsqueeze(1), present, torch.lerp(self._mean, present, self._mean_share))
        self._mean, self._fresh = mean, torch.zeros_like(self._fresh)
        return torch.cat((present, mean), 1)

    def felt(self, s: RobotState) -> RobotState:
        """`s` with the vertical tilted."""
        size = self.tilt.norm(dim=1, keepdim=True)
        tilt = self.tilt * (1.0 - LEAST_TILT / size.clamp_min(LEAST_TILT))
        gravity = s.projected_gravity_t + torch.nn.functional.pad(tilt, (0, 1)).to(s.projected_gravity_t.dtype)
        return dataclasses.replace(s, projected_gravity_t=torch.nn.functional.normalize(gravity, dim=1))
