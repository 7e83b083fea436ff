"""Argument checks. Each raises ValueError naming the argument, its value and what is allowed."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection
from typing import TYPE_CHECKING, TypeGuard

if TYPE_CHECKING:
    import torch


def require_positive_int(name: str, value: int) -> int:
    """Return `value` if it is an integer >= 1, else raise ValueError."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} must be a positive integer, got {value!r}")
    return value


def require_seed(name: str, value: int) -> int:
    """Return `value` if every random number generator takes it as a seed, else raise ValueError."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 2**62:
        raise ValueError(f"{name} must be an integer from 0 to 2**62, got {value!r}")
    return value


def is_finite(value: object) -> TypeGuard[float]:
    """Whether `value` is a number that a float holds; an integer may be beyond."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False


def require_finite(name: str, value: float) -> float:
    """Return `value` if it is a finite number, else raise ValueError."""
    if not is_finite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    return value


def require_range(name: str, value: float, low: float, high: float) -> float:
    """Return `value` if it lies in [low, high], else raise ValueError."""
    require_finite(name, value)
    if not low <= value <= high:
        raise ValueError(f"{name} must lie in [{low}, {high}], got {value!r}")
    return value


def require_interval(name: str, value: tuple[float, float]) -> tuple[float, float]:
    """Return `value` if it is a pair of finite numbers (low, high) with low <= high."""
    if len(value) != 2:
        raise ValueError(f"{name} must be a pair (low, high), got {value!r}")
    low, high = (require_finite(f"{name}[{i}]", v) for i, v in enumerate(value))
    if low > high:
        raise ValueError(f"{name} must have low <= high, got {value!r}")
    return value


def reason_of(error: BaseException) -> str:
    """First line of what an error says, or its kind if it says nothing."""
    return (str(error) or type(error).__name__).splitlines()[0]


def require_one_of(name: str, value: str, known: Collection[str]) -> str:
    """Return `value` if it is among the `known` names; the error lists them and the closest."""
    if value not in known:
        close = difflib.get_close_matches(str(value), list(known), n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise ValueError(f"{name} {value!r} is unknown{hint}; known: {', '.join(sorted(known))}")
    return value


def require_shape(name: str, value: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    """Return `value` if its shape is `shape`, else raise ValueError."""
    if tuple(value.shape) != tuple(shape):
        raise ValueError(f"{name} must have shape {tuple(shape)}, got {tuple(value.shape)}")
    return value


def require_all_finite(name: str, value: torch.Tensor) -> torch.Tensor:
    """Return `value` if all its elements are finite, else raise ValueError with the first index."""
    finite = value.isfinite()
    if not finite.all():
        index = tuple(int(i) for i in (~finite).nonzero()[0])
        raise ValueError(f"{name} must be finite, got {value[index].item()} at index {index}")
    return value
