"""Laws changed while they run, env by env and arm by arm."""

from __future__ import annotations

import pytest
import torch
from env_tools import NOMINAL, drive, mujoco_of, zeros

from cotap.compliance.laws import LAWS, LawConfig
from cotap.envs.randomization import RandomizationConfig


def test_a_law_set_in_one_env_and_arm_moves_only_that(make_env, robot):
    env, twin = (make_env(2, robot=robot, seed=3, randomization=NOMINAL, fixed_base=True) for _ in range(2))
    for e in (env, twin):
        e.motions.hold(e.motions.default)
        e.reset()
    env.set_law(1, 0, LawConfig("cotap", stiffness=(200.0, 300.0, 400.0), alpha=0.5))
    for _ in range(10):
        for e in (env, twin):
            e.step(zeros(e))
    assert env.upper_body.parameters.stiffness[1, 0].tolist() == [200.0, 300.0, 400.0]
    changed = (env.arm_stiffness() - twin.arm_stiffness()).abs().amax((2, 3))
    assert (changed > 1.0).tolist() == [[False, False], [True, False]]
    # Env 0 is under the same law as in the twin; only rounding may differ (its PD now runs as a law).
    joints = torch.tensor(env.spec.indices(env.spec.arms[0].joints))
    assert torch.allclose(env.state.joint_pos[0], twin.state.joint_pos[0], atol=2e-3)
    assert (env.state.joint_pos[1, joints] - twin.state.joint_pos[1, joints]).abs().max() > 5e-3


@pytest.mark.parametrize("randomized", [True, False])
def test_back_to_pd_actuators_are_the_robots_own(make_env, robot, randomized):
    env = make_env(2, robot=robot, randomization=RandomizationConfig(enabled=randomized))
    bias, gains = env.sim.field("actuator_biasprm").clone(), env.arm_stiffness()
    env.set_law(0, 1, LawConfig("soft-pd"))
    env.step(zeros(env))
    assert not torch.equal(env.sim.field("actuator_biasprm"), bias)
    assert torch.allclose(env.arm_stiffness()[0, 1], 30.0 * torch.eye(gains.shape[-1]))
    env.set_law(0, 1, LawConfig("pd"))
    assert not env.upper_body.active
    assert torch.equal(env.sim.field("actuator_biasprm"), bias)
    assert torch.equal(env.arm_stiffness(), gains)
    drive(env, 3)
    for i in range(2):
        _, data = mujoco_of(env, i)
        assert env.torque[i].tolist() == pytest.approx(data.actuator_force.tolist(), abs=3e-3)


def test_arm_stiffness_under_pd_is_the_joints_own(make_env, any_spec):
    env = make_env(1, robot=any_spec.name, randomization=NOMINAL)
    for a, arm in enumerate(any_spec.arms):
        kp = torch.tensor([any_spec.joint(name).kp for name in arm.joints])
        assert torch.allclose(env.arm_stiffness()[0, a], torch.diag(kp))


def test_a_law_set_twice_is_the_last_one(make_env, robot):
    env = make_env(1, robot=robot)
    for gain in (20.0, 50.0):
        env.set_law(0, 0, LawConfig("soft-pd", soft_gain=gain))
    env.step(zeros(env))
    size = len(env.spec.arms[0].joints)
    assert torch.allclose(env.arm_stiffness()[0, 0], 50.0 * torch.eye(size))
    assert len(env.upper_body._laws) == 2  # that one, and the other arm's PD


def test_a_law_that_is_set_survives_restarts(make_env, robot):
    env = make_env(2, robot=robot)
    env.set_law(1, 1, LawConfig("soft-pd", soft_gain=25.0))
    env.reset()
    env.step(zeros(env))
    size = len(env.spec.arms[0].joints)
    assert torch.allclose(env.arm_stiffness()[1, 1], 25.0 * torch.eye(size))
    assert not torch.allclose(env.arm_stiffness()[0, 1], 25.0 * torch.eye(size))


def test_a_law_out_of_range_changes_nothing(make_env, robot):
    env = make_env(1, robot=robot)
    before = env.upper_body.parameters.stiffness.clone()
    with pytest.raises(ValueError, match=r"stiffness\[1\]"):
        env.set_law(0, 0, LawConfig("facet", stiffness=(300.0, -1.0, 300.0)))
    assert torch.equal(env.upper_body.parameters.stiffness, before)
    assert not env.upper_body.active


def test_a_law_that_the_arms_cannot_have_changes_nothing(make_env, monkeypatch: pytest.MonkeyPatch):
    def refuse(arms, _):
        raise ValueError(f"needs three arms, got {len(arms.kp)}")

    monkeypatch.setitem(LAWS, "three-armed", refuse)
    env = make_env(2)
    before = env.upper_body.parameters.stiffness.clone()
    with pytest.raises(ValueError, match="needs three arms, got 2"):
        env.set_law(0, 0, LawConfig("three-armed", stiffness=(111.0, 111.0, 111.0)))
    assert torch.equal(env.upper_body.parameters.stiffness, before)
    assert not env.upper_body.active
    drive(env, 2)
