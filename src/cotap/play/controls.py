"""What the page may set: every value by name, with its range. Nothing else reaches the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cotap.checks import is_finite
from cotap.compliance.laws import DAMPINGS, ERRORS, LawConfig
from cotap.play import ROBOTS

AXES = ("x", "y", "z")
PUSH_N, PUSH_S = 600.0, 5.0
"""Largest force of a push [N] and longest [s]."""

Value = float | bool | str | tuple[float, ...] | None


class Refused(ValueError):
    """A value that cannot be used; the message, shown on the page, names it and says what is allowed."""


@dataclass(frozen=True)
class Number:
    """A number within a range."""

    label: str
    low: float
    high: float
    default: float
    step: float

    def clean(self, value: object) -> tuple[float, str | None]:
        """`value` within the range, and a notice if it had to be moved there. Raises Refused for what is no number."""
        if not is_finite(value):
            raise Refused(f"{self.label} must be a finite number, got {_shown(value)}")
        inside = min(max(float(value), self.low), self.high)
        notice = None
        if inside != value:
            notice = f"{self.label} {value:g} is outside [{self.low:g}, {self.high:g}]; {inside:g} is used"
        return inside, notice


@dataclass(frozen=True)
class Choice:
    """One of a few names."""

    label: str
    options: tuple[str, ...]
    default: str

    def clean(self, value: object) -> tuple[str, None]:
        """`value`, if it is among the options. Raises Refused otherwise."""
        if not isinstance(value, str) or value not in self.options:
            raise Refused(f"{self.label} {_shown(value)} is unknown; known: {', '.join(self.options)}")
        return value, None


@dataclass(frozen=True)
class Flag:
    """On or off."""

    label: str
    default: bool

    def clean(self, value: object) -> tuple[bool, None]:
        """`value`, if it is True or False. Raises Refused otherwise."""
        if not isinstance(value, bool):
            raise Refused(f"{self.label} must be on or off, got {_shown(value)}")
        return value, None


@dataclass(frozen=True)
class Point:
    """A point in the world frame of one robot's env, or None for none."""

    label: str
    reach: float
    """Largest magnitude of a coordinate [m]."""
    default: None = None

    def clean(self, value: object) -> tuple[tuple[float, ...] | None, str | None]:
        """`value`, three coordinates [m], within reach, and a notice if one had to be moved there. Raises Refused for
        anything else but None."""
        if value is None:
            return None, None
        if not isinstance(value, (tuple, list)) or len(value) != 3:
            raise Refused(f"{self.label} must be three coordinates, got {_shown(value)}")
        number = Number(self.label, -self.reach, self.reach, 0.0, 0.0)
        inside, notices = zip(*(number.clean(v) for v in value), strict=True)
        return inside, next(filter(None, notices), None)


Control = Number | Choice | Flag | Point


def _shown(value: object) -> str:
    """`value` as text, shortened: it comes from outside and goes into a notice."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


@dataclass(frozen=True)
class Ranges:
    """What depends on the policy and the robot: the ranges that a policy was trained on, and names."""

    velocity_x: tuple[float, float]
    velocity_y: tuple[float, float]
    yaw_rate: tuple[float, float]
    height_offset: tuple[float, float]
    sides: tuple[str, ...]
    """The arms."""
    laws: tuple[str, ...]
    motions: tuple[str, ...]
    checkpoints: tuple[str, ...]


SPEED = Number("speed", 0.1, 4.0, 1.0, 0.1)
"""How many times as fast as the clock."""


def _command(label: str, trained: tuple[float, float], step: float) -> Number:
    """Over the range of training, which need not hold zero: standing robots are asked for that all the same."""
    return Number(label, min(trained[0], 0.0), max(trained[1], 0.0), 0.0, step)


def make_controls(r: Ranges) -> dict[str, Control]:
    """Every control by name: `velocity_x`, `held.left.z`, `a.left.stiffness_x`, ..."""
    controls: dict[str, Control] = {
        "velocity_x": _command("forward [m/s]", r.velocity_x, 0.05),
        "velocity_y": _command("leftward [m/s]", r.velocity_y, 0.05),
        "yaw_rate": _command("turn [rad/s]", r.yaw_rate, 0.05),
        "height_offset": _command("height [m]", r.height_offset, 0.01),
        "stand": Flag("stand", True),
        "motion": Choice("arm motion", r.motions, r.motions[0]),
        "arm_actions": Flag("policy moves arms", True),
        "speed": SPEED,
        "paused": Flag("paused", False),
        "side_by_side": Flag("side by side", False),
        "push.hand": Choice("hand", r.sides, r.sides[0]),
        "push.force": Number("force [N]", 0.0, PUSH_N, 60.0, 5.0),
        "push.seconds": Number("for [s]", 0.02, PUSH_S, 0.5, 0.02),
    }
    for side in r.sides:
        for axis in AXES:
            controls[f"held.{side}.{axis}"] = Number(f"{side}, {axis} [N]", -60.0, 60.0, 0.0, 1.0)
    for robot in ROBOTS:
        controls[f"{robot}.checkpoint"] = Choice("policy", r.checkpoints, r.checkpoints[0])
        controls[f"{robot}.friction"] = Number("friction", 0.2, 1.5, 1.0, 0.05)
        controls[f"{robot}.mass_scale"] = Number("mass [nominal]", 0.8, 1.3, 1.0, 0.01)
        controls[f"{robot}.load_kg"] = Number("torso load [kg]", -1.0, 10.0, 0.0, 0.5)
        for side in r.sides:
            controls |= {f"{robot}.{side}.{name}": c for name, c in _law_controls(r.laws).items()}
            controls[f"{robot}.{side}.drag"] = Point("drag", 1e3)
    return controls


def _law_controls(laws: Sequence[str]) -> dict[str, Control]:
    """One arm's. Ranges hold those that distillation draws from."""
    law = LawConfig()
    out: dict[str, Control] = {"law": Choice("law", tuple(laws), "cotap" if "cotap" in laws else laws[0])}
    for axis, stiffness in zip(AXES, law.stiffness, strict=True):
        out[f"stiffness_{axis}"] = Number(f"K_ee {axis} [N/m]", 50.0, 1500.0, stiffness, 10.0)
    out["null_stiffness"] = Number("k_null [Nm/rad]", 5.0, 100.0, law.null_stiffness, 1.0)
    out["alpha"] = Number("alpha", 0.0, 1.0, law.alpha, 0.01)
    out["error"] = Choice("stiffness acts on", ERRORS, law.error)
    out["damping"] = Choice("damping", DAMPINGS, law.damping)
    out["passive"] = Flag("passive (energy store)", law.passive)
    return out
