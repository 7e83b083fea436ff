"""Laws of the arms that the paper compares, as options of `cotap evaluate`, for any robot."""

from __future__ import annotations

from cotap.robots import ROBOTS

PD, SOFT = "PD", "soft PD"
NULL_STIFFNESS = "25"
"""The paper's k_null in its evaluation [Nm/rad]."""
SOFT_SHARE = 0.3
"""Gain of the paper's soft PD, kp 30, over that of its PD, kp 100."""
COMPLIANT = ("K 100", "K 500", "K 800", "alpha 0.3, K 100", "alpha 0.7, K 100")
"""Names of the rows under CoTaP."""
CALM = ["--force", "0", "0", "0"]
"""Of an impact: none."""


def cotap(x: float, y: float, z: float, alpha: float = 1.0) -> list[str]:
    """CoTaP at a stiffness of the hand along x, y and z [N/m]."""
    stiffness = ["--stiffness", *(f"{value:g}" for value in (x, y, z))]
    return ["--method", "cotap", *stiffness, "--null-stiffness", NULL_STIFFNESS, "--alpha", f"{alpha:g}"]


def arms(robot: str) -> dict[str, list[str]]:
    """Rows of the impact table."""
    soft = f"soft-pd:soft_gain={soft_gain(robot):g}"
    return {
        PD: ["--method", "pd"],
        SOFT: ["--left", soft, "--right", soft],
        "K 100": cotap(100, 100, 300),
        "K 500": cotap(500, 500, 300),
        "K 800": cotap(800, 800, 300),
        "alpha 0.3, K 100": cotap(100, 100, 300, 0.3),
        "alpha 0.7, K 100": cotap(100, 100, 300, 0.7),
        "alpha 0": ["--method", "cotap", "--alpha", "0"],
    }


def label(robot: str, name: str) -> str:
    """A row's name on the page, with the gains that are the robot's [Nm/rad]."""
    gains = sorted(_gains(robot))
    own = f"{gains[0]:g}" if gains[0] == gains[-1] else f"{gains[0]:g} to {gains[-1]:g}"
    longer = {
        PD: f"PD, kp {own}",
        SOFT: f"soft PD, kp {soft_gain(robot):g}",
        "alpha 0": "alpha 0 (PD's stiffness, gravity compensated)",
    }
    return longer.get(name, name)


def soft_gain(robot: str) -> float:
    """The position gain of all arm joints under soft PD: the paper's share of the largest that they have [Nm/rad]."""
    return SOFT_SHARE * max(_gains(robot))


def _gains(robot: str) -> list[float]:
    spec = ROBOTS[robot]()
    return [joint.kp for joint in spec.joints if joint.name in spec.upper_joints]
