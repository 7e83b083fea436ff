"""Observations and laws as the ablations have them."""

from __future__ import annotations

import math

import pytest
import torch
from env_tools import drive, newest, privileged

from cotap.compliance import modulate_stiffness, resolve_joint_stiffness
from cotap.compliance.laws import LawConfig
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES
from cotap.envs.observations import ObservationConfig
from cotap.envs.upper_body import LawSampling, UpperBodyConfig


def test_arm_torque_moves_from_the_actor_to_the_critic(make_env, robot):
    usual, moved = (
        make_env(3, robot=robot, observations=ObservationConfig(arm_torque=seen)) for seen in ("actor", "critic")
    )
    for env in (usual, moved):
        drive(env, 2)
    one, two = usual.get_observations(), moved.get_observations()
    width = len(usual.spec.upper_joints)
    assert one["policy"].shape[1] - two["policy"].shape[1] == 5 * width
    torch.testing.assert_close(two["policy"], one["policy"][:, : -5 * width])
    torch.testing.assert_close(two["present"], one["present"][:, :-width])
    # The critic's: orientation, velocity, torque, forces.
    torque = newest(usual, one["policy"])["arm_torque"]
    assert torque.any()
    torch.testing.assert_close(privileged(moved, two["privileged"])["arm_torque"], torque)
    torch.testing.assert_close(two["privileged"][:, 7 + width :], one["privileged"][:, 7:])
    assert usual.layout()["terms"] != moved.layout()["terms"]
    assert ["arm_torque", width, 1.0] in moved.layout()["critic_terms"]


def test_goals_are_what_the_laws_are_asked_for(make_env, robot):
    left = LawConfig("facet", (300.0 * math.e, 300.0, 300.0 / math.e), 40.0 * math.e, 0.25)
    env = make_env(
        2, robot=robot, observations=ObservationConfig(goals=True), upper_body=UpperBodyConfig(left, LawConfig("pd"))
    )
    expected = [1.0, 0.0, -1.0, 1.0, 0.25, 0.0, 0.0, 0.0, 0.0, 1.0]
    obs = env.get_observations()
    goals = newest(env, obs["policy"])["goals"][0]
    assert goals.tolist() == pytest.approx(expected, abs=1e-5)
    assert obs["present"][0, -10:].tolist() == pytest.approx(expected, abs=1e-5)
    mirrored = newest(env, env.symmetry.observations["policy"](obs["policy"]))["goals"][0]
    assert mirrored.tolist() == pytest.approx([*expected[5:], *expected[:5]], abs=1e-5)


def test_goals_vary_where_they_are_drawn(make_env, robot):
    env = make_env(
        16, robot=robot, observations=ObservationConfig(goals=True),
        upper_body=UpperBodyConfig(sampling=LawSampling(True)),
    )  # fmt: skip
    assert float(env.get_observations()["policy"][:, -10:].std(0).min()) > 0.05


def test_without_the_ratio_alpha_alone_says_how_stiff_arms_are(make_env):
    """At an elbow angle with a condition number beyond 10, against the general form with the plain alpha."""
    law = LawConfig("cotap", (300.0, 200.0, 400.0), 30.0, 0.6)
    env = make_env(2, upper_body=UpperBodyConfig(law, law, singularity_ratio=False))
    with_ratio = make_env(2, upper_body=UpperBodyConfig(law, law))
    for e in (env, with_ratio):
        e.sim.qpos[:, 7 + 14] = e.sim.qpos[:, 7 + 18] = 1.4
        e.state = e.reader.read()
        e.upper_body.send(e.state, e.actuation.current[:, 11:], e.motions.current().velocity)
    s = env.state
    jacobian = (s.heading_w.transpose(1, 2) @ s.torso_rotation_w).unsqueeze(1) @ env.reader.arm_chains.jacobian(s.arms)
    jacobian = jacobian.double()
    k = resolve_joint_stiffness(jacobian, torch.tensor(law.stiffness).double().expand(2, 2, 3), 30.0)
    pd = 100.0 * torch.eye(4, dtype=torch.float64).expand_as(k)
    expected = modulate_stiffness(k, pd, torch.tensor(0.6, dtype=torch.float64).expand(2, 2)).float()
    torch.testing.assert_close(env.upper_body._stiffness[1], expected, rtol=2e-3, atol=0.05)
    assert (with_ratio.upper_body._stiffness[1] - expected).abs().max() > 1.0


def test_the_threshold_of_the_ratio_is_the_laws_own(make_env):
    """One that no arm reaches is none; arms of one environment may differ."""
    far = LawConfig("cotap", alpha=0.6, condition_threshold=1e9)
    stiffness = []
    for cfg in (
        UpperBodyConfig(far, LawConfig("cotap", alpha=0.6)),
        UpperBodyConfig(far, far, singularity_ratio=False),
    ):
        env = make_env(1, upper_body=cfg)
        env.sim.qpos[:, 7 + 14] = env.sim.qpos[:, 7 + 18] = 1.4
        env.state = env.reader.read()
        env.upper_body.send(env.state, env.actuation.current[:, 11:], env.motions.current().velocity)
        stiffness.append(env.upper_body.stiffness[0])
    torch.testing.assert_close(stiffness[0][0], stiffness[1][0])
    assert (stiffness[0][1] - stiffness[1][1]).abs().max() > 1.0
    with pytest.raises(ValueError, match=r"condition_threshold must lie in \[1.0"):
        LawConfig("cotap", condition_threshold=0.5).check()


def test_ablations_differ_from_the_quick_recipe_in_one_thing():
    base = BASE_RECIPES["default"]()
    expected = DISTILL_RECIPES["quick"](base)
    expected.env.observations.arm_torque = "critic"
    assert DISTILL_RECIPES["torque-critic"](base) == expected
    expected = DISTILL_RECIPES["quick"](base)
    expected.env.observations.goals = True
    assert DISTILL_RECIPES["goals"](base) == expected


def test_the_ratio_is_switched_off_by_its_recipe_alone():
    base = BASE_RECIPES["default"]()
    off = [name for name, make in DISTILL_RECIPES.items() if not make(base).env.upper_body.singularity_ratio]
    assert off == ["no-ratio"]
