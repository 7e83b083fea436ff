"""The environment as a whole: what goes where, and what one world's trouble does to the others."""

from __future__ import annotations

import copy
import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch

from cotap.envs import H1EnvConfig
from cotap.envs.commands import CommandConfig
from cotap.envs.disturbances import AssistConfig, HandForceConfig
from cotap.envs.h1_env import ActionConfig
from cotap.envs.motions import MotionConfig
from cotap.envs.observations import NoiseConfig, ObservationConfig, actor_terms
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.reference import ClipConfig, ReferenceConfig
from cotap.envs.terminations import TerminationConfig

STILL = ReferenceConfig(MotionConfig(hold=1.0, reach=0.0, punch=0.0, wave=0.0, swing=0.0), ClipConfig(share=0.0))
NOMINAL = RandomizationConfig(enabled=False)
FREE_HANDS = HandForceConfig(enabled=False)
NOISY = ObservationConfig(noise=NoiseConfig(enabled=True))


def actions(env, seed=0, scale=0.3):
    rng = torch.Generator().manual_seed(seed)
    while True:
        yield scale * torch.randn(env.num_envs, env.num_actions, generator=rng)


def rollout(env, steps, seed=0, scale=0.3) -> torch.Tensor:
    """Everything that agents see and get over `steps`, (steps, N, -1)."""
    out = []
    for action, _ in zip(actions(env, seed, scale), range(steps), strict=False):
        obs, reward, done, extras = env.step(action)
        out.append(
            torch.cat(
                (*[obs[k] for k in sorted(obs.keys())], reward[:, None], done[:, None], extras["group_rewards"]), 1
            )
        )
    return torch.stack(out)


def knock_over(env, world: int) -> None:
    """Lay a robot on its side in mid-air, where nothing touches it."""
    env.sim.qpos[world, 3:7] = torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0])


def newest(policy: torch.Tensor) -> dict[str, torch.Tensor]:
    """The present values of the actor's terms, scales undone, from an observation (N, 430)."""
    out, start = {}, 0
    for name, width, scale in actor_terms(19, 8):
        block = policy[:, start : start + 5 * width]
        out[name] = block[:, 4 * width :] / scale
        start += 5 * width
    assert start == policy.shape[1]
    return out


def test_sizes(make_env):
    env = make_env(3)
    obs = env.get_observations()
    assert env.num_actions == 19
    assert env.action_slices == {"lower": slice(0, 11), "upper": slice(11, 19)}
    assert {k: tuple(v.shape) for k, v in obs.items()} == {"policy": (3, 430), "privileged": (3, 13)}
    assert sum(obs[g].shape[1] for g in env.obs_groups["critic"]) == 443
    assert env.max_episode_length == 1000
    _, reward, done, extras = env.step(torch.zeros(3, 19))
    assert reward.shape == done.shape == extras["time_outs"].shape == extras["falls"].shape == (3,)
    assert extras["group_rewards"].shape == (3, len(env.reward_groups))
    torch.testing.assert_close(extras["group_rewards"].sum(1), reward)
    assert all(math.isfinite(float(v)) for v in extras["log"].values())


