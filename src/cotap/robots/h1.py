"""Unitree H1: 19 hinges, from the published parameters in facts/h1.json."""

from __future__ import annotations

from functools import lru_cache

from cotap.robots.from_facts import Gains, robot_from_facts, shipped_facts
from cotap.robots.shapes import COLORS, capsule
from cotap.robots.spec import ArmSpec, FootSpec, GeomSpec, RobotSpec

# Unitree's. The default pose of the legs has the centre of mass over the middle of the soles.
_GAINS = {
    "hip_yaw": Gains(150.0, 2.0),
    "hip_roll": Gains(150.0, 2.0),
    "hip_pitch": Gains(150.0, 2.0, -0.13),
    "knee": Gains(200.0, 4.0, 0.45),
    "ankle": Gains(40.0, 2.0, -0.32),
    "torso": Gains(300.0, 6.0),
    "shoulder": Gains(100.0, 2.0),
    "elbow": Gains(100.0, 2.0),
}
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")


def _visuals(body: str) -> tuple[GeomSpec, ...]:
    """Rounded primitive shapes that look like the robot; they carry no mass and touch nothing."""
    side = body.split("_")[0] if body.startswith(("left", "right")) else ""
    part = body.removeprefix("left_").removeprefix("right_").removesuffix("_link")
    y = 1.0 if side == "left" else -1.0
    shapes: dict[str, tuple[GeomSpec, ...]] = {
        "pelvis": (
            GeomSpec("ellipsoid", (0.075, 0.085, 0.075), (0.0, 0.0, -0.04), color="dark"),
            capsule((0.0, -0.07, -0.15), (0.0, 0.07, -0.15), 0.05, "dark"),
        ),
        "hip_yaw": (capsule((-0.05, 0.0, 0.0), (0.02, 0.0, 0.0), 0.055, "dark"),),
        "hip_roll": (capsule((0.0, 0.0, 0.0), (0.0, 0.09 * y, 0.0), 0.052, "dark"),),
        "hip_pitch": (
            capsule((0.0, 0.0, -0.02), (0.0, 0.0, -0.34), 0.062, "shell"),
            capsule((0.0, -0.045, 0.0), (0.0, 0.045, 0.0), 0.068, side),
        ),
        "knee": (
            capsule((0.0, -0.035, 0.0), (0.0, 0.035, 0.0), 0.056, side),
            capsule((0.012, 0.0, -0.06), (0.012, 0.0, -0.33), 0.045, "shell"),
            capsule((0.0, 0.0, -0.34), (0.0, 0.0, -0.39), 0.028, "dark"),
        ),
        "ankle": (
            capsule((0.0, -0.025, 0.0), (0.0, 0.025, 0.0), 0.034, "dark"),
            capsule((-0.035, -0.018, -0.052), (0.145, -0.018, -0.052), 0.018, side),
            capsule((-0.035, 0.018, -0.052), (0.145, 0.018, -0.052), 0.018, side),
        ),
        "torso": (
            capsule((0.0, 0.0, 0.02), (0.0, 0.0, 0.10), 0.07, "dark"),
            GeomSpec("ellipsoid", (0.115, 0.165, 0.19), (0.005, 0.0, 0.31), color="shell"),
            capsule((0.0, -0.12, 0.43), (0.0, 0.12, 0.43), 0.062, "shell"),
            capsule((0.02, 0.0, 0.50), (0.02, 0.0, 0.56), 0.04, "dark"),
            GeomSpec("ellipsoid", (0.085, 0.075, 0.11), (0.045, 0.0, 0.66), color="shell"),
            GeomSpec("ellipsoid", (0.05, 0.062, 0.07), (0.088, 0.0, 0.67), color="visor"),
        ),
        "shoulder_pitch": (GeomSpec("sphere", (0.062, 0.0, 0.0), (0.0, 0.04 * y, -0.01), color=side),),
        "shoulder_roll": (capsule((0.0, 0.0, 0.0), (0.0, 0.0, -0.10), 0.048, "dark"),),
        "shoulder_yaw": (capsule((0.0, 0.0, -0.01), (0.008, 0.0, -0.18), 0.042, "shell"),),
        "elbow": (
            capsule((0.0, -0.02, 0.0), (0.0, 0.02, 0.0), 0.044, side),
            capsule((0.03, 0.0, 0.0), (0.22, 0.0, 0.0), 0.035, "shell"),
            GeomSpec("ellipsoid", (0.05, 0.03, 0.038), (0.28, 0.0, 0.0), color=side),
        ),
    }
    return shapes[part]


@lru_cache(maxsize=1)
def h1() -> RobotSpec:
    """The Unitree H1. At zero arm angles the upper arms hang and the forearms point forward."""
    sides = ("left", "right")
    return robot_from_facts(
        shipped_facts("h1"),
        name="h1",
        gains=_GAINS,
        torso_body="torso_link",
        arms=tuple(
            ArmSpec(s, tuple(f"{s}_{j}" for j in _ARM), f"{s}_elbow_link", (0.3, 0.0, 0.0), f"{s}_elbow_link")
            for s in sides
        ),
        feet=tuple(FootSpec(s, f"{s}_ankle_link", (0.05, 0.0, -0.07)) for s in sides),
        visuals=_visuals,
        nominal_height_m=1.0205,
        menagerie="unitree_h1",
        colors=COLORS,
    )
