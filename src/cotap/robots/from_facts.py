"""From a file of facts, which `from_mjcf` writes, and a table of gains to a RobotSpec."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from cotap.checks import legible, reason_of
from cotap.inputs import InputError, read_text
from cotap.robots.kinematics import body_frame, default_angles
from cotap.robots.spec import ArmSpec, BodySpec, FootSpec, GeomSpec, JointSpec, RobotSpec


class Gains(NamedTuple):
    """What a joint's maker leaves open."""

    kp: float
    """Position gain [Nm/rad]."""
    kd: float
    """Damping gain [Nms/rad]."""
    default_rad: float = 0.0
    """Its angle in the default pose [rad]."""


def shipped_facts(name: str) -> Path:
    """Where the package keeps the facts of a robot."""
    return Path(str(files("cotap.robots").joinpath("facts", f"{name}.json")))


def robot_from_facts(
    facts: Path, name: str, gains: Mapping[str, Gains], torso_body: str, arms: tuple[ArmSpec, ...],
    feet: tuple[FootSpec, ...], visuals: Callable[[str], tuple[GeomSpec, ...]] | None = None,
    nominal_height_m: float | None = None, **fields: Any,
) -> RobotSpec:  # fmt: skip
    """A robot of published facts.

    Args:
        facts: The file: bodies, depth first, with masses, inertias and shapes, and the joint that moves each.
        name: The robot's name.
        gains: By joint or by a part of its name, such as `knee`; of several that fit the longest counts.
        torso_body: The body that carries the arms.
        arms: Left and right.
        feet: Left and right.
        visuals: Shapes to be seen of the body of a name; by default those that collide.
        nominal_height_m: Height of the torso link in the default pose; by default that which puts the lowest sole on
            the ground.
        fields: Others of `RobotSpec`.

    Raises:
        ValueError: the file cannot be read as facts, a joint has no gains, or the robot contradicts itself.
    """
    content = _read(facts)
    try:
        bodies = _arms_last([_body(entry, visuals) for entry in content["bodies"]], arms)
        entries = {entry["name"]: entry["joint"] for entry in content["bodies"]}
        joints = tuple(_joint(entries[b.name], gains) for b in bodies if b.joint is not None)
        excludes = tuple((first, second) for first, second in content["contact_excludes"])
    except (LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{facts}: these are no facts of a robot: {reason_of(error)}") from error
    names, free = {b.name for b in bodies}, [b.name for b in bodies if b.joint is None]
    if lost := [name for name in entries if name not in names]:
        raise ValueError(f"{facts}: the parents of {', '.join(lost)} do not lead to 'world'")
    if len(free) != 1:
        raise ValueError(f"{facts}: one body must be without a joint, the base, got {', '.join(free) or 'none'}")
    spec = RobotSpec(name, tuple(bodies), joints, free[0], torso_body, arms, feet, 0.0, excludes, **fields)
    return dataclasses.replace(spec, nominal_height_m=nominal_height_m or _torso_height(spec))


def _read(facts: Path) -> Any:
    try:
        return json.loads(read_text(facts))
    except InputError as error:
        raise ValueError(f"facts {str(facts)!r} {error}") from error
    except (ValueError, RecursionError) as error:  # not JSON, or nested without end
        raise ValueError(f"{facts}: these are no facts of a robot, not even JSON: {legible(str(error))}") from error


def _joint(entry: dict[str, Any], gains: Mapping[str, Gains]) -> JointSpec:
    name: str = entry["name"]
    fitting = [part for part in gains if part in name]
    if not fitting:
        raise ValueError(f"joint {name!r} has no gains; there are gains of {', '.join(gains)}")
    kp, kd, default = gains[max(fitting, key=len)]
    low, high = entry["range_rad"]
    return JointSpec(
        name, tuple(entry["axis"]), (low, high), entry["torque_limit_nm"], entry["velocity_limit_rad_s"], kp, kd,
        entry["armature"], entry["damping"], default, entry["mirror"], entry["mirror_sign"],
    )  # fmt: skip


def _body(entry: dict[str, Any], visuals: Callable[[str], tuple[GeomSpec, ...]] | None) -> BodySpec:
    name, joint = entry["name"], entry["joint"]
    shapes = tuple(
        GeomSpec(g["type"], tuple(g["size"]), tuple(g["pos"]), tuple(g["quat"])) for g in entry["collision_geoms"]
    )
    return BodySpec(
        name, entry["parent"], tuple(entry["pos"]), tuple(entry["quat"]), entry["mass"], tuple(entry["com"]),
        tuple(entry["inertia_quat"]), tuple(entry["diaginertia"]), joint and joint["name"], shapes,
        visuals(name) if visuals else shapes,
    )  # fmt: skip


def _arms_last(bodies: list[BodySpec], arms: tuple[ArmSpec, ...]) -> list[BodySpec]:
    """The bodies depth first, those that lead to the arms after their siblings, arm by arm: as `RobotSpec` wants it."""
    parents = {b.name: b.parent for b in bodies}
    rank: dict[str, int] = {}
    for i, arm in enumerate(arms, 1):
        body = arm.hand_body
        while body in parents:
            rank.setdefault(body, i)
            body = parents[body]

    def below(parent: str) -> list[BodySpec]:
        children = sorted((b for b in bodies if b.parent == parent), key=lambda b: rank.get(b.name, 0))
        return [body for child in children for body in (child, *below(child.name))]

    return below("world")


def _torso_height(spec: RobotSpec) -> float:
    """Height of the torso link above the lowest sole in the default pose, the base level [m]."""
    torso, _ = body_frame(spec, spec.torso_body, spec.base_body, default_angles(spec))
    return float(torso[2] - min(spec.sole(foot)[2] for foot in spec.feet))
