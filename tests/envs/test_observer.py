"""What is observed, term by term against MuJoCo; its history, its noise, and who sees what."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from env_tools import NOISY, drive, history_of, mujoco_of, newest, one_step, privileged, zeros

from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.hand_loads import HandLoadConfig
from cotap.envs.observations import NoiseConfig, ObservationConfig, critic_terms

LOADED = ExternalForceConfig(hand_loads=HandLoadConfig(enabled=True, episode_share=1.0, zero_probability=0.0))


def torso_of(model, data, body: str) -> dict[str, np.ndarray]:
    """Rotation, angular velocity in the body's frame, the heading frame, and the velocity there, of MuJoCo's."""
    twist, rotation = np.zeros(6), data.body(body).xmat.reshape(3, 3)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(body).id, twist, 0)
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    heading = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    spin, velocity = rotation.T @ twist[:3], heading.T @ twist[3:]
    return {"rotation": rotation, "spin": spin, "heading": heading, "velocity": velocity}


def test_every_term_is_what_it_names(make_env, robot):
    env = make_env(4, robot=robot)
    drive(env, 11)
    action = torch.linspace(-0.5, 0.5, 4 * env.num_actions).reshape(4, -1)
    obs, _, done, _ = env.step(action)
    assert not done.any()
    got, c = newest(env, obs["policy"]), env.commands.current()
    walking, angle = 1 - c.stand, 2 * math.pi * c.phase
    expected = {
        "command_velocity": c.velocity_h,
        "command_yaw_rate": c.yaw_rate[:, None],
        "command_stand": c.stand[:, None],
        "command_height": c.height[:, None],
        "reference_arm_position": env.motions.current().position,
        "joint_position": env.sim.qpos[:, 7:].float() - torch.tensor([j.default_rad for j in env.spec.joints]),
        "joint_velocity": env.sim.qvel[:, 6:].float(),
        "last_action": action,
        "sin_phase": (walking * torch.sin(angle))[:, None],
        "cos_phase": (walking * torch.cos(angle))[:, None],
    }
    for name, value in expected.items():
        torch.testing.assert_close(got[name], value, atol=1e-5, rtol=1e-5, msg=lambda m, name=name: f"{name}: {m}")
    assert got.keys() - expected.keys() == {"torso_angular_velocity", "projected_gravity", "arm_torque"}
    assert 0 < float(walking.sum()) <= 4
    for i in range(4):
        model, data = mujoco_of(env, i)
        torso = torso_of(model, data, env.spec.torso_body)
        np.testing.assert_allclose(got["torso_angular_velocity"][i], torso["spin"], atol=1e-4)
        np.testing.assert_allclose(got["projected_gravity"][i], torso["rotation"].T @ [0.0, 0.0, -1.0], atol=1e-5)
        np.testing.assert_allclose(got["arm_torque"][i], data.actuator_force[env.num_lower :], atol=2e-3)


def test_what_only_critics_see_is_what_it_names(make_env, robot):
    env = make_env(4, robot=robot, forces=LOADED)
    drive(env, 10)
    obs, _, done, _ = env.step(zeros(env))
    assert not done.any()
    got = privileged(env, obs["privileged"])
    names = [name for name, _, _ in critic_terms(2, num_feet=2)]
    assert list(got) == names
    assert names[:3] == ["torso_orientation", "torso_linear_velocity", "hand_force"]
    for i in range(4):
        model, data = mujoco_of(env, i)
        torso = torso_of(model, data, env.spec.torso_body)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, (torso["heading"].T @ torso["rotation"]).flatten())
        assert abs(float(got["torso_orientation"][i].double() @ torch.tensor(quat))) == pytest.approx(1.0, abs=1e-5)
        np.testing.assert_allclose(got["torso_linear_velocity"][i], torso["velocity"], atol=1e-4)
        force_h = env.hand_force_w[i].numpy() @ torso["heading"]
        np.testing.assert_allclose(got["hand_force"][i].reshape(-1, 3), force_h, atol=1e-3)
        height = data.body(env.spec.torso_body).xpos[2]
        assert float(got["torso_height"][i]) == pytest.approx(height, abs=1e-5)
    assert env.hand_force_w.norm(dim=2).min() > 1.0
    torch.testing.assert_close(got["mean_error"], env.record.mean_error)
    assert torch.equal(got["foot_contact"], env.state.foot_contact.float())
    torch.testing.assert_close(got["foot_height"], env.state.foot_pos_w[:, :, 2])
    ahead = [got[name] for name in names[names.index("push_nearness") :]]
    torch.testing.assert_close(torch.cat(ahead, 1), env.forces.ahead(env.state.heading_w, env.curriculum.samples))
    assert got["coming_load"].abs().amax(1).min() > 0.0


def test_scales_are_the_papers(make_env):
    """The observation itself, by hand for the H1: columns of the present step."""
    env = make_env(2)
    obs, *_ = env.step(zeros(env) + 0.4)
    present, s, c = obs["present"], env.state, env.commands.current()
    torch.testing.assert_close(present[:, 0:3], 0.25 * s.torso_angular_velocity_t)
    torch.testing.assert_close(present[:, 3:6], s.projected_gravity_t)
    torch.testing.assert_close(present[:, 10], 2.0 * c.height)
    torch.testing.assert_close(present[:, 38:57], 0.05 * s.joint_vel)
    torch.testing.assert_close(present[:, 57:76], torch.full((2, 19), 0.4))
    torch.testing.assert_close(obs["privileged"][:, 4:7], 2.0 * s.torso_linear_velocity_h)


def test_history_holds_the_last_steps_oldest_first(make_env, robot):
    env = make_env(2, robot=robot, observations=ObservationConfig(history=3))
    seen = {name: [v[:, -1]] * 3 for name, v in history_of(env, env.get_observations()["policy"]).items()}
    for i in range(7):
        obs, _, done, _ = env.step(zeros(env) + 0.1 * i)
        assert not done.any()
        history = history_of(env, obs["policy"])
        for name, value in one_step(env, obs["present"]).items():
            seen[name] = [*seen[name][1:], value]
            assert torch.equal(history[name], torch.stack(seen[name], 1)), name
    assert (seen["last_action"][0] < seen["last_action"][1]).all()
    assert (seen["last_action"][1] < seen["last_action"][2]).all()


@pytest.mark.parametrize(
    ("noise", "critic", "expected"),
    [(False, "present", "present"), (True, "present", "present"), (False, "history", "policy"),
     (True, "history", "clean")],
)  # fmt: skip
def test_who_sees_what(make_env, robot, noise, critic, expected):
    observations = ObservationConfig(critic=critic, noise=NoiseConfig(enabled=noise))
    env = make_env(2, robot=robot, observations=observations)
    assert env.obs_groups == {"actor": ["policy"], "critic": [expected, "privileged"]}
    obs, *_ = env.step(zeros(env))
    assert set(obs.keys()) == {"policy", expected, "privileged"}


@pytest.mark.parametrize("critic", ["present", "history"])
def test_noise_is_for_actors_and_never_for_critics(make_env, robot, critic):
    env = make_env(8, robot=robot, observations=ObservationConfig(critic=critic, noise=NOISY.noise))
    drive(env, 7)
    obs, *_ = env.step(zeros(env))
    clean = one_step(env, obs["present"]) if critic == "present" else newest(env, obs["clean"])
    seen = newest(env, obs["policy"])
    torch.testing.assert_close(clean["projected_gravity"], env.state.projected_gravity_t)
    torch.testing.assert_close(clean["joint_velocity"], env.state.joint_vel, atol=1e-5, rtol=1e-5)
    bounds = {"torso_angular_velocity": 0.2, "projected_gravity": 0.05, "joint_position": 0.01, "joint_velocity": 1.0}
    for name in clean:
        error = seen[name] - clean[name]
        if name in bounds:
            assert 0.6 * bounds[name] < float(error.abs().max()) <= bounds[name] * 1.001 + 1e-5, name
            assert float(error.mean().abs()) < 0.4 * bounds[name], name
        else:
            assert not error.any(), name


def test_past_steps_keep_the_noise_that_they_had(make_env):
    env = make_env(3, observations=NOISY)
    before = history_of(env, env.step(zeros(env))[0]["policy"])
    after = history_of(env, env.step(zeros(env))[0]["policy"])
    for name, values in before.items():
        assert torch.equal(after[name][:, :-1], values[:, 1:]), name


def test_a_clean_history_is_the_one_without_noise(make_env, robot):
    """The same robots with and without noisy sensors."""
    history = ObservationConfig(critic="history")
    noisy = make_env(3, robot=robot, observations=ObservationConfig(critic="history", noise=NOISY.noise))
    quiet = make_env(3, robot=robot, observations=history)
    quiet.load_state_dict(_without_noise(noisy.state_dict()))
    for _ in range(6):
        seen, *_ = noisy.step(zeros(noisy))
        there, *_ = quiet.step(zeros(quiet))
    torch.testing.assert_close(seen["clean"], there["policy"], atol=1e-6, rtol=0)
    assert not torch.equal(seen["policy"], there["policy"])


def _without_noise(state: dict) -> dict:
    """A noisy environment's state, for one without noise."""
    observer = dict(state["parts"]["observer"])
    observer["history"] = observer.pop("clean")
    observations = dict(state["observations"])
    observations["policy"] = observations.pop("clean")
    return state | {"parts": state["parts"] | {"observer": observer}, "observations": observations}