def test_observation_is_wired_to_what_it_names(make_env):
    env = make_env(4)
    for action, _ in zip(actions(env), range(12), strict=False):
        obs, *_ = env.step(action)
    got, s, c = newest(obs["policy"]), env.state, env.commands.current()
    default = torch.tensor([j.default_rad for j in env.spec.joints])
    expected = {
        "torso_angular_velocity": s.torso_angular_velocity_t,
        "projected_gravity": s.projected_gravity_t,
        "command_velocity": c.velocity_h,
        "command_yaw_rate": c.yaw_rate[:, None],
        "command_stand": c.stand[:, None],
        "command_height": c.height[:, None],
        "reference_arm_position": env.motions.current().position,
        "joint_position": env.sim.qpos[:, 7:].float() - default,
        "joint_velocity": env.sim.qvel[:, 6:].float(),
        "last_action": action,
        "sin_phase": ((1 - c.stand) * torch.sin(2 * math.pi * c.phase))[:, None],
        "cos_phase": ((1 - c.stand) * torch.cos(2 * math.pi * c.phase))[:, None],
    }
    for name, value in expected.items():
        torch.testing.assert_close(got[name], value, atol=1e-5, rtol=1e-5, msg=lambda m, name=name: f"{name}: {m}")
    # `ctrl` is what drives the actuators in the last physics step: the target times kp.
    torque = env.sim.ctrl.float() - env._kp * s.joint_pos - env._kd * s.joint_vel
    arm_limits = torch.tensor([40.0, 40.0, 18.0, 18.0] * 2)
    torch.testing.assert_close(got["arm_torque"], torque[:, 11:].clamp(-arm_limits, arm_limits), atol=1e-3, rtol=1e-4)
    critic = obs["privileged"]
    quat = critic[:, :4]
    expected_quat = np.zeros(4)
    for i in range(4):
        mujoco.mju_mat2Quat(expected_quat, s.torso_rotation_w[i].double().numpy().flatten())
        assert abs(float(quat[i] @ torch.from_numpy(expected_quat).float())) == pytest.approx(1.0, abs=1e-5)
    torch.testing.assert_close(critic[:, 4:7], 2.0 * s.torso_linear_velocity_h)


def test_history_holds_the_last_five_steps_oldest_first(make_env):
    env = make_env(2)
    gravity = [env.state.projected_gravity_t] * 5
    torch.testing.assert_close(env.get_observations()["policy"][:, 15:30], torch.cat(gravity[-5:], 1))
    for action, _ in zip(actions(env), range(7), strict=False):
        obs, _, done, _ = env.step(action)
        assert not done.any()
        gravity.append(env.state.projected_gravity_t)
        torch.testing.assert_close(obs["policy"][:, 15:30], torch.cat(gravity[-5:], 1))


def test_noise_is_for_the_actor_and_never_for_the_critic(make_env):
    quiet, noisy = make_env(8), make_env(8, observations=NOISY)
    assert quiet.obs_groups == {"actor": ["policy"], "critic": ["policy", "privileged"]}
    assert noisy.obs_groups == {"actor": ["policy"], "critic": ["clean", "privileged"]}
    for action, _ in zip(actions(noisy), range(8), strict=False):
        obs, *_ = noisy.step(action)
    clean, seen = newest(obs["clean"]), newest(obs["policy"])
    torch.testing.assert_close(clean["projected_gravity"], noisy.state.projected_gravity_t)
    bounds = {"torso_angular_velocity": 0.2, "projected_gravity": 0.05, "joint_position": 0.01, "joint_velocity": 1.0}
    for name in clean:
        error = (seen[name] - clean[name]).abs()
        if name in bounds:
            assert 0.6 * bounds[name] < float(error.max()) <= bounds[name] * 1.001 + 1e-5, name
            assert float((seen[name] - clean[name]).mean().abs()) < 0.3 * bounds[name], name
        else:
            assert not error.any(), name


def test_one_seed_is_one_future(make_env):
    a, b, c = (make_env(4, seed=s, observations=NOISY) for s in (5, 5, 6))
    first = rollout(a, 60, scale=1.0)
    assert first[..., -3].any()  # some worlds fell and restarted: that is covered too
    assert torch.equal(first, rollout(b, 60, scale=1.0))
    assert not torch.equal(first[0], rollout(c, 1)[0])


def test_state_dict_continues_exactly_elsewhere(make_env):
    env, other = (make_env(4, seed=s, observations=NOISY) for s in (0, 1))
    rollout(env, 30, scale=1.0)
    saved = copy.deepcopy(env.state_dict())
    assert torch.equal(saved["observations"]["policy"], env.get_observations()["policy"])
    future = rollout(env, 60, seed=1, scale=1.0)
    assert future[..., -3].any()
    rollout(other, 7)
    other.load_state_dict(saved)
    assert torch.equal(other.get_observations()["policy"], saved["observations"]["policy"])
    assert torch.equal(rollout(other, 60, seed=1, scale=1.0), future)
    assert other.samples == env.samples


