"""The mirror images that learning uses, against the simulation itself and against hand-worked columns."""

from __future__ import annotations

import math

import pytest
import torch
from env_tools import NOISY, NOMINAL, privileged, zeros

from cotap.compliance.laws import LawConfig
from cotap.envs.actions import ActionConfig
from cotap.envs.config import RewardConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.hand_loads import HandLoadConfig
from cotap.envs.modulation import ModulationConfig
from cotap.envs.observations import ObservationConfig
from cotap.envs.pushes import PushConfig
from cotap.envs.rewards import LowerRewards
from cotap.envs.scripted_forces import ForceProfile
from cotap.envs.symmetry import joint_reflection
from cotap.envs.upper_body import UpperBodyConfig


def test_joint_reflection_by_hand_for_the_h1(spec):
    mirrored = joint_reflection(spec, spec.joint_names)(torch.arange(1.0, 20.0))
    # yaw and roll change sign, pitch does not; left and right change places; the waist keeps its place.
    assert mirrored[:5].tolist() == [-6.0, -7.0, 8.0, 9.0, 10.0]
    assert float(mirrored[10]) == -11.0
    assert mirrored[11:15].tolist() == [16.0, -17.0, -18.0, 19.0]


def test_joint_reflection_by_name(any_spec):
    names = any_spec.joint_names
    reflect = joint_reflection(any_spec, names)
    for i, joint in enumerate(any_spec.joints):
        image = reflect(torch.eye(len(names))[i])
        expected = torch.zeros(len(names))
        expected[names.index(joint.mirror_name)] = joint.mirror_sign
        assert torch.equal(image, expected)


@pytest.mark.parametrize(
    "observations",
    [
        ObservationConfig(),
        ObservationConfig(critic="history", noise=NOISY.noise),
        ObservationConfig(arm_torque="critic", goals=True, history=3),
    ],
)
@pytest.mark.parametrize("kind", ["none", "alpha", "stiffness"])
def test_reflections_fit_and_undo_themselves(make_env, robot, rng, observations, kind):
    env = make_env(2, robot=robot, observations=observations, upper_body=modulated(kind))
    for group, observed in env.get_observations().items():
        reflect = env.symmetry.observations[group]
        assert reflect.index.numel() == observed.shape[1]
        x = torch.randn(3, observed.shape[1], generator=rng)
        assert torch.equal(reflect(reflect(x)), x)
        assert not torch.equal(reflect(x), x)
    a = torch.randn(3, env.num_actions, generator=rng)
    assert torch.equal(env.symmetry.actions(env.symmetry.actions(a)), a)


def mirrored_pair(make_env, robot: str, **fields):
    """Two envs that start as mirror images; the H1's own left and right differ in the seventh digit."""
    small = ActionConfig(lower_scale=0.25)  # what differs between left and right grows with the movement
    env = make_env(2, robot=robot, randomization=NOMINAL, actions=small, **fields)
    joints, lower = len(env.spec.joints), env.num_lower
    reflect = joint_reflection(env.spec, env.spec.joint_names)
    sign = torch.tensor([1.0, -1.0])
    arms = env.joint_targets.default + 0.2 * torch.linspace(-1.0, 1.0, joints)
    env.motions.hold(torch.stack((arms, reflect(arms)))[:, lower:])
    env.commands.override(
        torch.stack((torch.full((2,), 0.6), 0.3 * sign), 1), 0.5 * sign, torch.zeros(2),
        torch.full((2,), env.spec.nominal_height_m),
    )  # fmt: skip
    env.reset()
    q = env.joint_targets.default + 0.1 * torch.linspace(-1.0, 1.0, joints)
    q[lower:] = arms[lower:]
    pose = torch.stack((q, reflect(q)))
    base = torch.tensor([0.0, 0.0, env.spec.base_height_m + 0.02, 1.0, 0.0, 0.0, 0.0]).repeat(2, 1)
    speed = torch.zeros(2, 6 + joints)
    speed[:, 0], speed[:, 1], speed[:, 5] = 0.3, 0.2 * sign, 0.4 * sign
    both = torch.ones(2, dtype=torch.bool)
    env.sim.reset(both, torch.cat((base, pose), 1).double(), speed.double())
    env.actuation.reset(both, pose)
    env.commands.gait.phase = torch.tensor([0.3, 0.8])
    env.commands.gait.stand = torch.zeros(2)
    env.state = env.reader.read()
    return env


