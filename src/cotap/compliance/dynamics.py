"""Gravity torque, joint-space inertia and damping of serial arms, from the nominal description."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.compliance.kinematics import ChainPose
from cotap.compliance.small_matrices import batch_last, geometric_mean

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
    armature: torch.Tensor
    """(A, n) rotor inertia added to every joint [kg m^2]."""


def gravity_torque(links: LinkInertias, pose: ChainPose, up: torch.Tensor) -> torch.Tensor:
    """Torque (W, A, n) [Nm] that holds the arms still against gravity.

    For a hinge with axis n and anchor p that carries a mass M with its centre at c: `n . ((c - p) x M g up)`.

    Args:
        links: The arms' masses.
        pose: The arms' links in their root's frame.
        up: (W, 3) the vertical in the root's frame, unit length, pointing up.
    """
    anchors, axes, _, centers = _links(links, pose)
    weighted = links.mass[..., None, None] * centers
    lever = _carried(weighted, 1) - _carried(links.mass, 1)[..., None, None] * anchors
    # The torque of gravity is axis . (lever x -g up); holding still takes the opposite.
    lift = GRAVITY_M_S2 * up.T.expand_as(lever)
    return (axes * _cross(lever, lift)).sum(2).movedim(-1, 0)


def joint_inertia(links: LinkInertias, pose: ChainPose) -> torch.Tensor:
    """Joint-space inertia (W, A, n, n) [kg m^2] of arms whose root does not move.

    By composite bodies: a joint that turns at unit rate gives all that it carries a momentum about the root's origin,
    and its inertia with a joint before it is that joint's own motion times that momentum.
    """
    anchors, axes, rotations, centers = _links(links, pose)
    weighted = links.mass[..., None, None] * centers
    first_moment = _carried(weighted, 1)
    xx, xy, xz, yy, yz, zz = _carried(_about_origin(links, rotations, centers, weighted), 1).unbind(2)
    x, y, z = axes.unbind(2)
    spin = torch.stack((xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z), 2)
    # Turning about an axis moves the point of the body that is at the origin.
    origin_velocity = _cross(anchors, axes)
    angular = spin + _cross(first_moment, origin_velocity)
    linear = _cross(axes, first_moment) + _carried(links.mass, 1)[..., None, None] * origin_velocity
    joints = axes.shape[1]
    inertia = axes.new_empty(axes.shape[0], joints, joints, axes.shape[-1])
    for i in range(joints):
        shared = (axes[:, i : i + 1] * angular[:, i:] + origin_velocity[:, i : i + 1] * linear[:, i:]).sum(2)
        inertia[:, i, i:] = inertia[:, i:, i] = shared
    inertia.diagonal(dim1=1, dim2=2).add_(links.armature.unsqueeze(1))
    return inertia.movedim(-1, 0)


def _links(links: LinkInertias, pose: ChainPose) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Anchors, axes, rotations and centres of mass of the links, (A, n, ..., W): operations then run along the envs."""
    anchors, axes, rotations = (x.movedim(0, -1).contiguous() for x in (pose.anchors, pose.axes, pose.rotations))
    return anchors, axes, rotations, anchors + (rotations * links.com[..., None, :, None]).sum(3)


def _about_origin(
    links: LinkInertias, rotations: torch.Tensor, centers: torch.Tensor, weighted: torch.Tensor
) -> torch.Tensor:
    """Entries xx, xy, xz, yy, yz, zz of the links' inertias about the root's origin, in its frame, (A, n, 6, W).

    `weighted` (A, n, 3, W) are the links' centres times their masses.
    """
    own = (rotations.unsqueeze(4) * links.inertia[:, :, None, :, :, None]).sum(3)
    square = (weighted * centers).sum(2)
    entries = []
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        entry = (own[:, :, i] * rotations[:, :, j]).sum(2) - weighted[:, :, i] * centers[:, :, j]
        entries.append(entry + square if i == j else entry)
    return torch.stack(entries, 2)


def _carried(x: torch.Tensor, links: int) -> torch.Tensor:
    """Of a quantity of the links along dimension `links`, what each joint carries: its own link's and all beyond."""
    parts = list(x.unbind(links))
    for i in reversed(range(len(parts) - 1)):
        parts[i] = parts[i] + parts[i + 1]
    return torch.stack(parts, links)


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Cross products of vectors (A, n, 3, W)."""
    (ax, ay, az), (bx, by, bz) = a.unbind(2), b.unbind(2)
    return torch.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), 2)


def critical_damping(stiffness: torch.Tensor, inertia: torch.Tensor, ratio: float = 1.0) -> torch.Tensor:
    """Joint damping (..., n, n) [Nms/rad] that damps every mode of `M q'' + D q' + K q = 0` by `ratio` of critical.

    It is `2 ratio` times the geometric mean of K and M, `L (L^-1 K L^-T)^1/2 L^T` with `M = L L^T`.

    Args:
        stiffness: (..., n, n) symmetric positive definite [Nm/rad].
        inertia: (..., n, n) symmetric positive definite [kg m^2].
        ratio: Damping ratio.
    """
    k, m = batch_last(stiffness), batch_last(inertia)
    unit = m.diagonal().movedim(-1, 0).rsqrt()
    units = unit.unsqueeze(1) * unit  # in which every joint's own inertia is 1
    k = k * units
    # What is next to nothing in a direction may be negative there by rounding.
    k.diagonal().mul_(1.0 + 8.0 * torch.finfo(k.dtype).eps)
    mean = geometric_mean(k, m * units)
    return (2.0 * ratio * mean / units).movedim(-1, 0).reshape(stiffness.shape)
