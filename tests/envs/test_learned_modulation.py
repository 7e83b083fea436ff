"""What the upper agent's action sets of the arms' laws: bounds, rates, what zero means, what is observed of it."""

from __future__ import annotations

import math

import pytest
import torch
from env_tools import NOMINAL, STILL, history_of, newest, zeros

from cotap.compliance.laws import LawConfig
from cotap.configs import to_plain
from cotap.envs import HumanoidEnv
from cotap.envs.actions import ActionConfig
from cotap.envs.modulation import Modulation, ModulationConfig
from cotap.envs.upper_body import LawSampling, UpperBodyConfig

LEFT = LawConfig("cotap", (400.0, 300.0, 200.0), alpha=0.4)
RIGHT = LawConfig("cotap", (600.0, 300.0, 100.0), alpha=0.7)


def laws(kind: str, **fields) -> UpperBodyConfig:
    return UpperBodyConfig(LEFT, RIGHT, modulation=ModulationConfig(kind, **fields))


def asking(env: HumanoidEnv, **columns: float) -> torch.Tensor:
    """Actions of zero but for what is asked of the laws, by its place behind the joints' targets."""
    action = zeros(env)
    for name, value in columns.items():
        action[:, len(env.spec.joints) + int(name[1:])] = value
    return action


@pytest.mark.parametrize(("kind", "more"), [("none", 0), ("alpha", 2), ("stiffness", 8)])
def test_actions_and_terms_have_their_sizes(make_env, robot, kind, more):
    env = make_env(2, robot=robot, upper_body=laws(kind))
    joints, lower = len(env.spec.joints), len(env.spec.lower_joints)
    assert env.num_actions == joints + more
    assert env.action_slices == {"lower": slice(0, lower), "upper": slice(lower, joints + more)}
    shown = {name: width for name, width, _ in env.layout()["terms"] if name.startswith("law_")}
    assert shown == {"none": {}, "alpha": {"law_alpha": 2}, "stiffness": {"law_alpha": 2, "law_log_stiffness": 6}}[kind]
    assert ("modulation" in env.layout()) == (kind != "none")
    assert ["last_action", joints, 1.0] in env.layout()["terms"]


@pytest.mark.parametrize("kind", ["alpha", "stiffness"])
def test_a_zero_action_leaves_the_laws_as_they_are_configured(make_env, kind):
    """Step by step what a robot does whose laws nobody sets, to the rounding of a logarithm."""
    env, plain = (make_env(2, upper_body=laws(k), randomization=NOMINAL) for k in (kind, "none"))
    for _ in range(10):
        env.step(zeros(env))
        plain.step(zeros(plain))
    assert torch.equal(env.upper_body.parameters.alpha, plain.upper_body.parameters.alpha)
    torch.testing.assert_close(
        env.upper_body.parameters.stiffness, plain.upper_body.parameters.stiffness, rtol=1e-6, atol=0.0
    )
    torch.testing.assert_close(env.sim.qpos, plain.sim.qpos, rtol=0.0, atol=1e-5)


def test_parameters_go_where_actions_ask_at_their_rates(make_env):
    """By hand: alpha 0.4 plus 0.5 times 0.6, at 4 per second; the log of 100 N/m less 0.1, at 10 per second."""
    env = make_env(2, upper_body=laws("stiffness"))
    action = asking(env, c0=0.6, c7=-0.1, c5=9.0)  # left alpha, right z, right x
    p = env.upper_body.parameters
    seen = []
    for _ in range(12):
        env.step(action)
        seen.append((float(p.alpha[1, 0]), float(p.stiffness[1, 1, 2]), float(p.stiffness[1, 1, 0])))
    alpha, z, x = zip(*seen, strict=True)
    assert alpha == pytest.approx([min(0.4 + 0.08 * (k + 1), 0.7) for k in range(12)], abs=1e-6)
    assert z == pytest.approx([100.0 * math.exp(-0.1)] * 12, rel=1e-5)
    assert x == pytest.approx([min(600.0 * math.exp(0.2 * (k + 1)), 1200.0) for k in range(12)], rel=1e-5)
    torch.testing.assert_close(p.alpha[:, 1], torch.full((2,), 0.7))
    assert torch.equal(p.null_stiffness, torch.full((2, 2), 40.0))


def test_what_is_observed_is_what_was_asked_for(make_env):
    env = make_env(2, upper_body=laws("stiffness"))
    obs, *_ = env.step(asking(env, c0=-9.0, c1=9.0))
    now = newest(env, obs["policy"])
    assert now["law_alpha"][0].tolist() == pytest.approx([0.4 - 0.08, 0.7], abs=1e-6)
    logs = [math.log(400.0 / 300.0) + 0.2, 0.0, math.log(2.0 / 3.0), math.log(2.0), 0.0, -math.log(3.0)]
    assert now["law_log_stiffness"][0].tolist() == pytest.approx(logs, abs=1e-5)
    assert history_of(env, obs["policy"])["law_alpha"][0, :, 0].tolist() == pytest.approx([0.4] * 4 + [0.32], abs=1e-6)
    assert not now["last_action"].any()