def mirrored_steps(env, steps: int):
    """Observations and each group's reward of every step, driven by mirrored actions."""
    rng = torch.Generator().manual_seed(0)
    for _ in range(steps):
        action = 0.3 * torch.randn(env.num_actions, generator=rng)
        obs, _, done, extras = env.step(torch.stack((action, env.symmetry.actions(action))))
        assert not done.any()
        yield obs, extras


def modulated(kind: str) -> UpperBodyConfig:
    """Arms under one law each, of which the policy sets what `kind` says."""
    law = LawConfig("cotap", (500.0, 300.0, 200.0), alpha=0.5)
    return UpperBodyConfig(law, law, modulation=ModulationConfig(kind))


LOAD = ExternalForceConfig(scripted=ForceProfile((4.0, 0.0, -8.0), "both", 0.0))


@pytest.mark.parametrize("forces", [ExternalForceConfig(), LOAD], ids=["free", "loaded"])
def test_a_mirrored_step_is_mirrored(make_env, robot, forces):
    """One step from mirrored states: every observation group is mirrored, and rewards are equal, term by term.

    The published numbers of left and right differ, by some hundredths of a newton metre in a step.
    """
    atol = {"h1": 0.04, "g1": 0.04, "made-up": 1e-3}[robot]
    env = mirrored_pair(make_env, robot, forces=forces, observations=ObservationConfig(history=1))
    obs, extras = next(mirrored_steps(env, 1))
    for group, observed in obs.items():
        image = env.symmetry.observations[group](observed[0])
        torch.testing.assert_close(image, observed[1], atol=atol, rtol=1e-3, msg=lambda m, g=group: f"{g}: {m}")
        assert float((observed[0] - observed[1]).abs().max()) > 0.1
    torch.testing.assert_close(extras["group_rewards"][0], extras["group_rewards"][1], atol=1e-3, rtol=0.01)
    for group in env._groups:
        for name, function in group.terms.items():
            here, there = function(env.record).tolist()
            assert here == pytest.approx(there, rel=10 * atol, abs=0.1 * atol), name


@pytest.mark.parametrize("kind", ["alpha", "stiffness"])
def test_a_step_is_mirrored_with_the_laws_that_it_sets(make_env, robot, kind):
    """Actions large enough for every law to move as far as a step lets it."""
    atol = {"h1": 0.04, "g1": 0.04, "made-up": 1e-3}[robot]
    env = mirrored_pair(make_env, robot, observations=ObservationConfig(history=1), upper_body=modulated(kind))
    obs, _ = next(mirrored_steps(env, 1))
    torch.testing.assert_close(
        env.symmetry.observations["policy"](obs["policy"][0]), obs["policy"][1], atol=atol, rtol=0.03
    )
    p = env.upper_body.parameters
    for value in (p.alpha, p.stiffness):
        assert torch.equal(value[0], value[1].flip(0))
    assert not torch.equal(p.alpha[0], p.alpha[1])
    assert torch.equal(p.stiffness[0], p.stiffness[1]) == (kind == "alpha")


def test_mirrored_robots_stay_mirrored(make_env, robot):
    """Contacts magnify what little differs between left and right, so only roughly, over 20 steps.

    A foot just touches the ground or just does not, so what is paid for that is left out; it is compared above.
    """
    env = mirrored_pair(make_env, robot, rewards=RewardConfig(LowerRewards(contact_schedule=0.0)))
    for step, (obs, extras) in enumerate(mirrored_steps(env, 20)):
        if step < 5:
            continue  # the history still holds what was before the start
        for group, observed in obs.items():
            image = env.symmetry.observations[group](observed[0])
            assert float((image - observed[1]).abs().mean()) < 0.01
        here, there = extras["group_rewards"].unbind(0)
        torch.testing.assert_close(here, there, atol=0.02, rtol=0.05)
    assert float((obs["policy"][0] - obs["policy"][1]).abs().mean()) > 0.05