def test_state_dict_is_a_copy(make_env):
    """What was saved stays as it was while the environment goes on, restarts included."""
    env = make_env(4)
    rollout(env, 10)
    saved = env.state_dict()
    future = rollout(env, 60, seed=1, scale=1.0)
    assert future[..., -3].any()
    env.load_state_dict(saved)
    assert torch.equal(rollout(env, 60, seed=1, scale=1.0), future)
    env.load_state_dict(saved)
    assert torch.equal(rollout(env, 60, seed=1, scale=1.0), future)


def test_state_of_another_size_is_refused(make_env):
    with pytest.raises(ValueError, match="must have shape"):
        make_env(3).load_state_dict(make_env(4).state_dict())


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_actions_that_are_not_finite_are_refused(make_env, value):
    env = make_env(2)
    bad = torch.zeros(2, 19)
    bad[1, 4] = value
    before = env.sim.snapshot().state
    with pytest.raises(ValueError, match=rf"actions must be finite, got {value} at index \(1, 4\)"):
        env.step(bad)
    assert torch.equal(env.sim.snapshot().state, before)


def test_actions_of_another_shape_are_refused(make_env):
    with pytest.raises(ValueError, match=r"actions must have shape \(2, 19\), got \(2, 18\)"):
        make_env(2).step(torch.zeros(2, 18))


def test_actions_are_clipped_and_left_alone(make_env):
    a, b = (make_env(2, actions=ActionConfig(clip=0.5)) for _ in range(2))
    wild = torch.full((2, 19), 3.0)
    obs, *_ = a.step(wild)
    assert (wild == 3.0).all()
    assert (newest(obs["policy"])["last_action"] == 0.5).all()
    b.step(torch.full((2, 19), 0.5))
    assert torch.equal(a.sim.qpos, b.sim.qpos)


def stand_or_walk(env, stand: list[float], phase: list[float]) -> None:
    """Fixed commands, at these phases of the stride."""
    n = env.num_envs
    env.commands.override(torch.zeros(n, 2), torch.zeros(n), torch.tensor(stand), torch.full((n,), 1.0205))
    env.commands._phase, env.commands._stand = torch.tensor(phase), torch.tensor(stand)


def test_targets_by_hand(make_env):
    action = torch.zeros(2, 19)
    action[0, 3], action[0, 11], action[1, 18] = 2.0, -3.0, 1.0
    env = make_env(2, actions=ActionConfig(stance_balance=0.0))
    stand_or_walk(env, [1.0, 1.0], [0.0, 0.0])
    env.motions.hold(torch.linspace(0.1, 0.8, 8))
    target = env.target_from_action(action)
    assert float(target[0, 3]) == pytest.approx(0.45 + 0.25 * 2.0)  # knee: default plus scaled action
    assert float(target[0, 2]) == pytest.approx(-0.13)
    assert float(target[0, 11]) == pytest.approx(0.1 - 0.1 * 3.0)  # shoulder: reference plus scaled residual
    assert float(target[1, 18]) == pytest.approx(0.8 + 0.1)
    absolute = make_env(2, actions=ActionConfig(upper_mode="absolute"))
    stand_or_walk(absolute, [1.0, 1.0], [0.0, 0.0])
    absolute.motions.hold(torch.linspace(0.1, 0.8, 8))
    assert float(absolute.target_from_action(action)[0, 11]) == pytest.approx(-0.3)  # default plus scaled action


def test_the_gait_clock_lifts_the_swinging_leg(make_env):
    """Worlds: both feet down, left leg at the top of its swing (phase 0.79), right leg halfway up (0.5 + 0.685)."""
    env = make_env(3, actions=ActionConfig(step_lift=0.5, stance_balance=0.0))
    stand_or_walk(env, [1.0, 0.0, 0.0], [0.0, 0.79, 0.185])
    target = env.target_from_action(torch.zeros(3, 19))
    default = torch.tensor([j.default_rad for j in env.spec.joints])
    expected = default.repeat(3, 1)
    expected[1, 2:5] += 0.5 * torch.tensor([-0.35, 0.7, -0.35])
    expected[2, 7:10] += 0.5 * 0.5 * torch.tensor([-0.35, 0.7, -0.35])
    torch.testing.assert_close(target[:, :11], expected[:, :11], atol=1e-5, rtol=0)


