"""Arms that are led by hand: laws changed while they run, motions chosen by name."""

from __future__ import annotations

import pytest
import torch

from cotap.compliance.laws import LawConfig
from cotap.envs.clearance import LegClearance
from cotap.envs.disturbances import HandForceConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.reference import REST

PLAIN = {"randomization": RandomizationConfig(enabled=False), "hand_forces": HandForceConfig(enabled=False)}


def test_a_law_set_in_one_world_and_arm_moves_only_that_one(make_env):
    env, twin = (make_env(num_envs=2, seed=3, **PLAIN) for _ in range(2))
    for e in (env, twin):
        e.motions.hold(e.motions.default)
        e.reset()
    env.set_law(1, 0, LawConfig("cotap", stiffness=(200.0, 300.0, 400.0), alpha=0.5))
    for _ in range(10):
        for e in (env, twin):
            e.step(torch.zeros(2, e.num_actions))
    assert env.upper_body.parameters.stiffness[1, 0].tolist() == [200.0, 300.0, 400.0]
    moved = (env.arm_stiffness() - twin.arm_stiffness()).abs().amax((2, 3))
    assert (moved > 1.0).tolist() == [[False, False], [True, False]]
    # World 0 is under the same law as in the twin; only rounding may differ (its PD now runs as a law).
    assert torch.allclose(env.state.joint_pos[0], twin.state.joint_pos[0], atol=2e-3)
    assert (env.state.joint_pos[1, 11:15] - twin.state.joint_pos[1, 11:15]).abs().max() > 5e-3


def test_back_to_pd_the_actuators_are_the_robots_own_again(make_env):
    env = make_env(num_envs=1, **PLAIN)
    bias = env.sim.field("actuator_biasprm").clone()
    env.set_law(0, 1, LawConfig("soft-pd"))
    env.step(torch.zeros(1, env.num_actions))
    assert not torch.equal(env.sim.field("actuator_biasprm"), bias)
    assert torch.allclose(env.arm_stiffness()[0, 1], 30.0 * torch.eye(4))
    env.set_law(0, 1, LawConfig("pd"))
    assert not env.upper_body.active
    assert torch.equal(env.sim.field("actuator_biasprm"), bias)
    kp = {j.name: j.kp for j in env.spec.joints}[env.spec.arms[0].joints[0]]
    assert torch.allclose(env.arm_stiffness()[0, 0], kp * torch.eye(4))


def test_a_law_out_of_range_is_refused_and_changes_nothing(make_env):
    env = make_env(num_envs=1)
    before = env.upper_body.parameters.stiffness.clone()
    with pytest.raises(ValueError, match=r"stiffness\[1\]"):
        env.set_law(0, 0, LawConfig("cotap", stiffness=(300.0, -1.0, 300.0)))
    assert torch.equal(env.upper_body.parameters.stiffness, before)


def test_arms_are_led_into_a_clip_and_back_without_a_jump(make_env):
    env = make_env(num_envs=2)
    m, rng, clear = env.motions, env.rng, LegClearance(env.spec)
    m.hold(m.default)
    m.step(rng)
    m.reset(torch.tensor([True, False]), rng)
    assert torch.equal(m.current().position, m.default.expand(2, -1))
    clip = m.clips.names[0]
    positions = []
    for motion in (clip, REST):
        m.lead(motion)
        for _ in range(150):
            m.step(rng)
            positions.append(m.current().position.clone())
        if motion == clip:
            assert torch.allclose(m.current().position, clear(m.clips.current()), atol=1e-4)
            assert (m.current().position - m.default).abs().max() > 0.1
    assert torch.allclose(m.current().position, m.default.expand(2, -1), atol=1e-4)
    speed = torch.stack(positions).diff(dim=0).abs().max() / env.dt
    assert speed < 20.0
    m.lead(clip)
    m.reset(torch.tensor([True, False]), rng)
    assert torch.allclose(m.current().position[0], clear(m.clips.current())[0])
    assert m.clips.clip.tolist() == [0, 0]


def test_an_unknown_motion_is_refused_with_those_known(make_env):
    with pytest.raises(ValueError, match=r"known: .*rest"):
        make_env(num_envs=1).motions.lead("moonwalk")
