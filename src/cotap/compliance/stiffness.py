"""From task-space stiffness at the hand to joint stiffness (paper, section III-B).

All is computed in float64, but for `project_compliance`. Inside of `torch.compile` and `torch.func`, values are not
checked.

A Jacobian of six rows may mix lengths and angles, and its singular values then depend on the unit of length. Where they
count, its rows 4 to 6 are multiplied by a characteristic length, which makes lengths of all. The default of 1 leaves
them as they are: a radian counts as much as the Jacobian's unit of length, and two hands of three rows as the same.
"""

from __future__ import annotations

import torch

from cotap.checks import require_finite
from cotap.compliance.arguments import (
    full_precision,
    one_per_matrix,
    require_floats,
    require_like,
    require_positive_definite,
    require_ratio,
    require_symmetric,
    rounding,
    symmetric_part,
    values_are_known,
)

RANK_TOLERANCE = 0.02
"""Ratio of smallest to largest singular value of a Jacobian below which its pseudo-inverse is damped.

Above it (condition numbers up to 50) everything is exact. Below, `J J^T` is inverted as if its smallest singular value
were this share of its largest, so that a straight arm keeps finite, positive stiffness.
"""


def condition_number(jacobian: torch.Tensor, characteristic_length: float = 1.0) -> torch.Tensor:
    """Ratio (...) of largest to smallest singular value of Jacobians (..., m, n), m <= n; infinite where rank is lost.

    Rank is lost where the smallest is at most `4 m eps` of the largest, with the eps of the Jacobian's dtype.

    Args:
        jacobian: (..., m, n).
        characteristic_length: Factor on rows 4 to 6 if m is 6, in the Jacobian's unit of length. For poses, take about
            how far the hand reaches, 0.5 m for a humanoid; for two hands, 1.

    Raises:
        ValueError: the Jacobian is not of finite float32 or float64 numbers or has more rows than columns, or the
            length is not positive.
    """
    require_jacobian(jacobian)
    return _condition_number(_in_lengths(jacobian, characteristic_length), jacobian.dtype).to(jacobian.dtype)