def test_torque_is_what_the_actuators_give(make_env):
    """The law in the observation and rewards against MuJoCo's own actuator forces, gains randomised."""
    env = make_env(3, torque_limit_scale=0.5)
    for action, _ in zip(actions(env, scale=1.0), range(3), strict=False):
        env.step(action)
    torque = env.joint_torque(env.state)
    for i in range(3):
        model = copy.copy(env.sim.model)
        model.actuator_biasprm[:] = env.sim.field("actuator_biasprm")[i].numpy()
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = env.sim.qpos[i], env.sim.qvel[i]
        data.ctrl[:] = env.sim.ctrl[i]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(torque[i], data.actuator_force, atol=2e-3)
    assert float(torque[:, 9].abs().max()) <= 20.0  # half of the ankle's 40 Nm
    assert float(torque.abs().max()) > 1.0


def test_delay_holds_the_old_target_for_its_time(make_env):
    late = RandomizationConfig(delay_s=(0.02, 0.02))
    env, twin = (make_env(2, randomization=late, motions=STILL) for _ in range(2))
    env.step(torch.ones(2, 19))
    twin.step(torch.zeros(2, 19))
    assert torch.equal(env.sim.qpos, twin.sim.qpos)
    env.step(torch.zeros(2, 19))
    twin.step(torch.zeros(2, 19))
    assert (env.sim.qpos - twin.sim.qpos).abs().max() > 1e-3


def test_hand_forces_act_at_the_hands_in_the_heading_frame(make_env):
    env = make_env(4, hand_forces=HandForceConfig(curriculum_start=1.0, torque_share=0.5))
    for action, _ in zip(actions(env), range(6), strict=False):
        state = env.state  # forces are set from the state at the start of a step
        obs, _, done, _ = env.step(action)
        assert not done.any()
    model, record = env.sim.model, env._hand_force_w
    held_h = torch.einsum("nji,nhj->nhi", state.heading_w, record)
    ratio = held_h.norm(dim=2) / env.hand_forces._force_h.norm(dim=2)
    torch.testing.assert_close(held_h, env.hand_forces._force_h * ratio.unsqueeze(2), atol=1e-3, rtol=1e-3)
    assert (ratio <= 1.0 + 1e-5).all()
    assert (ratio > 0.1).all()
    torch.testing.assert_close(obs["privileged"][:, 7:13], 0.1 * record.flatten(1))
    # The wrench that was written is that of the force at the hand point.
    env._apply_forces()
    for i in range(4):
        data = mujoco.MjData(model)
        data.qpos[:] = env.sim.qpos[i]
        mujoco.mj_forward(model, data)
        for h, side in enumerate(("left", "right")):
            body = model.body(f"{side}_elbow_link").id
            expected, actual = np.zeros(model.nv), np.zeros(model.nv)
            force = env._hand_force_w[i, h].double().numpy()
            mujoco.mj_applyFT(model, data, force, np.zeros(3), data.site(f"{side}_hand").xpos, body, expected)
            wrench = env.sim.xfrc[i, body].numpy()
            mujoco.mj_applyFT(model, data, wrench[:3], wrench[3:], data.xipos[body], body, actual)
            np.testing.assert_allclose(actual, expected, atol=2e-4)
            # Arm torques stay within the share that is asked for.
            names = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
            arm = [model.joint(f"{side}_{n}").dofadr[0] for n in names]
            assert (np.abs(actual[arm]) <= 0.5 * np.array([40, 40, 18, 18]) + 1e-2).all()


