"""Settings as the text of a link, and back: what is out of its range is refused, and nothing is set then."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any
from urllib.parse import quote, unquote

from cotap.checks import quoted
from cotap.play.controls import Choice, Control, Flag, Number, Refused
from cotap.play.rules import consistent

NOT_LINKED = ("paused",)
"""Settings of a moment."""


def to_text(robot: str, controls: Mapping[str, Control], values: Mapping[str, Any]) -> str:
    """What differs from the defaults, as `robot:h1,stand:0,a.left.law:pd`, in letters that the guard lets pass."""
    changed = {n: values[n] for n, control in _linked(controls).items() if values[n] != control.default}
    return ",".join(f"{name}:{_written(value)}" for name, value in ({"robot": robot} | changed).items())


def from_text(text: object, robot: str, controls: Mapping[str, Control]) -> dict[str, Any]:
    """Every setting of a link, those that it does not name at their defaults.

    Raises:
        Refused: it is of another robot, or has a setting that is unknown, twice there, or out of its range.
    """
    linked = _linked(controls)
    given: dict[str, str] = {}
    for pair in str(text).split(","):
        name, _, written = pair.partition(":")
        if name in given or name not in {"robot", *linked}:
            raise Refused(f"{quoted(name)} in the link is {'there twice' if name in given else 'no setting'}")
        given[name] = unquote(written.replace("~", "%"), errors="replace")
    if given.pop("robot", None) != robot:
        raise Refused(f"the link is of another robot than {robot}")
    values = {name: _read(linked[name], written) for name, written in given.items()}
    return defaults(controls) | consistent(values)


def defaults(controls: Mapping[str, Control]) -> dict[str, Any]:
    """Of every setting that a link has."""
    return {name: control.default for name, control in _linked(controls).items()}


def _linked(controls: Mapping[str, Control]) -> dict[str, Number | Choice | Flag]:
    return {n: c for n, c in controls.items() if isinstance(c, (Number, Choice, Flag)) and n not in NOT_LINKED}


def _written(value: Any) -> str:
    text = str(int(value)) if isinstance(value, bool) else f"{value:.6g}" if isinstance(value, float) else value
    return quote(text, safe="").replace("~", "~7E").replace("%", "~")


def _read(control: Number | Choice | Flag, text: str) -> Any:
    value: object = text
    if isinstance(control, Flag):
        value = {"0": False, "1": True}.get(text, text)
    elif isinstance(control, Number):
        with contextlib.suppress(ValueError):
            value = float(text)
    clean, notice = control.clean(value)
    if notice:
        raise Refused(notice.partition(";")[0])
    return clean
