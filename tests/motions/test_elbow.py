"""The elbow of arms of any number of joints, against MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from cotap.motions.elbow import elbow_index
from cotap.motions.quality import forward_kinematics
from cotap.motions.refine import slow_down
from cotap.robots.mjcf import build_model


def test_elbows_and_hands_are_where_mujoco_has_them(any_spec):
    model = build_model(any_spec)
    data = mujoco.MjData(model)
    upper = [model.joint(name).qposadr[0] for name in any_spec.upper_joints]
    arms = np.random.default_rng(0).uniform(-0.5, 0.5, (20, len(upper)))
    _, elbow, hand, _ = forward_kinematics(any_spec, arms)
    for i, q in enumerate(arms):
        data.qpos[upper] = q
        mujoco.mj_kinematics(model, data)
        torso = data.body(any_spec.torso_body)
        for k, arm in enumerate(any_spec.arms):
            body = data.body(arm.hand_body)
            tip = body.xpos + body.xmat.reshape(3, 3) @ arm.hand_point
            points = np.stack((data.body(arm.elbow_body).xpos, tip)) - torso.xpos
            expected = points @ torso.xmat.reshape(3, 3)
            np.testing.assert_allclose(np.stack((elbow[i, k], hand[i, k])), expected, atol=1e-5)


def test_the_elbow_joint_moves_the_elbow_body(any_spec):
    for arm in any_spec.arms:
        assert arm.joints[elbow_index(any_spec, arm)] == any_spec.body(arm.elbow_body).joint
    with pytest.raises(ValueError, match="moves its elbow body"):
        elbow_index(any_spec, replace(any_spec.arms[0], elbow_body=any_spec.torso_body))


def test_fast_passages_are_slowed_within_limits(any_spec):
    joints = [any_spec.joints[i] for i in any_spec.indices(any_spec.upper_joints)]
    low, high = np.array([j.range_rad for j in joints]).T
    speed = np.array([j.velocity_limit_rad_s for j in joints])
    fast = 0.5 * (low + high) + np.sin(np.arange(30) / 50.0 * 2.0 * np.pi * 4.0)[:, None] * (high - low) * 0.4
    slow = slow_down(any_spec, fast)
    before, after = (np.abs(np.diff(q, axis=0)) * 50.0 / speed for q in (fast, slow))
    assert after.max() < 0.7 * before.max()
    assert (slow >= low - 1e-6).all()
    assert (slow <= high + 1e-6).all()
    held = np.tile(fast.mean(0), (len(fast), 1))
    went = forward_kinematics(any_spec, fast)[1:3]
    off = [
        np.linalg.norm(point - at, axis=-1).mean()
        for q in (slow, held)
        for point, at in zip(forward_kinematics(any_spec, q)[1:3], went, strict=True)
    ]
    assert max(off[:2]) < 0.5 * max(off[2:])  # of elbows and hands, against arms that hold still
