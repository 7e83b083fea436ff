"""Blows on arm joints, pushes on the base and uneven ground, in the environment."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from cotap.envs.disturbances import AssistConfig, HandForceConfig
from cotap.envs.forces import ForceProfile
from cotap.envs.punches import PunchConfig
from cotap.robots.ground import HALF_EXTENT_M, bumps

QUIET = HandForceConfig(enabled=False)


def test_a_blow_acts_at_the_joint_that_is_struck(make_env, spec):
    """Against MuJoCo's own map from a force at a point to joint torques, with a load in the same hand."""
    load = ForceProfile((5.0, -3.0, -20.0), "both", 0.0)
    env = make_env(8, hand_forces=QUIET, force=load, punches=PunchConfig(600.0, 0.08, 0.08))
    env.punches.joint = torch.arange(8)
    env._apply_forces()
    blow_w = env.punches.current()
    assert (blow_w.norm(dim=2) > 0.0).sum(1).tolist() == [1] * 8
    model, arm_bodies = env.sim.model, [b for a in spec.arms for b in spec.chain(a.hand_body, spec.torso_body)]
    for i in range(8):
        data = mujoco.MjData(model)
        data.qpos[:] = env.sim.qpos[i]
        mujoco.mj_forward(model, data)
        expected, actual = np.zeros(model.nv), np.zeros(model.nv)
        body = model.body(arm_bodies[i].name).id
        force = blow_w[i, i].double().numpy()
        mujoco.mj_applyFT(model, data, force, np.zeros(3), data.xpos[body], body, expected)
        for h, arm in enumerate(spec.arms):
            hand = env.hand_force_w[i, h].double().numpy()
            site = data.site(f"{arm.side}_hand").xpos
            mujoco.mj_applyFT(model, data, hand, np.zeros(3), site, model.body(arm.hand_body).id, expected)
        for b in range(model.nbody):
            wrench = env.sim.xfrc[i, b].numpy()
            mujoco.mj_applyFT(model, data, wrench[:3], wrench[3:], data.xipos[b], b, actual)
        np.testing.assert_allclose(actual, expected, atol=1e-2)


def test_a_blow_is_over_when_it_is_over(make_env):
    env = make_env(4, hand_forces=QUIET, punches=PunchConfig(300.0, 0.04, 0.2))
    pushed = []
    for _ in range(10):
        env.step(torch.zeros(4, 19))
        pushed.append(env.sim.xfrc.abs().amax((1, 2)) > 0.0)
    count = torch.stack(pushed).sum(0)
    assert ((count == 2) | (count == 3)).all()


def test_a_push_on_the_base_accelerates_the_robot_as_its_mass_has_it(make_env):
    """In the air: 200 N for 0.1 s on the whole robot changes its momentum by 20 N s."""
    push = ForceProfile((200.0, 0.0, 0.0), "left", 0.0, 0.1, place="base")
    envs = [make_env(2, hand_forces=QUIET, force=f, seed=3) for f in (push, ForceProfile())]
    for env in envs:
        env.sim.qpos[:, 2] += 1.0
        env.state = env.reader.read()
    heading = envs[0].state.heading_w[:, :, 0]
    for _ in range(6):
        for env in envs:
            env.step(torch.zeros(2, 19))
    for i in range(2):
        mass = envs[0].sim.field("body_mass")[i].sum()
        momentum = []
        for env in envs:
            data = mujoco.MjData(env.sim.model)
            data.qpos[:], data.qvel[:] = env.sim.qpos[i], env.sim.qvel[i]
            model = env.sim.model
            model.body_mass[:] = env.sim.field("body_mass")[i]
            mujoco.mj_forward(model, data)
            mujoco.mj_subtreeVel(model, data)
            momentum.append(float(mass) * torch.as_tensor(data.subtree_linvel[1].copy()))
        change = momentum[0] - momentum[1]
        torch.testing.assert_close(change, 20.0 * heading[i].double(), atol=1.0, rtol=0.0)


def test_bumps_are_gentle_and_within_their_height():
    height = bumps()
    assert height.min() == 0.0
    assert height.max() == 1.0
    slope = np.abs(np.diff(height, axis=1)).max() / (2 * HALF_EXTENT_M / (height.shape[1] - 1))
    assert 0.03 * slope < 0.25  # 3 cm of unevenness: no steeper than 14 degrees


def test_robots_start_on_uneven_ground_at_different_places(make_env):
    env = make_env(8, hand_forces=QUIET, unevenness_m=0.03)
    xy = env.sim.qpos[:, :2]
    assert float(xy.std(0).min()) > 1.0
    assert float(xy.abs().max()) < HALF_EXTENT_M
    for _ in range(20):
        _, _, done, _ = env.step(torch.zeros(8, 19))
        assert not done.any()
    assert env.state.foot_contact.any(1).all()
    low = env.state.foot_pos_w[:, :, 2].amin(1)
    assert (low.abs() < 0.03).all()
    assert float(low.std()) > 1e-3  # they stand at different heights


def test_a_base_that_is_held_starts_where_it_is_held(make_env):
    env = make_env(4, hand_forces=QUIET, unevenness_m=0.03, fixed_base=True)
    start = env.sim.qpos[:, :3].clone()
    for _ in range(10):
        env.step(torch.zeros(4, 19))
    torch.testing.assert_close(env.sim.qpos[:, :3], start, atol=1e-3, rtol=0)
    assert not start[:, :2].any()


def test_a_push_on_the_base_adds_to_the_help_of_the_gantry(make_env):
    push = ForceProfile((50.0, -20.0, 10.0), "left", 0.0, place="base")
    wrench = []
    for force, help_ in ((push, True), (ForceProfile(), True), (push, False)):
        env = make_env(3, hand_forces=QUIET, force=force, assist=AssistConfig(enabled=help_), seed=2)
        env._apply_forces()
        wrench.append(env.sim.xfrc[:, env._base_body].clone())
    both, helped, pushed = wrench
    assert helped[:, 2].abs().min() > 1.0
    assert pushed[:, :3].norm(dim=1).min() > 50.0
    torch.testing.assert_close(both, helped + pushed)


def test_ground_is_flat_unless_asked(make_env):
    model = make_env(1).sim.model
    assert model.nhfield == 0
    with pytest.raises(ValueError, match="unevenness_m"):
        make_env(1, unevenness_m=-0.1)
