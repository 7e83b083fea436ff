"""Small matrices of many arms, the batch last in memory: (rows, columns, B).

Every operation then runs along the batch. The library's products, inverses and decompositions take small matrices one
by one, which costs several times as long.
"""

from __future__ import annotations

import torch


def batch_last(matrix: torch.Tensor) -> torch.Tensor:
    """(m, n, B), contiguous, of matrices (..., m, n)."""
    return matrix.reshape(-1, *matrix.shape[-2:]).permute(1, 2, 0).contiguous()


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """`a b`, (l, n, B), of (l, m, B) and (m, n, B)."""
    out = a[:, 0].unsqueeze(1) * b[0]
    for k in range(1, len(b)):
        out.addcmul_(a[:, k].unsqueeze(1), b[k])
    return out


def plus_diagonal(a: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """`a + shift I` for matrices (n, n, ...) and numbers (...)."""
    out = a.clone()
    out.diagonal().add_(shift.unsqueeze(-1))
    return out


def eigenvalues_3x3(a: torch.Tensor) -> torch.Tensor:
    """Eigenvalues (3, ...), ascending, of symmetric positive semidefinite matrices (3, 3, ...).

    In float64 the middle one is exact to 1e-8 of the largest, and so is the smallest beside a large middle one.
    """
    xx, xy, xz, yy, yz, zz = _entries(a)
    mean = (xx + yy + zz) / 3.0
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    xy2, xz2, yz2 = xy * xy, xz * xz, yz * yz
    square = (dx * dx + dy * dy + dz * dz + 2.0 * (xy2 + xz2 + yz2)) / 6.0
    spread = square.sqrt()
    tiny, eps = torch.finfo(a.dtype).tiny, torch.finfo(a.dtype).eps
    determinant = dx * (dy * dz - yz2) - xy2 * dz - xz2 * dy + 2.0 * xy * xz * yz
    angle = torch.acos((0.5 * determinant / (square * spread).clamp_min(tiny)).clamp_(-1.0, 1.0)) / 3.0
    largest = mean + 2.0 * spread * angle.cos()
    smallest = mean + 2.0 * spread * (angle + 2.0 * torch.pi / 3.0).cos()
    middle = (3.0 * mean - largest - smallest).maximum(eps * largest)
    # Beside two large eigenvalues the formula loses the digits of a small one; the determinant keeps them.
    others = (middle * largest).clamp_min(tiny)
    whole = xx * (yy * zz - yz2) - xy2 * zz - xz2 * yy + 2.0 * xy * xz * yz
    smallest = torch.where(smallest < 1e-3 * largest, whole / others, smallest).clamp_min(0.0).minimum(middle)
    return torch.stack((smallest, middle, largest))


def inverse_3x3(a: torch.Tensor) -> torch.Tensor:
    """Inverses (3, 3, ...) of symmetric matrices (3, 3, ...)."""
    xx, xy, xz, yy, yz, zz = _entries(a)
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    cyy, cyz, czz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    adjugate = torch.stack((cxx, cxy, cxz, cxy, cyy, cyz, cxz, cyz, czz))
    return (adjugate / (xx * cxx + xy * cxy + xz * cxz)).unflatten(0, (3, 3))


def _entries(a: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """The six different entries (...) of symmetric matrices (3, 3, ...)."""
    return a[0, 0], a[0, 1], a[0, 2], a[1, 1], a[1, 2], a[2, 2]


def inverse(matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Inverses of positive definite matrices (n, n, B), by sweeps over the diagonal, and the logarithms (B,) of their
    determinants."""
    swept, pivots = matrix.clone(), []
    for i in range(len(matrix)):
        column = swept[i].clone()
        pivots.append(column[i])
        over = column[i].reciprocal()
        row = column * over
        swept.addcmul_(column.unsqueeze(1), row, value=-1.0)
        swept[i] = swept[:, i] = row
        swept[i, i] = -over
    return swept.neg_(), torch.stack(pivots).log_().sum(0)


_ITERATIONS = 6
"""Of the geometric mean. Rounding is left where the eigenvalues of `a^-1 b` vary by 1e4, or 1e6 in up to 4 rows."""


def geometric_mean(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """`a (a^-1 b)^1/2` of positive definite matrices (n, n, B).

    `X <- (X + Y^-1) / 2` and `Y <- (Y + X^-1) / 2`, from `a` and `b^-1`, tend to the mean and its inverse (E. D. Denman
    and A. N. Beavers, The matrix sign function and computations in systems, Appl. Math. Comput. 2, 1976); first
    scaled, so that the product of their determinants is 1.
    """
    twice = 2.0 * len(a)
    x, over_y = a.clone(), b
    y, logarithm = inverse(b)
    for _ in range(_ITERATIONS):
        over_x, of_x = inverse(x)
        scale = 0.5 * ((logarithm - of_x) / twice).exp()
        x.mul_(scale).addcmul_(over_y, 0.25 / scale)
        y.mul_(scale).addcmul_(over_x, 0.25 / scale)
        over_y, of_y = inverse(y)
        logarithm = -of_y
    return 0.5 * (x + over_y)
