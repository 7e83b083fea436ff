"""The environment as a whole: the order of a step, how episodes end and begin, and what one env's trouble harms."""

from __future__ import annotations

import copy
import dataclasses
import math

import pytest
import torch
from env_tools import (
    NOISY,
    NOMINAL,
    drive,
    history_of,
    hold_still,
    knock_over,
    mujoco_of,
    newest,
    privileged,
    rollout,
    zeros,
)
from robots.joints import called

from cotap.compliance.laws import LawConfig
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.actions import ActionConfig
from cotap.envs.commands import CommandConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.hand_loads import HandLoadConfig
from cotap.envs.observations import ObservationConfig
from cotap.envs.path_following import PathConfig
from cotap.envs.pushes import PushConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.terminations import TerminationConfig
from cotap.envs.upper_body import UpperBodyConfig


def finite(log: dict[str, torch.Tensor]) -> bool:
    return all(math.isfinite(float(value)) for value in log.values())


def test_sizes_follow_the_robot(make_env, any_spec):
    env = make_env(3, robot=any_spec.name)
    joints, lower = len(any_spec.joints), len(any_spec.lower_joints)
    assert env.num_actions == joints
    assert env.action_slices == {"lower": slice(0, lower), "upper": slice(lower, joints)}
    obs = env.get_observations()
    width = sum(width for _, width, _ in env.observer.history.terms)
    hands, feet = len(any_spec.arms), len(any_spec.feet)
    # Orientation, velocity, averaged error, height; the next push and the next load; forces on hands, and feet.
    critic = 4 + 3 + 3 + 1 + (6 + hands) + (1 + 3 * hands) + 3 * hands + 2 * feet
    sizes = {"policy": (3, 5 * width), "present": (3, width), "privileged": (3, critic)}
    assert {k: tuple(v.shape) for k, v in obs.items()} == sizes
    assert env.max_episode_length == 1000
    _, reward, done, extras = env.step(zeros(env))
    assert reward.shape == done.shape == extras["time_outs"].shape == extras["falls"].shape == (3,)
    assert extras["group_rewards"].shape == (3, len(env.reward_groups))
    torch.testing.assert_close(extras["group_rewards"].sum(1), reward)
    assert finite(extras["log"])


def test_sizes_of_the_h1_are_the_papers(make_env):
    env = make_env(2)
    assert env.action_slices == {"lower": slice(0, 11), "upper": slice(11, 19)}
    paper = make_env(2, observations=ObservationConfig(critic="history"))
    assert {k: v.shape[1] for k, v in paper.get_observations().items()} == {"policy": 430, "privileged": 13}
    assert env.get_observations()["present"].shape[1] == 86
    assert sum(paper.get_observations()[g].shape[1] for g in paper.obs_groups["critic"]) == 443


@pytest.mark.parametrize(("seconds", "steps"), [(0.14, 7), (0.3, 15), (0.31, 16), (20.0, 1000)])
def test_episodes_are_as_many_steps_as_their_time(make_env, seconds, steps):
    assert make_env(1, terminations=TerminationConfig(episode_s=seconds)).max_episode_length == steps


def test_one_seed_is_one_future(make_env, robot):
    a, b, c = (make_env(4, robot=robot, seed=s, observations=NOISY) for s in (5, 5, 6))
    first, ended = rollout(a, 60, scale=3.0)
    assert ended.any()  # restarts are covered too
    assert torch.equal(first, rollout(b, 60, scale=3.0)[0])
    assert not torch.equal(first[0], rollout(c, 1, scale=3.0)[0][0])


def test_envs_can_start_all_alike(make_env, robot):
    env = make_env(3, robot=robot, randomization=NOMINAL)
    assert (env.sim.qpos[0] - env.sim.qpos[1]).abs().max() > 1e-3
    first = env.reset_identical(7)["policy"].clone()
    assert torch.equal(first[1:], first[:1].expand(2, -1))
    assert torch.equal(env.sim.qpos[1:], env.sim.qpos[:1].expand(2, -1))
    assert torch.equal(env.reset_identical(7)["policy"], first)
    assert not torch.equal(env.reset_identical(8)["policy"], first)