def test_the_phase_is_mirrored_by_half_a_stride(make_env):
    env = make_env(2, observations=ObservationConfig(history=1))
    env.commands.gait.phase, env.commands.gait.stand = torch.tensor([0.1, 0.6]), torch.zeros(2)
    obs = env._observe(torch.zeros(2, dtype=torch.bool))
    names = [name for name, width, _ in env.observer.history.terms for _ in range(width)]
    columns = [names.index("sin_phase"), names.index("cos_phase")]
    image = env.symmetry.observations["policy"](obs["policy"])
    torch.testing.assert_close(image[0, columns], obs["policy"][1, columns], atol=1e-5, rtol=0)


def test_what_is_to_come_is_mirrored(make_env, robot):
    """A push on the left hand from the left, and loads to come, by hand."""
    forces = ExternalForceConfig(
        HandLoadConfig(enabled=True, episode_share=1.0), PushConfig(enabled=True, episode_share=1.0)
    )
    env = make_env(1, robot=robot, forces=forces)
    pushes, loads = env.forces.pushes, env.forces.hand_loads
    pushes._next_s[:], loads._remaining_s[:] = 0.5, 1.0
    pushes._coming_place[:], pushes._coming_w[0] = 1, env.state.heading_w[0] @ torch.tensor([0.1, -0.6, 0.2])
    loads._coming_h[0] = torch.tensor([[1.0, 2.0, 3.0], [-4.0, 5.0, -6.0]])
    seen = env._observe(torch.zeros(1, dtype=torch.bool))["privileged"]
    own, image = (privileged(env, v) for v in (seen, env.symmetry.observations["privileged"](seen)))
    near, far = math.exp(-0.5), math.exp(-1.0)
    for got, sideways, place, coming in (
        (own, -0.6, [0, 1, 0, 0], [1, 2, 3, -4, 5, -6]),
        (image, 0.6, [0, 0, 1, 0], [-4, -5, -6, 1, -2, 3]),
    ):
        assert got["push_nearness"].item() == pytest.approx(near)
        assert got["push_velocity"][0].tolist() == pytest.approx([0.1 * near, sideways * near, 0.2 * near], abs=1e-6)
        assert got["push_place"][0].tolist() == pytest.approx([near * p for p in place])
        assert got["load_nearness"].item() == pytest.approx(far)
        assert got["coming_load"][0].tolist() == pytest.approx([far * f for f in coming], abs=1e-5)


def test_what_critics_see_of_feet_and_errors_is_mirrored(make_env, robot, rng):
    """On numbers that no symmetry leaves as they are."""
    env = make_env(1, robot=robot)
    x = torch.randn(env.get_observations()["privileged"].shape, generator=rng)
    own, image = (privileged(env, v) for v in (x, env.symmetry.observations["privileged"](x)))
    for name in ("foot_height", "foot_contact"):
        assert torch.equal(image[name], own[name].flip(1))
    assert torch.equal(image["mean_error"], own["mean_error"] * torch.tensor([1.0, -1.0, -1.0]))
    assert torch.equal(image["torso_height"], own["torso_height"])


def test_hand_forces_change_arms(make_env, robot):
    env = make_env(1, robot=robot, forces=ExternalForceConfig(scripted=ForceProfile((4.0, 3.0, -8.0), "left", 0.0)))
    obs, *_ = env.step(zeros(env))
    reflect = env.symmetry.observations["privileged"]
    forces, image = (
        privileged(env, seen)["hand_force"][0].unflatten(0, (-1, 3))
        for seen in (obs["privileged"], reflect(obs["privileged"]))
    )
    assert torch.equal(image, forces.flip(0) * torch.tensor([1.0, -1.0, 1.0]))
    assert forces[0].any()
    assert not forces[1].any()
