"""A humanoid that nobody builds, unlike the H1 wherever the package must not care: three waist joints, a torso that is
not the base, ankles that roll, arms of seven joints with weak wrists, and gains and rotors of each joint's own."""

from __future__ import annotations

import math
from functools import lru_cache

from cotap.robots import ArmSpec, BodySpec, FootSpec, GeomSpec, JointSpec, RobotSpec
from cotap.robots.spec import Quat, Vec3

LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
WAIST = ("waist_yaw", "waist_roll", "waist_pitch")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
SIDES = ("left", "right")

_AXES: dict[str, Vec3] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}

# Of the left side: axis, range [rad], torque [Nm] and velocity [rad/s] limits, kp [Nm/rad], kd [Nms/rad],
# armature [kg m^2], damping [Nms/rad], default angle [rad].
_JOINTS: dict[str, tuple[str, tuple[float, float], float, float, float, float, float, float, float]] = {
    "hip_pitch": ("y", (-2.0, 1.5), 90.0, 25.0, 260.0, 6.0, 0.03, 0.4, -0.25),
    "hip_roll": ("x", (-0.4, 1.2), 90.0, 20.0, 160.0, 4.0, 0.04, 0.5, 0.0),
    "hip_yaw": ("z", (-1.0, 1.2), 60.0, 25.0, 120.0, 3.0, 0.025, 0.3, 0.0),
    "knee": ("y", (0.0, 2.3), 140.0, 18.0, 350.0, 7.0, 0.05, 0.6, 0.5),
    "ankle_pitch": ("y", (-0.9, 0.6), 50.0, 20.0, 300.0, 6.0, 0.02, 0.25, -0.25),
    "ankle_roll": ("x", (-0.3, 0.35), 40.0, 20.0, 90.0, 2.5, 0.015, 0.2, 0.0),
    "waist_yaw": ("z", (-2.0, 2.0), 80.0, 20.0, 220.0, 5.0, 0.035, 0.45, 0.0),
    "waist_roll": ("x", (-0.5, 0.5), 60.0, 20.0, 260.0, 5.5, 0.03, 0.35, 0.0),
    "waist_pitch": ("y", (-0.5, 0.6), 60.0, 20.0, 280.0, 6.0, 0.032, 0.4, 0.0),
    "shoulder_pitch": ("y", (-3.0, 2.6), 25.0, 20.0, 70.0, 2.0, 0.012, 0.15, 0.1),
    "shoulder_roll": ("x", (-1.5, 2.2), 25.0, 20.0, 65.0, 1.8, 0.011, 0.14, 0.15),
    "shoulder_yaw": ("z", (-2.6, 2.4), 25.0, 22.0, 50.0, 1.5, 0.009, 0.12, 0.05),
    "elbow": ("y", (-1.0, 2.0), 25.0, 22.0, 55.0, 1.4, 0.01, 0.1, 0.2),
    "wrist_roll": ("x", (-1.9, 2.0), 5.0, 30.0, 20.0, 0.6, 0.004, 0.05, 0.0),
    "wrist_pitch": ("y", (-1.6, 1.4), 5.0, 28.0, 15.0, 0.5, 0.003, 0.04, 0.0),
    "wrist_yaw": ("z", (-1.5, 1.6), 5.0, 26.0, 12.0, 0.4, 0.002, 0.03, 0.0),
}


def _about(axis: str, angle: float) -> Quat:
    x, y, z = (math.sin(angle / 2.0) * v for v in _AXES[axis])
    return (math.cos(angle / 2.0), x, y, z)


_NONE: Quat = (1.0, 0.0, 0.0, 0.0)
_ALONG_X = _about("y", 0.5 * math.pi)