@pytest.mark.parametrize("mode", ["residual", "absolute"])
def test_arms_are_sent_to_their_reference_whatever_is_asked_of_them(make_env, robot, mode):
    env = make_env(2, robot=robot, upper_body=laws("alpha"), actions=ActionConfig(upper_mode=mode))
    obs, *_ = env.step(torch.full((2, env.num_actions), 0.5))
    now, lower = newest(env, obs["policy"]), env.num_lower
    assert torch.equal(env.actuation.current[:, lower:], now["reference_arm_position"])
    assert not now["last_action"][:, lower:].any()
    assert (now["last_action"][:, :lower] == 0.5).all()
    assert (env.record.action[:, len(env.spec.joints) :] == 0.5).all()


def test_an_action_counts_as_far_as_it_does_something(make_env):
    """Beyond the bounds it changes nothing: what the next observation shows of it is the bound."""
    env = make_env(2, upper_body=laws("alpha"))
    env.step(asking(env, c0=7.0, c1=-7.0))
    first = env.record.action[0, -2:].tolist()
    assert first == pytest.approx([(1.0 - 0.4) / 0.5, -0.7 / 0.5], abs=1e-6)
    env.step(asking(env, c0=9.0, c1=-9.0))
    assert env.record.last_action[0, -2:].tolist() == env.record.action[0, -2:].tolist() == first


def test_episodes_begin_with_the_configured_laws(make_env):
    env = make_env(3, upper_body=laws("stiffness"))
    for _ in range(3):
        env.step(asking(env, c0=1.0, c1=1.0))
    before = env.upper_body.parameters.alpha.clone()
    env._restart(torch.tensor([False, True, False]))
    p = env.upper_body.parameters
    assert p.alpha[1].tolist() == pytest.approx([0.4, 0.7])
    assert p.stiffness[1, 0].tolist() == pytest.approx([400.0, 300.0, 200.0], rel=1e-6)
    assert torch.equal(p.alpha[[0, 2]], before[[0, 2]])


def test_laws_that_are_held_stay(make_env):
    env = make_env(2, upper_body=laws("stiffness", held=True))
    for _ in range(3):
        env.step(asking(env, c0=1.0, c1=1.0))
    assert env.upper_body.parameters.alpha[0].tolist() == pytest.approx([0.4, 0.7])
    assert env.layout() == make_env(2, upper_body=laws("stiffness")).layout()


def test_an_energy_store_holds_back_what_the_policy_asks_for(make_env):
    """An arm that hangs off its target may not stiffen with an empty store; without a store it does."""
    stiffness = []
    for passive in (True, False):
        law = LawConfig("cotap", (100.0, 100.0, 100.0), passive=passive, store_energy=0.0, damping="pd")
        cfg = UpperBodyConfig(law, law, modulation=ModulationConfig("stiffness", stiffness_rate=1000.0))
        env = make_env(1, upper_body=cfg, randomization=NOMINAL, motions=STILL, fixed_base=True)
        env.step(zeros(env))
        env.sim.qpos[:, 7 + env.num_lower :] += 0.3
        env.state = env.reader.read()
        env.step(asking(env, **{f"c{i}": 9.0 for i in (1, 2, 3, 5, 6, 7)}))
        assert env.upper_body.parameters.stiffness.flatten().tolist() == pytest.approx([1200.0] * 6, rel=1e-5)
        stiffness.append(float(env.upper_body.stiffness.diagonal(dim1=-2, dim2=-1).sum()))
        assert ("held_back" in env.upper_body.report) == passive
    assert stiffness[0] < 0.9 * stiffness[1]


def test_bounded_asks_for_the_same():
    modulation = Modulation(ModulationConfig("stiffness", alpha=(0.2, 0.8)), [LEFT, RIGHT], 0.02)
    action = 4.0 * torch.randn(50, 8, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(modulation.wanted(action.clamp(*modulation.action_bounds)), modulation.wanted(action))
    assert float(modulation.wanted(action)[:, 0].max()) == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        (laws("beta"), "modulation.kind 'beta' is unknown"),
        (laws("alpha", alpha=(0.5, 1.2)), r"modulation.alpha\[1\]"),
        (laws("stiffness", stiffness=(300.0, 80.0)), "modulation.stiffness"),
        (laws("alpha", alpha_rate=0.0), "modulation.alpha_rate"),
        (laws("alpha", alpha=(0.5, 1.0)), "upper_body.left.alpha, which a zero action asks for,"),
        (laws("stiffness", stiffness=(150.0, 800.0)), r"upper_body.right.stiffness\[2\], which a zero"),
        (UpperBodyConfig(LEFT, modulation=ModulationConfig("alpha")), "pd, the right arm's law, reads no alpha"),
        (UpperBodyConfig(LEFT, LawConfig("facet"), modulation=ModulationConfig("alpha")), "facet, the right arm's"),
        (UpperBodyConfig(LEFT, RIGHT, sampling=LawSampling(True), modulation=ModulationConfig("alpha")), "draws"),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_named(cfg, message):
    with pytest.raises(ValueError, match=message):
        cfg.check()


def test_without_it_the_config_alone_has_changed(make_env):
    assert to_plain(UpperBodyConfig().modulation)["kind"] == "none"
    assert "modulation" not in make_env(1).layout()