def test_assistance_pulls_towards_the_command_and_fades(make_env):
    assist = AssistConfig(
        enabled=True, full_samples=20, fade_samples=20, end_samples=40, velocity_gain=300.0,
        force_limit=150.0, yaw_gain=50.0,
        weight_share=0.25, height_stiffness=0.0, height_damping=0.0,
    )  # fmt: skip
    env = make_env(2, assist=assist, hand_forces=FREE_HANDS, randomization=NOMINAL)
    ten, two = torch.tensor([[10.0, 0.0], [0.0, 10.0]]), torch.tensor([2.0, -2.0])
    env.commands.override(ten, two, torch.zeros(2), torch.full((2,), 1.0205))
    env.commands.set_velocity(ten, two, torch.ones(2, dtype=torch.bool))
    forward = env.state.heading_w[0, :2, 0].double()
    left = env.state.heading_w[1, :2, 1].double()
    env.step(torch.zeros(2, 19))
    wrench = env.sim.xfrc[:, env.sim.model.body("pelvis").id]
    torch.testing.assert_close(wrench[0, :2], 150.0 * forward, rtol=0.03, atol=5.0)
    torch.testing.assert_close(wrench[1, :2], 150.0 * left, rtol=0.03, atol=5.0)
    assert wrench[:, 2].tolist() == [pytest.approx(0.25 * 51.437 * 9.81)] * 2
    assert wrench[0, 5] > 50.0 > -50.0 > wrench[1, 5]
    for _ in range(14):  # 28 samples before the last of 15 steps of two worlds, 8 of them beyond the first 20
        env.step(torch.zeros(2, 19))
    assert env.sim.xfrc[0, 1, 2] == pytest.approx(0.25 * 51.437 * 9.81 * math.exp(-8 / 20))
    for _ in range(6):
        env.step(torch.zeros(2, 19))
    assert not env.sim.xfrc[:, 1].any()


def test_assistance_lifts_towards_the_commanded_height(make_env):
    assist = AssistConfig(enabled=True, weight_share=0.25, height_stiffness=1000.0, height_damping=0.0)
    env = make_env(2, assist=assist, hand_forces=FREE_HANDS, randomization=NOMINAL)
    stand_or_walk(env, [1.0, 1.0], [0.0, 0.0])
    env.commands._height = env.state.height + torch.tensor([0.05, -0.05])
    env.step(torch.zeros(2, 19))
    lift = env.sim.xfrc[:, env.sim.model.body("pelvis").id, 2] - 0.25 * 51.437 * 9.81
    assert lift.tolist() == [pytest.approx(50.0, abs=0.1), pytest.approx(-50.0, abs=0.1)]


def test_without_assistance_there_is_no_wrench_on_the_base(make_env):
    env = make_env(2)
    rollout(env, 3)
    assert not env.sim.xfrc[:, env.sim.model.body("pelvis").id].any()


def test_joint_accelerations_are_the_change_of_velocity(make_env):
    env = make_env(2)
    rollout(env, 3)
    before = env.sim.qvel[:, 6:].clone()
    env.step(torch.ones(2, 19))
    change = (env.sim.qvel[:, 6:] - before).float()
    torch.testing.assert_close(env.record.joint_acceleration, change / 0.02, atol=1e-3, rtol=1e-4)
    assert float(change.abs().max()) > 0.1


def test_falls_and_time_outs_are_told_apart(make_env):
    env = make_env(3, terminations=TerminationConfig(episode_s=0.1))
    knock_over(env, 1)
    _, _, done, extras = env.step(torch.zeros(3, 19))
    assert done.tolist() == extras["falls"].tolist() == [False, True, False]
    assert not extras["time_outs"].any()
    assert env.episode_length_buf.tolist() == [1, 0, 1]
    for _ in range(3):
        _, _, done, extras = env.step(torch.zeros(3, 19))
        assert not done.any()
    _, _, done, extras = env.step(torch.zeros(3, 19))
    assert done.tolist() == extras["time_outs"].tolist() == [True, False, True]
    assert not extras["falls"].any()
    _, _, done, _ = env.step(torch.zeros(3, 19))
    assert done.tolist() == [False, True, False]


def test_a_fall_at_the_last_step_is_a_fall(make_env):
    env = make_env(2, terminations=TerminationConfig(episode_s=0.02))
    knock_over(env, 1)
    _, _, done, extras = env.step(torch.zeros(2, 19))
    assert done.all()
    assert extras["falls"].tolist() == [False, True]
    assert extras["time_outs"].tolist() == [True, False]