# Of the left side: position in the parent's frame [m], orientation there, mass [kg], centre of mass [m], half extents
# of the box whose inertia it has [m], shapes.
_LINKS: dict[str, tuple[Vec3, Quat, float, Vec3, Vec3, tuple[GeomSpec, ...]]] = {
    "hip_pitch": ((0.0, 0.07, -0.06), _NONE, 0.8, (0.0, 0.02, 0.0), (0.04, 0.04, 0.04), ()),
    "hip_roll": ((0.0, 0.03, 0.0), _NONE, 0.8, (0.0, 0.0, -0.02), (0.04, 0.04, 0.04), ()),
    "hip_yaw": (
        (0.0, 0.0, 0.0), _NONE, 2.5, (0.0, 0.005, -0.15), (0.05, 0.05, 0.15),
        (GeomSpec("capsule", (0.05, 0.13, 0.0), (0.0, 0.0, -0.14), color="shell"),),
    ),
    "knee": (
        (0.0, 0.0, -0.315), _NONE, 1.8, (0.01, 0.0, -0.13), (0.04, 0.04, 0.15),
        (GeomSpec("capsule", (0.04, 0.11, 0.0), (0.0, 0.0, -0.15), color="shell"),),
    ),
    "ankle_pitch": ((0.0, 0.0, -0.315), _NONE, 0.2, (0.0, 0.0, 0.0), (0.02, 0.02, 0.02), ()),
    "ankle_roll": (
        (0.0, 0.0, 0.0), _NONE, 0.7, (0.02, 0.0, -0.03), (0.09, 0.035, 0.015),
        (GeomSpec("box", (0.1, 0.04, 0.015), (0.03, 0.0, -0.035), color="left"),),
    ),
    "waist_yaw": ((-0.01, 0.0, 0.03), _about("y", 0.15), 0.3, (0.0, 0.0, 0.0), (0.03, 0.03, 0.02), ()),
    "waist_roll": ((-0.01, 0.0, 0.02), _NONE, 0.3, (0.0, 0.0, 0.0), (0.03, 0.03, 0.02), ()),
    "waist_pitch": (
        (-0.01, 0.0, 0.03), _about("y", -0.15), 10.0, (0.05, 0.0, 0.16), (0.08, 0.11, 0.17),
        (
            GeomSpec("box", (0.08, 0.1, 0.14), (0.03, 0.0, 0.17), color="shell"),
            GeomSpec("sphere", (0.08, 0.0, 0.0), (0.05, 0.0, 0.41)),
        ),
    ),
    "shoulder_pitch": ((0.03, 0.12, 0.25), _about("x", 0.2), 0.6, (0.0, 0.02, 0.0), (0.03, 0.03, 0.03), ()),
    "shoulder_roll": ((0.0, 0.04, 0.0), _about("x", -0.2), 0.6, (0.0, 0.0, -0.03), (0.03, 0.03, 0.04), ()),
    "shoulder_yaw": (
        (0.0, 0.0, -0.08), _NONE, 0.8, (0.0, 0.003, -0.05), (0.03, 0.03, 0.08),
        (GeomSpec("capsule", (0.03, 0.06, 0.0), (0.0, 0.0, -0.04), color="shell"),),
    ),
    "elbow": (
        (0.01, 0.0, -0.12), _NONE, 0.7, (0.05, 0.0, 0.0), (0.07, 0.025, 0.025),
        (GeomSpec("capsule", (0.028, 0.05, 0.0), (0.05, 0.0, 0.0), _ALONG_X, color="shell"),),
    ),
    "wrist_roll": ((0.12, 0.0, 0.0), _NONE, 0.2, (0.02, 0.0, 0.0), (0.03, 0.02, 0.02), ()),
    "wrist_pitch": ((0.05, 0.0, 0.0), _NONE, 0.1, (0.01, 0.0, 0.0), (0.02, 0.02, 0.02), ()),
    "wrist_yaw": (
        (0.04, 0.0, 0.0), _NONE, 0.2, (0.04, 0.002, 0.0), (0.04, 0.03, 0.02),
        (GeomSpec("sphere", (0.035, 0.0, 0.0), (0.05, 0.0, 0.0), color="left"),),
    ),
}  # fmt: skip
_PELVIS = BodySpec(
    "pelvis", "world", (0.0, 0.0, 0.7), _NONE, 4.0, (0.005, 0.0, -0.02), _NONE, (0.02, 0.015, 0.02), None,
    (GeomSpec("capsule", (0.06, 0.05, 0.0), (0.0, 0.0, -0.03), _about("x", 0.5 * math.pi)),),
    (GeomSpec("capsule", (0.06, 0.05, 0.0), (0.0, 0.0, -0.03), _about("x", 0.5 * math.pi)),),
)  # fmt: skip


def _joint(side: str, part: str) -> JointSpec:
    axis, (low, high), torque, velocity, kp, kd, armature, damping, default = _JOINTS[part]
    sign = 1.0 if axis == "y" else -1.0
    if side == "right":
        low, high = sorted((sign * low, sign * high))
        default *= sign
    mirror = {"left": f"right_{part}", "right": f"left_{part}", "": part}[side]
    return JointSpec(
        _name(side, part), _AXES[axis], (low, high), torque, velocity, kp, kd, armature, damping, default, mirror, sign
    )


def _body(side: str, part: str, parent: str) -> BodySpec:
    pos, (w, x, y, z), mass, com, (a, b, c), shapes = _LINKS[part]
    sign = -1.0 if side == "right" else 1.0
    inertia = (mass / 3.0 * (b * b + c * c), mass / 3.0 * (a * a + c * c), mass / 3.0 * (a * a + b * b))
    name = _name(side, part)
    shapes = tuple(GeomSpec(s.type, s.size, s.pos, s.quat, side if s.color == "left" else s.color) for s in shapes)
    return BodySpec(
        f"{name}_link", parent, (pos[0], sign * pos[1], pos[2]), (w, sign * x, y, sign * z), mass,
        (com[0], sign * com[1], com[2]), _NONE, inertia, name, shapes, shapes,
    )  # fmt: skip


def _name(side: str, part: str) -> str:
    return f"{side}_{part}" if side else part


def _chain(side: str, parts: tuple[str, ...], root: str) -> list[BodySpec]:
    parents = (root, *(f"{_name(side, part)}_link" for part in parts))
    return [_body(side, part, parent) for part, parent in zip(parts, parents, strict=False)]


@lru_cache(maxsize=1)
def made_up() -> RobotSpec:
    """At zero arm angles the upper arms hang and the forearms point forward, as the H1's."""
    chains = [("left", LEG, "pelvis"), ("right", LEG, "pelvis"), ("", WAIST, "pelvis")]
    chains += [(side, ARM, "waist_pitch_link") for side in SIDES]
    return RobotSpec(
        name="made-up",
        bodies=(_PELVIS, *(body for chain in chains for body in _chain(*chain))),
        joints=tuple(_joint(side, part) for side, parts, _ in chains for part in parts),
        base_body="pelvis",
        torso_body="waist_pitch_link",
        arms=tuple(
            ArmSpec(s, tuple(f"{s}_{j}" for j in ARM), f"{s}_wrist_yaw_link", (0.05, 0.0, 0.0), f"{s}_elbow_link")
            for s in SIDES
        ),
        feet=tuple(FootSpec(s, f"{s}_ankle_roll_link", (0.03, 0.0, -0.05)) for s in SIDES),
        nominal_height_m=0.8028,
        contact_excludes=tuple(("pelvis", f"{s}_hip_yaw_link") for s in SIDES),
        colors={
            "dark": (0.2, 0.2, 0.22), "shell": (0.75, 0.8, 0.7), "left": (0.2, 0.5, 0.3), "right": (0.6, 0.3, 0.5)
        },
    )  # fmt: skip
