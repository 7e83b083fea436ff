"""Descriptions that contradict themselves are refused, by the name of what is wrong."""

from __future__ import annotations

import dataclasses

import pytest
from robots.joints import called


def changed(spec, name, **fields):
    """The robot with fields of one joint changed."""
    joints = tuple(dataclasses.replace(j, **fields) if j.name == name else j for j in spec.joints)
    return dataclasses.replace(spec, joints=joints)


def test_joints_must_be_ordered_lower_body_first(spec):
    with pytest.raises(ValueError, match="lower body first"):
        dataclasses.replace(spec, joints=spec.joints[::-1])


def test_joints_must_follow_the_bodies(any_spec):
    first, second, *rest = any_spec.joints
    names = f"joint '{second.name}' is out of order, '{first.name}' is next"
    with pytest.raises(ValueError, match=names):
        dataclasses.replace(any_spec, joints=(second, first, *rest))
    with pytest.raises(ValueError, match=f"joint '{rest[0].name}' is out of order, '{second.name}' is next"):
        dataclasses.replace(any_spec, joints=(first, *rest))
    last = any_spec.bodies[-1]
    with pytest.raises(ValueError, match=f"joint '{last.joint}' is out of order, None is next"):
        dataclasses.replace(any_spec, bodies=any_spec.bodies[:-1])


def test_bodies_may_be_listed_by_depth(any_spec):
    """Only the order among siblings counts, as for MuJoCo."""
    depth = {b.name: len(any_spec.chain(b.name, any_spec.base_body)) for b in any_spec.bodies}
    by_depth = tuple(sorted(any_spec.bodies, key=lambda b: depth[b.name]))
    assert by_depth != any_spec.bodies
    dataclasses.replace(any_spec, bodies=by_depth)
    turned = tuple(sorted(any_spec.bodies, key=lambda b: (depth[b.name], -any_spec.bodies.index(b))))
    with pytest.raises(ValueError, match="depth first"):
        dataclasses.replace(any_spec, bodies=turned)


def test_mirrors_must_be_mutual(any_spec):
    first, second = any_spec.joints[:2]
    with pytest.raises(ValueError, match=f"mirror of {first.name} is unknown: 'nobody'"):
        changed(any_spec, first.name, mirror_name="nobody")
    for fields in ({"mirror_name": second.name}, {"mirror_sign": -first.mirror_sign}):
        with pytest.raises(ValueError, match=f"{first.name} and .* are not each other's mirror"):
            changed(any_spec, first.name, **fields)


def test_a_mirror_sign_is_a_sign(any_spec):
    with pytest.raises(ValueError, match=r"must be 1 or -1, got 0.5"):
        changed(any_spec, any_spec.joints[0].name, mirror_sign=0.5)


def test_the_default_pose_is_its_own_mirror_image(any_spec):
    first = any_spec.joints[0]
    message = rf"must be its own mirror image; {first.name} has 0\.3 rad and {first.mirror_name} \S+ rad"
    with pytest.raises(ValueError, match=message):
        changed(any_spec, first.name, default_rad=0.3)
    middle = next(j for j in any_spec.joints if j.mirror_name == j.name and j.mirror_sign < 0)
    with pytest.raises(ValueError, match=f"{middle.name} has 0.1 rad .* sign -1"):
        changed(any_spec, middle.name, default_rad=0.1)


def test_base_and_torso_are_two_bodies(any_spec):
    with pytest.raises(ValueError, match="base and torso must be two bodies"):
        dataclasses.replace(any_spec, torso_body=any_spec.base_body)


def test_left_comes_before_right(any_spec):
    for fields in ({"feet": any_spec.feet[::-1]}, {"feet": any_spec.feet[:1]}, {"arms": any_spec.arms[::-1]}):
        with pytest.raises(ValueError, match=r"(feet|arms) must be 'left' and 'right', in this order, got \('"):
            dataclasses.replace(any_spec, **fields)
    exchanged = zip(any_spec.feet, reversed(any_spec.feet), strict=True)
    feet = tuple(dataclasses.replace(other, side=foot.side) for foot, other in exchanged)
    with pytest.raises(ValueError, match="the left foot must come first, got 'left'"):
        dataclasses.replace(any_spec, feet=feet)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("velocity_limit_rad_s", 0.0, r"velocity_limit_rad_s must lie in \[1e-06, .*got 0"),
        ("velocity_limit_rad_s", float("nan"), "velocity_limit_rad_s must .*nan"),
        ("velocity_limit_rad_s", "12", "velocity_limit_rad_s must .*'12'"),
        ("torque_limit_nm", -5.0, "torque_limit_nm must lie in .*got -5"),
        ("kp", -1.0, "kp must lie in .*got -1"),
        ("kd", float("nan"), "kd must .*nan"),
        ("range_rad", (1.0, -1.0), "range_rad must begin below its end, got"),
        ("range_rad", (2.0, 3.0), r"default_rad must lie in \[2.0, 3.0\]"),
    ],
)
def test_numbers_of_a_joint_are_in_their_range(any_spec, field, value, message):
    name = any_spec.joints[0].name
    with pytest.raises(ValueError, match=f"joint '{name}': {message}"):
        changed(any_spec, name, **{field: value})


def test_an_arms_joints_lead_to_its_own_hand(any_spec):
    left, right = any_spec.arms
    crossed = dataclasses.replace(left, hand_body=right.hand_body, elbow_body=right.elbow_body)
    with pytest.raises(ValueError, match="the left arm's joints must be those from the torso to its hand"):
        dataclasses.replace(any_spec, arms=(crossed, right))


def test_joints_that_pitch(any_spec):
    """By their axis in the base's frame, whatever their mirror sign says."""
    pitching = {j.name for j in any_spec.joints if any_spec.pitches(j.name)}
    legs = [f"{side}_{part}" for side in ("left", "right") for part in ("hip_pitch", "knee")]
    assert set(called(any_spec, *legs)) <= pitching
    assert not any(part in name for name in pitching for part in ("hip_yaw", "hip_roll"))


def test_arms_must_be_equally_long(any_spec):
    left, right = any_spec.arms
    count = len(right.joints)
    short = dataclasses.replace(left, joints=left.joints[1:])  # its first joint then counts as the waist's
    with pytest.raises(ValueError, match=f"equally many joints, got {{'left': {count - 1}, 'right': {count}}}"):
        dataclasses.replace(any_spec, arms=(short, right))


def test_bodies_must_exist(any_spec):
    arm, foot = any_spec.arms[0], any_spec.feet[0]
    wrong = (
        {"torso_body": "nothing"},
        {"arms": (dataclasses.replace(arm, hand_body="nothing"), any_spec.arms[1])},
        {"feet": (dataclasses.replace(foot, body="nothing"), any_spec.feet[1])},
        {"contact_excludes": (("nothing", foot.body),)},
    )
    for fields in wrong:
        with pytest.raises(ValueError, match=f"{any_spec.name} has no body 'nothing'"):
            dataclasses.replace(any_spec, **fields)
