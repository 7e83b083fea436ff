"""Quaternions (w, x, y, z) and rotation matrices, batch first. `inverse` means the transpose of a rotation."""

from __future__ import annotations

import torch


def matrix_from_quat(q: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = q.unbind(-1)
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    rows = (
        1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy),
        2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx),
        2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy),
    )  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quat_about_z(yaw: torch.Tensor) -> torch.Tensor:
    """Quaternions (..., 4) of rotations by `yaw` (...) about z."""
    half = 0.5 * yaw
    zero = torch.zeros_like(half)
    return torch.stack((half.cos(), zero, zero, half.sin()), -1)


def rotate(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """`matrix @ vector` for (..., m, n) and (..., n)."""
    return (matrix * vector.unsqueeze(-2)).sum(-1)


def rotate_inverse(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """`matrix^T @ vector` for (..., 3, 3) and (..., 3)."""
    return (matrix * vector.unsqueeze(-1)).sum(-2)


def yaw_of(matrix_w: torch.Tensor) -> torch.Tensor:
    """Yaw (...) [rad] of orientations (..., 3, 3)."""
    return torch.atan2(matrix_w[..., 1, 0], matrix_w[..., 0, 0])


def heading_matrix(matrix_w: torch.Tensor) -> torch.Tensor:
    """The rotation about z (..., 3, 3) that shares the yaw of `matrix_w`: z up, x along the body's forward axis."""
    forward = torch.nn.functional.normalize(matrix_w[..., :2, 0], dim=-1)
    c, s = forward.unbind(-1)
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    return torch.stack((c, -s, zero, s, c, zero, zero, zero, one), -1).unflatten(-1, (3, 3))


def quat_from_matrix(m: torch.Tensor) -> torch.Tensor:
    """Unit quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3); stable at every rotation.

    Each row of the symmetric 4x4 matrix below is the quaternion times four times one of its components; the row of
    the largest component is the best conditioned.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in m.unbind(-2))
    rows = torch.stack(
        (
            1 + a + e + i, h - f, c - g, d - b,
            h - f, 1 + a - e - i, b + d, c + g,
            c - g, b + d, 1 - a + e - i, f + h,
            d - b, c + g, f + h, 1 - a - e + i,
        ),
        -1,
    ).unflatten(-1, (4, 4))  # fmt: skip
    best = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = torch.nn.functional.normalize(
        rows.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2), dim=-1
    )
    return torch.where(q[..., :1] < 0.0, -q, q)
