"""When to step: how likely a fall is for every point of the stride that the gait clock could be put to.

A clock that runs on regardless decides by chance which foot a blow finds in the air, and that decides most falls. What
is judged here, from joints and IMU alone, lets the clock jump to where a robot that was struck catches itself.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import nn

from cotap.envs.commands import Catch, Command
from cotap.envs.judgement import load_shipped, perceptron
from cotap.envs.persistence import Stateful
from cotap.envs.state import RobotState
from cotap.envs.symmetry import joint_reflection
from cotap.reflection import Reflection, join
from cotap.robots import RobotSpec

BINS = 24
"""Points of the stride that are told apart; an even number, so that a mirror image is one of them."""
HIDDEN = (128, 64)


class FallRisk(nn.Module):
    """From what the robot feels (N, W) to logits (N, BINS + 1) of a fall: per point of the stride, and for standing on.

    Left-right symmetric: the mean of what it says of a state and, half a stride on, of its mirror image.
    """

    def __init__(self, reflection: Reflection) -> None:
        super().__init__()
        self._reflection = reflection
        self.net = perceptron(reflection.index.numel(), *HIDDEN, BINS + 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Logits (N, BINS + 1)."""
        mirrored = self.net(self._reflection(x))
        points = mirrored[:, :BINS].roll(BINS // 2, 1)
        return 0.5 * (self.net(x) + torch.cat((points, mirrored[:, BINS:]), 1))


HURRY_S = 0.8
"""For how long a robot that catches itself steps faster [s]."""
REST_S = 0.25
"""Time between two jumps of the clock [s]: a step must be taken before it can be judged."""
GAIN = 0.2
"""By how much a jump must lower the chance of a fall."""
CORRECTION_GAIN = 0.05
"""The same of a jump that corrects the one before: the foot has hardly moved, so that less has to be gained."""


class StepTiming(Stateful):
    """Decides when the gait clock jumps, by the shipped `FallRisk` (fitted to simulated blows by
    `scripts/fit_step_timing.py`).

    Args:
        spec: The robot.
        num_envs: Number of worlds.
        dt: Control step [s].
        correct_s: For how long after a jump it may be corrected [s]: the first one comes in the middle of a blow.

    Raises:
        ValueError: the shipped weights are for another number of joints.
    """

    STATE = ("_since_s", "_since_first_s")

    def __init__(self, spec: RobotSpec, num_envs: int, dt: float, correct_s: float = 0.0) -> None:
        self._dt, self._correct_s = dt, correct_s
        self._default = torch.tensor([j.default_rad for j in spec.joints])
        self._since_s = torch.full((num_envs,), math.inf)
        """Since the clock jumped."""
        self._since_first_s = torch.full((num_envs,), math.inf)
        """Since it jumped and was not correcting a jump."""
        self.model = FallRisk(feature_reflection(spec)).eval()
        load_shipped(self.model.net, "step_timing.npz", "step timing", spec)

    def reset(self, mask: torch.Tensor) -> None:
        """Worlds in `mask` (N,) start anew."""
        self._since_s[mask] = self._since_first_s[mask] = math.inf

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As of any `Stateful`; states that were saved before jumps were corrected have had first jumps only."""
        super().load_state_dict({"_since_first_s": state.get("_since_s"), **state})

    @torch.no_grad()
    def risk(self, s: RobotState, command: Command) -> torch.Tensor:
        """Chance (N, BINS + 1) of a fall within two seconds: with the clock put to each point of the stride, and, last,
        for a standing robot that stands on."""
        return self.model(features(s, command, self._default)).sigmoid()

    def step(self, s: RobotState, command: Command, leans: torch.Tensor) -> Catch:
        """Judge N worlds once a control step.

        Args:
            s: The state; only joints, gravity's direction and angular velocity are used.
            command: What is commanded, and the gait's phase.
            leans: (N,) bool, robots that must not stand on.
        """
        risk = self.risk(s, command)
        least, point = risk[:, :BINS].min(1)
        stands = command.stand > 0.5
        present = torch.where(stands, risk[:, BINS], risk_at(risk, command.phase))
        gain = present - least
        first = (gain > GAIN) & (self._since_s > REST_S) | (stands & leans)
        corrects = (gain > CORRECTION_GAIN) & (self._since_first_s + 0.5 * self._dt < self._correct_s) & ~stands
        jumps = first | corrects
        self._since_s = torch.where(jumps, 0.0, self._since_s + self._dt)
        self._since_first_s = torch.where(first, 0.0, self._since_first_s + self._dt)
        return Catch(jumps, point / BINS, self._since_s < HURRY_S)


def features(s: RobotState, command: Command, default: torch.Tensor) -> torch.Tensor:
    """What risk is judged by, (N, 9 + 2 J): gravity, angular velocity, joints and their speeds, commands.

    Args:
        s: The state; only joints, gravity's direction and angular velocity are used.
        command: What is commanded.
        default: (J,) the default pose [rad].
    """
    return torch.cat(
        (
            s.projected_gravity_t, 0.25 * s.torso_angular_velocity_t, s.joint_pos - default, 0.05 * s.joint_vel,
            command.velocity_h, command.yaw_rate.unsqueeze(1),
        ),
        1,
    ).float()  # fmt: skip


def feature_reflection(spec: RobotSpec) -> Reflection:
    """The mirror image of `features`."""
    joints = joint_reflection(spec, spec.joint_names)
    vector, axial = (torch.tensor(x) for x in ((1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)))
    commands = torch.tensor((1.0, -1.0, -1.0))
    three = torch.arange(3)
    return join([Reflection(three, vector), Reflection(three, axial), joints, joints, Reflection(three, commands)])


def risk_at(risk: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
    """Risk (N,) of going on at `phase` (N,), linear between the points of `risk` (N, BINS + 1)."""
    place = phase * BINS
    low = place.floor().long() % BINS
    ends = risk.gather(1, torch.stack((low, (low + 1) % BINS), 1))
    return torch.lerp(ends[:, 0], ends[:, 1], place - place.floor())
