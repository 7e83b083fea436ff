"""From task-space stiffness at the hand to joint stiffness (paper, section III-B)."""

from __future__ import annotations

import torch

from cotap.checks import require_all_finite, require_finite
from cotap.compliance.spd import require_ratio, require_symmetric

RANK_TOLERANCE = 0.02
"""Ratio of smallest to largest singular value of a Jacobian below which its pseudo-inverse is damped.

Above it (condition numbers up to 50) everything is exact. Below, `J J^T` is inverted as if its smallest singular value
were this share of its largest, so that a straight arm keeps finite, positive stiffness.
"""


def condition_number(jacobian: torch.Tensor) -> torch.Tensor:
    """Ratio (...) of largest to smallest singular value of Jacobians (..., m, n), m <= n; infinite where rank is lost.

    Raises:
        ValueError: the Jacobian is not finite, or has more rows than columns.
    """
    require_jacobian(jacobian)
    values = torch.linalg.svdvals(jacobian)
    largest, smallest = values[..., 0], values[..., -1]
    # What is smaller than rounding is zero.
    floor = torch.finfo(jacobian.dtype).eps * largest
    infinite = torch.full_like(largest, torch.inf)
    safe = torch.where(smallest > floor, smallest, torch.ones_like(smallest))
    return torch.where(smallest > floor, largest / safe, infinite)


def singularity_aware_ratio(
    alpha: torch.Tensor | float, jacobian: torch.Tensor, threshold: float = 10.0
) -> torch.Tensor:
    """`alpha / (1 + max(0, cond(J) - threshold))`, (...): hands over to PD near a singularity (paper, equation 10).

    Args:
        alpha: (...) in [0, 1], or one number.
        jacobian: (..., m, n).
        threshold: Condition number up to which alpha is kept, at least 1.

    Raises:
        ValueError: alpha lies outside [0, 1], the threshold is below 1, or the Jacobian is not finite.
    """
    require_finite("threshold", threshold)
    if threshold < 1.0:
        raise ValueError(f"threshold must be at least 1, the smallest condition number, got {threshold!r}")
    ratio = torch.as_tensor(alpha, dtype=jacobian.dtype, device=jacobian.device)
    require_ratio("alpha", ratio)
    return ratio / (1.0 + (condition_number(jacobian) - threshold).clamp_min(0.0))


def damped_gram_inverse(jacobian: torch.Tensor) -> torch.Tensor:
    """`(J J^T + e^2 I)^-1`, (..., m, m); e is zero unless J is nearly rank deficient (see `RANK_TOLERANCE`)."""
    gram = jacobian @ jacobian.transpose(-1, -2)
    squares = torch.linalg.eigvalsh(gram.detach())
    missing = (RANK_TOLERANCE**2 * squares[..., -1] - squares[..., 0]).clamp_min(0.0)
    tiny = torch.finfo(jacobian.dtype).tiny
    eye = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    return torch.linalg.inv(gram + (missing + tiny)[..., None, None] * eye)


def task_compliance(
    jacobian: torch.Tensor, task_stiffness: torch.Tensor, base_compliance: torch.Tensor | None = None
) -> torch.Tensor:
    """`C_hat = K_ee^-1 - C_base`, (..., m, m): what is left for the arm of the compliance felt at the hand.

    Args:
        jacobian: (..., m, n), for its shape: what has as many dimensions is a matrix, what has one fewer a diagonal.
        task_stiffness: (..., m) diagonal or (..., m, m), symmetric positive definite [N/m].
        base_compliance: (..., m) or (..., m, m), symmetric positive semidefinite: how far the hand moves with the arm's
            base per unit of force, `J_eb K_torso^-1 J_eb^T` [m/N]. None for a base that does not move.

    Raises:
        ValueError: shapes do not fit, the stiffness is not positive definite, or it is more than the base allows.
    """
    rows, dims = jacobian.shape[-2], jacobian.dim()
    stiffness = as_matrix("task_stiffness", task_stiffness, rows, dims)
    smallest = torch.linalg.eigvalsh(stiffness.detach())[..., 0]
    if not (smallest > 0.0).all():
        raise ValueError(f"task_stiffness must be positive definite, got an eigenvalue of {float(smallest.amin()):g}")
    compliance = _symmetric(torch.linalg.inv(stiffness))
    if base_compliance is None:
        return compliance
    base = as_matrix("base_compliance", base_compliance, rows, dims)
    lowest = torch.linalg.eigvalsh(base.detach())[..., 0].amin()
    if lowest < -1e-6 * float(base.detach().abs().amax()):
        raise ValueError(f"base_compliance must not be negative, got an eigenvalue of {float(lowest):g}")
    left = compliance - base
    room = torch.linalg.eigvalsh(left.detach())[..., 0]
    if not (room > 0.0).all():
        raise ValueError(
            "task_stiffness is more than the base allows: K_ee^-1 - base_compliance must stay positive definite, "
            f"got an eigenvalue of {float(room.amin()):g}"
        )
    return left


