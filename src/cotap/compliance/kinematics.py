"""Forward kinematics of serial chains of hinges, batched over envs and over chains of equal length."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch

from cotap.rotations import matrix_from_quat


@dataclass(frozen=True)
class ChainPose:
    """Where the links of a chain are, in the frame of its root. W envs, A chains, n joints."""

    anchors: torch.Tensor
    """Joint origins, which are the links' origins, (W, A, n, 3) [m]."""
    axes: torch.Tensor
    """Joint axes, (W, A, n, 3), unit vectors."""
    rotations: torch.Tensor
    """Orientation of the links, (W, A, n, 3, 3)."""
    tip: torch.Tensor
    """The tip point on the last link, (W, A, 3) [m]."""

    @property
    def rotation(self) -> torch.Tensor:
        """(W, A, 3, 3) orientation of the last link."""
        return self.rotations[:, :, -1]


class SerialChains:
    """Hinge chains rooted in one body, such as the two arms of a torso.

    Poses are computed with envs last in memory, and returned as views with envs first: small matrices side by side
    take several times as long.

    Args:
        offsets: Position of each link in its parent's frame, (A, n, 3) [m].
        quats: Its orientation there at zero angle, (A, n, 4).
        axes: Joint axes in the links' frames, (A, n, 3).
        tip: The tip point in the last link's frame, (A, 3) [m].
    """

    def __init__(self, offsets: torch.Tensor, quats: torch.Tensor, axes: torch.Tensor, tip: torch.Tensor) -> None:
        self.num_chains, self.num_joints = offsets.shape[:2]
        fixed = matrix_from_quat(quats)
        # Rodrigues' formula, R = I + sin(q) W + (1 - cos(q)) W^2, with the fixed rotation multiplied in beforehand.
        x, y, z = axes.unbind(-1)
        zero = torch.zeros_like(x)
        skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
        self._fixed, self._sine, self._versine = (_last(m) for m in (fixed, fixed @ skew, fixed @ skew @ skew))
        self._offsets, self._axes, self._tip = _last(offsets), _last(axes), _last(tip)

    def to(self, dtype: torch.dtype) -> SerialChains:
        """The same chains in another precision."""
        out = copy.copy(self)
        for name in ("_fixed", "_sine", "_versine", "_offsets", "_axes", "_tip"):
            setattr(out, name, getattr(self, name).to(dtype))
        return out

    def pose(self, q: torch.Tensor) -> ChainPose:
        """Pose of every link for joint angles `q` (W, A, n) [rad]."""
        angle = q.permute(2, 1, 0).contiguous()[:, None, None]
        local = self._fixed + angle.sin() * self._sine + (1.0 - angle.cos()) * self._versine  # (n, 3, 3, A, W)
        position, rotation = self._offsets[0].expand_as(local[0, 0]), local[0]
        anchors, rotations = [position], [rotation]
        for i in range(1, self.num_joints):
            position = position + (rotation * self._offsets[i]).sum(1)
            rotation = (rotation.unsqueeze(2) * local[i]).sum(1)
            anchors.append(position)
            rotations.append(rotation)
        tip = position + (rotation * self._tip).sum(1)
        turned = torch.stack(rotations)
        axes = (turned * self._axes.unsqueeze(1)).sum(2)
        return ChainPose(
            torch.stack(anchors).permute(3, 2, 0, 1), axes.permute(3, 2, 0, 1), turned.permute(4, 3, 0, 1, 2),
            tip.permute(2, 1, 0),
        )  # fmt: skip

    @staticmethod
    def jacobian(pose: ChainPose) -> torch.Tensor:
        """Jacobian of the tip's position in the root frame, (W, A, 3, n) [m/rad]."""
        return torch.linalg.cross(pose.axes, pose.tip.unsqueeze(2) - pose.anchors).transpose(-1, -2)


def _last(constant: torch.Tensor) -> torch.Tensor:
    """A chain's constant (A, ...) as (..., A, 1), to go with envs last."""
    return constant.movedim(0, -1).unsqueeze(-1).contiguous()
