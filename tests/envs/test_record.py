"""The record of a step against MuJoCo and finite differences: what rewards are computed from."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from env_tools import NOMINAL, drive, hold_still, knock_over, mujoco_of, zeros

from cotap.envs.gait_phase import GaitConfig
from cotap.envs.record import height_slope, in_phase
from cotap.envs.rewards import UpperRewards

EPS = 1e-4


def key_points_w(env, data) -> np.ndarray:
    """Hands and elbows in the world, of MuJoCo's own."""
    hands = [data.site(f"{arm.side}_hand").xpos for arm in env.spec.arms]
    return np.array([*hands, *(data.body(arm.elbow_body).xpos for arm in env.spec.arms)])


def torso_of(env, data) -> tuple[np.ndarray, np.ndarray]:
    body = data.body(env.spec.torso_body)
    return body.xpos.copy(), body.xmat.reshape(3, 3).copy()


def reference_in(env, data, arms: torch.Tensor) -> np.ndarray:
    """Where the reference's key points are in the world, carried by the torso that `data` has."""
    model = env.sim.model
    other = mujoco.MjData(model)
    other.qpos[:] = data.qpos
    other.qpos[7 + env.num_lower :] = arms.numpy()
    mujoco.mj_kinematics(model, other)
    return key_points_w(env, other)


def moved(model, data, seconds: float) -> mujoco.MjData:
    """The same robot a moment later, or earlier, at its present velocity."""
    other = mujoco.MjData(model)
    other.qpos[:] = data.qpos
    mujoco.mj_integratePos(model, other.qpos, data.qvel, seconds)
    mujoco.mj_kinematics(model, other)
    return other


def tumbling(make_env, robot):
    """A record of robots that turn fast in the air, arms away from their reference."""
    env = make_env(3, robot=robot, randomization=NOMINAL)
    drive(env, 5)
    rng = torch.Generator().manual_seed(2)
    env.sim.qpos[:, 2] += 1.0
    env.sim.qvel[:, 3:6] = 2.0 * torch.randn(3, 3, generator=rng).double()
    env.sim.qpos[:, 7 + env.num_lower :] += 0.2 * torch.randn(3, env.num_actions - env.num_lower, generator=rng)
    env.state = env.reader.read()
    env.step(torch.randn(3, env.num_actions, generator=rng))
    return env


def test_key_points_are_mujocos_in_the_torso_frame(make_env, robot):
    env = tumbling(make_env, robot)
    record = env.record
    for i in range(3):
        _, data = mujoco_of(env, i)
        position, rotation = torso_of(env, data)
        points = key_points_w(env, data)
        np.testing.assert_allclose(record.key_points_t[i], (points - position) @ rotation, atol=1e-5)
        wanted = reference_in(env, data, record.reference.position[i])
        np.testing.assert_allclose(record.key_points_reference_t[i], (wanted - position) @ rotation, atol=1e-5)


def test_key_velocities_are_finite_differences_of_them(make_env, robot):
    """Relative to the torso and in its frame; the reference's along its own joint rates."""
    env = tumbling(make_env, robot)
    record = env.record
    for i in range(3):
        model, data = mujoco_of(env, i)
        seen, wanted = [], []
        for sign in (1.0, -1.0):
            later = moved(model, data, sign * EPS)
            position, rotation = torso_of(env, later)
            seen.append((key_points_w(env, later) - position) @ rotation)
            arms = record.reference.position[i].double() + sign * EPS * record.reference.velocity[i].double()
            wanted.append((reference_in(env, later, arms) - position) @ rotation)
        np.testing.assert_allclose(record.key_velocities_t[i], (seen[0] - seen[1]) / (2 * EPS), atol=2e-3)
        rate = (wanted[0] - wanted[1]) / (2 * EPS)
        np.testing.assert_allclose(record.key_velocities_reference_t[i], rate, atol=2e-3)
    assert float(record.key_velocities_t.abs().max()) > 0.5


def test_key_velocity_term_is_of_world_velocities(make_env, robot):
    """Paper, appendix A: points of robot and reference, both carried by the torso, differentiated in the world."""
    env = tumbling(make_env, robot)
    record = env.record
    got = UpperRewards.TERMS["track_key_velocities"].function(record)
    assert float(record.state.torso_angular_velocity_t.norm(dim=1).min()) > 0.5
    differs = []
    for i in range(3):
        model, data = mujoco_of(env, i)
        error = []
        for sign in (1.0, -1.0):
            later = moved(model, data, sign * EPS)
            arms = record.reference.position[i].double() + sign * EPS * record.reference.velocity[i].double()
            error.append(key_points_w(env, later) - reference_in(env, later, arms))
        squared = (((error[0] - error[1]) / (2 * EPS)) ** 2).sum()
        assert -np.log(float(got[i])) == pytest.approx(squared, rel=5e-3)
        without_spin = (record.key_velocities_t[i] - record.key_velocities_reference_t[i]).square().sum()
        differs.append(abs(float(without_spin) / squared - 1.0))
    assert max(differs) > 0.02  # a torso that does not turn would have another term


def test_joint_accelerations_are_the_change_of_velocity(make_env, robot):
    env = make_env(2, robot=robot)
    drive(env, 3)
    before = env.sim.qvel[:, 6:].clone()
    env.step(zeros(env) + 1.0)
    change = (env.sim.qvel[:, 6:] - before).float()
    torch.testing.assert_close(env.record.joint_acceleration, change / 0.02, atol=1e-3, rtol=1e-4)
    assert float(change.abs().max()) > 0.1


