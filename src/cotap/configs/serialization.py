"""Config dataclasses to plain data (for JSON and checkpoints) and back."""

from __future__ import annotations

import dataclasses
import typing
from typing import Any, TypeVar

from cotap.checks import quoted

T = TypeVar("T")


def to_plain(config: Any) -> Any:
    """Nested dataclasses as dicts, tuples as lists."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return {f.name: to_plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, (list, tuple)):
        return [to_plain(v) for v in config]
    return config


def from_plain(cls: type[T], data: dict[str, Any], where: str = "") -> T:
    """The inverse of `to_plain`; fields that `data` lacks take their defaults.

    Raises:
        ValueError: `data` has a field that `cls` does not know, or a value of another type than the field's; the
            message names it, `where` before it.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{where or cls.__name__} must be a table of fields, got {_shown(data)}")
    hints = typing.get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]  # pyright: ignore[reportArgumentType]
    unknown = sorted(str(name) for name in data if name not in names)
    if unknown:
        raise ValueError(f"{cls.__name__} has no field {quoted(unknown[0])}; known: {', '.join(names)}")
    prefix = f"{where}." if where else ""
    return cls(**{name: _value(hints[name], data[name], prefix + name) for name in names if name in data})


def _value(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_plain(typing.cast(type[Any], hint), value, where)
    if typing.get_origin(hint) is tuple:
        return _items(hint, value, where)
    allowed = (int, float) if hint is float else hint
    if not isinstance(value, allowed) or (isinstance(value, bool) and hint is not bool):
        raise ValueError(f"{where} must be of type {hint.__name__}, got {_shown(value)}")
    return value


def _items(hint: Any, value: Any, where: str) -> tuple[Any, ...]:
    kinds = typing.get_args(hint)
    if not isinstance(value, (list, tuple)):
        raise ValueError(f"{where} must be a list, got {_shown(value)}")
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(kinds) != len(value):
        raise ValueError(f"{where} must have {len(kinds)} entries, got {len(value)}")
    return tuple(_value(kind, v, f"{where}[{i}]") for i, (kind, v) in enumerate(zip(kinds, value, strict=True)))


def _shown(value: Any) -> str:
    """A value in an error, however long or deep it is."""
    return f"{type(value).__name__} {quoted(value)}"
