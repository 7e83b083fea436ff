"""Symmetric positive definite matrices: logarithm, exponential and the log-Euclidean mean (paper, section III-C).

The log-Euclidean mean of stiffness matrices is `exp(sum_i w_i log K_i)`. Its determinant is the weighted geometric mean
of theirs, so that a blend never swells beyond what it is blended from; an average of the entries would.

All is computed in float64. Inside of `torch.compile` and `torch.func`, values are not checked.
"""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from torch.autograd.forward_ad import _set_fwd_grad_enabled

from cotap.compliance.arguments import (
    one_per_matrix,
    require_like,
    require_positive_definite,
    require_ratio,
    require_symmetric,
    rounding,
    symmetric_part,
    values_are_known,
)


class _SpdLog(torch.autograd.Function):
    """Logarithm of a matrix with known eigenvectors. Equal eigenvalues (a PD law's) do not upset its derivatives."""

    @staticmethod
    def forward(matrix: torch.Tensor, values: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:  # noqa: ARG004  # pyright: ignore[reportIncompatibleMethodOverride]
        return (vectors * values.log().unsqueeze(-2)) @ vectors.transpose(-1, -2)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        ctx.save_for_backward(output, *inputs[1:])
        ctx.save_for_forward(output)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        log, values, vectors = ctx.saved_tensors
        if torch.is_grad_enabled():  # derivatives of this one are wanted
            return _log_derivative(log, symmetric_part(gradient)), None, None
        return _last_log_derivative(values, vectors, symmetric_part(gradient)), None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *inputs: torch.Tensor) -> tuple[torch.Tensor, int]:  # pyright: ignore[reportIncompatibleMethodOverride]
        # By hand: the rule that torch makes up fails in backward over a vectorised forward.
        batch = info.batch_size
        whole = (
            x.expand(batch, *x.shape) if d is None else x.movedim(d, 0) for x, d in zip(inputs, in_dims, strict=True)
        )
        return cast(torch.Tensor, _SpdLog.apply(*whole)), 0

    @staticmethod
    def jvp(ctx: Any, tangent: torch.Tensor, *_: None) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (log,) = ctx.saved_tensors
        with _set_fwd_grad_enabled(True):  # torch disables it in here: forward over forward would be zero
            return _log_derivative(log, tangent)


