"""Displacements are told along the heading: MuJoCo's own positions of hands and torso, tilted torsos included."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.evaluation.protocol import mirrored_pose
from cotap.evaluation.rollout import trajectory_row
from cotap.evaluation.static import StaticStiffness, settle


def along_heading(data: mujoco.MjData, torso: str, vectors_w: np.ndarray) -> np.ndarray:
    """World vectors (..., 3), turned back by the direction that the torso's x axis has on the ground."""
    x_axis = data.body(torso).xmat.reshape(3, 3)[:, 0]
    yaw = math.atan2(x_axis[1], x_axis[0])
    turn = np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    return vectors_w @ turn.T


def posed(model: mujoco.MjModel, qpos) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def hands_w(data: mujoco.MjData) -> np.ndarray:
    return np.array([data.site(f"{side}_hand").xpos for side in ("left", "right")])


@pytest.fixture
def turning(make_env, robot):
    """A step of robots in the air that lean, have turned and turn, arms off their reference, forces on their hands."""
    load = ExternalForceConfig(scripted=ForceProfile((8.0, -5.0, -12.0), "left", 0.0))
    env = make_env(3, robot=robot, randomization=RandomizationConfig(enabled=False), forces=load)
    rng = torch.Generator().manual_seed(2)
    signs = torch.sign(torch.randn(3, 4, generator=rng))
    turned = torch.tensor([1.0, 0.0, 0.0, 0.0]) + torch.tensor([0.0, 0.15, 0.15, 0.6]) * signs
    env.sim.qpos[:, 2] += 1.0
    env.sim.qpos[:, 3:7] = torch.nn.functional.normalize(turned.double(), dim=1)
    env.sim.qpos[:, 7 + env.num_lower :] += 0.3
    env.sim.qvel[:, :6] = 1.5 * torch.randn(3, 6, generator=rng).double()
    env.state = env.reader.read()
    _, _, done, extras = env.step(torch.zeros(3, env.num_actions))
    assert not done.any()
    return env, trajectory_row(env, extras["falls"])


def test_a_recorded_hand_is_off_its_reference_along_the_heading(turning):
    env, row = turning
    torso = env.spec.torso_body
    for i in range(3):
        state = env.sim.qpos[i].numpy()
        data = posed(env.sim.model, state)
        assert data.body(torso).xmat[8] < 0.99  # tilted
        reference = state.copy()
        reference[7 + env.num_lower :] = env.record.reference.position[i].numpy()
        off_w = hands_w(data) - hands_w(posed(env.sim.model, reference))
        np.testing.assert_allclose(row["hand_offset"][i], along_heading(data, torso, off_w), atol=2e-5)
        assert np.abs(off_w).max() > 0.02


def test_a_recorded_velocity_is_the_torsos_along_the_heading_and_about_the_vertical(turning):
    env, row = turning
    model, torso, twist = env.sim.model, env.spec.torso_body, np.zeros(6)
    for i in range(3):
        data = posed(model, env.sim.qpos[i].numpy())
        data.qvel[:] = env.sim.qvel[i].numpy()
        mujoco.mj_forward(model, data)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(torso).id, twist, 0)
        expected = along_heading(data, torso, twist[3:])
        expected[2] = twist[2]
        np.testing.assert_allclose(row["velocity"][i], expected, atol=1e-4)
        about_own_axis = data.body(torso).xmat.reshape(3, 3)[:, 2] @ twist[:3]
        assert abs(about_own_axis - twist[2]) > 0.005  # which is not the same


def test_the_torque_that_statics_asks_of_the_arms_is_gravitys_less_the_loads(turning):
    env, row = turning
    model = env.sim.model
    for i in range(3):
        data = posed(model, env.sim.qpos[i].numpy())
        mujoco.mj_forward(model, data)  # at rest: what is left of the bias is gravity
        felt = np.zeros(model.nv)
        for arm, force in zip(env.spec.arms, env.hand_force_w[i].double().numpy(), strict=True):
            body = model.body(arm.hand_body).id
            mujoco.mj_applyFT(model, data, force, np.zeros(3), data.site(f"{arm.side}_hand").xpos, body, felt)
        expected = (data.qfrc_bias - felt)[6 + env.num_lower :]
        np.testing.assert_allclose(row["arm_static_torque"][i], expected, atol=1e-3)
        assert np.abs(felt[6 + env.num_lower :]).max() > 1.0


def test_torques_are_recorded_as_shares_of_every_joint_s_limit(turning):
    """Legs, waist and arms, in the order of the joints."""
    env, row = turning
    limit = torch.tensor([env.spec.joint(name).torque_limit_nm for name in env.spec.joint_names])
    torch.testing.assert_close(row["torque_share"] * limit, env.torque.abs())
    assert (row["torque_share"][:, : env.num_lower] > 0.0).any()
    assert row["torque_share"].max() <= 1.0
    torch.testing.assert_close(row["torque_share"][:, env.num_lower :] * limit[env.num_lower :],
                               row["arm_torque"].abs())  # fmt: skip


@pytest.mark.parametrize("lean", [0.4, -0.3])
def test_a_loaded_hand_moves_along_the_heading_of_a_torso_that_leans(lean):
    """A waist that bends tilts the torso though the pelvis is held: the load is vertical, and so is what it does."""
    protocol = StaticStiffness(num_envs=2, force=(0.0, 0.0, -5.0), levels=2, settle_seconds=3.0)
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig("g1", num_threads=1)))
    protocol.prepare(env)
    side = protocol.load(env, torch.tensor([[0.0, 0.0, -5.0]]).expand(2, 3))
    waist = env.spec.joint_names.index("waist_pitch_joint")
    bend = torch.zeros(2, env.num_actions)
    bend[:, waist] = lean / env.joint_targets.scale[waist]
    settled = settle(env, lambda _: bend, 3.0, side)
    half = round(3.0 / env.dt)
    before, after = (posed(env.sim.model, settled.film[k - 1, : env.sim.model.nq].numpy()) for k in (half, 2 * half))
    torso = env.spec.torso_body
    assert math.asin(before.body(torso).xmat[2]) == pytest.approx(lean, abs=0.1)
    # In the torso, which gives way itself, and as the torso was before the load.
    where = [d.body(torso).xmat.reshape(3, 3).T @ (hands_w(d)[side] - d.body(torso).xpos) for d in (before, after)]
    moved_w = before.body(torso).xmat.reshape(3, 3) @ (where[1] - where[0])
    np.testing.assert_allclose(settled.moved[0], along_heading(before, torso, moved_w), atol=5e-5)
    assert moved_w[2] < -0.005


def test_a_pose_of_the_left_arm_is_mirrored_by_its_joints_signs(make_env):
    """By hand, for the H1: shoulder pitch and elbow keep their signs, roll and yaw change them."""
    env = make_env(1)
    pose = mirrored_pose(env, (0.1, 0.2, 0.3, 0.4))
    assert pose.tolist() == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.1, -0.2, -0.3, 0.4])
    assert torch.equal(mirrored_pose(env, ()), env.motions.default)


def test_a_pose_of_the_left_arm_puts_the_right_hand_at_its_mirror_image(make_env, robot):
    env = make_env(1, robot=robot)
    left = tuple(0.1 + 0.1 * k for k in range(len(env.spec.arms[0].joints)))
    state = env.sim.model.qpos0.copy()
    state[7:] = 0.0
    state[7 + env.num_lower :] = mirrored_pose(env, left).numpy()
    hands = hands_w(posed(env.sim.model, state))
    np.testing.assert_allclose(hands[1], hands[0] * [1.0, -1.0, 1.0], atol=5e-5)
