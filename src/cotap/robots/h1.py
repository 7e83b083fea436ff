"""Unitree H1: 19 hinges, from the published parameters in facts/h1.json."""

from __future__ import annotations

import json
from functools import lru_cache
from importlib.resources import files
from typing import Any

from cotap.robots.spec import ArmSpec, BodySpec, FootSpec, GeomSpec, JointSpec, RobotSpec

# kp [Nm/rad], kd [Nms/rad], default angle [rad], velocity limit [rad/s]; Unitree's gains. The default pose of the legs
# has the centre of mass over the middle of the soles.
_JOINTS: dict[str, tuple[float, float, float, float]] = {
    "hip_yaw": (150.0, 2.0, 0.0, 23.0),
    "hip_roll": (150.0, 2.0, 0.0, 23.0),
    "hip_pitch": (150.0, 2.0, -0.13, 23.0),
    "knee": (200.0, 4.0, 0.45, 14.0),
    "ankle": (40.0, 2.0, -0.32, 9.0),
    "torso": (300.0, 6.0, 0.0, 23.0),
    "shoulder_pitch": (100.0, 2.0, 0.0, 9.0),
    "shoulder_roll": (100.0, 2.0, 0.0, 9.0),
    "shoulder_yaw": (100.0, 2.0, 0.0, 20.0),
    "elbow": (100.0, 2.0, 0.0, 20.0),
}
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
_LEG = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")
_X90 = (0.70710678, 0.70710678, 0.0, 0.0)
_Y90 = (0.70710678, 0.0, 0.70710678, 0.0)

_COLORS = {
    "dark": (0.16, 0.17, 0.20),
    "shell": (0.88, 0.89, 0.91),
    "left": (0.13, 0.45, 0.80),
    "right": (0.88, 0.42, 0.13),
    "visor": (0.05, 0.06, 0.09),
}


def _capsule(a: tuple[float, float, float], b: tuple[float, float, float], r: float, color: str) -> GeomSpec:
    """A capsule from `a` to `b`, both on one axis of the body frame."""
    delta = [y - x for x, y in zip(a, b, strict=True)]
    axis = max(range(3), key=lambda i: abs(delta[i]))
    quat = (_Y90, _X90, (1.0, 0.0, 0.0, 0.0))[axis]
    mid = ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2)
    return GeomSpec("capsule", (r, abs(delta[axis]) / 2, 0.0), mid, quat, color)


def _visuals(body: str) -> tuple[GeomSpec, ...]:
    """Rounded primitive shapes that look like the robot; they carry no mass and touch nothing."""
    side = body.split("_")[0] if body.startswith(("left", "right")) else ""
    part = body.removeprefix("left_").removeprefix("right_").removesuffix("_link")
    y = 1.0 if side == "left" else -1.0
    shapes: dict[str, tuple[GeomSpec, ...]] = {
        "pelvis": (
            GeomSpec("ellipsoid", (0.075, 0.085, 0.075), (0.0, 0.0, -0.04), color="dark"),
            _capsule((0.0, -0.07, -0.15), (0.0, 0.07, -0.15), 0.05, "dark"),
        ),
        "hip_yaw": (_capsule((-0.05, 0.0, 0.0), (0.02, 0.0, 0.0), 0.055, "dark"),),
        "hip_roll": (_capsule((0.0, 0.0, 0.0), (0.0, 0.09 * y, 0.0), 0.052, "dark"),),
        "hip_pitch": (
            _capsule((0.0, 0.0, -0.02), (0.0, 0.0, -0.34), 0.062, "shell"),
            _capsule((0.0, -0.045, 0.0), (0.0, 0.045, 0.0), 0.068, side),
        ),
        "knee": (
            _capsule((0.0, -0.035, 0.0), (0.0, 0.035, 0.0), 0.056, side),
            _capsule((0.012, 0.0, -0.06), (0.012, 0.0, -0.33), 0.045, "shell"),
            _capsule((0.0, 0.0, -0.34), (0.0, 0.0, -0.39), 0.028, "dark"),
        ),
        "ankle": (
            _capsule((0.0, -0.025, 0.0), (0.0, 0.025, 0.0), 0.034, "dark"),
            _capsule((-0.035, -0.018, -0.052), (0.145, -0.018, -0.052), 0.018, side),
            _capsule((-0.035, 0.018, -0.052), (0.145, 0.018, -0.052), 0.018, side),
        ),
        "torso": (
            _capsule((0.0, 0.0, 0.02), (0.0, 0.0, 0.10), 0.07, "dark"),
            GeomSpec("ellipsoid", (0.115, 0.165, 0.19), (0.005, 0.0, 0.31), color="shell"),
            _capsule((0.0, -0.12, 0.43), (0.0, 0.12, 0.43), 0.062, "shell"),
            _capsule((0.02, 0.0, 0.50), (0.02, 0.0, 0.56), 0.04, "dark"),
            GeomSpec("ellipsoid", (0.085, 0.075, 0.11), (0.045, 0.0, 0.66), color="shell"),
            GeomSpec("ellipsoid", (0.05, 0.062, 0.07), (0.088, 0.0, 0.67), color="visor"),
        ),
        "shoulder_pitch": (GeomSpec("sphere", (0.062, 0.0, 0.0), (0.0, 0.04 * y, -0.01), color=side),),
        "shoulder_roll": (_capsule((0.0, 0.0, 0.0), (0.0, 0.0, -0.10), 0.048, "dark"),),
        "shoulder_yaw": (_capsule((0.0, 0.0, -0.01), (0.008, 0.0, -0.18), 0.042, "shell"),),
        "elbow": (
            _capsule((0.0, -0.02, 0.0), (0.0, 0.02, 0.0), 0.044, side),
            _capsule((0.03, 0.0, 0.0), (0.22, 0.0, 0.0), 0.035, "shell"),
            GeomSpec("ellipsoid", (0.05, 0.03, 0.038), (0.28, 0.0, 0.0), color=side),
        ),
    }
    return shapes[part]


