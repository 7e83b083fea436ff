"""Blended stiffness of many arms at once, in closed form: what rollouts use in place of `modulate_stiffness`.

For a PD law whose gain is one number k on all joints of an arm, the log-Euclidean blend is a matrix power,
`K = k^(1-a) K_u^a`. With `G = B B^T`, `B^T B = J^T C_hat^-1 J`, and the projector N on the null space,

    K = k^(1-a) (B^T G^(a-1) B + k_null^a N),

and the power of the m x m matrix G is a Newton polynomial through its eigenvalues, which have a closed form for m = 3.
Gains that differ between joints become one number where joints are measured in units of `1 / sqrt(gain)`: there the
blend is taken, and the result is on the geodesic `P^1/2 (P^-1/2 K_u P^-1/2)^a P^1/2` from the PD gains P to `K_u`.
All in float64: the polynomial's terms cancel, and one double costs less than one eigendecomposition. Not to be
differentiated: where eigenvalues coincide, the result is not finite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from cotap.compliance.stiffness import RANK_TOLERANCE

_ROUNDING = 1e-14
"""Share of the largest eigenvalue below which one is taken for rounding."""


@dataclass(frozen=True)
class ArmStiffness:
    """What one control step of compliance needs, for arms (..., n joints) with a 3-D task."""

    stiffness: torch.Tensor
    """(..., n, n) the blend K [Nm/rad]."""
    pseudo_inverse: torch.Tensor
    """(..., n, 3) J#, damped near rank loss unless the threshold is infinite; of all that reach the hand's target,
    what the PD gains resist least."""
    null_projector: torch.Tensor
    """(..., n, n) I - J# J."""
    ratio: torch.Tensor
    """(...) alpha after the singularity."""
    singularity: torch.Tensor
    """(...) 1 / (1 + max(0, cond(J) - threshold))."""
    eigenvalue_range: torch.Tensor
    """(..., 2) smallest and largest eigenvalue of K [Nm/rad]; where gains differ, of K relative to them, times the
    largest gain."""


def eigenvalues_3x3(a: torch.Tensor) -> torch.Tensor:
    """Eigenvalues (..., 3), ascending, of symmetric positive semidefinite matrices (..., 3, 3)."""
    xx, xy, xz, yy, yz, zz = _entries(a)
    mean = (xx + yy + zz) / 3.0
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    xy2, xz2, yz2 = xy * xy, xz * xz, yz * yz
    square = (dx * dx + dy * dy + dz * dz + 2.0 * (xy2 + xz2 + yz2)) / 6.0
    spread = square.sqrt()
    tiny = torch.finfo(a.dtype).tiny
    determinant = dx * (dy * dz - yz2) - xy2 * dz - xz2 * dy + 2.0 * xy * xz * yz
    angle = torch.acos((0.5 * determinant / (square * spread).clamp_min(tiny)).clamp_(-1.0, 1.0)) / 3.0
    largest = mean + 2.0 * spread * angle.cos()
    smallest = mean + 2.0 * spread * (angle + 2.0 * torch.pi / 3.0).cos()
    middle = 3.0 * mean - largest - smallest
    # Beside two large eigenvalues the formula loses the digits of a small one; the determinant keeps them.
    product = (middle * largest).clamp_min(tiny)
    whole = xx * (yy * zz - yz2) - xy2 * zz - xz2 * yy + 2.0 * xy * xz * yz
    smallest = torch.where(smallest < 1e-3 * largest, whole / product, smallest)
    return torch.stack((smallest, middle, largest), -1)


def inverse_3x3(a: torch.Tensor) -> torch.Tensor:
    """Inverses (..., 3, 3) of symmetric matrices (..., 3, 3)."""
    xx, xy, xz, yy, yz, zz = _entries(a)
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    cyy, cyz, czz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    adjugate = torch.stack((cxx, cxy, cxz, cxy, cyy, cyz, cxz, cyz, czz), -1)
    return (adjugate / (xx * cxx + xy * cxy + xz * cxz).unsqueeze(-1)).unflatten(-1, (3, 3))


