"""Config dataclasses to plain data (for JSON and checkpoints) and back."""

from __future__ import annotations

import dataclasses
import typing
from typing import Any, TypeVar

T = TypeVar("T")


def to_plain(config: Any) -> Any:
    """Nested dataclasses as dicts, tuples as lists."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return {f.name: to_plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, (list, tuple)):
        return [to_plain(v) for v in config]
    return config


def from_plain(cls: type[T], data: dict[str, Any]) -> T:
    """The inverse of `to_plain`; fields that `data` lacks take their defaults.

    Raises:
        ValueError: `data` has a field that `cls` does not know.
    """
    hints = typing.get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]  # pyright: ignore[reportArgumentType]
    unknown = sorted(set(data) - set(names))
    if unknown:
        raise ValueError(f"{cls.__name__} has no field {unknown[0]!r}; known: {', '.join(names)}")
    return cls(**{name: _value(hints[name], data[name]) for name in names if name in data})


def _value(hint: Any, value: Any) -> Any:
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return from_plain(typing.cast(type[Any], hint), value)
    return tuple(value) if isinstance(value, list) else value