def _joint(entry: dict[str, Any], armature: float, damping: float) -> JointSpec:
    name: str = entry["name"]
    part = name.removeprefix("left_").removeprefix("right_")
    kp, kd, default, velocity = _JOINTS[part]
    swap = {"left": "right", "right": "left"}
    side = name.split("_")[0]
    mirror = f"{swap[side]}_{part}" if side in swap else name
    # Reflection in the x-z plane keeps rotations about y and reverses those about x and z.
    sign = 1.0 if entry["axis"] == [0.0, 1.0, 0.0] else -1.0
    low, high = entry["range_rad"]
    return JointSpec(
        name, tuple(entry["axis"]), (low, high), entry["torque_limit_nm"], velocity, kp, kd, armature, damping, default,
        mirror, sign,
    )  # fmt: skip


def _body(entry: dict[str, Any]) -> BodySpec:
    hinge = entry["joint"]["name"] if entry["joint"]["type"] == "hinge" else None
    geoms = tuple(
        GeomSpec(g["type"], tuple(g["size"]), tuple(g["pos"]), tuple(g["quat"])) for g in entry["collision_geoms"]
    )
    return BodySpec(
        entry["name"], entry["parent"], tuple(entry["pos"]), tuple(entry["quat"]), entry["mass"], tuple(entry["com"]),
        tuple(entry["inertia_quat"]), tuple(entry["diaginertia"]), hinge, geoms, _visuals(entry["name"]),
    )  # fmt: skip


@lru_cache(maxsize=1)
def h1() -> RobotSpec:
    """The Unitree H1. At zero arm angles the upper arms hang and the forearms point forward."""
    facts = json.loads(files("cotap.robots").joinpath("facts/h1.json").read_text(encoding="utf-8"))
    passive = facts["joint_armature"], facts["joint_damping"]
    joints = tuple(_joint(b["joint"], *passive) for b in facts["bodies"] if b["joint"]["type"] == "hinge")
    sides = ("left", "right")
    return RobotSpec(
        name="h1",
        bodies=tuple(_body(b) for b in facts["bodies"]),
        joints=joints,
        base_body="pelvis",
        torso_body="torso_link",
        arms=tuple(
            ArmSpec(s, tuple(f"{s}_{j}" for j in _ARM), f"{s}_elbow_link", (0.3, 0.0, 0.0), f"{s}_elbow_link")
            for s in sides
        ),
        feet=tuple(FootSpec(s, f"{s}_ankle_link", (0.05, 0.0, -0.07)) for s in sides),
        nominal_height_m=1.0205,
        menagerie="unitree_h1",
        colors=_COLORS,
    )
