"""What an ONNX policy says of itself: all that a robot must agree with. Needs neither torch nor a simulator."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from cotap.checks import is_finite, require_one_of, require_positive_int, require_range

FORMAT = "cotap-policy-1"
INPUT, TARGETS, ACTION = "observation", "joint_targets", "action"
ARM_MODES = ("residual", "absolute")
PER_JOINT = (
    "default_pose_rad", "action_scale_rad", "kp", "kd", "torque_limit_nm", "joint_range_rad", "velocity_limit_rad_s",
)  # fmt: skip


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
    """(J,) names, in the order of every vector here and of the outputs."""
    default_pose_rad: list[float]
    """(J,) what observed joint positions are relative to."""
    action_scale_rad: list[float]
    """(J,) radians of target per unit of action; contained in the graph."""
    action_clip: float
    """Largest magnitude of an action; contained in the graph."""
    arm_action: dict[str, Any]
    """`mode` (residual or absolute) and `reference_lead_s`: see `cotap.deployment.policy.arm_advance`."""
    agents: dict[str, list[int]]
    """Each actor's joints, [first, last + 1]."""
    kp: list[float]
    """(J,) PD position gains [Nm/rad]."""
    kd: list[float]
    """(J,) PD damping gains [Nms/rad]."""
    torque_limit_nm: list[float]
    joint_range_rad: list[list[float]]
    """(J, 2)."""
    velocity_limit_rad_s: list[float]
    nominal_height_m: float
    """Height of the torso link above flat ground in the default pose."""
    control_dt: float
    """Time between two observations [s]."""
    observation: dict[str, Any]
    """`terms` (name, width, scale), `history`, and in words `order` and `frames`."""
    commands: dict[str, Any]
    """Ranges that commands were drawn from, rates that they change at, the gait's period."""
    law: dict[str, Any]
    """The arms' laws in training (`left`, `right`, `torso`, `singularity_ratio`) and the `ranges` of their parameters;
    null where they were fixed."""
    checkpoint_sha256: str
    cotap_version: str
    opset: int

    @property
    def observation_width(self) -> int:
        """Numbers in an observation, history included."""
        return self.observation["history"] * sum(width for _, width, _ in self.observation["terms"])

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
        raise PolicyError(
            f"{where} lacks the metadata {', '.join(missing)}; export policies with python -m cotap.export"
        )
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
        raise PolicyError(f"{where}: {error or type(error).__name__}") from error
    return metadata


def _check(m: PolicyMetadata) -> None:
    if m.format != FORMAT:
        raise ValueError(f"format is {m.format!r}; this cotap reads {FORMAT!r}")
    for name in ("robot", "stage", "checkpoint_sha256", "cotap_version"):
        _require(isinstance(getattr(m, name), str), name, "a text", getattr(m, name))
    for name in ("arm_action", "agents", "observation", "commands", "law"):
        _require(isinstance(getattr(m, name), dict), name, "an object", getattr(m, name))
    names = isinstance(m.joints, list) and all(isinstance(joint, str) for joint in m.joints)
    _require(names and len(set(m.joints)) == len(m.joints) > 0, "joints", "a list of different names", m.joints)
    for name in PER_JOINT:
        _check_per_joint(name, getattr(m, name), len(m.joints))
    require_range("metadata action_clip", m.action_clip, 1e-3, 1e6)
    require_range("metadata nominal_height_m", m.nominal_height_m, 0.0, 100.0)
    require_range("metadata control_dt", m.control_dt, 1e-4, 1.0)
    require_positive_int("metadata opset", m.opset)
    for part, entries in (("observation", ("terms", "history")), ("arm_action", ("mode", "reference_lead_s")),
                          ("law", ("left", "right", "ranges"))):  # fmt: skip
        absent = [entry for entry in entries if entry not in getattr(m, part)]
        if absent:
            raise ValueError(f"metadata {part} lacks {absent[0]!r}")
    require_one_of("metadata arm_action.mode", m.arm_action["mode"], ARM_MODES)
    require_range("metadata arm_action.reference_lead_s", m.arm_action["reference_lead_s"], 0.0, 1.0)
    for agent, bounds in m.agents.items():
        pair = isinstance(bounds, list) and [type(v) for v in bounds] == [int, int]
        _require(pair and 0 <= bounds[0] < bounds[1] <= len(m.joints), f"agents.{agent}", "[first, last + 1]", bounds)
    require_positive_int("metadata observation.history", m.observation["history"])
    terms = m.observation["terms"]
    _require(isinstance(terms, list), "observation.terms", "a list", terms)
    for term in terms:
        if not (isinstance(term, list) and len(term) == 3 and isinstance(term[0], str) and is_finite(term[2])):
            raise ValueError(f"metadata observation has a term that is not (name, width, scale): {term}")
        require_positive_int(f"metadata observation: width of {term[0]}", term[1])
    ranges = m.law["ranges"]
    _require(ranges is None or isinstance(ranges, dict), "law.ranges", "an object or null", ranges)
    for name, bounds in (ranges or {}).items():
        pair = isinstance(bounds, list) and len(bounds) == 2 and all(is_finite(v) for v in bounds)
        _require(pair and bounds[0] <= bounds[1], f"law.ranges.{name}", "[low, high]", bounds)


def _check_per_joint(name: str, values: Any, count: int) -> None:
    _require(isinstance(values, list), name, "a list", values)
    if len(values) != count:
        raise ValueError(f"metadata {name} has {len(values)} entries for {count} joints")
    if name == "joint_range_rad":
        pairs = all(isinstance(pair, list) and len(pair) == 2 for pair in values)
        _require(pairs, name, "pairs [low, high]", values)
        values = [v for pair in values for v in pair]
    if not all(is_finite(v) for v in values):
        raise ValueError(f"metadata {name} holds what is not a finite number: {values}")


def _require(fits: bool, name: str, what: str, value: Any) -> None:
    if not fits:
        raise ValueError(f"metadata {name} must be {what}, got {reprlib.repr(value)}")