def test_ended_worlds_restart_within_the_step(make_env):
    env = make_env(3)
    rollout(env, 8)
    knock_over(env, 1)
    obs, *_ = env.step(torch.ones(3, 19))
    assert env.state.height[1] == pytest.approx(1.0305, abs=1e-4)
    now = newest(obs["policy"])
    assert not now["last_action"][1].any()
    assert now["last_action"][0].all()
    gravity = obs["policy"][1, 15:30].view(5, 3)
    assert torch.equal(gravity, gravity[:1].expand(5, 3))
    torch.testing.assert_close(now["joint_position"][1, 11:], env.motions.current().position[1])
    # The new episode starts as if its pose had always been the target.
    torch.testing.assert_close(env.targets.previous[1], env.sim.qpos[1, 7:].float())
    # The record that rewards were given for, and metrics read, is still that of the step.
    assert (env.record.action == 1.0).all()
    assert env.record.state.projected_gravity_t[1, 2] > -0.5 > env.state.projected_gravity_t[1, 2]


def test_after_a_restart_every_world_is_seen_as_it_is(make_env):
    """Only worlds that restart are read again."""
    env = make_env(3)
    rollout(env, 8)
    knock_over(env, 1)
    env.step(torch.ones(3, 19))
    seen, there = dataclasses.asdict(env.state), dataclasses.asdict(env.reader.read())
    torch.testing.assert_close(seen, there, atol=0.0, rtol=0.0)


def test_a_restarted_world_owes_nothing_to_its_past(make_env):
    """The critic of a new episode sees no force of the old one."""
    env = make_env(2, hand_forces=HandForceConfig(curriculum_start=1.0))
    rollout(env, 3)
    assert env._hand_force_w[1].any()
    knock_over(env, 1)
    obs, *_ = env.step(torch.zeros(2, 19))
    assert not obs["privileged"][1, 7:].any()
    assert obs["privileged"][0, 7:].any()


def test_restarts_face_every_way(make_env):
    env = make_env(32)
    yaw = torch.atan2(env.state.heading_w[:, 1, 0], env.state.heading_w[:, 0, 0])
    assert float(yaw.min()) < -2.0
    assert float(yaw.max()) > 2.0


@pytest.mark.usefixtures("in_tmp_path")
@pytest.mark.parametrize("field", ["qpos", "qvel"])
def test_a_diverged_world_is_ended_and_counted_and_harms_no_other(make_env, field):
    env, twin = make_env(4), make_env(4)
    rollout(env, 5)
    rollout(twin, 5)
    getattr(env.sim, field)[2, 10] = math.nan
    obs, reward, done, extras = env.step(torch.zeros(4, 19))
    twin_obs, twin_reward, *_ = twin.step(torch.zeros(4, 19))
    assert done.tolist() == extras["falls"].tolist() == [False, False, True, False]
    assert not extras["time_outs"].any()
    assert env.num_diverged == 1
    assert extras["log"]["/episode/diverged"] == 1.0
    assert all(math.isfinite(float(v)) for v in extras["log"].values())
    assert reward[2] == 0.0
    assert torch.isfinite(extras["group_rewards"]).all()
    others = [0, 1, 3]
    assert torch.equal(reward[others], twin_reward[others])
    for group in ("policy", "privileged"):
        assert torch.isfinite(obs[group]).all()
        assert torch.equal(obs[group][others], twin_obs[group][others])
    assert env.state.height[2] == pytest.approx(1.0305, abs=1e-4)
    assert torch.isfinite(rollout(env, 5)).all()
    assert env.num_diverged == 1


@pytest.mark.usefixtures("in_tmp_path")
def test_even_if_all_worlds_diverge_the_log_is_finite(make_env):
    env = make_env(2)
    env.sim.qvel[:, 0] = math.nan
    _, reward, done, extras = env.step(torch.zeros(2, 19))
    assert done.all()
    assert not reward.any()
    assert env.num_diverged == 2
    assert all(math.isfinite(float(v)) for v in extras["log"].values())