def test_a_restart_puts_the_base_at_its_height(make_env, robot):
    env = make_env(8, robot=robot)
    expected = torch.full((8,), env.spec.base_height_m + 0.01, dtype=torch.float64)
    torch.testing.assert_close(env.sim.qpos[:, 2], expected)
    for i in range(8):
        _, data = mujoco_of(env, i)
        torso = data.body(env.spec.torso_body)
        assert float(env.state.height[i]) == pytest.approx(torso.xpos[2], abs=1e-5)
        lowest = min(data.site(f"{foot.side}_foot").xpos[2] for foot in env.spec.feet)
        assert -0.01 < lowest < 0.03
    # Legs and waist begin within 0.05 rad of the default pose, which lowers a torso by little.
    assert (env.state.height - env.spec.nominal_height_m).abs().max() < 0.02


def test_base_and_torso_are_two_bodies(make_env):
    env = make_env(2, robot="made-up", randomization=NOMINAL)
    assert env.spec.nominal_height_m - env.spec.base_height_m > 0.05
    hold_still(env)
    env.reset()
    for _ in range(40):
        *_, extras = env.step(zeros(env))
    assert (env.state.height - env.sim.qpos[:, 2].float()).min() > 0.05
    assert float(extras["log"]["/command/error_height"]) < 0.03  # of the torso's height, not the base's


def test_restarts_face_every_way(make_env, robot):
    env = make_env(32, robot=robot)
    yaw = torch.atan2(env.state.heading_w[:, 1, 0], env.state.heading_w[:, 0, 0])
    assert float(yaw.min()) < -2.0
    assert float(yaw.max()) > 2.0


def test_falls_and_time_outs_are_told_apart(make_env, robot):
    env = make_env(3, robot=robot, terminations=TerminationConfig(episode_s=0.1))
    knock_over(env, 1)
    _, _, done, extras = env.step(zeros(env))
    assert done.tolist() == extras["falls"].tolist() == [False, True, False]
    assert not extras["time_outs"].any()
    assert env.episode_length_buf.tolist() == [1, 0, 1]
    for _ in range(3):
        _, _, done, extras = env.step(zeros(env))
        assert not done.any()
    _, _, done, extras = env.step(zeros(env))
    assert done.tolist() == extras["time_outs"].tolist() == [True, False, True]
    assert not extras["falls"].any()
    _, _, done, _ = env.step(zeros(env))
    assert done.tolist() == [False, True, False]


def test_a_fall_at_the_last_step_is_a_fall(make_env):
    env = make_env(2, terminations=TerminationConfig(episode_s=0.02))
    knock_over(env, 1)
    _, _, done, extras = env.step(zeros(env))
    assert done.all()
    assert extras["falls"].tolist() == [False, True]
    assert extras["time_outs"].tolist() == [True, False]


def test_a_fall_is_too_low_for_this_robot(make_env, robot):
    """At nine tenths of its own height: one robot stands, the other squats, feet above the floor."""
    env = make_env(2, robot=robot, randomization=NOMINAL, terminations=TerminationConfig(min_height=0.9))
    joints = called(env.spec, "left_hip_pitch", "right_hip_pitch", "left_knee", "right_knee")
    env.sim.qpos[1, 7 + torch.tensor(env.spec.indices(joints))] = torch.tensor([-0.9, -0.9, 1.8, 1.8]).double()
    _, data = mujoco_of(env, 1)
    env.sim.qpos[1, 2] -= min(data.site(f"{foot.side}_foot").xpos[2] for foot in env.spec.feet) - 0.02
    env.state = env.reader.read()
    assert 0.5 < float(env.state.height[1] / env.spec.nominal_height_m) < 0.88
    _, _, _, extras = env.step(zeros(env))
    assert extras["falls"].tolist() == [False, True]


