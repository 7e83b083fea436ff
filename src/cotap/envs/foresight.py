"""Whether a standing robot will fall if it stands on: judged so early that a step is still in time.

How far the torso leans tells it late: hips keep the torso upright while the whole robot tips over its toes. Joints and
IMU together tell it a second ahead.
"""

from __future__ import annotations

import math

import torch
from torch import nn

from cotap.envs.commands import Command
from cotap.envs.judgement import load_shipped, perceptron
from cotap.envs.state import RobotState
from cotap.envs.step_timing import feature_reflection, features
from cotap.reflection import Reflection
from cotap.robots import RobotSpec

HIDDEN = (64, 32)
AHEAD_S = 1.5
"""How far ahead a fall is told of [s]."""
SURE = 3.0
"""Logit from which a robot is taken to fall: a step that was not needed costs less than a fall, but costs."""
FAR_RAD = 0.3
"""Lean from which a standing robot steps whatever is foreseen: nothing of the kind stood on where this was learned."""


class StandingRisk(nn.Module):
    """From what the robot feels (N, W), as `features` gives it, to the logit (N,) of a fall out of standing on.

    Left-right symmetric: the mean of what it says of a state and of its mirror image.
    """

    def __init__(self, reflection: Reflection) -> None:
        super().__init__()
        self._reflection = reflection
        self.net = perceptron(reflection.index.numel(), *HIDDEN, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Logits (N,)."""
        return 0.5 * (self.net(x) + self.net(self._reflection(x))).squeeze(1)


class Foresight:
    """Tells which standing robots will fall, by the shipped `StandingRisk` (fitted to simulated standing by
    `scripts/fit_foresight.py`).

    Args:
        spec: The robot.

    Raises:
        ValueError: the shipped weights are for another number of joints.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self._default = torch.tensor([j.default_rad for j in spec.joints])
        self.model = StandingRisk(feature_reflection(spec)).eval()
        load_shipped(self.model.net, "foresight.npz", "foresight", spec)

    @torch.no_grad()
    def falling(self, s: RobotState, command: Command) -> torch.Tensor:
        """(N,) bool: who would fall by standing on; says nothing of robots that step.

        Args:
            s: The state; only joints, gravity's direction and angular velocity are used.
            command: What is commanded.
        """
        return self.model(features(s, command, self._default)) > SURE

    def lean(self, lean: torch.Tensor, s: RobotState, command: Command) -> torch.Tensor:
        """The lean (N,) [rad] by which a robot is to step: of one that stands infinite if it will fall or already leans
        far, and else none, whatever its arms do to its torso; of one that steps `lean` as it is."""
        steps = self.falling(s, command) | (lean > FAR_RAD)
        return torch.where(command.stand > 0.5, torch.where(steps, math.inf, 0.0), lean)
