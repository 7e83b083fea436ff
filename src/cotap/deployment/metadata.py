"""What an ONNX policy says of itself: all that a robot must agree with. Needs neither torch nor a simulator."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

FORMAT = "cotap-policy-1"
INPUT, TARGETS, ACTION = "observation", "joint_targets", "action"


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
    per_joint = (
        "default_pose_rad", "action_scale_rad", "kp", "kd", "torque_limit_nm", "joint_range_rad",
        "velocity_limit_rad_s",
    )  # fmt: skip
    for name in per_joint:
        values = getattr(m, name)
        if len(values) != len(m.joints):
            raise ValueError(f"metadata {name} has {len(values)} entries for {len(m.joints)} joints")
        flat = [v for entry in values for v in entry] if name == "joint_range_rad" else values
        if not all(_is_finite(v) for v in flat):
            raise ValueError(f"metadata {name} holds what is not a finite number: {values}")
    if not isinstance(m.control_dt, (int, float)) or not 1e-4 <= m.control_dt <= 1.0:
        raise ValueError(f"metadata control_dt must lie in [0.0001, 1.0] s, got {m.control_dt!r}")
    for part, entries in (("observation", ("terms", "history")), ("arm_action", ("mode", "reference_lead_s")),
                          ("law", ("left", "right", "ranges"))):  # fmt: skip
        absent = [entry for entry in entries if entry not in getattr(m, part)]
        if absent:
            raise ValueError(f"metadata {part} lacks {absent[0]!r}")
    for term in m.observation["terms"]:
        if not (len(term) == 3 and isinstance(term[0], str) and isinstance(term[1], int) and _is_finite(term[2])):
            raise ValueError(f"metadata observation has a term that is not (name, width, scale): {term}")


def _is_finite(value: Any) -> bool:
    """Whether this is a number that a float holds; JSON has larger ones."""
    return isinstance(value, (int, float)) and abs(value) <= sys.float_info.max
