"""From human arms to robot arms, in closed form.

A human arm is its upper arm's rotation relative to the chest and its elbow's flexion. In the torso frame used here x
points forward, y to the left, z up; with the identity rotation the upper arm hangs down, and flexion lifts the forearm
forward. A robot arm whose shoulder is pitch, roll, yaw and whose elbow bends about the same axis as the pitch follows
both exactly, up to its joint limits. A wrist rests at its zero, as nearly as its limits let it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from cotap.motions.elbow import elbow_index
from cotap.robots import ArmSpec, BodySpec, RobotSpec

_TURNED_RAD = 0.05
_ALONG = 0.95
"""Cosine of a third of a radian."""


@dataclass(frozen=True)
class HumanMotion:
    """A human's arms and root over time, in a z-up world; times start at 0 and grow."""

    name: str
    times_s: np.ndarray
    """(T,) [s]."""
    upper_arms: dict[str, np.ndarray]
    """Per side, (T, 3, 3): the upper arm's rotation in the chest frame."""
    flexions: dict[str, np.ndarray]
    """Per side, (T,) elbow flexion, 0 for a straight arm [rad]."""
    root: np.ndarray
    """(T, 3) x, y [m] and heading [rad]."""


@dataclass(frozen=True)
class ArmFrames:
    """What the closed form needs of one robot arm."""

    tilt: float
    """Rotation of the shoulder's pitch axis about x [rad]."""
    low: np.ndarray
    high: np.ndarray
    """Limits of all joints of the arm [rad]."""


def arm_frames(spec: RobotSpec, arm: ArmSpec) -> ArmFrames:
    """Read an arm's shoulder from the robot. Raises ValueError for an arm of another kind."""
    chain = spec.chain(arm.hand_body, spec.torso_body)
    joints = [spec.joints[i] for i in spec.indices(arm.joints)]
    axes = [j.axis for j in joints[:4]]
    if elbow_index(spec, arm) != 3 or axes != [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)]:
        raise ValueError(
            f"{spec.name}: {arm.side} arm does not begin with shoulder pitch, roll, yaw and elbow; its axes are {axes}"
        )
    _require_bent_at_zero(spec, arm, chain)
    tilt = 2.0 * np.arctan2(chain[0].quat[1], chain[0].quat[0])
    rest = Rotation.from_quat(chain[0].quat, scalar_first=True) * Rotation.from_euler("X", -tilt)
    if np.abs(rest.as_rotvec()[[0, 2]]).max() > _TURNED_RAD:  # a turn about y is one of the pitch joint
        raise ValueError(f"{spec.name}: the {arm.side} shoulder must be tilted about x alone, got quat {chain[0].quat}")
    low, high = np.array([j.range_rad for j in joints]).T
    return ArmFrames(float(tilt), low, high)


def _require_bent_at_zero(spec: RobotSpec, arm: ArmSpec, chain: tuple[BodySpec, ...]) -> None:
    """Raise ValueError unless, at zero angles, the upper arm hangs down and the forearm points forward, with links from
    the shoulder's roll to the elbow that are not turned against the torso: what the closed form takes for granted."""
    turn, origin, origins = Rotation.identity(), np.zeros(3), []
    straight = True
    for number, body in enumerate(chain):
        origin, turn = origin + turn.apply(body.pos), turn * Rotation.from_quat(body.quat, scalar_first=True)
        origins.append(origin)
        straight = straight and (not 1 <= number <= 3 or turn.magnitude() < _TURNED_RAD)
    upper, fore = origins[3] - origins[1], origin + turn.apply(arm.hand_point) - origins[3]
    bent = -upper[2] > _ALONG * np.linalg.norm(upper) and fore[0] > _ALONG * np.linalg.norm(fore)
    if not (straight and bent):
        raise ValueError(
            f"{spec.name}: at zero angles the {arm.side} upper arm must point down and the forearm forward, with links "
            f"that are not turned; they point along {np.round(upper, 2).tolist()} and {np.round(fore, 2).tolist()}"
        )


