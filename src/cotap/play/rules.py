"""How controls depend on each other: which give way to another, and which do nothing at present."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cotap.compliance.laws import reads
from cotap.play import ROBOTS
from cotap.play.controls import AXES, Choice, Control, Number

VELOCITIES = ("velocity_x", "velocity_y", "yaw_rate")
"""Commands that are zero while robots stand."""
LAW_FIELDS = {f"stiffness_{axis}": "stiffness" for axis in AXES} | {
    name: name for name in ("null_stiffness", "alpha", "error", "damping", "passive")
}
"""Controls of an arm, with the field of its law that each sets."""


def consistent(asked: Mapping[str, Any]) -> dict[str, Any]:
    """`asked`, and what changes with it: to stand, or to squat, ends velocities; to walk ends standing and squatting.
    Asked for both, robots stand."""
    if asked.get("stand") or asked.get("height_offset"):
        return {**asked, **dict.fromkeys(VELOCITIES, 0.0), "stand": True}
    if asked.get("stand") is False or any(asked.get(name) for name in VELOCITIES):
        return {**asked, "stand": False, "height_offset": 0.0}
    return dict(asked)


def without_effect(controls: Mapping[str, Control], values: Mapping[str, Any]) -> set[str]:
    """Names of the controls that do nothing at present, with these values in force."""
    return {name for name, control in controls.items() if _leaves_no_choice(control) or _is_idle(name, values)}


def _leaves_no_choice(control: Control) -> bool:
    if isinstance(control, Choice):
        return len(control.options) < 2
    return isinstance(control, Number) and control.low == control.high


def _is_idle(name: str, values: Mapping[str, Any]) -> bool:
    head, *rest = name.split(".")
    if head in ROBOTS and len(rest) == 2 and rest[1] in LAW_FIELDS:
        return not reads(values[f"{head}.{rest[0]}.law"], LAW_FIELDS[rest[1]])
    return name == "speed" and values["paused"]
