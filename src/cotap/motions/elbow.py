"""Which joint of an arm is its elbow; those after it are its wrist."""

from __future__ import annotations

from cotap.robots import ArmSpec, RobotSpec


def elbow_index(spec: RobotSpec, arm: ArmSpec) -> int:
    """Position among `arm.joints` of the joint that moves `arm.elbow_body`. Raises ValueError if none of them does."""
    joint = spec.body(arm.elbow_body).joint
    if joint not in arm.joints:
        raise ValueError(f"{spec.name}: no joint of the {arm.side} arm moves its elbow body {arm.elbow_body!r}")
    return arm.joints.index(joint)


def wrist_joints(spec: RobotSpec) -> tuple[str, ...]:
    """The joints after the elbows, of both arms."""
    return tuple(name for arm in spec.arms for name in arm.joints[elbow_index(spec, arm) + 1 :])
