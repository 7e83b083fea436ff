"""What motors do in one control step: torque that is affine in the joints' state, in float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cotap.compliance.laws import TorqueLaw


@dataclass(frozen=True)
class JointLaw:
    """`tau = bias - K q - D dq`, evaluated at the engine's (the motor driver's) rate. J joints."""

    bias: np.ndarray
    """(J,) [Nm]."""
    stiffness: np.ndarray
    """(J, J) [Nm/rad]."""
    damping: np.ndarray
    """(J, J) [Nms/rad]."""

    def torque(self, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Torques (J,) [Nm], limits aside, at joint angles (J,) [rad] and rates (J,) [rad/s]."""
        return self.bias - self.stiffness @ q - self.damping @ dq

    def ramped(self, share: float) -> JointLaw:
        """The same with all but its damping scaled by `share`."""
        return JointLaw(share * self.bias, share * self.stiffness, self.damping)

    def with_arms(self, arms: TorqueLaw, first: int) -> JointLaw:
        """The same with joints from `first` on under the law of env 0 of `arms`."""
        bias, stiffness, damping = self.bias.copy(), self.stiffness.copy(), self.damping.copy()
        for arm in range(arms.anchor.shape[1]):
            k, d = arms.stiffness[0, arm].numpy(), arms.damping[0, arm].numpy()
            begin = first + arm * len(k)
            mine = slice(begin, begin + len(k))
            stiffness[mine, mine], damping[mine, mine] = k, d
            constant = arms.feedforward[0, arm] + arms.elastic[0, arm]
            bias[mine] = constant.numpy() + k @ arms.anchor[0, arm].numpy()
        return JointLaw(bias, stiffness, damping)


def pd_law(kp: np.ndarray, kd: np.ndarray, target: np.ndarray) -> JointLaw:
    """`kp (target - q) - kd dq` for gains and targets (J,)."""
    return JointLaw(kp * target, np.diag(kp), np.diag(kd))


def damped_law(kd: np.ndarray) -> JointLaw:
    """`-kd dq`: what a robot is left with when it is stopped."""
    return JointLaw(np.zeros_like(kd), np.zeros((len(kd), len(kd))), np.diag(kd))
