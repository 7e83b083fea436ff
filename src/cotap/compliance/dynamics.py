"""Gravity torque, joint-space inertia and damping of serial arms, from the nominal description."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.compliance.kinematics import ChainPose
from cotap.rotations import rotate

GRAVITY_M_S2 = 9.81


@dataclass(frozen=True)
class LinkInertias:
    """Masses of the links of A chains of n links, in the links' frames."""

    mass: torch.Tensor
    """(A, n) [kg]."""
    com: torch.Tensor
    """(A, n, 3) centre of mass in the link's frame [m]."""
    inertia: torch.Tensor
    """(A, n, 3, 3) about the centre of mass, in the link's frame [kg m^2]."""
    armature: float = 0.0
    """Rotor inertia added to every joint [kg m^2]."""


def gravity_torque(links: LinkInertias, pose: ChainPose, up: torch.Tensor) -> torch.Tensor:
    """Torque (W, A, n) [Nm] that holds the arms still against gravity.

    For a hinge with axis n and anchor p that carries a mass M with its centre at c: `n . ((c - p) x M g up)`.

    Args:
        links: The arms' masses.
        pose: The arms' links in their root's frame.
        up: (W, 3) the vertical in the root's frame, unit length, pointing up.
    """
    centers = pose.anchors + rotate(pose.rotations, links.com)
    weighted = links.mass.unsqueeze(-1) * centers
    # What a joint carries is its own link and all beyond.
    carried = weighted.flip(2).cumsum(2).flip(2)
    mass = links.mass.flip(1).cumsum(1).flip(1)
    lever = carried - mass.unsqueeze(-1) * pose.anchors
    # The torque of gravity is axis . (lever x -g up); holding still takes the opposite.
    lift = GRAVITY_M_S2 * up[:, None, None, :].expand_as(lever)
    return (pose.axes * torch.linalg.cross(lever, lift)).sum(-1)


def joint_inertia(links: LinkInertias, pose: ChainPose) -> torch.Tensor:
    """Joint-space inertia (W, A, n, n) [kg m^2] of arms whose root does not move."""
    axes, joints = pose.axes, pose.axes.shape[2]
    centers = pose.anchors + rotate(pose.rotations, links.com)
    arm = centers.unsqueeze(2) - pose.anchors.unsqueeze(3)  # (W, A, joint, link, 3)
    moves = torch.ones(joints, joints, dtype=arm.dtype, device=arm.device).triu()
    weight = (moves * links.mass.sqrt().unsqueeze(-2)).unsqueeze(-1)
    linear = (torch.linalg.cross(axes.unsqueeze(3).expand_as(arm), arm) * weight).flatten(-2)
    world = pose.rotations @ links.inertia @ pose.rotations.transpose(-1, -2)
    # Two joints turn together what the one nearer to the hand carries.
    carried = world.flip(2).cumsum(2).flip(2)
    spin = axes @ (carried @ axes.unsqueeze(-1)).squeeze(-1).transpose(-1, -2)
    spin = spin.triu() + spin.triu(1).transpose(-1, -2)
    eye = torch.eye(joints, dtype=arm.dtype, device=arm.device)
    return linear @ linear.transpose(-1, -2) + spin + links.armature * eye


def critical_damping(stiffness: torch.Tensor, inertia: torch.Tensor, ratio: float = 1.0) -> torch.Tensor:
    """Joint damping (..., n, n) [Nms/rad] that damps every mode of `M q'' + D q' + K q = 0` by `ratio` of critical.

    With `M = L L^T` and `S = L^-1 K L^-T`, `D = 2 ratio L sqrt(S) L^T`.

    Args:
        stiffness: (..., n, n) symmetric positive definite [Nm/rad].
        inertia: (..., n, n) symmetric positive definite [kg m^2].
        ratio: Damping ratio.
    """
    factor = torch.linalg.cholesky(inertia)
    whitened = torch.linalg.solve_triangular(factor, stiffness, upper=False)
    whitened = torch.linalg.solve_triangular(factor, whitened.transpose(-1, -2), upper=False)
    values, vectors = torch.linalg.eigh(0.5 * (whitened + whitened.transpose(-1, -2)))
    root = factor @ vectors
    return 2.0 * ratio * (root * values.clamp_min(0.0).sqrt().unsqueeze(-2)) @ root.transpose(-1, -2)