def _entries(a: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """The six different entries (...) of symmetric matrices (..., 3, 3), each contiguous."""
    return a.flatten(-2)[..., [0, 1, 2, 4, 5, 8]].movedim(-1, 0).contiguous().unbind(0)


def _plus(a: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """`a + shift I` for matrices (..., 3, 3) and numbers (...)."""
    out = a.clone()
    torch.diagonal(out, dim1=-2, dim2=-1).add_(shift.unsqueeze(-1))
    return out


def blended_stiffness(
    jacobian: torch.Tensor, task_stiffness: torch.Tensor, null_stiffness: torch.Tensor, pd_stiffness: torch.Tensor,
    alpha: torch.Tensor, threshold: float = 10.0,
) -> ArmStiffness:  # fmt: skip
    """The singularity-aware blend of compliance and PD (paper, equations 7 to 10).

    Agrees with `modulate_stiffness(resolve_joint_stiffness(...), pd, singularity_aware_ratio(...))` up to the damping
    near rank loss, for gains that differ at alpha 0 and 1. Arguments are taken to be valid.

    Args:
        jacobian: (..., 3, n) of the hands, in the frame in which stiffness is diagonal [m/rad].
        task_stiffness: (..., 3) what the arm contributes, `C_hat^-1` as a diagonal, or (..., 3, 3) [N/m].
        null_stiffness: (...) of the joint with the largest gain; that of the others is as many times lower as their
            gains are [Nm/rad].
        pd_stiffness: The PD law's gains: (...) where they are the same on all joints of an arm, else (..., n) [Nm/rad].
        alpha: (...) in [0, 1].
        threshold: Condition number up to which alpha is kept. If it is infinite, alpha is kept everywhere and lost rank
            is not made up for: the paper's law without its ratio.
    """
    j = jacobian.double()
    tolerance = 0.0 if math.isinf(threshold) else RANK_TOLERANCE
    squares = eigenvalues_3x3(j @ j.transpose(-1, -2))
    singularity = 1.0 / (1.0 + (_condition(squares) - threshold).clamp_min(0.0))
    ratio = alpha.double() * singularity
    if pd_stiffness.dim() < jacobian.dim() - 1:
        return _in_one_gain(
            j, squares, task_stiffness, null_stiffness, pd_stiffness, ratio, singularity, tolerance, jacobian.dtype
        )
    largest = pd_stiffness.double().amax(-1)
    root = (pd_stiffness.double() / largest.unsqueeze(-1)).sqrt()
    j = j / root.unsqueeze(-2)
    squares = eigenvalues_3x3(j @ j.transpose(-1, -2))
    blend = _in_one_gain(
        j, squares, task_stiffness, null_stiffness, largest, ratio, singularity, tolerance, jacobian.dtype
    )
    rows, columns = root.to(jacobian.dtype).unsqueeze(-1), root.to(jacobian.dtype).unsqueeze(-2)
    return replace(
        blend, stiffness=rows * blend.stiffness * columns, pseudo_inverse=blend.pseudo_inverse / rows,
        null_projector=blend.null_projector / rows * columns,
    )  # fmt: skip


def _condition(squares: torch.Tensor) -> torch.Tensor:
    """Condition number (...) of a Jacobian, of its squared singular values (..., 3)."""
    largest = squares[..., 2].clamp_min(1e-12)
    return (largest / squares[..., 0].clamp_min(1e-14 * largest)).sqrt()


def _in_one_gain(
    j: torch.Tensor, squares: torch.Tensor, task_stiffness: torch.Tensor, null_stiffness: torch.Tensor,
    pd_stiffness: torch.Tensor, ratio: torch.Tensor, singularity: torch.Tensor, tolerance: float,
    kind: torch.dtype,
) -> ArmStiffness:  # fmt: skip
    """`blended_stiffness` for one gain (...), of a Jacobian in float64 and its squared singular values."""
    gram = j @ j.transpose(-1, -2)
    largest = squares[..., 2].clamp_min(1e-12)
    missing = (tolerance**2 * largest - squares[..., 0]).clamp_min(0.0)
    eye = torch.eye(j.shape[-1], dtype=j.dtype, device=j.device)
    transposed = j.transpose(-1, -2)
    pseudo_inverse = transposed @ inverse_3x3(_plus(gram, missing.maximum(_ROUNDING * largest)))
    # The projector itself is as exact as doubles allow: the rank that is lost is made up for in the power below.
    null_projector = eye - transposed @ inverse_3x3(_plus(gram, _ROUNDING * largest)) @ j
    if task_stiffness.dim() == j.dim():
        b = torch.linalg.cholesky(task_stiffness.double()).transpose(-1, -2) @ j
    else:
        b = task_stiffness.double().sqrt().unsqueeze(-1) * j
    inner = b @ b.transpose(-1, -2)
    values = eigenvalues_3x3(inner)
    values = values.maximum(_ROUNDING * values[..., 2:].clamp_min(1e-12))
    null, pd = null_stiffness.double(), pd_stiffness.double()
    # A direction that the arm can hardly move in is as stiff as the damped null space makes it.
    lost = missing / (squares[..., 0].clamp_min(0.0) + missing + 1e-300)
    stiff = torch.cat((values[..., :1] + (lost * null).unsqueeze(-1), values[..., 1:]), -1)
    scale = pd.pow(1.0 - ratio)
    power = _through(inner, values, stiff.pow(ratio.unsqueeze(-1)) / values, ratio - 1.0)
    of_null = null.pow(ratio)
    task = b.transpose(-1, -2) @ power @ b
    stiffness = scale[..., None, None] * (task + of_null[..., None, None] * null_projector)
    ends = stiff[..., [0, 2]].pow(ratio.unsqueeze(-1))
    spectrum = torch.stack((torch.minimum(ends[..., 0], of_null), torch.maximum(ends[..., 1], of_null)), -1)
    return ArmStiffness(
        stiffness.to(kind), pseudo_inverse.to(kind), null_projector.to(kind), ratio.to(kind), singularity.to(kind),
        (scale.unsqueeze(-1) * spectrum).to(kind),
    )  # fmt: skip


def _through(matrix: torch.Tensor, values: torch.Tensor, images: torch.Tensor, exponent: torch.Tensor) -> torch.Tensor:
    """The function (..., 3, 3) of `matrix` that takes its ascending eigenvalues to `images`, (..., 3) both.

    Newton's polynomial; where eigenvalues nearly coincide, derivatives of `x^exponent` stand in for its differences.
    """
    low, middle, high = values.unbind(-1)
    f_low, f_middle, f_high = images.unbind(-1)
    first = _divided(f_low, f_middle, low, middle, exponent)
    second = _divided(f_middle, f_high, middle, high, exponent)
    gap = high - low
    close = gap <= 1e-4 * high
    third = torch.where(
        close,
        0.5 * exponent * (exponent - 1.0) * middle.pow(exponent - 2.0),
        (second - first) / torch.where(close, torch.ones_like(gap), gap),
    )
    slope = _plus(third[..., None, None] * matrix, first - third * middle)
    return _plus(_plus(matrix, -low) @ slope, f_low)


def _divided(
    f_a: torch.Tensor, f_b: torch.Tensor, a: torch.Tensor, b: torch.Tensor, exponent: torch.Tensor
) -> torch.Tensor:
    """First divided difference of `x^exponent` between `a` and `b`; the derivative where they are nearly equal."""
    gap = b - a
    close = gap <= 1e-6 * b
    derivative = exponent * (0.5 * (a + b)).pow(exponent - 1.0)
    return torch.where(close, derivative, (f_b - f_a) / torch.where(close, torch.ones_like(gap), gap))
