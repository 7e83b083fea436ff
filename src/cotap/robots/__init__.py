"""Robots by name. A new robot is a file of facts, one file that builds a RobotSpec of them, and one line here."""

from __future__ import annotations

from collections.abc import Callable

from cotap.robots.g1 import g1
from cotap.robots.h1 import h1
from cotap.robots.spec import ArmSpec, BodySpec, FootSpec, GeomSpec, JointSpec, RobotSpec

ROBOTS: dict[str, Callable[[], RobotSpec]] = {"h1": h1, "g1": g1}

__all__ = ["ROBOTS", "ArmSpec", "BodySpec", "FootSpec", "GeomSpec", "JointSpec", "RobotSpec", "g1", "h1"]
