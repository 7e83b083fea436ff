"""From targets to torques, against MuJoCo's own actuators."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from env_tools import NOMINAL, STILL, drive, knock_over, mujoco_of, zeros

from cotap.envs.randomization import RandomizationConfig


def delayed(seconds: float) -> RandomizationConfig:
    return RandomizationConfig(delay_s=(seconds, seconds))


def late_start(env, action: torch.Tensor) -> torch.Tensor:
    """Joint velocities after one step, from rest in the air, where nothing but the actuators differs."""
    env.sim.qpos[:, 2] += 1.0
    env.state = env.reader.read()
    env.step(action)
    return env.sim.qvel[:, 6:].clone()


def test_torque_is_what_mujocos_actuators_give(make_env, robot):
    """The PD law in observation and rewards, gains and delays randomised, limits reached."""
    env = make_env(4, robot=robot, torque_limit_scale=0.5)
    drive(env, 3, scale=1.0)
    assert torch.equal(env.actuation.joint_torque(env.state), env.torque)
    limit = 0.5 * torch.tensor([j.torque_limit_nm for j in env.spec.joints])
    for i in range(4):
        _, data = mujoco_of(env, i)
        np.testing.assert_allclose(env.torque[i], data.actuator_force, atol=3e-3)
    assert (env.torque.abs() <= limit + 1e-4).all()
    assert (env.torque.abs() > 0.999 * limit).any()
    assert (env.torque.abs() < 0.9 * limit).any()


def test_torque_is_zero_in_envs_that_restart(make_env, robot):
    env = make_env(3, robot=robot)
    assert not env.torque.any()
    drive(env, 4, scale=1.0)
    knock_over(env, 1)
    env.step(zeros(env))
    assert not env.torque[1].any()
    assert env.torque[[0, 2]].abs().amax(1).min() > 1.0
    assert env.record.torque[1].any()  # the step that ended had torque


def test_no_delay_acts_at_once(make_env, robot):
    env, twin = (make_env(2, robot=robot, randomization=delayed(0.0), motions=STILL) for _ in range(2))
    assert (late_start(env, zeros(env) + 1.0) - late_start(twin, zeros(env))).abs().amin(1).min() > 1e-3
    assert torch.equal(env.actuation.arrived(0), torch.ones(2))


def test_a_whole_step_of_delay_holds_the_old_target(make_env, robot):
    env, twin = (make_env(2, robot=robot, randomization=delayed(0.02), motions=STILL) for _ in range(2))
    env.step(zeros(env) + 1.0)
    twin.step(zeros(env))
    assert torch.equal(env.sim.qpos, twin.sim.qpos)
    env.step(zeros(env))
    twin.step(zeros(env))
    assert (env.sim.qpos - twin.sim.qpos).abs().amax(1).min() > 1e-3


@pytest.mark.parametrize("delay_ms", [0.0, 3.0, 5.0, 10.0, 13.0, 20.0])
def test_shares_of_the_step_add_to_what_is_not_delayed(make_env, delay_ms):
    """By hand: of each physics step of 10 ms, the new command holds for what the delay leaves of it."""
    env = make_env(1, randomization=delayed(1e-3 * delay_ms))
    shares = [float(env.actuation.arrived(k)) for k in range(2)]
    assert shares == pytest.approx([max(0.0, 1.0 - 0.1 * delay_ms), min(1.0, 2.0 - 0.1 * delay_ms)], abs=1e-5)
    assert 0.01 * sum(shares) == pytest.approx(0.02 - 1e-3 * delay_ms, abs=1e-6)


@pytest.mark.parametrize("delay_ms", [0.0, 4.0, 10.0, 16.0, 20.0])
def test_delayed_targets_reach_mujoco_as_hand_mixed(make_env, robot, delay_ms):
    """The same two physics steps in MuJoCo alone, targets mixed by hand."""
    fixed = RandomizationConfig(delay_s=(1e-3 * delay_ms, 1e-3 * delay_ms), kp_scale=(1.0, 1.0), kd_scale=(1.0, 1.0))
    env = make_env(1, robot=robot, randomization=fixed, motions=STILL)
    action = torch.linspace(-1.0, 1.0, env.num_actions).unsqueeze(0)
    late_start(env, action)
    model, data = mujoco_of(env, 0)
    kp = np.array([j.kp for j in env.spec.joints])
    old = env.actuation.current[0].double().numpy()
    env.step(0.5 * action.flip(1))
    new = env.actuation.current[0].double().numpy()
    for share in (max(0.0, 1.0 - 0.1 * delay_ms), min(1.0, 2.0 - 0.1 * delay_ms)):
        data.ctrl[:] = kp * (share * new + (1.0 - share) * old)
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(env.sim.qpos[0], data.qpos, atol=1e-6)
    np.testing.assert_allclose(env.sim.qvel[0], data.qvel, atol=2e-4)
    assert np.abs(data.qvel[6:]).max() > 0.1


def test_a_new_episode_has_always_had_its_pose_as_target(make_env, robot):
    env = make_env(3, robot=robot)
    drive(env, 8)
    knock_over(env, 1)
    env.step(zeros(env) + 1.0)
    pose = env.sim.qpos[:, 7:].float()
    torch.testing.assert_close(env.actuation.previous[1], pose[1])
    torch.testing.assert_close(env.actuation.current[1], pose[1])
    assert (env.actuation.current[[0, 2]] - pose[[0, 2]]).abs().amax(1).min() > 0.1


def test_limits_scale_and_bound_the_actuators(make_env, robot):
    env = make_env(1, robot=robot, torque_limit_scale=0.5, randomization=NOMINAL)
    half = [0.5 * j.torque_limit_nm for j in env.spec.joints]
    np.testing.assert_allclose(env.sim.model.actuator_forcerange[:, 1], half)
    np.testing.assert_allclose(env.sim.model.actuator_forcerange[:, 0], [-x for x in half])
    assert env.actuation.torque_limit.tolist() == pytest.approx(half)
    arms = env.arm_limits.flatten().tolist()
    assert arms == pytest.approx(half[env.num_lower :])
