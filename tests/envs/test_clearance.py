"""Hands stay out of the legs: against MuJoCo's forward kinematics and its collisions."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from cotap.envs.clearance import LegClearance
from cotap.envs.reference import ClipConfig, ReferenceConfig, ReferenceMotion
from cotap.robots.mjcf import build_model


@pytest.fixture(scope="module")
def full(spec):
    return build_model(spec, "full")


def posed(spec, model, q) -> mujoco.MjData:
    data = mujoco.MjData(model)
    for joint, angle in zip(spec.upper_joints, q.tolist(), strict=True):
        data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return data


def hands_t(spec, model, q):
    """Hand points in the torso's frame, by MuJoCo."""
    data = posed(spec, model, q)
    torso = model.body(spec.torso_body).id
    frame, origin = data.xmat[torso].reshape(3, 3), data.xpos[torso]
    hands = []
    for arm in spec.arms:
        body = model.body(arm.hand_body).id
        hands.append(frame.T @ (data.xpos[body] + data.xmat[body].reshape(3, 3) @ arm.hand_point - origin))
    return torch.tensor(np.array(hands))


def arms_meet_legs(spec, model, q) -> bool:
    data = posed(spec, model, q)
    names = [model.body(model.geom_bodyid[g]).name for c in data.contact[: data.ncon] for g in (c.geom1, c.geom2)]
    pairs = zip(names[::2], names[1::2], strict=True)
    return any(("elbow" in a and "hip" in b) or ("hip" in a and "elbow" in b) for a, b in pairs)


def random_poses(spec, rng, n):
    joints = [spec.joints[i] for i in spec.indices(spec.upper_joints)]
    low, high = torch.tensor([j.range_rad for j in joints]).unbind(1)
    default = torch.tensor([j.default_rad for j in joints])
    low, high = torch.maximum(low, default - 1.2), torch.minimum(high, default + 1.2)
    return low + (high - low) * torch.rand(n, len(joints), generator=rng)


def test_low_hands_end_up_beside_the_legs_and_others_stay_where_they_were(spec, full, rng):
    poses = random_poses(spec, rng, 800)
    cleared = LegClearance(spec)(poses)
    low = high = 0
    for before, after in zip(poses, cleared, strict=True):
        old, new = hands_t(spec, full, before), hands_t(spec, full, after)
        for arm, sign in enumerate((1.0, -1.0)):
            own = slice(4 * arm, 4 * arm + 4)
            if old[arm, 2] > spec.legs_below_m or sign * old[arm, 1] > spec.legs_within_m:
                assert torch.equal(before[own], after[own])
                high += 1
            elif old[arm, 2] < spec.legs_below_m - 0.08:
                assert sign * new[arm, 1] > spec.legs_within_m - 0.03
                low += 1
    assert low > 20
    assert high > 800


def test_nothing_that_is_cleared_meets_standing_legs(spec, full, rng):
    poses = random_poses(spec, rng, 1500)
    before = sum(arms_meet_legs(spec, full, q) for q in poses)
    after = sum(arms_meet_legs(spec, full, q) for q in LegClearance(spec)(poses))
    assert before > 20
    assert after == 0


def test_the_default_pose_is_clear(spec):
    default = torch.tensor([[spec.joints[i].default_rad for i in spec.indices(spec.upper_joints)]])
    assert torch.equal(LegClearance(spec)(default), default)


def test_both_arms_are_treated_alike(spec, rng):
    poses = random_poses(spec, rng, 200)
    mirror = torch.tensor([1.0, -1.0, -1.0, 1.0])
    mirrored = torch.cat((poses[:, 4:] * mirror, poses[:, :4] * mirror), 1)
    cleared = LegClearance(spec)(poses)
    expected = torch.cat((cleared[:, 4:] * mirror, cleared[:, :4] * mirror), 1)
    torch.testing.assert_close(LegClearance(spec)(mirrored), expected, atol=1e-5, rtol=0)


def test_references_keep_clear_unless_told_not_to(spec, full):
    met = {}
    for clear in (True, False):
        cfg = ReferenceConfig(clips=ClipConfig(share=0.2, hold_s=(0.5, 2.0)), clear_of_legs=clear)
        motion, rng = ReferenceMotion(cfg, spec, 128, 0.02), torch.Generator().manual_seed(0)
        motion.reset(torch.ones(128, dtype=torch.bool), rng)
        met[clear] = 0
        for step in range(400):
            motion.step(rng)
            if step % 20 == 0:
                met[clear] += sum(arms_meet_legs(spec, full, q) for q in motion.current().position)
    assert met[False] > 15
    assert met[True] * 10 <= met[False]  # two Newton steps leave one in hundreds


def test_a_restarted_world_begins_where_its_reference_is_clear(spec):
    n, position = 400, {}
    mask = torch.arange(n) % 2 == 1
    for clear in (True, False):
        motion = ReferenceMotion(ReferenceConfig(clear_of_legs=clear), spec, n, 0.02)
        before = motion.current().position.clone()
        motion.reset(mask, torch.Generator().manual_seed(0))
        position[clear] = motion.current().position
        assert torch.equal(position[clear][~mask], before[~mask])
    joints = [spec.joints[i] for i in spec.indices(spec.upper_joints)]
    low, high = torch.tensor([j.range_rad for j in joints]).unbind(1)
    margin = ReferenceConfig().generator.limit_margin_rad
    expected = LegClearance(spec)(position[False][mask]).clamp(low + margin, high - margin)
    torch.testing.assert_close(position[True][mask], expected, atol=1e-6, rtol=0)
    assert float((expected - position[False][mask]).abs().max()) > 0.1
