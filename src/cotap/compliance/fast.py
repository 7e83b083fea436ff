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
from dataclasses import dataclass

import torch

from cotap.compliance.small_matrices import batch_last, eigenvalues_3x3, inverse_3x3, plus_diagonal, product
from cotap.compliance.stiffness import RANK_TOLERANCE

_ROUNDING = 1e-8
"""Share of the largest squared singular value below which the smallest is taken for rounding, more so the smaller. The
rounding of the power's polynomial grows with its inverse, times how many times one task stiffness is the other."""


@dataclass(frozen=True)
class ArmStiffness:
    """What one control step of compliance needs, for arms (..., n joints) with a 3-D task."""

    stiffness: torch.Tensor
    """(..., n, n) the blend K [Nm/rad]."""
    pseudo_inverse: torch.Tensor
    """(..., n, 3) J# [rad/m]: of all joint motions that move the hand as asked, the one that the PD gains resist least.
    Damped near rank loss unless the threshold is infinite."""
    null_projector: torch.Tensor
    """(..., n, n) I - J# J."""
    ratio: torch.Tensor
    """(...) alpha times `singularity`: the exponent a of the blend."""
    singularity: torch.Tensor
    """(...) 1 / (1 + max(0, cond(J) - threshold))."""
    eigenvalue_range: torch.Tensor
    """(..., 2) smallest and largest eigenvalue of K [Nm/rad]; where gains differ, of K relative to them, times the
    largest gain."""


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
    j = batch_last(jacobian.double())
    gram = product(j, j.transpose(0, 1))
    squares = eigenvalues_3x3(gram)
    singularity = 1.0 / (1.0 + (_condition(squares) - threshold).clamp_min(0.0))
    ratio, null = alpha.double().flatten() * singularity, null_stiffness.double().flatten()
    pd, root = pd_stiffness.double(), None
    if pd.dim() == jacobian.dim() - 1:
        root = (pd / pd.amax(-1, keepdim=True)).sqrt().reshape(-1, pd.shape[-1]).T.contiguous()
        pd, j = pd.amax(-1), j / root
        gram = product(j, j.transpose(0, 1))
        squares = eigenvalues_3x3(gram)
    tolerance = 0.0 if math.isinf(threshold) else RANK_TOLERANCE
    missing = (tolerance**2 * squares[2].clamp_min(1e-12) - squares[0]).clamp_min(0.0)
    pseudo_inverse, projector, kept = _null_space(j, gram, squares, missing)
    # A direction that the arm can hardly move in is as stiff as the damped null space makes it.
    lost = missing / (squares[0] + missing + 1e-300) * null
    if task_stiffness.dim() == jacobian.dim():
        b = product(batch_last(torch.linalg.cholesky(task_stiffness.double()).mT), j)
    else:
        b = task_stiffness.double().sqrt().reshape(-1, 3).T.unsqueeze(1) * j
    stiffness, spectrum = _power(b, projector, kept, lost, null, pd.flatten(), ratio)
    if root is not None:
        rows = root.unsqueeze(1)
        stiffness, pseudo_inverse, projector = rows * stiffness * root, pseudo_inverse / rows, projector / rows * root
    shape = jacobian.shape[:-2]
    values = (stiffness, pseudo_inverse, projector, ratio, singularity, spectrum)
    return ArmStiffness(*(x.to(jacobian.dtype).movedim(-1, 0).reshape(shape + x.shape[:-1]) for x in values))


def _condition(squares: torch.Tensor) -> torch.Tensor:
    """Condition number (B,) of a Jacobian, of its squared singular values (3, B)."""
    largest = squares[2].clamp_min(1e-12)
    return (largest / squares[0].clamp_min(1e-14 * largest)).sqrt()


def _null_space(
    j: torch.Tensor, gram: torch.Tensor, squares: torch.Tensor, missing: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of Jacobians (3, n, B) with `gram` J J^T: the pseudo-inverse (n, 3, B), damped by what is `missing`, and the
    projector (n, n, B) on their null space.

    The projector itself is exact up to rounding: the rank that is lost is made up for in the power. Last, the share
    (B,) of the direction of the smallest singular value that it leaves to the hand, 1 but for what is rounding.
    """
    transposed = j.transpose(0, 1)
    smallest, least = squares[0], _ROUNDING * squares[2].clamp_min(1e-12)
    shift = (least - smallest).clamp_min(0.0)
    damped, exact = (inverse_3x3(plus_diagonal(gram, x)) for x in (missing.maximum(shift), shift))
    of_hand = product(transposed, product(exact, j))
    projector = plus_diagonal(-of_hand, torch.ones_like(shift))
    return product(transposed, damped), projector, smallest / smallest.maximum(least)


def _power(
    b: torch.Tensor, projector: torch.Tensor, kept: torch.Tensor, lost: torch.Tensor, null: torch.Tensor,
    pd: torch.Tensor, ratio: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """`pd^(1-a) (B^T G^(a-1) B + null^a N)`, (n, n, B), for a `ratio` a, and its outermost eigenvalues (2, B).

    `kept` is the share of the direction of the smallest eigenvalue of G that is not N's, `lost` what the damped null
    space adds to that eigenvalue.
    """
    inner = product(b, b.transpose(0, 1))
    values = eigenvalues_3x3(inner)
    values = values.maximum(1e-14 * values[2].clamp_min(1e-12))
    stiff = torch.stack((values[0] + lost, values[1], values[2])).pow(ratio)
    scale, of_null = pd.pow(1.0 - ratio), null.pow(ratio)
    images = stiff / values
    images[0] *= kept
    task = product(b.transpose(0, 1), product(_through(inner, values, images, ratio - 1.0), b))
    stiffness = scale * (task + of_null * projector)
    return stiffness, scale * torch.stack((torch.minimum(stiff[0], of_null), torch.maximum(stiff[2], of_null)))


def _through(matrix: torch.Tensor, values: torch.Tensor, images: torch.Tensor, exponent: torch.Tensor) -> torch.Tensor:
    """The function (3, 3, B) of `matrix` that takes its ascending eigenvalues to `images`, (3, B) both.

    Newton's polynomial; where eigenvalues nearly coincide, derivatives of `x^exponent` stand in for its differences.
    """
    low, middle, high = values
    f_low, f_middle, f_high = images
    first = _divided(f_low, f_middle, low, middle, exponent)
    second = _divided(f_middle, f_high, middle, high, exponent)
    gap = high - low
    close = gap <= 1e-4 * high
    third = torch.where(
        close,
        0.5 * exponent * (exponent - 1.0) * middle.pow(exponent - 2.0),
        (second - first) / torch.where(close, torch.ones_like(gap), gap),
    )
    slope = plus_diagonal(third * matrix, first - third * middle)
    return plus_diagonal(product(plus_diagonal(matrix, -low), slope), f_low)


def _divided(
    f_a: torch.Tensor, f_b: torch.Tensor, a: torch.Tensor, b: torch.Tensor, exponent: torch.Tensor
) -> torch.Tensor:
    """First divided difference of `x^exponent` between `a` and `b`; the derivative where they are nearly equal."""
    gap = b - a
    close = gap <= 1e-6 * b
    derivative = exponent * (0.5 * (a + b)).pow(exponent - 1.0)
    return torch.where(close, derivative, (f_b - f_a) / torch.where(close, torch.ones_like(gap), gap))
