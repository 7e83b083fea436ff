"""The closed form of the arm, against the robot's own forward kinematics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cotap.motions.processing import JointMotion, make_clip
from cotap.motions.quality import assess, forward_kinematics
from cotap.motions.retarget import (
    ArmFrames,
    HumanMotion,
    arm_direction,
    arm_frames,
    choose_branch,
    elbow_angle,
    retarget,
    shoulder_angles,
)
from cotap.robots import ROBOTS

T = 200
SIDES = ("left", "right")


def wave(seed: int, low, high, steps: int = T) -> np.ndarray:
    """Smooth random joint angles (steps, n) inside limits."""
    rng = np.random.default_rng(seed)
    low, high = np.asarray(low), np.asarray(high)
    phase = rng.uniform(0, 2 * np.pi, (1, len(low)))
    t = np.linspace(0.0, 4.0, steps)[:, None]
    return (low + high) / 2 + (high - low) / 2 * np.sin(rng.uniform(0.5, 1.5, (1, len(low))) * t + phase)


def upper_arm_rotation(frames: ArmFrames, q: np.ndarray) -> np.ndarray:
    """(T, 3, 3) upper arm in the chest frame for shoulder angles `q` (T, >= 3): Rx(tilt) Ry Rx(roll - tilt) Rz."""
    turns = Rotation.from_euler("YXZ", q[:, :3] - [0.0, frames.tilt, 0.0])  # each about the axis that was turned
    return (Rotation.from_euler("X", frames.tilt) * turns).as_matrix()


@pytest.mark.parametrize("index", [0, 1])
def test_shoulder_angles_invert_the_rotation(spec, index):
    frames = arm_frames(spec, spec.arms[index])
    sign = 1.0 if index == 0 else -1.0
    q = wave(index, [-2.0, -0.2, -1.0], [2.0, 1.7, 1.5]) * [1.0, sign, sign]
    solutions = shoulder_angles(frames, upper_arm_rotation(frames, q))
    for branch in solutions:  # both give the same rotation
        np.testing.assert_allclose(
            upper_arm_rotation(frames, branch), upper_arm_rotation(frames, q), atol=1e-12, rtol=0
        )
    np.testing.assert_allclose(choose_branch(frames, solutions), q, atol=1e-9)


@pytest.mark.parametrize("index", [0, 1])
def test_the_rotation_is_the_robots(spec, index):
    """Elbow position by MuJoCo-tested chains: shoulder plus the rotated upper arm."""
    frames = arm_frames(spec, spec.arms[index])
    sign = 1.0 if index == 0 else -1.0
    q = wave(3, [-1.5, -0.2, -1.0], [1.5, 1.7, 1.5]) * [1.0, sign, sign]
    joints = np.zeros((T, 8))
    joints[:, 4 * index : 4 * index + 3] = q
    shoulder, elbow, hand, _ = forward_kinematics(spec, joints)
    rotation = upper_arm_rotation(frames, q)
    np.testing.assert_allclose(
        elbow[:, index], shoulder[:, index] + rotation @ np.array([0.0185, 0.0, -0.1343 - 0.198]), atol=1e-5
    )
    # With the elbow at zero the forearm points along the upper arm's x axis.
    np.testing.assert_allclose(hand[:, index] - elbow[:, index], 0.3 * rotation[:, :, 0], atol=1e-5)


@pytest.mark.parametrize("name", sorted(ROBOTS))
@pytest.mark.parametrize("index", [0, 1])
def test_upper_arm_and_forearm_are_rigid_in_the_frames_that_a_human_gives(name, index):
    spec = ROBOTS[name]()
    arm = spec.arms[index]
    frames, count = arm_frames(spec, arm), len(arm.joints)
    sign = 1.0 if index == 0 else -1.0
    shoulders = wave(4, [-1.5, -0.2, -1.0], [1.5, 1.2, 1.2]) * [1.0, sign, sign]
    rotation, flexion = upper_arm_rotation(frames, shoulders), wave(9, [0.2], [1.8])[:, 0]
    rotations = {a.side: rotation for a in spec.arms}
    motion = HumanMotion("made", np.arange(T) / 50.0, rotations, dict.fromkeys(SIDES, flexion), np.zeros((T, 3)))
    joints = retarget(spec, motion)
    np.testing.assert_array_equal(joints.reshape(T, 2, count)[:, :, 4:], 0.0)  # wrists rest
    shoulder, elbow, hand, _ = forward_kinematics(spec, joints)
    upper = np.einsum("tji,tj->ti", rotation, elbow[:, index] - shoulder[:, index])
    np.testing.assert_allclose(upper, upper[:1].repeat(T, 0), atol=0.0125)  # G1's elbow is 6 mm off the yaw's axis
    assert upper[0, 2] < -0.15  # an arm hangs
    c, s, zero, one = np.cos(flexion), np.sin(flexion), np.zeros(T), np.ones(T)
    bend = np.stack((np.stack((c, zero, -s), 1), np.stack((zero, one, zero), 1), np.stack((s, zero, c), 1)), 1)
    forearm = np.einsum("tji,tj->ti", rotation @ bend, hand[:, index] - elbow[:, index])
    np.testing.assert_allclose(forearm, forearm[:1].repeat(T, 0), atol=1e-4)  # G1's frames are rounded
    assert forearm[0, 2] < -0.15  # and goes on downwards where the elbow is straight


def test_elbow_flexion_lifts_the_forearm_forward():
    assert elbow_angle(np.array([0.0, np.pi / 2])).tolist() == pytest.approx([np.pi / 2, 0.0])
    direction = arm_direction(np.eye(3)[None].repeat(2, 0), np.array([0.0, np.pi / 2]), 1.0)
    np.testing.assert_allclose(direction, [[0.0, 0.0, -1.0], [np.sqrt(0.5), 0.0, -np.sqrt(0.5)]], atol=1e-12)


def human(spec, joints: np.ndarray) -> HumanMotion:
    """A human whose arms move exactly as these robot joints."""
    rotations = {a.side: upper_arm_rotation(arm_frames(spec, a), joints[:, 4 * i :]) for i, a in enumerate(spec.arms)}
    flexions = {side: np.pi / 2 - joints[:, 4 * i + 3] for i, side in enumerate(SIDES)}
    return HumanMotion("made", np.arange(len(joints)) / 50.0, rotations, flexions, np.zeros((len(joints), 3)))


def test_retargeting_returns_the_joints_it_was_made_from(spec):
    joints = np.concatenate(
        (wave(5, [-1.5, -0.2, -1.0, -1.0], [1.5, 1.6, 1.5, 1.4]),
         wave(6, [-1.5, -1.6, -1.5, -1.0], [1.5, 0.2, 1.0, 1.4])), 1
    )  # fmt: skip
    np.testing.assert_allclose(retarget(spec, human(spec, joints)), joints, atol=1e-9)


@pytest.mark.parametrize(("aside_deg", "direction_deg"), [(0.0, 2.0), (30.0, 30.0)])
def test_quality_is_measured_against_the_human(spec, aside_deg, direction_deg):
    """Joints that are exactly the human's; and the same beside a human who holds all of the arm aside."""
    joints = np.concatenate((wave(5, [0.2, 0.0, -0.1, -0.8], [0.6, 0.1, 0.1, 0.8]),
                             wave(6, [0.2, -0.1, -0.1, -0.8], [0.6, 0.0, 0.1, 0.8])), 1)  # fmt: skip
    them = human(spec, joints)
    turn = Rotation.from_euler("Y", aside_deg, degrees=True).as_matrix()
    turned = {side: turn @ upper for side, upper in them.upper_arms.items()}
    motion = JointMotion("made", them.times_s, joints, them.root, human=replace(them, upper_arms=turned))
    clip, report = make_clip(spec, motion, "made", "none")
    quality = assess(spec, motion, clip, report)
    assert quality.hand_direction_error_deg == pytest.approx(direction_deg, abs=2.0)
    assert quality.elbow_correlation > 0.99
    reach = 2.0 * np.sin(np.radians(0.5 * aside_deg)) * 0.5
    assert quality.hand_path_error_m == pytest.approx(reach, abs=0.06)


