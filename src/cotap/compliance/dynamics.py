"""Gravity torque, joint-space inertia and damping of serial arms, from the nominal description."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import torch

from cotap.compliance.arguments import full_precision
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
    centers = pose.anchors + rotate(pose.rotations, links.com)
    weighted = links.mass.unsqueeze(-1) * centers
    lever = _carried(weighted, 2) - _carried(links.mass, 1).unsqueeze(-1) * pose.anchors
    # The torque of gravity is axis . (lever x -g up); holding still takes the opposite.
    lift = GRAVITY_M_S2 * up[:, None, None, :].expand_as(lever)
    return (pose.axes * torch.linalg.cross(lever, lift)).sum(-1)


def joint_inertia(links: LinkInertias, pose: ChainPose) -> torch.Tensor:
    """Joint-space inertia (W, A, n, n) [kg m^2] of arms whose root does not move.

    By composite bodies: a joint that turns at unit rate gives all that it carries a momentum about the root's origin,
    and its inertia with a joint before it is that joint's own motion times that momentum.
    """
    # Envs last: every operation then runs along them.
    anchors, axes, rotations = (x.movedim(0, -1).contiguous() for x in (pose.anchors, pose.axes, pose.rotations))
    centers = anchors + (rotations * links.com[..., None, :, None]).sum(3)
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


@full_precision
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
    size = stiffness.shape[-2:]
    values, root = _diagonalized(whitened.reshape(-1, *size), factor.reshape(-1, *size))
    half = (root * (2.0 * ratio * values.clamp_min(0.0).sqrt()).sqrt()).movedim(-1, 0)
    return (half @ half.transpose(-1, -2)).reshape(stiffness.shape)


def _diagonalized(symmetric: torch.Tensor, factor: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Eigenvalues (n, B) of positive definite matrices (B, n, n), and `factor` (B, n, n) times their eigenvectors, as
    (n, n, B).

    Jacobi's method, all matrices at once: the library's decomposition takes them one by one, which costs twice as long
    for many small ones, and in single precision it is less exact where eigenvalues lie far apart. For n up to 7 as many
    sweeps as there are columns leave what single precision rounds anyway; in double precision it is left, too.
    """
    n = symmetric.shape[-1]
    both = torch.cat((symmetric, factor), 1).permute(1, 2, 0).contiguous()
    matrix = both[:n]
    transposed = matrix.transpose(0, 1)
    tiny = torch.finfo(symmetric.dtype).tiny
    for p, q in n * list(combinations(range(n), 2)):
        twice, apart = 2.0 * matrix[p, q], matrix[q, q] - matrix[p, p]
        width = torch.addcmul(twice * twice, apart, apart).sqrt_().add_(tiny)
        tangent = twice / (apart + torch.copysign(width, apart))
        cosine = (1.0 + tangent * tangent).rsqrt_()
        sine = tangent * cosine
        _rotate_columns(both, p, q, cosine, sine)
        _rotate_columns(transposed, p, q, cosine, sine)
    return matrix.diagonal().movedim(-1, 0), both[n:]


def _rotate_columns(matrix: torch.Tensor, p: int, q: int, cosine: torch.Tensor, sine: torch.Tensor) -> None:
    """Turn columns p and q of matrices (rows, n, B) into each other, in place."""
    first, second = matrix[:, p], matrix[:, q]
    matrix[:, p], matrix[:, q] = (
        torch.addcmul(cosine * first, sine, second, value=-1.0),
        torch.addcmul(sine * first, cosine, second),
    )