def test_ended_envs_restart_within_the_step(make_env, robot):
    env = make_env(3, robot=robot)
    drive(env, 8)
    knock_over(env, 1)
    obs, *_ = env.step(zeros(env) + 1.0)
    assert float(env.sim.qpos[1, 2]) == pytest.approx(env.spec.base_height_m + 0.01)
    now = newest(env, obs["policy"])
    assert not now["last_action"][1].any()
    assert now["last_action"][0].all()
    assert not now["arm_torque"][1].any()
    for values in history_of(env, obs["policy"]).values():
        assert torch.equal(values[1], values[1, :1].expand_as(values[1]))
    arms = now["joint_position"][1] + env.joint_targets.default
    torch.testing.assert_close(arms[env.num_lower :], env.motions.current().position[1])
    # The record that rewards were given for, and metrics read, is still that of the step.
    assert (env.record.action == 1.0).all()
    assert env.record.state.projected_gravity_t[1, 2] > -0.5 > env.state.projected_gravity_t[1, 2]


def test_after_a_restart_every_env_is_seen_as_it_is(make_env, robot):
    """Only envs that restart are read again."""
    env = make_env(3, robot=robot)
    drive(env, 8)
    knock_over(env, 1)
    env.step(zeros(env) + 1.0)
    seen, there = dataclasses.asdict(env.state), dataclasses.asdict(env.reader.read())
    torch.testing.assert_close(seen, there, atol=0.0, rtol=0.0)


def test_a_restart_leaves_other_envs_alone(make_env, robot):
    """Their future is the one that they have where no other falls, noise and draws aside."""
    env, twin = (make_env(3, robot=robot, randomization=NOMINAL) for _ in range(2))
    for e in (env, twin):
        hold_still(e)
        e.reset()
    drive(env, 4)
    drive(twin, 4)
    knock_over(env, 1)
    others = [0, 2]
    for step in range(6):
        obs, reward, done, _ = env.step(zeros(env))
        same, same_reward, *_ = twin.step(zeros(twin))
        assert done.tolist() == [False, step == 0, False]
        assert torch.equal(obs["policy"][others], same["policy"][others])
        assert torch.equal(reward[others], same_reward[others])


def test_a_restarted_env_owes_nothing_to_its_past(make_env, robot):
    """The critic of a new episode sees no force of the old one."""
    loads = HandLoadConfig(enabled=True, episode_share=1.0, zero_probability=0.0)
    env = make_env(2, robot=robot, forces=ExternalForceConfig(hand_loads=loads))
    drive(env, 3)
    assert env.hand_force_w[1].any()
    knock_over(env, 1)
    obs, *_ = env.step(zeros(env))
    forces = privileged(env, obs["privileged"])["hand_force"]
    assert not forces[1].any()
    assert forces[0].any()
    assert not env.recorder.mean_error[1].any()
    assert env.recorder.mean_error[0].any()