@pytest.mark.parametrize(("elbow", "share"), [(0.5 * np.pi, 1.0), (0.0, 0.0)])
def test_straight_arms_are_near_a_singularity(spec, elbow, share):
    joints = np.tile([0.3, 0.2, 0.0, elbow, 0.3, -0.2, 0.0, elbow], (50, 1))
    motion = JointMotion("made", np.arange(50) / 50.0, joints, np.zeros((50, 3)))
    assert assess(spec, motion, *make_clip(spec, motion, "made", "none")).singular_fraction == share


def test_branches_avoid_limits_and_jumps(spec):
    frames = arm_frames(spec, spec.arms[0])
    solutions = np.zeros((2, 5, 3))
    solutions[1] = 0.5
    solutions[0, 2, 1] = -1.0  # beyond the roll's limit of -0.34: the other branch, from there or all along
    path = choose_branch(frames, solutions)
    assert np.allclose(path, 0.5)
    solutions[0, 2, 1] = 0.0
    solutions[1, 2, 2] = 9.0
    assert np.allclose(choose_branch(frames, solutions), 0.0)


def test_an_arm_of_another_kind_is_refused(spec):
    joints = tuple(replace(j, axis=(0.0, 0.0, 1.0)) if j.name == "left_elbow" else j for j in spec.joints)
    with pytest.raises(ValueError, match="left arm does not begin with shoulder pitch, roll, yaw and elbow"):
        arm_frames(replace(spec, joints=joints), spec.arms[0])


def test_an_arm_that_is_straight_at_zero_is_refused(spec):
    """Its forearm would be sent up or back, a quarter turn from where it should be."""
    turned = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
    bodies = tuple(replace(b, quat=turned) if b.joint == "left_elbow" else b for b in spec.bodies)
    with pytest.raises(ValueError, match=r"the left upper arm must point down and the forearm forward, .*turned"):
        arm_frames(replace(spec, bodies=bodies), spec.arms[0])


@pytest.mark.parametrize(("axis", "refused"), [("X", False), ("Y", False), ("Z", True)])
def test_a_shoulder_may_be_tilted_and_no_more(spec, axis, refused):
    """Turned by half a radian, and back at the next link, so that the upper arm hangs as before."""
    turn = Rotation.from_euler(axis, 0.5)

    def turned(body):
        own = Rotation.from_quat(body.quat, scalar_first=True)
        if body.joint == "left_shoulder_pitch":
            own = turn * own
        elif body.joint == "left_shoulder_roll":
            own = before.inv() * turn.inv() * before * own
        return replace(body, quat=tuple(own.as_quat(scalar_first=True)))

    (first,) = [b for b in spec.bodies if b.joint == "left_shoulder_pitch"]
    before = Rotation.from_quat(first.quat, scalar_first=True)
    other = replace(spec, bodies=tuple(turned(b) for b in spec.bodies))
    if refused:
        with pytest.raises(ValueError, match="the left shoulder must be tilted about x alone"):
            arm_frames(other, spec.arms[0])
    else:
        arm_frames(other, spec.arms[0])
