"""Argument checks. Each raises ValueError naming the argument, its value and what is allowed."""

from __future__ import annotations

import difflib
import math
import reprlib
from collections.abc import Collection
from typing import TYPE_CHECKING, TypeGuard

if TYPE_CHECKING:
    import torch


def quoted(value: object, longest: int = 100) -> str:
    """A value in an error: as Python writes it, but short, however long or deep it is."""
    short = reprlib.Repr()
    short.maxlevel, short.maxstring, short.maxother, short.maxlong = 3, longest, longest, longest
    try:
        return short.repr(value)
    except ValueError:  # Python does not write out integers of many thousand digits
        return f"a {type(value).__name__} too long to show"


def shortened(text: str, longest: int = 2000) -> str:
    """A message to be printed, without its middle if it is longer than that, and without what no terminal should get:
    what a file holds may be in it, whole."""
    half = longest // 2
    short = text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"
    return "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in short)


def legible(text: str, longest: int = 200) -> str:
    """A name from a file, to be printed: as it is, or as `quoted` has it if it is long or no terminal should get it."""
    return text if len(text) <= longest and text.isprintable() else quoted(text, longest)


def require_positive_int(name: str, value: int) -> int:
    """Return `value` if it is an integer >= 1, else raise ValueError."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} must be a positive integer, got {quoted(value)}")
    return value


LARGEST_SEED = 2**62


def require_seed(name: str, value: int) -> int:
    """Return `value` if every random number generator takes it as a seed, else raise ValueError."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= LARGEST_SEED:
        raise ValueError(f"{name} must be an integer from 0 to 2**62, got {quoted(value)}")
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
        raise ValueError(f"{name} must be a finite number, got {quoted(value)}")
    return value


def require_range(name: str, value: float, low: float, high: float) -> float:
    """Return `value` if it lies in [low, high], else raise ValueError."""
    require_finite(name, value)
    if not low <= value <= high:
        raise ValueError(f"{name} must lie in [{low}, {high}], got {quoted(value)}")
    return value


def require_interval(name: str, value: tuple[float, float]) -> tuple[float, float]:
    """Return `value` if it is a pair of finite numbers (low, high) with low <= high."""
    if len(value) != 2:
        raise ValueError(f"{name} must be a pair (low, high), got {quoted(value)}")
    low, high = (require_finite(f"{name}[{i}]", v) for i, v in enumerate(value))
    if low > high:
        raise ValueError(f"{name} must have low <= high, got {quoted(value)}")
    return value


def reason_of(error: BaseException) -> str:
    """First line of what an error says, to be printed, or its kind if it says nothing; of a key, that it is missing."""
    if isinstance(error, KeyError) and error.args:
        return f"{quoted(error.args[0])} is missing"
    return legible((str(error) or type(error).__name__).splitlines()[0], 1000)


def require_one_of(name: str, value: str, known: Collection[str]) -> str:
    """Return `value` if it is among the `known` names; the error lists them and the closest."""
    if value not in known:
        close = difflib.get_close_matches(str(value)[:100], list(known), n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise ValueError(f"{name} {quoted(value)} is unknown{hint}; known: {', '.join(sorted(known))}")
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
