"""What an ONNX policy says of itself: all that a robot must agree with. Needs neither torch nor a simulator."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from cotap.checks import is_finite, legible, quoted, reason_of, require_one_of, require_positive_int, require_range

FORMAT = "cotap-policy-4"
INPUT, TARGETS, LAW_TARGETS = "observation", "joint_targets", "law_targets"
STAGES = ("base", "distill")
UPPER_MODES = ("residual", "absolute")
PER_JOINT = ("default_pose_rad", "kp", "kd", "torque_limit_nm")


class PolicyError(ValueError):
    """A file that cannot be used as a policy; the message names it and says why."""


@dataclass(frozen=True)
class PolicyMetadata:
    """Every field is an entry of the file's metadata, its value in JSON. J joints, in the order of `joints`."""

    format: str
    """Says that this is a cotap policy, and of which layout."""
    robot: str
    stage: str
    """base or distill."""
    joints: list[str]
    """(J,) names, in the order of every vector here and of the targets; the arms' last."""
    default_pose_rad: list[float]
    """(J,) what observed joint positions and targets are relative to."""
    kp: list[float]
    """(J,) PD position gains [Nm/rad]."""
    kd: list[float]
    """(J,) PD damping gains [Nms/rad]."""
    torque_limit_nm: list[float]
    """(J,)."""
    action: dict[str, Any]
    """`scale_rad` (J,) radians of target per unit of action, `clip` the largest magnitude of an action, and what the
    arms' actions are added to, `upper_mode`: residual (the reference) or absolute (the default pose). With learned
    modulation also `law_targets` (M,): what each number of the second output is."""
    observation: dict[str, Any]
    """`terms` (name, width, scale), `history` in steps, `about` each term what it is, its unit and its range, and in
    words `order` and `frames`."""
    control_dt: float
    """Time between two observations [s]."""
    gait: dict[str, Any]
    """`period_s` of a stride."""
    commands: dict[str, Any]
    """Ranges that commands were drawn from, and the rates at which they are approached."""
    nominal_height_m: float
    """Height of the torso link's origin above flat ground in the default pose [m]."""
    terminations: dict[str, Any]
    """What counted as a fall."""
    law: dict[str, Any]
    """The arms' laws in training (`left`, `right`) and all that belongs to them."""
    golden: dict[str, Any]
    """Steps worked out: the `command` asked for, the gait's `phase` at the start, `readings` step by step, and the last
    `observation` (O,) with its `joint_targets` (J,) [rad] (and `law_targets`), to check a robot's loop against."""
    checkpoint_sha256: str
    cotap_version: str
    opset: int

    @property
    def observation_width(self) -> int:
        """Numbers in an observation, history included."""
        return self.observation["history"] * sum(width for _, width, _ in self.observation["terms"])

    @property
    def law_targets(self) -> list[str]:
        """What the policy asks of the arms' laws, in words; nothing without learned modulation."""
        return self.action.get("law_targets", [])

    def to_properties(self) -> dict[str, str]:
        """As ONNX keeps it."""
        return {f.name: json.dumps(getattr(self, f.name), allow_nan=False) for f in fields(self)}


def read_metadata(where: str, properties: Mapping[str, str]) -> PolicyMetadata:
    """What `to_properties` gave.

    Raises:
        PolicyError: an entry is missing, cannot be read, or does not fit the others.
    """
    names = [f.name for f in fields(PolicyMetadata)]
    missing = [name for name in names if name not in properties]
    if missing:
        raise PolicyError(f"{where} lacks the metadata {', '.join(missing)}; export policies with cotap export")
    values: dict[str, Any] = {}
    for name in names:
        try:
            values[name] = json.loads(properties[name])
        except (ValueError, RecursionError) as error:  # not JSON, or nested without end
            raise PolicyError(f"{where}: metadata {name} is not JSON: {error}") from error
    metadata = PolicyMetadata(**values)
    try:
        _check(metadata)
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise PolicyError(f"{where}: {reason_of(error)}") from error
    return metadata


def _check(m: PolicyMetadata) -> None:
    if m.format != FORMAT:
        raise ValueError(f"format is {quoted(m.format)}; this cotap reads {FORMAT!r}")
    require_one_of("metadata stage", m.stage, STAGES)
    for name in ("robot", "checkpoint_sha256", "cotap_version"):
        _require(isinstance(getattr(m, name), str), name, "a text", getattr(m, name))
    for name in ("action", "observation", "gait", "commands", "terminations", "law", "golden"):
        _require(isinstance(getattr(m, name), dict), name, "an object", getattr(m, name))
    names = isinstance(m.joints, list) and all(isinstance(joint, str) for joint in m.joints)
    _require(names and len(set(m.joints)) == len(m.joints) > 0, "joints", "a list of different names", m.joints)
    for name in PER_JOINT:
        _check_per_joint(name, getattr(m, name), len(m.joints))
    require_range("metadata nominal_height_m", m.nominal_height_m, 0.0, 100.0)
    require_range("metadata control_dt", m.control_dt, 1e-4, 1.0)
    require_positive_int("metadata opset", m.opset)
    for part, entries in {"observation": ("terms", "history"), "action": ("scale_rad", "clip", "upper_mode")}.items():
        absent = [entry for entry in entries if entry not in getattr(m, part)]
        if absent:
            raise ValueError(f"metadata {part} lacks {absent[0]!r}")
    _check_action(m.action, len(m.joints))
    _check_observation(m.observation)
    golden = {"observation": m.observation_width, "joint_targets": len(m.joints)}
    golden |= {"law_targets": len(m.law_targets)} if m.law_targets else {}
    for name, count in golden.items():
        _check_numbers(f"golden.{name}", m.golden.get(name), count, "numbers")


def _check_action(action: dict[str, Any], joints: int) -> None:
    _check_per_joint("action.scale_rad", action["scale_rad"], joints)
    for value in action["scale_rad"]:  # the loop divides by it
        require_range("metadata action.scale_rad", value, 1e-6, 1e3)
    require_range("metadata action.clip", action["clip"], 1e-3, 1e6)
    require_one_of("metadata action.upper_mode", action["upper_mode"], UPPER_MODES)
    targets = action.get("law_targets", [])
    texts = isinstance(targets, list) and all(isinstance(target, str) for target in targets)
    _require(texts, "action.law_targets", "a list of texts", targets)


def _check_observation(observation: dict[str, Any]) -> None:
    require_positive_int("metadata observation.history", observation["history"])
    terms = observation["terms"]
    _require(isinstance(terms, list), "observation.terms", "a list", terms)
    for term in terms:
        if not (isinstance(term, list) and len(term) == 3 and isinstance(term[0], str) and is_finite(term[2])):
            raise ValueError(f"metadata observation has a term that is not (name, width, scale): {quoted(term)}")
        require_positive_int(f"metadata observation: width of {legible(term[0])}", term[1])


def _check_per_joint(name: str, values: Any, count: int) -> None:
    _check_numbers(name, values, count, "joints")


def _check_numbers(name: str, values: Any, count: int, of: str) -> None:
    _require(isinstance(values, list), name, "a list", values)
    if len(values) != count:
        raise ValueError(f"metadata {name} has {len(values)} entries for {count} {of}")
    if not all(is_finite(v) for v in values):
        raise ValueError(f"metadata {name} holds what is not a finite number: {quoted(values)}")


def _require(fits: bool, name: str, what: str, value: Any) -> None:
    if not fits:
        raise ValueError(f"metadata {name} must be {what}, got {quoted(value)}")
