"""Checks of what the library is given. Each raises ValueError naming the argument, its value and what is allowed.

Types and shapes are always checked. Values are checked where there are any: not while `torch.compile` or `torch.export`
traces, and not inside the transforms of `torch.func`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch
from torch._C._functorch import maybe_current_level

from cotap.checks import require_all_finite, require_finite

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def full_precision(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorator: the function computes in the precision of its arguments, inside of `torch.autocast`, too."""

    @functools.wraps(function)
    def exact(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return function(*args, **kwargs)

    return exact


def values_are_known() -> bool:
    """Whether numbers can be looked at: not while a compiler traces, and not inside of `torch.func`."""
    return not torch.compiler.is_compiling() and maybe_current_level() is None


def rounding(size: int, dtype: torch.dtype) -> float:
    """Share of its largest eigenvalue up to which an eigenvalue of a size x size matrix counts as zero: `4 size eps`.

    It is the library's one rule for what is singular, also for singular values of a Jacobian of `size` rows. Rounding
    of the entries to `dtype` turns an eigenvalue of zero into less than a quarter of it. Since all is computed in
    float64, the order of rows does not matter.
    """
    return 4.0 * size * torch.finfo(dtype).eps


def require_floats(name: str, value: torch.Tensor) -> None:
    """Raise ValueError unless `value` is a tensor of finite float32 or float64 numbers."""
    if not isinstance(value, torch.Tensor):
        raise ValueError(f"{name} must be a tensor, got {type(value).__name__}")
    if value.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{name} must hold float32 or float64 numbers, got {value.dtype}")
    if values_are_known():
        require_all_finite(name, value)


def require_like(name: str, value: torch.Tensor, of: str, other: torch.Tensor) -> None:
    """Raise ValueError unless `value` is finite and has the dtype and the device of `other`, the argument `of`."""
    if isinstance(value, torch.Tensor) and (value.dtype, value.device) != (other.dtype, other.device):
        raise ValueError(
            f"{name} must have the dtype and the device of {of}, {other.dtype} on {other.device}, "
            f"got {value.dtype} on {value.device}"
        )
    require_floats(name, value)


def require_symmetric(name: str, matrix: torch.Tensor) -> None:
    """Raise ValueError unless `matrix` (..., n, n) is square, finite and symmetric to rounding."""
    require_floats(name, matrix)
    if matrix.dim() < 2 or matrix.shape[-1] != matrix.shape[-2]:
        raise ValueError(f"{name} must have shape (..., n, n), got {tuple(matrix.shape)}")
    if matrix.shape[-1] == 0:
        raise ValueError(f"{name} must not be empty, got shape {tuple(matrix.shape)}")
    if not values_are_known():
        return
    asymmetry = (matrix - matrix.transpose(-1, -2)).detach().abs().amax(dim=(-1, -2))
    allowed = 100.0 * torch.finfo(matrix.dtype).eps * matrix.detach().abs().amax(dim=(-1, -2))
    if (asymmetry > allowed).any():
        raise ValueError(f"{name} must be symmetric, got entries that differ by {float(asymmetry.amax()):g}")


def symmetric_part(matrix: torch.Tensor) -> torch.Tensor:
    """Of matrices (..., n, n): without what rounding has made of them."""
    return 0.5 * (matrix + matrix.transpose(-1, -2))


def require_positive_definite(name: str, values: torch.Tensor, dtype: torch.dtype) -> None:
    """Raise ValueError unless ascending eigenvalues (..., n) of matrices in `dtype` are positive (see `rounding`)."""
    if not values_are_known():
        return
    smallest, largest = values[..., 0], values[..., -1]
    share = rounding(values.shape[-1], dtype)
    bad = smallest <= share * largest
    if bad.any():
        raise ValueError(
            f"{name} must be positive definite, got an eigenvalue of {float(smallest[bad][0]):g} with a largest of "
            f"{float(largest[bad][0]):g}; up to {share:.1e} of that counts as zero in {dtype}"
        )


def one_per_matrix(name: str, value: torch.Tensor | float, of: str, matrices: torch.Tensor) -> torch.Tensor:
    """`value` in float64: a number for each of `matrices` (..., m, n), the argument `of`, or one for all.

    Raises:
        ValueError: it is neither, or not finite.
    """
    if not isinstance(value, torch.Tensor):
        if values_are_known():
            require_finite(name, value)
        return torch.as_tensor(value, dtype=torch.float64, device=matrices.device)
    require_like(name, value, of, matrices)
    batch = tuple(matrices.shape[:-2])
    if value.dim() > 0 and tuple(value.shape) != batch:
        raise ValueError(f"{name} must be one number or, as {of}, have shape {batch}, got {tuple(value.shape)}")
    return value.double()


def require_ratio(name: str, value: torch.Tensor) -> None:
    """Raise ValueError unless every entry of `value` lies in [0, 1]."""
    if not values_are_known():
        return
    outside = value.detach()[(value.detach() < 0.0) | (value.detach() > 1.0)]
    if outside.numel():
        raise ValueError(f"{name} must lie in [0, 1], got {float(outside.reshape(-1)[0]):g}")