def test_critics_see_the_same_wherever_north_is(make_env, robot):
    """Turned about the vertical, with the same forces in the heading frame, a robot looks the same to its critic."""
    loads = HandLoadConfig(enabled=True, episode_share=1.0, zero_probability=0.0)
    env = make_env(2, robot=robot, forces=ExternalForceConfig(hand_loads=loads), randomization=NOMINAL)
    drive(env, 3)
    s, force_w = env.state, env.hand_force_w
    turn = torch.tensor([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    turned = dataclasses.replace(s, torso_rotation_w=turn @ s.torso_rotation_w, heading_w=turn @ s.heading_w)
    seen = []
    for env.state, env.forces.hand_force_w in ((s, force_w), (turned, force_w @ turn.T)):
        observed = env._observe(torch.zeros(2, dtype=torch.bool))
        seen.append(privileged(env, observed["privileged"]))
    assert force_w.norm(dim=2).min() > 1.0
    by_hand = torch.einsum("nwh,naw->nah", s.heading_w, force_w).flatten(1)
    torch.testing.assert_close(seen[0]["hand_force"], by_hand, atol=1e-4, rtol=1e-5)
    for name, value in seen[0].items():
        torch.testing.assert_close(seen[1][name], value, atol=1e-4, rtol=1e-5)


@pytest.mark.usefixtures("in_tmp_path")
@pytest.mark.parametrize("field", ["qpos", "qvel"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_diverged_env_ends_and_harms_no_other(make_env, robot, field, value):
    env, twin = make_env(4, robot=robot), make_env(4, robot=robot)
    drive(env, 5)
    drive(twin, 5)
    getattr(env.sim, field)[2, 10] = value
    obs, reward, done, extras = env.step(zeros(env))
    twin_obs, twin_reward, *_ = twin.step(zeros(twin))
    assert done.tolist() == extras["falls"].tolist() == [False, False, True, False]
    assert not extras["time_outs"].any()
    assert env.num_diverged == 1
    assert extras["log"]["/episode/diverged"] == 1.0
    assert finite(extras["log"])
    assert reward[2] == 0.0
    assert torch.isfinite(extras["group_rewards"]).all()
    others = [0, 1, 3]
    assert torch.equal(reward[others], twin_reward[others])
    for group, observed in obs.items():
        assert torch.isfinite(observed).all()
        assert torch.equal(observed[others], twin_obs[group][others])
    assert float(env.sim.qpos[2, 2]) == pytest.approx(env.spec.base_height_m + 0.01)
    assert torch.isfinite(rollout(env, 5)[0]).all()
    assert env.num_diverged == 1


@pytest.mark.usefixtures("in_tmp_path")
def test_a_diverged_env_begins_anew_with_all_at_work(make_env, robot):
    """Whatever carries something from step to step forgets it: paths, laws that remember, estimates, loads, pushes."""
    facet = LawConfig("facet", sensing="estimated")
    env = make_env(
        3, robot=robot, path=PathConfig(share=1.0), upper_body=UpperBodyConfig(facet, copy.copy(facet)),
        forces=ExternalForceConfig(
            hand_loads=HandLoadConfig(enabled=True), pushes=PushConfig(enabled=True, interval_s=(0.12, 0.2))
        ), observations=NOISY,
    )  # fmt: skip
    drive(env, 4)
    env.sim.qpos[1, 3] = math.nan
    _, _, done, extras = env.step(zeros(env))
    assert done[1]
    assert finite(extras["log"])
    assert torch.isfinite(rollout(env, 20)[0]).all()
    assert env.num_diverged == 1


@pytest.mark.usefixtures("in_tmp_path")
def test_logs_stay_finite_even_if_all_envs_diverge(make_env, robot):
    env = make_env(2, robot=robot)
    env.sim.qvel[:, 0] = math.nan
    _, reward, done, extras = env.step(zeros(env))
    assert done.all()
    assert not reward.any()
    assert env.num_diverged == 2
    assert finite(extras["log"])


def test_samples_count_envs_of_all_processes():
    env = HumanoidEnv(HumanoidEnvConfig(num_envs=3, num_threads=1), processes=4)
    drive(env, 5)
    assert env.samples == 5 * 3 * 4
    with pytest.raises(ValueError, match="processes must be a positive integer"):
        HumanoidEnv(HumanoidEnvConfig(num_envs=1), processes=0)


def test_a_reward_is_the_weighted_sum_of_its_logged_terms(make_env, robot):
    env = make_env(3, robot=robot)
    drive(env, 3)
    *_, extras = env.step(zeros(env) + 0.3)
    for i, group in enumerate(env.reward_groups):
        terms = [float(v) for k, v in extras["log"].items() if k.startswith(f"/{group}/")]
        assert len(terms) > 9
        assert sum(terms) == pytest.approx(float(extras["group_rewards"][:, i].mean()), abs=1e-5)


def test_a_fall_is_paid_for_once(make_env, robot):
    env = make_env(2, robot=robot)
    knock_over(env, 1)
    *_, extras = env.step(zeros(env))
    assert float(extras["log"]["/lower/fall"]) == pytest.approx(0.5 * -50.0)
    assert float(extras["log"]["/lower/alive"]) == pytest.approx(0.5 * 0.3 * 0.02)


def test_the_log_has_the_slope_of_measured_on_commanded(make_env, robot):
    env = make_env(2, robot=robot, commands=CommandConfig(stand_probability=0.0))
    env.step(zeros(env))
    zero = torch.zeros(2)
    walk = torch.tensor([[1.0, 0.0], [-0.5, 0.2]])
    env.commands.override(walk, zero + 0.3, zero, zero + env.spec.nominal_height_m)
    env.commands.set_velocity(walk, zero + 0.3, torch.ones(2, dtype=torch.bool))
    _, _, done, extras = env.step(zeros(env))
    assert not done.any()
    measured = env.state.torso_linear_velocity_h[:, 0]
    expected = float((measured[0] * 1.0 - 0.5 * measured[1]) / 1.25)
    assert float(extras["log"]["/command/slope_x"]) == pytest.approx(expected, abs=1e-5)
    assert float(extras["log"]["/command/slope_yaw"]) == pytest.approx(float(env.state.yaw_rate.mean()) / 0.3, abs=1e-4)


def test_the_layout_names_what_a_policy_must_agree_with(make_env, any_spec):
    layout = make_env(1, robot=any_spec.name).layout()
    assert layout["robot"] == any_spec.name
    assert layout["joints"] == list(any_spec.joint_names)
    assert layout["history"] == 5
    assert layout["control_dt"] == 0.02
    assert layout["actions"]["lower_scale"] == 0.6
    assert [name for name, _, _ in layout["terms"]][:2] == ["torso_angular_velocity", "projected_gravity"]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_actions_that_are_not_finite_are_refused(make_env, robot, value):
    env = make_env(2, robot=robot)
    bad = zeros(env)
    bad[1, 4] = value
    before = env.sim.snapshot().state
    with pytest.raises(ValueError, match=rf"actions must be finite, got {value} at index \(1, 4\)"):
        env.step(bad)
    assert torch.equal(env.sim.snapshot().state, before)


def test_actions_of_another_shape_are_refused(make_env, any_spec):
    joints = len(any_spec.joints)
    with pytest.raises(ValueError, match=rf"actions must have shape \(2, {joints}\), got \(2, {joints - 1}\)"):
        make_env(2, robot=any_spec.name).step(torch.zeros(2, joints - 1))


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"num_envs": 0}, "num_envs must be a positive integer, got 0"),
        ({"robot": "h2"}, "robot 'h2' is unknown; known: g1, h1"),
        ({"collision": "none"}, "collision 'none' is unknown; known: feet, full"),
        ({"control_dt": math.nan}, "control_dt must be a finite number, got nan"),
        ({"substeps": -2}, "substeps must be a positive integer"),
        ({"torque_limit_scale": 0.0}, "torque_limit_scale must lie in"),
        ({"unevenness_m": -0.1}, "unevenness_m must lie in"),
        (
            {"actions": ActionConfig(upper_mode="both")},
            "actions.upper_mode 'both' is unknown; known: absolute, residual",
        ),
        ({"randomization": RandomizationConfig(delay_s=(0.0, 0.5))}, r"randomization.delay_s\[1\] must lie in"),
        ({"forces": ExternalForceConfig(pushes=PushConfig(hand_share=2.0))}, "pushes.hand_share must lie in"),
        ({"observations": ObservationConfig(critic="all")}, "observations.critic 'all' is unknown"),
        ({"path": PathConfig(leash_m=0.0)}, "path.leash_m must lie in"),
    ],
)
def test_bad_configs_are_refused_by_name(make_env, fields, match):
    with pytest.raises(ValueError, match=match):
        make_env(**{"num_envs": 1, **fields})


def test_every_default_config_is_fresh():
    one, other = HumanoidEnvConfig(), HumanoidEnvConfig()
    for field in dataclasses.fields(one):
        if dataclasses.is_dataclass(value := getattr(one, field.name)):
            assert value is not getattr(other, field.name)