def test_a_new_episode_has_no_acceleration_of_the_old(make_env, robot):
    env = make_env(2, robot=robot)
    drive(env, 5, scale=1.0)
    knock_over(env, 1)
    env.step(zeros(env))
    before = env.sim.qvel[:, 6:].clone()
    env.step(zeros(env))
    change = (env.sim.qvel[:, 6:] - before).float()
    torch.testing.assert_close(env.record.joint_acceleration, change / 0.02, atol=1e-3, rtol=1e-4)


def test_actions_targets_and_torques_are_the_steps(make_env, robot):
    env = make_env(2, robot=robot)
    first, second = zeros(env) + 0.2, zeros(env) - 0.1
    env.step(first)
    env.step(second)
    record = env.record
    assert torch.equal(record.action, second)
    assert torch.equal(record.last_action, first)
    assert torch.equal(record.torque, env.torque)
    arms = slice(env.num_lower, None)
    torch.testing.assert_close(record.arm_target, env.joint_targets(second, record.reference.position)[:, arms])


def test_velocity_errors_are_averaged_by_hand(make_env, robot):
    """Over a stride, here of 0.1 s: the last five steps, zero before the first."""
    env = make_env(3, robot=robot, gait=GaitConfig(period_s=0.1))
    hold_still(env, stand=0.0)
    env.commands.set_velocity(
        torch.tensor([[0.6, -0.3]]).repeat(3, 1), torch.full((3,), 0.5), torch.ones(3, dtype=torch.bool)
    )
    env.reset()
    env.commands.set_velocity(
        torch.tensor([[0.6, -0.3]]).repeat(3, 1), torch.full((3,), 0.5), torch.ones(3, dtype=torch.bool)
    )
    errors = [torch.zeros(3, 3)] * 5
    for _ in range(10):
        _, _, done, _ = env.step(zeros(env))
        assert not done.any()
        s, c = env.state, env.commands.current()
        error = torch.cat((s.torso_linear_velocity_h[:, :2] - c.velocity_h, (s.yaw_rate - c.yaw_rate)[:, None]), 1)
        errors = [*errors[1:], error]
        mean = torch.stack(errors).mean(0)
        torch.testing.assert_close(env.record.mean_error, mean, atol=1e-6, rtol=1e-5)
    assert mean[:, 0].max() < -0.1
    assert mean[:, 1].min() > 0.05


def test_contacts_and_swing_follow_the_phase(make_env, robot):
    env = make_env(3, robot=robot)
    hold_still(env, stand=0.0)
    env.commands.gait.stand[:] = torch.tensor([0.0, 0.0, 1.0])
    env.commands._target[2, 3] = 1.0
    env.commands.gait.phase = torch.tensor([0.765, 0.265, 0.0])  # a step before mid-swing of the left, of the right
    env.step(zeros(env))
    assert env.record.desired_contact.tolist() == [[False, True], [True, False], [True, True]]
    expected = torch.tensor([[0.5, 0.0], [0.0, 0.5], [0.0, 0.0]])
    torch.testing.assert_close(env.record.swing, expected, atol=1e-5, rtol=0)


def test_arm_poses_of_the_h1_have_elbows_at_the_forearm(make_env):
    """By hand: at zero angles, forearms of 0.3 m point forward from the elbows."""
    env = make_env(1, randomization=NOMINAL)
    arms = env.reader.arm_chains.pose(torch.zeros(1, 2, 4))
    points, _ = env.recorder._key_points(arms, torch.zeros(1, 2, 4))
    forearm = points[0, :2] - points[0, 2:]
    torch.testing.assert_close(forearm, torch.tensor([[0.3, 0.0, 0.0]] * 2), atol=1e-5, rtol=0)


def test_the_height_slope_is_numpys_regression_over_standing_robots():
    generator = np.random.default_rng(0)
    commanded, noise = generator.uniform(0.8, 1.0, 200), generator.normal(0.0, 0.02, 200)
    stand = generator.random(200) < 0.4
    measured = np.where(stand, 0.3 + 0.7 * commanded + noise, 5.0)  # what walks does not count
    slope = height_slope(*(torch.tensor(values) for values in (measured, commanded, stand.astype(float))))
    assert float(slope) == pytest.approx(np.polyfit(commanded[stand], measured[stand], 1)[0], rel=1e-6)
    assert float(height_slope(torch.ones(3), torch.ones(3), torch.zeros(3))) == 0.0  # nobody stands


def test_in_phase_is_the_share_of_feet_of_walking_robots():
    as_asked = torch.tensor([[True, False], [False, False], [True, True]])
    assert float(in_phase(as_asked, torch.tensor([0.0, 0.0, 1.0]))) == 0.25  # one foot of four
    assert float(in_phase(as_asked, torch.ones(3))) == 0.0  # nobody walks


def test_the_log_has_the_share_of_feet_in_phase(make_env, robot):
    env = make_env(16, robot=robot)
    for _ in range(10):
        *_, extras = env.step(zeros(env))
        r = env.record
        feet = [
            float((force > 5.0) == down)
            for forces, wanted, stand in zip(r.state.foot_force, r.desired_contact, r.command.stand, strict=True)
            for force, down in zip(forces, wanted, strict=True)
            if stand == 0
        ]
        assert float(extras["log"]["/command/in_phase"]) == pytest.approx(np.mean(feet), abs=1e-6)