def test_falling_and_lasting_move_the_force_curriculum(make_env):
    env = make_env(2, terminations=TerminationConfig(episode_s=0.2), hand_forces=HandForceConfig(curriculum_start=0.5))
    knock_over(env, 1)
    env.step(torch.zeros(2, 19))
    torch.testing.assert_close(env.hand_forces.scale, torch.tensor([0.5, 0.3]))
    for _ in range(9):
        env.step(torch.zeros(2, 19))
    torch.testing.assert_close(env.hand_forces.scale, torch.tensor([0.55, 0.3]))


def test_log_measures_the_slope_of_measured_against_commanded(make_env):
    env = make_env(2, commands=CommandConfig(stand_probability=0.0))
    env.step(torch.zeros(2, 19))
    measured = env.state.torso_linear_velocity_h[:, :2]
    zero = torch.zeros(2)
    walk = torch.tensor([[1.0, 0.0], [-0.5, 0.2]])
    env.commands.override(walk, zero + 0.3, zero, zero + 1.0205)
    env.commands.set_velocity(walk, zero + 0.3, torch.ones(2, dtype=torch.bool))
    _, _, done, extras = env.step(torch.zeros(2, 19))
    assert not done.any()
    measured = env.state.torso_linear_velocity_h[:, 0]
    expected = float((measured[0] * 1.0 - 0.5 * measured[1]) / 1.25)
    assert float(extras["log"]["/command/slope_x"]) == pytest.approx(expected, abs=1e-5)
    assert float(extras["log"]["/command/slope_yaw"]) == pytest.approx(float(env.state.yaw_rate.mean()) / 0.3, abs=1e-4)


def test_key_points_move_as_their_velocities_say(make_env):
    """Finite differences of hands and elbows in the torso frame, along random arm rates."""
    env = make_env(3)
    rng = torch.Generator().manual_seed(2)
    q, rate = torch.randn(2, 3, 2, 4, generator=rng)
    eps = 1e-2
    chains = env.reader.arm_chains
    points, velocities = env._key_points(chains.pose(q), rate)
    after, before = (env._key_points(chains.pose(q + s * eps * rate), rate)[0] for s in (1, -1))
    torch.testing.assert_close(velocities, (after - before) / (2 * eps), atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(points[:, :2], chains.pose(q).tip)
    model, data = env.sim.model, mujoco.MjData(env.sim.model)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[18:26] = q[0].flatten()
    mujoco.mj_kinematics(model, data)
    for i, side in enumerate(("left", "right")):
        np.testing.assert_allclose(points[0, 2 + i], data.body(f"{side}_elbow_link").xpos, atol=1e-5)


def test_layout_names_what_a_policy_must_agree_with(make_env):
    layout = make_env(1).layout()
    assert layout["robot"] == "h1"
    assert layout["joints"][10] == "torso"
    assert layout["history"] == 5
    assert layout["actions"]["lower_scale"] == 0.25


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"num_envs": 0}, "num_envs must be a positive integer, got 0"),
        ({"robot": "h2"}, "robot 'h2' is unknown; known: h1"),
        ({"collision": "none"}, "collision 'none' is unknown; known: feet, full"),
        ({"control_dt": math.nan}, "control_dt must be a finite number, got nan"),
        ({"substeps": -2}, "substeps must be a positive integer"),
        ({"torque_limit_scale": 0.0}, "torque_limit_scale must lie in"),
        (
            {"actions": ActionConfig(upper_mode="both")},
            "actions.upper_mode 'both' is unknown; known: absolute, residual",
        ),
        ({"randomization": RandomizationConfig(delay_s=(0.0, 0.5))}, r"randomization.delay_s\[1\] must lie in"),
    ],
)
def test_bad_configs_are_refused_by_name(make_env, fields, match):
    with pytest.raises(ValueError, match=match):
        make_env(**{"num_envs": 1, **fields})


def test_default_config_is_fresh():
    assert H1EnvConfig().commands is not H1EnvConfig().commands