def elbow_angle(flexion: np.ndarray) -> np.ndarray:
    """The robot's elbow angle: its forearm points forward at zero, so that a straight arm is a quarter turn."""
    return 0.5 * np.pi - flexion


def _about_x(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def shoulder_angles(frames: ArmFrames, rotation: np.ndarray) -> np.ndarray:
    """Both solutions (2, T, 3) of pitch, roll and yaw for upper arm rotations (T, 3, 3), wrapped towards the limits.

    The arm is Rx(tilt) Ry(pitch) Rx(roll - tilt) Rz(yaw). Where the upper arm lies along the pitch axis only the sum of
    pitch and yaw is defined; what is returned there is one of many solutions.
    """
    m = _about_x(-frames.tilt) @ rotation
    roll = np.arcsin(np.clip(-m[:, 1, 2], -1.0, 1.0))
    pitch, yaw = np.arctan2(m[:, 0, 2], m[:, 2, 2]), np.arctan2(m[:, 1, 0], m[:, 1, 1])
    first = np.stack((pitch, roll + frames.tilt, yaw), 1)
    second = np.stack((pitch + np.pi, np.pi - roll + frames.tilt, yaw + np.pi), 1)
    middle = 0.5 * (frames.low + frames.high)[:3]
    return (np.stack((first, second)) - middle + np.pi) % (2.0 * np.pi) - np.pi + middle


def choose_branch(frames: ArmFrames, solutions: np.ndarray) -> np.ndarray:
    """The path (T, 3) through `solutions` (2, T, 3) that least exceeds limits and moves least (dynamic programming)."""
    excess = np.maximum(frames.low[:3] - solutions, solutions - frames.high[:3]).clip(0.0).sum(2)
    step = solutions[None, :, 1:] - solutions[:, None, :-1]  # (from, to, T - 1, 3)
    move = np.square(np.linalg.norm(step, axis=-1))
    cost = 100.0 * excess[:, 0]
    came_from = np.zeros((2, solutions.shape[1]), dtype=np.int64)
    for t in range(1, solutions.shape[1]):
        # move[a, b] is from solution a's frame t - 1 to solution b's frame t.
        total = cost[:, None] + move[:, :, t - 1]
        came_from[:, t] = total.argmin(0)
        cost = total.min(0) + 100.0 * excess[:, t]
    branch = int(cost.argmin())
    path = np.empty(solutions.shape[1], dtype=np.int64)
    for t in range(solutions.shape[1] - 1, -1, -1):
        path[t] = branch
        branch = int(came_from[branch, t])
    return np.take_along_axis(solutions, path[None, :, None], 0)[0]


def retarget(spec: RobotSpec, motion: HumanMotion) -> np.ndarray:
    """Arm joints (T, U) at the motion's own times, not yet limited [rad]."""
    arms: list[np.ndarray] = []
    for arm in spec.arms:
        frames = arm_frames(spec, arm)
        shoulder = choose_branch(frames, shoulder_angles(frames, motion.upper_arms[arm.side]))
        wrist = np.clip(np.zeros((len(shoulder), 1)), frames.low[4:], frames.high[4:])
        arms.append(np.column_stack((shoulder, elbow_angle(motion.flexions[arm.side]), wrist)))
    return np.concatenate(arms, 1)


def arm_direction(rotation: np.ndarray, flexion: np.ndarray, forearm_ratio: float) -> np.ndarray:
    """Unit vector (T, 3) from shoulder to hand of an arm whose forearm is `forearm_ratio` times its upper arm."""
    zero = np.zeros_like(flexion)
    local = np.stack((np.sin(flexion), zero, -np.cos(flexion)), 1) * forearm_ratio - [0.0, 0.0, 1.0]
    hand = np.einsum("tij,tj->ti", rotation, local)
    return hand / np.linalg.norm(hand, axis=1, keepdims=True)
