"""Standing: the legs' pose at every height and the feedback that balances it, fed forward to the legs."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco
import numpy as np
import torch
from scipy.optimize import least_squares

from cotap.robots import RobotSpec

HEIGHT_STEP_M = 0.02
LOWEST_M = -0.3
_LARGEST_RAD = 1.0
"""Largest correction: the feedback is linear, and made for small errors."""


class StanceBalance:
    """Targets of the legs' pitch joints that stand upright at a height, soles flat, mass over their middle, and
    that correct what tilts.

    PD control alone does not hold the robot upright: its ankles are a fifth as stiff as its weight asks for. Only what
    the robot's own sensors measure is used: joints, gravity's direction and angular velocity.

    Args:
        spec: The robot, whose `stance` holds the gains.
        model: Its compiled model.
    """

    def __init__(self, spec: RobotSpec, model: mujoco.MjModel) -> None:
        stance = spec.stance
        self.joints = torch.tensor([spec.indices(leg) for leg in stance.joints])
        """(F, n) which joints are moved."""
        self._nominal = spec.nominal_height_m
        count = round(-LOWEST_M / HEIGHT_STEP_M) + 1
        poses, offsets = zip(*(_stand(spec, model, -i * HEIGHT_STEP_M) for i in range(count)), strict=True)
        self._poses = torch.tensor(np.array(poses), dtype=torch.float32)
        """(H, n) joint angles from nominal height downwards."""
        self._offsets = torch.tensor(np.array(offsets), dtype=torch.float32)
        """(H, n) how far targets must be from the angles for PD control to carry the weight."""
        self._gains = [torch.cat((torch.tensor(g.gain), torch.tensor(g.bias).unsqueeze(1)), 1) for g in stance.gains]
        """Of the two heights: (n, 2 (1 + n) + 1), bias last; or (N, ...), one per world."""
        self._offsets_m = [g.height_offset_m for g in stance.gains]

    def __call__(
        self, height: torch.Tensor, joint_pos: torch.Tensor, joint_vel: torch.Tensor, projected_gravity: torch.Tensor,
        angular_velocity: torch.Tensor,
    ) -> torch.Tensor:  # fmt: skip
        """Targets (N, n) [rad], the same for every leg.

        Args:
            height: (N,) commanded height of the torso link [m].
            joint_pos: (N, J) [rad].
            joint_vel: (N, J) [rad/s].
            projected_gravity: (N, 3) unit vector in the torso frame.
            angular_velocity: (N, 3) of the torso, in its frame [rad/s].
        """
        place = ((self._nominal - height) / HEIGHT_STEP_M).clamp(0.0, len(self._poses) - 1.001)
        row, share = place.long(), place.frac().unsqueeze(1)
        pose = torch.lerp(self._poses[row], self._poses[row + 1], share)
        offset = torch.lerp(self._offsets[row], self._offsets[row + 1], share)
        bent, bending = joint_pos[:, self.joints].mean(1), joint_vel[:, self.joints].mean(1)
        error = torch.cat((projected_gravity[:, :1], bent - pose, angular_velocity[:, 1:2], bending), 1)
        correction = (self._gain(height) @ torch.nn.functional.pad(error, (0, 1), value=1.0).unsqueeze(-1)).squeeze(-1)
        return pose + offset + correction.clamp(-_LARGEST_RAD, _LARGEST_RAD)

    def set_gains(self, gains: torch.Tensor, which: int) -> None:
        """Try other gains (N, n, 2 (1 + n) + 1), bias last, one per world, at the first or second tuned height."""
        self._gains[which] = gains

    def _gain(self, height: torch.Tensor) -> torch.Tensor:
        """Linear between the two tuned heights."""
        high, low = self._offsets_m
        share = ((height - self._nominal - high) / (low - high)).clamp(0.0, 1.0)
        first, second = self._gains
        return torch.lerp(first, second, share[:, None, None])


def _stand(spec: RobotSpec, model: mujoco.MjModel, offset_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Angles (n,) of a leg's pitch joints, upright at `offset_m` from nominal height, and the targets' offsets (n,)."""
    data = mujoco.MjData(model)
    legs = [spec.indices(leg) for leg in spec.stance.joints]
    foot, body = spec.feet[0], model.body(spec.feet[0].body).id
    default = np.array([j.default_rad for j in spec.joints])

    def place(angles: np.ndarray) -> np.ndarray:
        """Put the legs there; returns where the sole is in the base's frame (3,)."""
        data.qpos[:] = np.concatenate((np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), default))
        for leg in legs:
            data.qpos[[7 + i for i in leg]] = angles
        mujoco.mj_forward(model, data)
        return data.xpos[body] + data.xmat[body].reshape(3, 3) @ foot.sole

    start = default[legs[0]]
    level = place(start)[2] - offset_m

    def residual(angles: np.ndarray) -> np.ndarray:
        sole = place(angles)
        return np.array([sole[2] - level, data.subtree_com[0, 0] - sole[0], angles.sum()])

    crouch = np.array([2.5, -5.0, 2.5]) * offset_m
    angles = least_squares(residual, start + crouch, xtol=1e-12, ftol=1e-12, gtol=1e-12).x
    sole = place(angles)
    # Each leg carries its share of all that its sole does not: a vertical force through the middle of the sole.
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, sole, body)
    dofs = [model.joint(name).dofadr[0] for name in spec.stance.joints[0]]
    ground = jacobian[2, dofs] * data.qfrc_bias[2] / len(legs)
    kp = np.array([spec.joints[i].kp for i in legs[0]])
    return angles, (data.qfrc_bias[dofs] - ground) / kp
