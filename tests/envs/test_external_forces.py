"""All that acts from outside, added up to one wrench per body, against MuJoCo's own map from forces to joints."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from env_tools import NOMINAL, at_point, drive, felt, mujoco_of, zeros

from cotap.envs.curriculum import AssistConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.hand_loads import HandLoadConfig
from cotap.envs.punches import PunchConfig
from cotap.envs.pushes import PushConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.robots.ground import HALF_EXTENT_M, bumps


def scripted(profile: ForceProfile) -> ExternalForceConfig:
    return ExternalForceConfig(scripted=profile)


def hands(env, model, data, index: int) -> np.ndarray:
    """Generalised forces (nv,) of the forces that the environment says are on the hands."""
    out = np.zeros(model.nv)
    for a, arm in enumerate(env.spec.arms):
        site = data.site(f"{arm.side}_hand").xpos
        out += at_point(model, data, arm.hand_body, site, env.hand_force_w[index, a].numpy())
    return out


def test_nothing_acts_without_a_source(make_env, robot):
    env = make_env(3, robot=robot)
    drive(env, 5)
    assert not env.sim.xfrc.any()
    assert not env.hand_force_w.any()


def test_hand_loads_act_at_the_hands(make_env, robot):
    loads = HandLoadConfig(enabled=True, episode_share=1.0, zero_probability=0.0)
    env = make_env(4, robot=robot, forces=ExternalForceConfig(hand_loads=loads))
    drive(env, 6)
    robots = [mujoco_of(env, i) for i in range(4)]
    env.step(zeros(env))
    for i, (model, data) in enumerate(robots):
        got = felt(model, data, env.sim.xfrc[i])
        np.testing.assert_allclose(got, hands(env, model, data, i), atol=3e-4)
        assert np.abs(got).max() > 1.0


def test_scripted_forces_turn_with_the_robot(make_env, robot):
    """Along the heading frame: what pulls forward pulls forward whichever way a robot faces."""
    env = make_env(6, robot=robot, forces=scripted(ForceProfile((10.0, 4.0, -7.0), "both", 0.0)))
    heading = env.state.heading_w
    env.step(zeros(env))
    expected = heading @ torch.tensor([10.0, 4.0, -7.0])
    for a in range(len(env.spec.arms)):
        torch.testing.assert_close(env.hand_force_w[:, a], expected)


def test_a_punch_acts_at_the_joint_that_is_struck(make_env, robot):
    """Every joint of the robot in turn, with a load in the hands."""
    n = len(make_env(1, robot=robot).spec.joints)
    load = ForceProfile((5.0, -3.0, -20.0), "both", 0.0)
    env = make_env(n, robot=robot, forces=ExternalForceConfig(punches=PunchConfig(600.0, first_s=0.0), scripted=load))
    drive(env, 2, scale=0.1)
    env.forces.punches.joint[:, 0] = torch.arange(n)
    env.forces.apply(env.sim.xfrc, env.state, torch.zeros(n), 0.0)
    _, punch_w = env.forces.punches.at(torch.zeros(n))
    assert (punch_w.norm(dim=1) > 90.0).all()
    for i, joint in enumerate(env.spec.joint_names):
        model, data = mujoco_of(env, i)
        link = model.joint(joint).bodyid[0]
        expected = hands(env, model, data, i)
        expected += at_point(model, data, model.body(link).name, data.joint(joint).xanchor, punch_w[i].numpy())
        np.testing.assert_allclose(felt(model, data, env.sim.xfrc[i]), expected, atol=1e-2)


def test_a_punch_is_over_when_it_is_over(make_env, robot):
    punches = PunchConfig(300.0, 0.04, 0.2, first_s=0.06)
    env = make_env(4, robot=robot, forces=ExternalForceConfig(punches=punches))
    struck = []
    for _ in range(10):
        env.step(zeros(env))
        struck.append(env.sim.xfrc.abs().amax((1, 2)) > 0.0)
    assert torch.stack(struck).T.tolist() == [[False] * 3 + [True] * 2 + [False] * 5] * 4


def test_all_sources_add_up(make_env, robot):
    """Loads, a push on a hand, one on the base, punches and a script, each against what it says of itself."""
    env = make_env(
        4, robot=robot, forces=ExternalForceConfig(
            HandLoadConfig(enabled=True, episode_share=1.0), PushConfig(enabled=True, episode_share=1.0),
            PunchConfig(200.0, first_s=0.0), ForceProfile((40.0, 0.0, 10.0), "left", 0.0, place="base"),
        ),
    )  # fmt: skip
    drive(env, 2, scale=0.1)
    sources, spec = env.forces, env.spec
    sources.pushes.place[:], sources.pushes._left_s[:] = torch.tensor([0, 1, 2, 3 + 4]), 1.0
    sources.pushes.force_w[:] = torch.tensor([50.0, -80.0, 10.0])
    env.forces.apply(env.sim.xfrc, env.state, torch.zeros(4), 0.0)
    base = spec.base_body
    for i in range(4):
        model, data = mujoco_of(env, i)
        expected = hands(env, model, data, i)
        joint, punch_w = (part[i] for part in sources.punches.at(torch.zeros(4)))
        struck = model.joint(spec.joint_names[joint])
        link = model.body(struck.bodyid[0]).name
        expected += at_point(model, data, link, data.joint(struck.name).xanchor, punch_w.numpy())
        on_base = env.state.heading_w[i] @ torch.tensor([40.0, 0.0, 10.0])
        expected += at_point(model, data, base, data.body(base).xipos, on_base.numpy())
        pushed = {0: base, 3: spec.bodies[4].name}.get(i)
        if pushed:
            expected += at_point(model, data, pushed, data.body(pushed).xipos, [50.0, -80.0, 10.0])
        np.testing.assert_allclose(felt(model, data, env.sim.xfrc[i]), expected, atol=2e-2)


def test_a_force_on_the_base_gives_its_momentum(make_env, robot):
    """In the air: 200 N for 0.1 s on the whole robot change its momentum by 20 Ns."""
    profile = ForceProfile((200.0, 0.0, 0.0), "left", 0.0, 0.1, place="base")
    envs = [make_env(2, robot=robot, forces=scripted(f), seed=3) for f in (profile, ForceProfile())]
    for env in envs:
        env.sim.qpos[:, 2] += 1.0
        env.state = env.reader.read()
    heading = envs[0].state.heading_w[:, :, 0]
    for _ in range(6):
        for env in envs:
            env.step(zeros(env))
    for i in range(2):
        momentum = []
        for env in envs:
            model, data = mujoco_of(env, i)
            mujoco.mj_subtreeVel(model, data)
            momentum.append(float(model.body_mass.sum()) * torch.as_tensor(data.subtree_linvel[1].copy()))
        change = momentum[0] - momentum[1]
        torch.testing.assert_close(change, 20.0 * heading[i].double(), atol=1.0, rtol=0.0)


def test_a_force_on_the_base_adds_to_assistance(make_env, robot):
    """Even where base and torso are one body."""
    profile = ForceProfile((50.0, -20.0, 10.0), "left", 0.0, place="base")
    wrench = []
    for force, assisted in ((profile, True), (ForceProfile(), True), (profile, False)):
        env = make_env(3, robot=robot, forces=scripted(force), assist=AssistConfig(enabled=assisted), seed=2)
        env.step(zeros(env))
        wrench.append(env.sim.xfrc.clone())
    both, assisted, pushed = wrench
    assert assisted.abs().amax((1, 2)).min() > 1.0
    assert pushed[:, :, :3].norm(dim=2).amax(1).min() > 50.0
    torch.testing.assert_close(both, assisted + pushed)


def test_bumps_are_gentle_and_within_their_height():
    height = bumps()
    assert height.min() == 0.0
    assert height.max() == 1.0
    slope = np.abs(np.diff(height, axis=1)).max() / (2 * HALF_EXTENT_M / (height.shape[1] - 1))
    assert 0.03 * slope < 0.25  # 3 cm of unevenness: no steeper than 14 degrees


def test_robots_start_on_bumps_at_different_places(make_env, robot):
    env = make_env(8, robot=robot, unevenness_m=0.03)
    xy = env.sim.qpos[:, :2]
    assert float(xy.std(0).min()) > 1.0
    assert float(xy.abs().max()) < HALF_EXTENT_M
    for _ in range(20):
        _, _, done, _ = env.step(zeros(env))
        assert not done.any()
    assert env.state.foot_contact.any(1).all()
    low = env.state.foot_pos_w[:, :, 2].amin(1)
    assert (low.abs() < 0.03).all()
    assert float(low.std()) > 1e-3  # they stand at different heights


def test_a_base_that_is_held_starts_where_it_is_held(make_env, robot):
    env = make_env(4, robot=robot, unevenness_m=0.03, fixed_base=True, randomization=NOMINAL)
    start = env.sim.qpos[:, :3].clone()
    for _ in range(10):
        env.step(zeros(env))
    torch.testing.assert_close(env.sim.qpos[:, :3], start, atol=2e-3, rtol=0)
    assert not start[:, :2].any()


def test_ground_is_flat_unless_asked(make_env):
    assert make_env(1).sim.model.nhfield == 0
    assert make_env(1, unevenness_m=0.02).sim.model.nhfield == 1


@pytest.mark.parametrize(
    ("cfg", "match"),
    [
        (ExternalForceConfig(hand_loads=HandLoadConfig(hold_s=(2.0, 1.0))), r"hand_loads\.hold_s"),
        (ExternalForceConfig(pushes=PushConfig(episode_share=2.0)), r"pushes\.episode_share"),
        (ExternalForceConfig(punches=PunchConfig(-1.0)), r"punches\.force_n"),
        (ExternalForceConfig(scripted=ForceProfile(hand="foot")), r"force\.hand"),
    ],
)
def test_every_source_is_checked(cfg, match):
    with pytest.raises(ValueError, match=match):
        cfg.check()
