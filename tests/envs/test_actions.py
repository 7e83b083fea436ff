"""From actions to joint targets."""

from __future__ import annotations

import pytest
import torch
from env_tools import drive, newest, zeros

from cotap.envs.actions import ActionConfig, JointTargets


@pytest.mark.parametrize("mode", ["residual", "absolute"])
def test_targets_are_an_offset_plus_scaled_actions(any_spec, rng, mode):
    lower, joints = len(any_spec.lower_joints), len(any_spec.joints)
    targets = JointTargets(ActionConfig(0.3, upper_scale=0.2, upper_mode=mode), any_spec)
    action = torch.randn(3, joints, generator=rng)
    reference = torch.randn(3, joints - lower, generator=rng)
    for i, joint in enumerate(any_spec.joints):
        scale, offset = 0.3 if i < lower else 0.2, joint.default_rad
        if i < lower and joint.kp > joint.torque_limit_nm:  # saturated before a radian
            scale *= joint.torque_limit_nm / joint.kp
        if i >= lower and mode == "residual":
            offset = reference[:, i - lower]
        torch.testing.assert_close(targets(action, reference)[:, i], offset + scale * action[:, i])


def test_targets_by_hand_for_the_h1(spec):
    action = torch.zeros(2, 19)
    action[0, 3], action[0, 10], action[0, 11], action[1, 18] = 2.0, 4.0, -3.0, 1.0
    reference = torch.linspace(0.1, 0.8, 8).repeat(2, 1)
    target = JointTargets(ActionConfig(), spec)(action, reference)
    assert float(target[0, 3]) == pytest.approx(0.45 + 0.6 * 2.0)  # knee: default plus scaled action
    assert float(target[0, 2]) == pytest.approx(-0.13)
    assert float(target[0, 10]) == pytest.approx(0.6 * 200.0 / 300.0 * 4.0)  # torso: 200 Nm at 300 Nm/rad
    assert float(target[0, 11]) == pytest.approx(0.1 - 0.1 * 3.0)  # shoulder: reference plus scaled residual
    assert float(target[1, 18]) == pytest.approx(0.8 + 0.1)
    absolute = JointTargets(ActionConfig(upper_mode="absolute"), spec)(action, reference)
    assert float(absolute[0, 11]) == pytest.approx(-0.3)  # default plus scaled action


def test_the_waist_has_a_share_of_the_scale(any_spec):
    whole, part = (JointTargets(ActionConfig(waist_share=share), any_spec).scale for share in (1.0, 0.25))
    waist = torch.tensor([j.name.startswith(("torso", "waist")) for j in any_spec.joints])
    assert int(waist.sum()) == len(any_spec.waist_joints) > 0
    torch.testing.assert_close(part[waist], 0.25 * whole[waist])
    assert torch.equal(part[~waist], whole[~waist])


def test_targets_do_not_write_to_the_default_pose(any_spec):
    targets = JointTargets(ActionConfig(), any_spec)
    default = targets.default.clone()
    targets(torch.ones(2, len(any_spec.joints)), torch.ones(2, len(any_spec.upper_joints)))
    assert torch.equal(targets.default, default)


def test_arms_are_sent_where_the_reference_will_be(make_env, robot):
    """The reference of the step's end, which the observation after it shows."""
    env = make_env(3, robot=robot)
    for _ in range(30):
        obs, *_ = env.step(zeros(env))
        expected = newest(env, obs["policy"])["reference_arm_position"]
        torch.testing.assert_close(env.actuation.current[:, env.num_lower :], expected)
    assert float(env.motions.current().velocity.abs().max()) > 0.01


def test_actions_are_clipped_and_left_alone(make_env, robot):
    a, b = (make_env(2, robot=robot, actions=ActionConfig(clip=0.5)) for _ in range(2))
    wild = torch.full((2, a.num_actions), 3.0)
    obs, *_ = a.step(wild)
    assert (wild == 3.0).all()
    assert (newest(a, obs["policy"])["last_action"] == 0.5).all()
    b.step(torch.full((2, b.num_actions), 0.5))
    assert torch.equal(a.sim.qpos, b.sim.qpos)


def test_an_action_that_is_changed_later_changes_nothing(make_env):
    a, b = make_env(2), make_env(2)
    action = torch.full((2, a.num_actions), 0.2)
    a.step(action)
    action[:] = 9.0
    b.step(torch.full((2, b.num_actions), 0.2))
    assert torch.equal(drive(a, 2)[-1], drive(b, 2)[-1])


@pytest.mark.parametrize(
    ("field", "value"),
    [("lower_scale", -1.0), ("waist_share", 0.0), ("upper_scale", 11.0), ("clip", 0.0), ("upper_mode", "both")],
)
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=rf"actions\.{field}"):
        ActionConfig(**{field: value}).check()
