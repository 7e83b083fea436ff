"""What the arms' laws know of the forces on the hands: the simulation's own, or an estimate from the arms' torques."""

from __future__ import annotations

import math

import torch

from cotap.compliance.dynamics import gravity_torque, joint_inertia
from cotap.compliance.force_estimation import hand_force, observe_torque
from cotap.compliance.interface import Arms
from cotap.envs.state import RobotState
from cotap.persistence import Stateful

TIME_CONSTANT_S = 0.05
"""Of the estimate's low pass."""


class HandSensors(Stateful):
    """Forces on the hands over the control step that has just ended, in the heading frame.

    Args:
        arms: Nominal model of the arms, which estimates use.
        num_envs: Number of envs.
        dt: Control step [s].
        estimates: Whether anyone asks for estimates; without, none are made.
    """

    STATE = ("privileged", "estimated", "_momentum", "_torque")

    def __init__(self, arms: Arms, num_envs: int, dt: float, estimates: bool) -> None:
        self._arms, self._dt, self.estimates = arms, dt, estimates
        num_arms, joints = arms.kp.shape
        self.privileged = torch.zeros(num_envs, num_arms, 3, dtype=arms.kp.dtype)
        self.estimated = torch.zeros(num_envs, num_arms, 3, dtype=arms.kp.dtype)
        self._momentum, self._torque = (torch.zeros(num_envs, num_arms, joints, dtype=arms.kp.dtype) for _ in range(2))

    def reset(self, mask: torch.Tensor) -> None:
        """Arms in the envs of `mask` start at rest, with nothing on their hands."""
        for name in self.STATE:
            getattr(self, name)[mask] = 0.0

    def sense(
        self, state: RobotState, q: torch.Tensor, dq: torch.Tensor, force_w: torch.Tensor, effort: torch.Tensor
    ) -> None:
        """Take in a control step.

        Args:
            state: At its end.
            q: (N, A, n) the arms' joint angles in it [rad].
            dq: (N, A, n) [rad/s].
            force_w: (N, A, 3) what acted on the hands, world frame [N].
            effort: (N, A, n) mean torque of the arms' motors over the step [Nm].
        """
        self.privileged = force_w @ state.heading_w
        if not self.estimates:
            return
        to_heading = state.torso_to_heading
        pose = self._arms.chains.pose(q)
        momentum = (joint_inertia(self._arms.inertias, pose) @ dq.unsqueeze(-1)).squeeze(-1)
        gravity = gravity_torque(self._arms.inertias, pose, to_heading[:, 2])
        share = 1.0 - math.exp(-self._dt / TIME_CONSTANT_S)
        effort = effort - self._arms.friction * dq
        self._torque = observe_torque(self._torque, momentum - self._momentum, effort, gravity, share, self._dt)
        self._momentum = momentum
        self.estimated = hand_force(to_heading.unsqueeze(1) @ self._arms.chains.jacobian(pose), self._torque)