def project_compliance(compliance: torch.Tensor, floor: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Raise the eigenvalues of `compliance` (..., m, m) to at least `floor` [m/N].

    Returns the projected matrices and which of them (...) bool were changed: for rollouts, where an infeasible
    stiffness is bounded and counted rather than refused.
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
) -> torch.Tensor:
    """`K_u = J^T C_hat^-1 J + k_null (I - J# J)`, (..., n, n): the joint stiffness that makes a hand as stiff as asked.

    With null-space stiffness a multiple of the identity this equals the paper's general form,
    `K_u^-1 = J# C_hat J#^T + Y - J# J Y J^T J#^T` with `Y = I / k_null` (paper, equation 7), without inverting an
    n x n matrix. It is symmetric positive definite at every pose, singular ones included: near those the projector is
    damped (see `RANK_TOLERANCE`), which adds stiffness and never takes it away.

    Args:
        jacobian: (..., m, n), m <= n: 3-D positions of any arm, 6-D poses of arms with at least 6 joints, or both
            hands stacked.
        task_stiffness: (..., m) diagonal or (..., m, m), symmetric positive definite [N/m].
        null_stiffness: (...) or one number, positive: stiffness of motion that leaves the hand where it is [Nm/rad].
        base_compliance: (..., m) or (..., m, m): the hand's compliance through a moving base [m/N]; None for none.

    Raises:
        ValueError: a shape does not fit, a value is not finite, a stiffness is not positive, or the base does not
            allow the stiffness asked for.
    """
    require_jacobian(jacobian)
    joints = jacobian.shape[-1]
    null = torch.as_tensor(null_stiffness, dtype=jacobian.dtype, device=jacobian.device)
    require_all_finite("null_stiffness", null)
    if not (null.detach() > 0.0).all():
        raise ValueError(f"null_stiffness must be positive, got {float(null.detach().amin()):g}")
    stiffness = torch.linalg.inv(task_compliance(jacobian, task_stiffness, base_compliance))
    transposed = jacobian.transpose(-1, -2)
    eye = torch.eye(joints, dtype=jacobian.dtype, device=jacobian.device)
    projector = eye - transposed @ damped_gram_inverse(jacobian) @ jacobian
    return _symmetric(transposed @ stiffness @ jacobian + null[..., None, None] * projector)


def require_jacobian(jacobian: torch.Tensor) -> None:
    """Raise ValueError unless `jacobian` is a finite floating point (..., m, n) with 1 <= m <= n."""
    if jacobian.dim() < 2 or jacobian.shape[-2] < 1:
        raise ValueError(f"jacobian must have shape (..., m, n), got {tuple(jacobian.shape)}")
    if not jacobian.is_floating_point():
        raise ValueError(f"jacobian must hold floating point numbers, got {jacobian.dtype}")
    rows, joints = jacobian.shape[-2:]
    if rows > joints:
        raise ValueError(f"a task of {rows} dimensions needs at least {rows} joints, the jacobian has {joints}")
    require_all_finite("jacobian", jacobian)


def as_matrix(name: str, value: torch.Tensor, size: int, dims: int) -> torch.Tensor:
    """`value` as (..., size, size): a matrix if it has `dims` dimensions, a diagonal if it has one fewer.

    Raises:
        ValueError: it has another number of dimensions or another size, or is not finite and symmetric.
    """
    require_all_finite(name, value)
    if value.dim() == dims and tuple(value.shape[-2:]) == (size, size):
        require_symmetric(name, value)
        return value
    if value.dim() == dims - 1 and value.shape[-1] == size:
        return torch.diag_embed(value)
    raise ValueError(
        f"{name} must have {dims - 1} dimensions (..., {size}), a diagonal, or {dims} (..., {size}, {size}), "
        f"got shape {tuple(value.shape)}"
    )


def _symmetric(matrix: torch.Tensor) -> torch.Tensor:
    return 0.5 * (matrix + matrix.transpose(-1, -2))
