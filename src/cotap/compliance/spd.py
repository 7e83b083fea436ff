"""Symmetric positive definite matrices: logarithm, exponential and the log-Euclidean mean (paper, section III-C).

The log-Euclidean mean of stiffness matrices is `exp(sum_i w_i log K_i)`. Its determinant is the weighted geometric mean
of theirs, so that a blend never swells beyond what it is blended from; an average of the entries would.
"""

from __future__ import annotations

from typing import Any, cast

import torch

from cotap.checks import require_all_finite


def require_symmetric(name: str, matrix: torch.Tensor) -> None:
    """Raise ValueError unless `matrix` (..., n, n) is square, finite and symmetric to rounding."""
    if matrix.dim() < 2 or matrix.shape[-1] != matrix.shape[-2]:
        raise ValueError(f"{name} must have shape (..., n, n), got {tuple(matrix.shape)}")
    if not matrix.is_floating_point():
        raise ValueError(f"{name} must hold floating point numbers, got {matrix.dtype}")
    require_all_finite(name, matrix)
    if matrix.shape[-1] == 0:
        raise ValueError(f"{name} must not be empty, got shape {tuple(matrix.shape)}")
    if matrix.numel() == 0:
        return
    asymmetry = (matrix - matrix.transpose(-1, -2)).detach().abs().amax(dim=(-1, -2))
    allowed = 100.0 * torch.finfo(matrix.dtype).eps * matrix.detach().abs().amax(dim=(-1, -2))
    if (asymmetry > allowed).any():
        raise ValueError(f"{name} must be symmetric, got entries that differ by {float(asymmetry.amax()):g}")


class _SpdLog(torch.autograd.Function):
    """Logarithm with the derivative of Daleckii and Krein, which equal eigenvalues (a PD law's) do not upset."""

    @staticmethod
    def forward(ctx: Any, matrix: torch.Tensor) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, vectors = torch.linalg.eigh(matrix)
        if not (values > 0.0).all():
            raise ValueError(f"matrix must be positive definite, got an eigenvalue of {float(values.amin()):g}")
        ctx.save_for_backward(values, vectors)
        return (vectors * values.log().unsqueeze(-2)) @ vectors.transpose(-1, -2)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, vectors = ctx.saved_tensors
        a, b = values.unsqueeze(-1), values.unsqueeze(-2)
        close = (a - b).abs() <= 1e-4 * torch.maximum(a, b)
        slope = torch.where(close, 2.0 / (a + b), (a.log() - b.log()) / torch.where(close, torch.ones_like(a), a - b))
        inner = vectors.transpose(-1, -2) @ _symmetric(gradient) @ vectors
        return vectors @ (slope * inner) @ vectors.transpose(-1, -2)


def spd_log(matrix: torch.Tensor) -> torch.Tensor:
    """Logarithm (..., n, n) of symmetric positive definite matrices (..., n, n); differentiable once.

    Raises:
        ValueError: a matrix is not finite, symmetric and positive definite.
    """
    require_symmetric("matrix", matrix)
    return cast(torch.Tensor, _SpdLog.apply(_symmetric(matrix)))


def spd_exp(matrix: torch.Tensor) -> torch.Tensor:
    """Exponential (..., n, n), positive definite, of symmetric matrices (..., n, n).

    Raises:
        ValueError: a matrix is not finite and symmetric.
    """
    require_symmetric("matrix", matrix)
    return _symmetric(torch.linalg.matrix_exp(_symmetric(matrix)))


def log_euclidean_mean(stiffness: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """`exp(sum_i w_i log K_i)`, (..., n, n).

    Args:
        stiffness: (..., k, n, n) symmetric positive definite matrices.
        weights: (..., k), not negative, summing to 1.

    Raises:
        ValueError: shapes do not fit, weights are negative or do not sum to 1, or a matrix is not positive definite.
    """
    if stiffness.dim() < 3:
        raise ValueError(f"stiffness must have shape (..., k, n, n), got {tuple(stiffness.shape)}")
    require_weights(weights, stiffness.shape[-3])
    return spd_exp((weights[..., None, None] * spd_log(stiffness)).sum(-3))


def require_weights(weights: torch.Tensor, count: int) -> None:
    """Raise ValueError unless `weights` (..., count) are finite, not negative, and sum to 1."""
    if weights.dim() < 1 or weights.shape[-1] != count:
        raise ValueError(f"weights must have shape (..., {count}), got {tuple(weights.shape)}")
    require_all_finite("weights", weights)
    if (weights.detach() < 0.0).any():
        raise ValueError(f"weights must not be negative, got {float(weights.detach().amin()):g}")
    total = weights.detach().sum(-1)
    if ((total - 1.0).abs() > 1e-4).any():
        raise ValueError(f"weights must sum to 1, got {float(total.reshape(-1)[(total - 1.0).abs().argmax()]):g}")


def modulate_stiffness(k_comp: torch.Tensor, k_pd: torch.Tensor, alpha: torch.Tensor | float) -> torch.Tensor:
    """`exp(alpha log K_comp + (1 - alpha) log K_pd)`, (..., n, n): compliance at 1, PD at 0 (paper, equation 9).

    Args:
        k_comp: (..., n, n) symmetric positive definite.
        k_pd: (..., n, n) symmetric positive definite.
        alpha: (...) in [0, 1], or one number.

    Raises:
        ValueError: alpha lies outside [0, 1], or a matrix is not symmetric positive definite.
    """
    ratio = torch.as_tensor(alpha, dtype=k_comp.dtype, device=k_comp.device)
    require_ratio("alpha", ratio)
    ratio = ratio[..., None, None]
    return spd_exp(ratio * spd_log(k_comp) + (1.0 - ratio) * spd_log(k_pd))


def require_ratio(name: str, value: torch.Tensor) -> None:
    """Raise ValueError unless every entry of `value` lies in [0, 1]."""
    require_all_finite(name, value)
    outside = value.detach()[(value.detach() < 0.0) | (value.detach() > 1.0)]
    if outside.numel():
        raise ValueError(f"{name} must lie in [0, 1], got {float(outside.reshape(-1)[0]):g}")


def _symmetric(matrix: torch.Tensor) -> torch.Tensor:
    return 0.5 * (matrix + matrix.transpose(-1, -2))
