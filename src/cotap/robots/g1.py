"""Unitree G1: 29 hinges, from the published parameters in facts/g1.json."""

from __future__ import annotations

from functools import lru_cache

from cotap.robots.from_facts import Gains, robot_from_facts, shipped_facts
from cotap.robots.shapes import COLORS, capsule
from cotap.robots.spec import ArmSpec, FootSpec, GeomSpec, RobotSpec

# Legs: mjlab's. With those of unitree_rl_gym, equal random actions turn a standing G1's torso twice as fast. Waist:
# FALCON's stiffness, with three times its damping, for the same reason. Arms: Unitree's of the examples of
# unitree_sdk2, halved at the wrists, which hold 5 Nm. The default pose of the legs has the centre of mass over the
# middle of the soles.
_GAINS = {
    "hip": Gains(40.2, 2.56),
    "hip_roll": Gains(99.1, 6.31),
    "hip_pitch": Gains(40.2, 2.56, -0.13),
    "knee": Gains(99.1, 6.31, 0.3),
    "ankle": Gains(28.5, 1.81),
    "ankle_pitch": Gains(28.5, 1.81, -0.17),
    "waist": Gains(300.0, 15.0),
    "shoulder": Gains(40.0, 1.0),
    "elbow": Gains(40.0, 1.0),
    "wrist": Gains(20.0, 0.5),
}
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")


def _visuals(body: str) -> tuple[GeomSpec, ...]:
    """Rounded primitive shapes that look like the robot; they carry no mass and touch nothing."""
    side = body.split("_")[0] if body.startswith(("left", "right")) else ""
    part = body.removeprefix("left_").removeprefix("right_").removesuffix("_link")
    y = 1.0 if side == "left" else -1.0
    shapes: dict[str, tuple[GeomSpec, ...]] = {
        "pelvis": (
            GeomSpec("ellipsoid", (0.065, 0.075, 0.06), (0.0, 0.0, -0.05), color="dark"),
            capsule((0.0, -0.05, -0.1), (0.0, 0.05, -0.1), 0.045, "shell"),
        ),
        "hip_pitch": (capsule((0.0, 0.0, 0.0), (0.0, 0.05 * y, -0.03), 0.047, "dark"),),
        "hip_roll": (
            capsule((-0.03, 0.0, 0.0), (0.045, 0.0, 0.0), 0.043, side),
            capsule((0.02, 0.0, -0.02), (0.025, 0.0, -0.11), 0.052, "shell"),
        ),
        "hip_yaw": (
            capsule((-0.004, 0.0, -0.02), (-0.06, 0.0, -0.14), 0.055, "shell"),
            capsule((-0.078, -0.03, -0.177), (-0.078, 0.03, -0.177), 0.05, "dark"),
        ),
        "knee": (
            capsule((0.0, -0.04, 0.0), (0.0, 0.04, 0.0), 0.042, side),
            capsule((0.006, 0.0, -0.05), (0.01, 0.0, -0.2), 0.038, "shell"),
            capsule((0.006, 0.0, -0.2), (0.0, 0.0, -0.29), 0.026, "dark"),
        ),
        "ankle_pitch": (capsule((0.0, -0.022, 0.0), (0.0, 0.022, 0.0), 0.022, "dark"),),
        "ankle_roll": (
            capsule((-0.04, -0.018, -0.02), (0.115, -0.022, -0.02), 0.015, side),
            capsule((-0.04, 0.018, -0.02), (0.115, 0.022, -0.02), 0.015, side),
            capsule((-0.03, 0.0, -0.012), (0.07, 0.0, -0.016), 0.018, "dark"),
        ),
        "waist_yaw": (capsule((0.0, 0.0, 0.005), (0.0, 0.0, 0.03), 0.05, "dark"),),
        "waist_roll": (capsule((-0.03, 0.0, 0.0), (0.03, 0.0, 0.0), 0.035, "dark"),),
        "torso": (
            capsule((0.0, 0.0, 0.02), (0.005, 0.0, 0.09), 0.058, "dark"),
            GeomSpec("ellipsoid", (0.08, 0.1, 0.125), (0.01, 0.0, 0.19), color="shell"),
            capsule((0.004, -0.075, 0.248), (0.004, 0.075, 0.248), 0.05, "shell"),
            capsule((0.004, 0.0, 0.29), (0.004, 0.0, 0.35), 0.035, "dark"),
            GeomSpec("ellipsoid", (0.06, 0.058, 0.085), (0.012, 0.0, 0.415), color="shell"),
            GeomSpec("ellipsoid", (0.035, 0.047, 0.062), (0.043, 0.0, 0.415), color="visor"),
        ),
        "shoulder_pitch": (capsule((0.0, 0.0, 0.0), (0.0, 0.04 * y, -0.01), 0.04, side),),
        "shoulder_roll": (capsule((0.0, 0.004 * y, -0.01), (0.0, 0.006 * y, -0.09), 0.037, "dark"),),
        "shoulder_yaw": (capsule((0.0, 0.0, 0.0), (0.012, 0.0, -0.075), 0.035, "shell"),),
        "elbow": (
            capsule((0.0, -0.02, 0.0), (0.0, 0.02, 0.0), 0.036, side),
            capsule((0.02, 0.0, -0.008), (0.09, 0.0, -0.01), 0.032, "shell"),
        ),
        "wrist_roll": (capsule((0.0, 0.0, 0.0), (0.03, 0.0, 0.0), 0.03, "dark"),),
        "wrist_pitch": (capsule((0.0, 0.0, 0.0), (0.035, 0.0, 0.0), 0.03, "shell"),),
        "wrist_yaw": (
            capsule((0.0, 0.0, 0.0), (0.045, 0.0, 0.0), 0.027, "dark"),
            GeomSpec("ellipsoid", (0.06, 0.022, 0.035), (0.1, -0.005 * y, 0.0), color=side),
        ),
    }
    return shapes[part]


@lru_cache(maxsize=1)
def g1() -> RobotSpec:
    """The Unitree G1. At zero arm angles the upper arms hang and the forearms point forward."""
    sides = ("left", "right")
    return robot_from_facts(
        shipped_facts("g1"),
        name="g1",
        gains=_GAINS,
        torso_body="torso_link",
        arms=tuple(
            ArmSpec(
                s, tuple(f"{s}_{j}_joint" for j in _ARM), f"{s}_wrist_yaw_link", (0.08, 0.0, 0.0), f"{s}_elbow_link"
            )
            for s in sides
        ),
        feet=tuple(FootSpec(s, f"{s}_ankle_roll_link", (0.035, 0.0, -0.035)) for s in sides),
        visuals=_visuals,
        menagerie="unitree_g1",
        colors=COLORS,
    )
