"""Forward kinematics of serial chains of hinges, batched over worlds and over chains of equal length."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch

from cotap.rotations import matrix_from_quat


@dataclass(frozen=True)
class ChainPose:
    """Where the links of a chain are, in the frame of its root. W worlds, A chains, n joints."""

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

    Args:
        offsets: Position of each link in its parent's frame, (A, n, 3) [m].
        quats: Its orientation there at zero angle, (A, n, 4).
        axes: Joint axes in the links' frames, (A, n, 3).
        tip: The tip point in the last link's frame, (A, 3) [m].
    """

    def __init__(self, offsets: torch.Tensor, quats: torch.Tensor, axes: torch.Tensor, tip: torch.Tensor) -> None:
        self.offsets, self.axes, self.tip = offsets, axes, tip
        self.num_joints = offsets.shape[1]
        self._fixed = matrix_from_quat(quats)
        # Rodrigues' formula, R = I + sin(q) W + (1 - cos(q)) W^2, with the fixed rotation multiplied in beforehand.
        x, y, z = axes.unbind(-1)
        zero = torch.zeros_like(x)
        skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).unflatten(-1, (3, 3))
        self._sine, self._versine = self._fixed @ skew, self._fixed @ skew @ skew

    def to(self, dtype: torch.dtype) -> SerialChains:
        """The same chains in another precision."""
        out = copy.copy(self)
        for name in ("offsets", "axes", "tip", "_fixed", "_sine", "_versine"):
            setattr(out, name, getattr(self, name).to(dtype))
        return out

    @property
    def rodrigues(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Matrices F, S and V, (A, n, 3, 3), of rotations into the links' parents, `F + sin(q) S + (1 - cos(q)) V`."""
        return self._fixed, self._sine, self._versine

    def pose(self, q: torch.Tensor) -> ChainPose:
        """Pose of every link for joint angles `q` (W, A, n) [rad]."""
        sine, versine = q.sin()[..., None, None], (1.0 - q.cos())[..., None, None]
        local = self._fixed + sine * self._sine + versine * self._versine  # (W, A, n, 3, 3)
        position, rotation = self.offsets[:, 0].expand(q.shape[0], -1, 3), local[:, :, 0]
        rotations = [rotation]
        anchors, axes = [position], [(rotation @ self.axes[:, 0, :, None]).squeeze(-1)]
        for i in range(1, self.num_joints):
            position = position + (rotation @ self.offsets[:, i, :, None]).squeeze(-1)
            rotation = rotation @ local[:, :, i]
            rotations.append(rotation)
            anchors.append(position)
            axes.append((rotation @ self.axes[:, i, :, None]).squeeze(-1))
        tip = position + (rotation @ self.tip[..., None]).squeeze(-1)
        return ChainPose(torch.stack(anchors, 2), torch.stack(axes, 2), torch.stack(rotations, 2), tip)

    @staticmethod
    def jacobian(pose: ChainPose) -> torch.Tensor:
        """Jacobian of the tip's position in the root frame, (W, A, 3, n) [m/rad]."""
        return torch.linalg.cross(pose.axes, pose.tip.unsqueeze(2) - pose.anchors).transpose(-1, -2)
