"""Joints by their plain names."""

from __future__ import annotations

from cotap.robots import RobotSpec


def called(spec: RobotSpec, *names: str) -> list[str]:
    """The robot's own names of joints such as left_knee: some makers' end in `_joint`."""
    return [name if name in spec.joint_names else f"{name}_joint" for name in names]
