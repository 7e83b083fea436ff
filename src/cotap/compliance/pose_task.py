"""Blended stiffness where the hand's task is its pose: position and orientation, for arms of six joints or more.

The blend is that of `fast`: the geodesic from the PD gains to the compliant stiffness. Six dimensions have no closed
form, so that an eigendecomposition does it, at several times the cost.
"""

from __future__ import annotations

import torch

from cotap.compliance.arguments import symmetric_part
from cotap.compliance.fast import ArmStiffness
from cotap.compliance.kinematics import ChainPose, SerialChains
from cotap.compliance.stiffness import damped_gram_inverse


def pose_jacobian(pose: ChainPose, to_frame: torch.Tensor) -> torch.Tensor:
    """(W, A, 6, n): how the hand moves [m/rad] and turns [rad/rad] in the frame that `to_frame` (W, 3, 3) leads to."""
    turn = to_frame.unsqueeze(1)
    return torch.cat((turn @ SerialChains.jacobian(pose), turn @ pose.axes.transpose(-1, -2)), -2)


def blended_pose_stiffness(
    jacobian: torch.Tensor, stiffness: torch.Tensor, rotational_stiffness: float, null_stiffness: torch.Tensor,
    pd_stiffness: torch.Tensor, alpha: torch.Tensor, threshold: float, characteristic_length: float,
) -> ArmStiffness:  # fmt: skip
    """The singularity-aware blend of compliance and PD for poses. Arguments are taken to be valid.

    Args:
        jacobian: (..., 6, n) of `pose_jacobian`, n >= 6.
        stiffness: (..., 3) what the arm contributes to the hand's position, as a diagonal, or (..., 3, 3) [N/m].
        rotational_stiffness: Of its orientation, about every axis [Nm/rad].
        null_stiffness: (...) of the joint with the largest gain; that of the others is as many times lower as their
            gains are [Nm/rad].
        pd_stiffness: (..., n) the PD law's gains [Nm/rad].
        alpha: (...) in [0, 1].
        threshold: Condition number up to which alpha is kept.
        characteristic_length: What a radian counts as, where singular values are compared [m].
    """
    kind, gains, null = jacobian.dtype, pd_stiffness.double(), null_stiffness.double()[..., None, None]
    length = torch.ones(6, dtype=torch.float64, device=jacobian.device)
    length[3:] = characteristic_length
    j = length.unsqueeze(-1) * jacobian.double()
    values = torch.linalg.svdvals(j)
    condition = values[..., 0] / values[..., -1].clamp_min(1e-7 * values[..., 0])
    singularity = 1.0 / (1.0 + (condition - threshold).clamp_min(0.0))
    ratio = alpha.double() * singularity

    # Joints are measured in units in which the PD law has one gain.
    largest = gains.amax(-1)
    root = (gains / largest.unsqueeze(-1)).sqrt()
    j = j / root.unsqueeze(-2)
    pseudo_inverse = j.transpose(-1, -2) @ damped_gram_inverse(j)
    null_projector = torch.eye(j.shape[-1], dtype=j.dtype, device=j.device) - pseudo_inverse @ j
    task = torch.zeros(*j.shape[:-1], 6, dtype=j.dtype, device=j.device)
    task[..., :3, :3] = stiffness if stiffness.dim() == j.dim() else torch.diag_embed(stiffness)
    task[..., 3:, 3:] = rotational_stiffness / characteristic_length**2 * torch.eye(3, dtype=j.dtype, device=j.device)
    compliant = j.transpose(-1, -2) @ task @ j + null * null_projector
    values, vectors = torch.linalg.eigh(symmetric_part(compliant))
    blended = largest.pow(1.0 - ratio).unsqueeze(-1) * values.clamp_min(1e-9).pow(ratio.unsqueeze(-1))
    rows, columns = root.unsqueeze(-1), root.unsqueeze(-2)
    whole = rows * ((vectors * blended.unsqueeze(-2)) @ vectors.transpose(-1, -2)) * columns
    return ArmStiffness(
        whole.to(kind), (pseudo_inverse * length / rows).to(kind), (null_projector / rows * columns).to(kind),
        ratio.to(kind), singularity.to(kind), blended[..., [0, -1]].to(kind),
    )  # fmt: skip