def _condition_number(jacobian: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """The same of a Jacobian in float64 and in lengths, which was given in `dtype`."""
    values = torch.linalg.svdvals(jacobian)
    largest, smallest = values[..., 0], values[..., -1]
    full = smallest > rounding(jacobian.shape[-2], dtype) * largest
    return torch.where(full, largest / torch.where(full, smallest, 1.0), torch.inf)


def singularity_aware_ratio(
    alpha: torch.Tensor | float, jacobian: torch.Tensor, threshold: float = 10.0, characteristic_length: float = 1.0
) -> torch.Tensor:
    """`alpha / (1 + max(0, cond(J) - threshold))`, (...): hands over to PD near a singularity (paper, equation 10).

    Args:
        alpha: (...) in [0, 1] of the Jacobian's dtype, or one number.
        jacobian: (..., m, n).
        threshold: Condition number up to which alpha is kept, at least 1.
        characteristic_length: See `condition_number`.

    Raises:
        ValueError: dtypes or shapes do not fit, alpha lies outside [0, 1], the threshold is below 1, or
            `condition_number` refuses the rest.
    """
    require_jacobian(jacobian)
    if values_are_known() and require_finite("threshold", threshold) < 1.0:
        raise ValueError(f"threshold must be at least 1, the smallest condition number, got {threshold!r}")
    ratio = one_per_matrix("alpha", alpha, "jacobian", jacobian)
    require_ratio("alpha", ratio)
    j = _in_lengths(jacobian, characteristic_length)
    near = _condition_number(j.detach(), jacobian.dtype) > threshold
    condition = _condition_number(_constant_unless(near, j), jacobian.dtype)
    return (ratio / (1.0 + (condition - threshold).clamp_min(0.0))).to(jacobian.dtype)


def damped_gram_inverse(jacobian: torch.Tensor) -> torch.Tensor:
    """`(J J^T + e^2 I)^-1`, (..., m, m); e is zero unless J is nearly rank deficient (see `RANK_TOLERANCE`)."""
    gram = jacobian @ jacobian.transpose(-1, -2)
    squares = torch.linalg.eigvalsh(gram.detach())
    damped = squares[..., 0] < RANK_TOLERANCE**2 * squares[..., -1]
    squares = torch.linalg.eigvalsh(_constant_unless(damped, gram))
    missing = (RANK_TOLERANCE**2 * squares[..., -1] - squares[..., 0]).clamp_min(0.0)
    tiny = torch.finfo(jacobian.dtype).tiny
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    return torch.linalg.inv(gram + (missing + tiny)[..., None, None] * eye)


def task_compliance(
    jacobian: torch.Tensor, task_stiffness: torch.Tensor, base_compliance: torch.Tensor | None, lengths: torch.Tensor
) -> torch.Tensor:
    """`C_hat = K_ee^-1 - C_base`, (..., m, m) in float64: what is left for the arm of the compliance felt at the hand.

    Args:
        jacobian: (..., m, n), for its shape and dtype.
        task_stiffness: (..., m) diagonal or (..., m, m), symmetric positive definite [N/m].
        base_compliance: (..., m) or (..., m, m), symmetric positive semidefinite: how far the hand moves with the arm's
            base per unit of force, `J_eb K_torso^-1 J_eb^T` [m/N]. None for a base that does not move.
        lengths: (m,) factors on the Jacobian's rows; the result is for the rows so multiplied.

    Raises:
        ValueError: dtypes or shapes do not fit, the stiffness is not positive definite, or it is more than the base
            allows.
    """
    units = lengths.unsqueeze(-1) * lengths
    stiffness = as_matrix("task_stiffness", task_stiffness, jacobian) / units
    require_positive_definite("task_stiffness", torch.linalg.eigvalsh(stiffness.detach()), jacobian.dtype)
    compliance = symmetric_part(torch.linalg.inv(stiffness))
    if base_compliance is None:
        return compliance
    base = as_matrix("base_compliance", base_compliance, jacobian) * units
    left = compliance - base
    if values_are_known():
        _require_allowed(compliance.detach(), base.detach(), left.detach(), rounding(len(lengths), jacobian.dtype))
    return left


def _require_allowed(compliance: torch.Tensor, base: torch.Tensor, left: torch.Tensor, share: float) -> None:
    """Raise ValueError unless `base` is not negative and what is `left` positive, to that share of the largest."""
    values = torch.linalg.eigvalsh(base)
    negative = values[..., 0] < -share * values.abs().amax(-1)
    if negative.any():
        lowest = float(values[..., 0][negative][0])
        raise ValueError(f"base_compliance must not be negative, got an eigenvalue of {lowest:g}")
    room = torch.linalg.eigvalsh(left)[..., 0]
    bad = room <= share * torch.linalg.eigvalsh(compliance)[..., -1]
    if bad.any():
        raise ValueError(
            "task_stiffness is more than the base allows: K_ee^-1 - base_compliance must stay positive definite, "
            f"got an eigenvalue of {float(room[bad][0]):g}"
        )


@full_precision
def project_compliance(compliance: torch.Tensor, floor: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Raise the eigenvalues of `compliance` (..., m, m) to at least `floor` [m/N].

    Returns the projected matrices and which of them (...) bool were changed: for rollouts, where an infeasible
    stiffness is bounded and counted rather than refused. Not to be differentiated: where eigenvalues coincide, the
    result is not finite.
    """
    values, vectors = torch.linalg.eigh(compliance)
    changed = values[..., 0] < floor
    raised = (vectors * values.clamp_min(floor).unsqueeze(-2)) @ vectors.transpose(-1, -2)
    return torch.where(changed[..., None, None], raised, compliance), changed


def resolve_joint_stiffness(
    jacobian: torch.Tensor,
    task_stiffness: torch.Tensor,
    null_stiffness: torch.Tensor | float,
    base_compliance: torch.Tensor | None = None,
    characteristic_length: float = 1.0,
) -> torch.Tensor:
    """`K_u = J^T C_hat^-1 J + k_null (I - J# J)`, (..., n, n): the joint stiffness that makes a hand as stiff as asked.

    With null-space stiffness a multiple of the identity this equals the paper's general form,
    `K_u^-1 = J# C_hat J#^T + Y - J# J Y J^T J#^T` with `Y = I / k_null` (paper, equation 7), without inverting an
    n x n matrix. With one that differs between joints it is `J^T C_hat^-1 J + S (I - J'# J') S`, S the diagonal of
    `sqrt(k_null)` and `J' = J S^-1`: positive definite, where the paper's form need not be, and the hand feels just as
    stiff, `J K_u^-1 J^T = C_hat`.

    It is symmetric positive definite at every pose, singular ones included: near those the projector is damped (see
    `RANK_TOLERANCE`), which adds stiffness and never takes it away. It is differentiable to any order except where
    damping sets in.

    Args:
        jacobian: (..., m, n), m <= n: 3-D positions of any arm, 6-D poses of arms with at least 6 joints, or both
            hands stacked.
        task_stiffness: (..., m) diagonal or (..., m, m), symmetric positive definite [N/m].
        null_stiffness: (...) or one number, or (..., n) joint by joint, positive: stiffness of motion that leaves the
            hand where it is [Nm/rad].
        base_compliance: (..., m) or (..., m, m): the hand's compliance through a moving base [m/N]; None for none.
        characteristic_length: Factor on rows 4 to 6 where damping is decided, if m is 6: see `condition_number`.

    Tensors have the dtype of `jacobian` and the same batch.

    Raises:
        ValueError: a dtype or a shape does not fit, a value is not finite, a stiffness is not positive (definite, see
            `spd_log`), the base does not allow the stiffness asked for, or the length is not positive.
    """
    require_jacobian(jacobian)
    null = _null_stiffness(null_stiffness, jacobian)
    if values_are_known() and not (null.detach() > 0.0).all():
        raise ValueError(f"null_stiffness must be positive, got {float(null.detach().amin()):g}")
    lengths = _row_lengths(jacobian, characteristic_length)
    stiffness = torch.linalg.inv(task_compliance(jacobian, task_stiffness, base_compliance, lengths))
    j = lengths.unsqueeze(-1) * jacobian.double()
    root = null.sqrt()
    scaled = j / root.unsqueeze(-2)
    eye = torch.eye(j.shape[-1], dtype=j.dtype, device=j.device)
    projector = eye - scaled.transpose(-1, -2) @ damped_gram_inverse(scaled) @ scaled
    of_null = root.unsqueeze(-1) * projector * root.unsqueeze(-2)
    return symmetric_part(j.transpose(-1, -2) @ stiffness @ j + of_null).to(jacobian.dtype)


def _null_stiffness(value: torch.Tensor | float, jacobian: torch.Tensor) -> torch.Tensor:
    """`value`, (...) or one number or (..., n), as (..., n) in float64. Raises ValueError if it has another shape."""
    if isinstance(value, torch.Tensor) and value.shape == jacobian[..., 0, :].shape:
        require_like("null_stiffness", value, "jacobian", jacobian)
        return value.double()
    null = one_per_matrix("null_stiffness", value, "jacobian", jacobian)
    return null.unsqueeze(-1).expand(*null.shape, jacobian.shape[-1])


def require_jacobian(jacobian: torch.Tensor) -> None:
    """Raise ValueError unless `jacobian` is a finite floating point (..., m, n) with 1 <= m <= n."""
    require_floats("jacobian", jacobian)
    if jacobian.dim() < 2 or jacobian.shape[-2] < 1:
        raise ValueError(f"jacobian must have shape (..., m, n), got {tuple(jacobian.shape)}")
    rows, joints = jacobian.shape[-2:]
    if rows > joints:
        raise ValueError(f"a task of {rows} dimensions needs at least {rows} joints, the jacobian has {joints}")


def _row_lengths(jacobian: torch.Tensor, characteristic_length: float) -> torch.Tensor:
    """Factors (m,) that make lengths of all rows of `jacobian` (..., m, n)."""
    if values_are_known() and require_finite("characteristic_length", characteristic_length) <= 0.0:
        raise ValueError(f"characteristic_length must be positive, got {characteristic_length!r}")
    lengths = torch.ones(jacobian.shape[-2], dtype=torch.float64, device=jacobian.device)
    if len(lengths) == 6:
        lengths[3:] = characteristic_length
    return lengths


def _in_lengths(jacobian: torch.Tensor, characteristic_length: float) -> torch.Tensor:
    return _row_lengths(jacobian, characteristic_length).unsqueeze(-1) * jacobian.double()


def _constant_unless(condition: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    """`matrix`, without derivatives unless `condition` (...): equal eigenvalues have no second ones even times zero."""
    return torch.where(condition[..., None, None], matrix, matrix.detach())


def as_matrix(name: str, value: torch.Tensor, jacobian: torch.Tensor) -> torch.Tensor:
    """`value` as (..., m, m) in float64, for `jacobian` (..., m, n): (..., m) is a diagonal.

    Raises:
        ValueError: it has another shape or dtype, or is not finite and symmetric.
    """
    require_like(name, value, "jacobian", jacobian)
    diagonal = tuple(jacobian.shape[:-1])
    whole = (*diagonal, diagonal[-1])
    if tuple(value.shape) == whole:
        require_symmetric(name, value)
        return symmetric_part(value.double())
    if tuple(value.shape) == diagonal:
        return torch.diag_embed(value.double())
    raise ValueError(f"{name} must have shape {diagonal}, a diagonal, or {whole}, got {tuple(value.shape)}")