def _log_derivative(log: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Derivative of the logarithm where it is `log`, along `direction`, (..., n, n); differentiable itself.

    The inverse of the exponential's derivative, which is the upper right block of `exp([[log, E], [0, log]])`.
    """
    n = log.shape[-1]
    base = log.unsqueeze(-3).expand(*log.shape[:-2], n * n, n, n)
    each = torch.eye(n * n, dtype=log.dtype, device=log.device).unflatten(-1, (n, n)).expand_as(base)
    blocks = torch.cat((torch.cat((base, each), -1), torch.cat((torch.zeros_like(base), base), -1)), -2)
    derivatives = torch.linalg.matrix_exp(blocks)[..., :n, n:].reshape(*base.shape[:-2], n * n)
    # Not `solve`: in torch, forward derivatives of its forward derivatives are wrong.
    inverse = torch.linalg.inv(derivatives.transpose(-1, -2))
    return (inverse @ direction.reshape(*direction.shape[:-2], n * n, 1)).reshape(direction.shape)


def _last_log_derivative(values: torch.Tensor, vectors: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """The same from eigenvalues and eigenvectors (Daleckii and Krein): many times as fast, not differentiable."""
    a, b = values.unsqueeze(-1), values.unsqueeze(-2)
    close = (a - b).abs() <= 1e-4 * torch.maximum(a, b)
    slope = torch.where(close, 2.0 / (a + b), (a.log() - b.log()) / torch.where(close, torch.ones_like(a), a - b))
    return vectors @ (slope * (vectors.transpose(-1, -2) @ direction @ vectors)) @ vectors.transpose(-1, -2)


# If the compiler traced into it, second derivatives would be zero. The decorator imports the compiler: about a second.
@torch.compiler.allow_in_graph
def log_from_eigenvectors(matrix: torch.Tensor, values: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Logarithm (..., n, n) of `matrix`, whose eigenvalues (..., n) and eigenvectors (..., n, n) are known."""
    return cast(torch.Tensor, _SpdLog.apply(matrix, values, vectors))


def _log(name: str, matrix: torch.Tensor) -> torch.Tensor:
    """Logarithm in float64 of the argument `name`, which is checked."""
    require_symmetric(name, matrix)
    whole = symmetric_part(matrix.double())
    values, vectors = torch.linalg.eigh(whole.detach())
    require_positive_definite(name, values, matrix.dtype)
    return log_from_eigenvectors(whole, values, vectors)


def _exp(matrix: torch.Tensor) -> torch.Tensor:
    return symmetric_part(torch.linalg.matrix_exp(matrix))


def spd_log(matrix: torch.Tensor) -> torch.Tensor:
    """Logarithm (..., n, n) of symmetric positive definite matrices (..., n, n).

    Derivatives of any order are exact, at equal eigenvalues, too.

    Raises:
        ValueError: a matrix is not of finite float32 or float64 numbers, not symmetric, or not positive definite: its
            smallest eigenvalue is at most `4 n eps` of its largest, with the eps of its dtype.
    """
    return _log("matrix", matrix).to(matrix.dtype)


def spd_exp(matrix: torch.Tensor) -> torch.Tensor:
    """Exponential (..., n, n), positive definite, of symmetric matrices (..., n, n).

    Raises:
        ValueError: a matrix is not of finite float32 or float64 numbers, not symmetric, or its exponential is beyond
            what its dtype holds or would be refused by `spd_log`.
    """
    require_symmetric("matrix", matrix)
    whole = symmetric_part(matrix.double())
    if values_are_known():
        _require_exponential(torch.linalg.eigvalsh(whole.detach()), matrix.dtype)
    return _exp(whole).to(matrix.dtype)


def _require_exponential(values: torch.Tensor, dtype: torch.dtype) -> None:
    """Raise ValueError unless `dtype` holds a positive definite exponential for ascending eigenvalues (..., n)."""
    numbers = torch.finfo(dtype)
    least, most, apart = math.log(numbers.tiny), math.log(numbers.max), -math.log(rounding(values.shape[-1], dtype))
    low, high = values[..., 0], values[..., -1]
    bad = (low < least) | (high > most) | (high - low >= apart)
    if bad.any():
        raise ValueError(
            f"matrix must have eigenvalues from {least:.1f} to {most:.1f} and less than {apart:.1f} apart, for its "
            f"exponential to be positive definite in {dtype}, got {float(low[bad][0]):g} to {float(high[bad][0]):g}"
        )


def log_euclidean_mean(stiffness: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """`exp(sum_i w_i log K_i)`, (..., n, n).

    Args:
        stiffness: (..., k, n, n) symmetric positive definite matrices.
        weights: (..., k), not negative, summing to 1; of the same dtype and with the same batch.

    Raises:
        ValueError: dtypes or shapes do not fit, weights are negative or do not sum to 1, or a matrix is not symmetric
            positive definite (see `spd_log`).
    """
    logarithms = _log("stiffness", stiffness)
    if stiffness.dim() < 3:
        raise ValueError(f"stiffness must have shape (..., k, n, n), got {tuple(stiffness.shape)}")
    require_weights(weights, stiffness)
    return _exp((weights.double()[..., None, None] * logarithms).sum(-3)).to(stiffness.dtype)


def require_weights(weights: torch.Tensor, stiffness: torch.Tensor) -> None:
    """Raise ValueError unless there is one of `weights` for each of `stiffness`, not negative, and they sum to 1."""
    require_like("weights", weights, "stiffness", stiffness)
    if weights.shape != stiffness.shape[:-2]:
        raise ValueError(f"weights must have shape {tuple(stiffness.shape[:-2])}, got {tuple(weights.shape)}")
    if not values_are_known():
        return
    if (weights.detach() < 0.0).any():
        raise ValueError(f"weights must not be negative, got {float(weights.detach().amin()):g}")
    total = weights.detach().sum(-1)
    if ((total - 1.0).abs() > 1e-4).any():
        raise ValueError(f"weights must sum to 1, got {float(total.reshape(-1)[(total - 1.0).abs().argmax()]):g}")


def modulate_stiffness(k_comp: torch.Tensor, k_pd: torch.Tensor, alpha: torch.Tensor | float) -> torch.Tensor:
    """`exp(alpha log K_comp + (1 - alpha) log K_pd)`, (..., n, n): compliance at 1, PD at 0 (paper, equation 9).

    Args:
        k_comp: (..., n, n) symmetric positive definite.
        k_pd: (..., n, n) symmetric positive definite; of the shape and dtype of `k_comp`.
        alpha: (...) in [0, 1] of the same dtype, or one number.

    Raises:
        ValueError: dtypes or shapes do not fit, alpha lies outside [0, 1], or a matrix is not symmetric positive
            definite (see `spd_log`).
    """
    log_comp = _log("k_comp", k_comp)
    require_like("k_pd", k_pd, "k_comp", k_comp)
    if k_pd.shape != k_comp.shape:
        raise ValueError(f"k_pd must have the shape of k_comp, {tuple(k_comp.shape)}, got {tuple(k_pd.shape)}")
    ratio = one_per_matrix("alpha", alpha, "k_comp", k_comp)
    require_ratio("alpha", ratio)
    ratio = ratio[..., None, None]
    return _exp(ratio * log_comp + (1.0 - ratio) * _log("k_pd", k_pd)).to(k_comp.dtype)
