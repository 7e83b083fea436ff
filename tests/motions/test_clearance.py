"""Bounds of arm joints against MuJoCo's own contacts after mj_forward."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from cotap.motions.clearance import STEP_RAD, clear_range, touching
from cotap.motions.generator import MotionConfig, MotionGenerator
from cotap.robots import ROBOTS
from cotap.robots.mjcf import build_model


def overlap(model: mujoco.MjModel, names: list[str], pose: np.ndarray, spec) -> float:
    """How deep shapes overlap [m] with the named joints at `pose` and all others in the default pose."""
    data = mujoco.MjData(model)
    data.qpos[2] = 10.0  # the ground is not a part of the robot
    for joint in spec.joints:
        data.joint(joint.name).qpos = joint.default_rad
    for name, angle in zip(names, pose, strict=True):
        data.joint(name).qpos = angle
    mujoco.mj_forward(model, data)
    return max((-contact.dist for contact in data.contact), default=0.0)


@pytest.fixture
def model(any_spec) -> mujoco.MjModel:
    return build_model(any_spec, "full", fixed_base=True)


def wide(spec) -> tuple[torch.Tensor, torch.Tensor]:
    """All of the joints' ranges (U,)."""
    low, high = torch.tensor([spec.joints[i].range_rad for i in spec.indices(spec.upper_joints)]).unbind(1)
    return low, high


def test_a_bound_that_came_in_is_where_the_arm_meets_the_body(any_spec, model):
    before, met = wide(any_spec), overlap(model, [], np.zeros(0), any_spec) + 0.002
    for side, after, sign in zip(before, clear_range(any_spec, *before), (-1.0, 1.0), strict=True):
        assert (sign * (side - after) >= 0.0).all()
        for name, old, new in zip(any_spec.upper_joints, side.tolist(), after.tolist(), strict=True):
            assert overlap(model, [name], np.array([new]), any_spec) <= met
            if abs(old - new) > STEP_RAD:
                assert overlap(model, [name], np.array([new + sign * 1.01 * STEP_RAD]), any_spec) > met


def test_where_the_robots_file_has_its_base_does_not_count(any_spec):
    first, *rest = any_spec.bodies
    low = dataclasses.replace(any_spec, bodies=(dataclasses.replace(first, pos=(0.0, 0.0, 0.0)), *rest))
    for bound, same in zip(clear_range(any_spec, *wide(any_spec)), clear_range(low, *wide(any_spec)), strict=True):
        assert torch.equal(bound, same)


def test_few_random_poses_of_arms_are_inside_the_body(any_spec, model):
    """Of G1's 71 % were, with the joints' own limits."""
    motion = MotionGenerator(MotionConfig(), any_spec, 400, 0.02)
    rng = torch.Generator().manual_seed(0)
    motion.reset(torch.ones(400, dtype=torch.bool), rng)
    met = overlap(model, [], np.zeros(0), any_spec) + 0.002
    inside = [
        overlap(model, list(any_spec.upper_joints), pose, any_spec) > met
        for _ in range(5)
        for pose in (motion._draw(torch.ones(400, dtype=torch.bool), rng), motion._goal)[1].numpy()
    ]
    assert np.mean(inside) < 0.12


def test_left_and_right_have_mirrored_bounds():
    for spec in (make() for make in ROBOTS.values()):
        low, high = clear_range(spec, *wide(spec))
        of = dict(zip(spec.upper_joints, zip(low.tolist(), high.tolist(), strict=True), strict=True))
        for name, bounds in of.items():
            joint = spec.joints[spec.indices([name])[0]]
            mirrored = sorted(joint.mirror_sign * bound for bound in of[joint.mirror_name])
            assert bounds == pytest.approx(mirrored, abs=STEP_RAD / 2)


def test_no_bound_moves_where_shapes_meet_in_the_default_pose_only(any_spec):
    """What touches already cannot be kept apart: bounds that are the default pose itself stay."""
    default = torch.tensor([any_spec.joints[i].default_rad for i in any_spec.indices(any_spec.upper_joints)])
    for side in clear_range(any_spec, default, default):
        torch.testing.assert_close(side, default)


def test_an_arm_that_touches_the_body_is_told_from_one_that_is_free(any_spec, model):
    """As MuJoCo's contacts after mj_forward have it, body by body; the other arm's contacts are its own."""
    low, high = wide(any_spec)
    poses = low + (high - low) * torch.rand(40, len(low), generator=torch.Generator().manual_seed(0))
    data, address = mujoco.MjData(model), [model.joint(name).qposadr[0] for name in any_spec.upper_joints]
    moved_by = {body.name: body.joint for body in any_spec.bodies}
    qpos = np.tile(data.qpos, (40, 1))
    qpos[:, address] = poses.numpy()
    expected = np.zeros((len(any_spec.arms), 40), dtype=bool)
    for i, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        for contact in data.contact:
            joints = [moved_by.get(model.body(model.geom_bodyid[geom]).name) for geom in contact.geom]
            for side, arm in enumerate(any_spec.arms):
                expected[side, i] |= contact.dist < 0.0 and (joints[0] in arm.joints) != (joints[1] in arm.joints)
    assert 0.1 < expected.mean() < 0.9
    for side, touched in enumerate(expected):
        assert touching(model, any_spec, side, torch.from_numpy(qpos)).tolist() == touched.tolist()
    assert not touching(build_model(any_spec, "feet"), any_spec, 0, torch.from_numpy(qpos)).any()
    qpos[:, address] = [any_spec.joints[i].default_rad for i in any_spec.indices(any_spec.upper_joints)]
    assert not touching(model, any_spec, 0, torch.from_numpy(qpos[:1])).any()
