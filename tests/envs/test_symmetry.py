"""The mirror images that learning uses, against the simulation itself and against hand-worked columns."""

from __future__ import annotations

import torch

from cotap.envs.disturbances import HandForceConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.symmetry import joint_reflection


def test_joint_reflection_by_hand(spec):
    q = torch.arange(1.0, 20.0)
    mirrored = joint_reflection(spec, spec.joint_names)(q)
    # yaw and roll change sign, pitch does not; left and right change places; the waist keeps its place.
    assert mirrored[:5].tolist() == [-6.0, -7.0, 8.0, 9.0, 10.0]
    assert float(mirrored[10]) == -11.0
    assert mirrored[11:15].tolist() == [16.0, -17.0, -18.0, 19.0]


def test_reflections_are_their_own_inverse(make_env, rng):
    env = make_env(2)
    symmetry = env.symmetry
    for group, reflection in symmetry.observations.items():
        width = env.get_observations()["policy" if group == "clean" else group].shape[1]
        x = torch.randn(3, width, generator=rng)
        assert torch.equal(reflection(reflection(x)), x)
        assert not torch.equal(reflection(x), x)
    a = torch.randn(3, 19, generator=rng)
    assert torch.equal(symmetry.actions(symmetry.actions(a)), a)


def test_a_mirrored_world_sees_mirrored_observations(make_env):
    """Two worlds start and are driven as mirror images; the robot's own left and right differ a little."""
    env = make_env(2, randomization=RandomizationConfig(enabled=False), hand_forces=HandForceConfig(enabled=False))
    symmetry, both = env.symmetry, torch.ones(2, dtype=torch.bool)
    env.motions.hold(torch.stack((torch.full((8,), 0.2), symmetry.actions(torch.full((19,), 0.2))[11:])))
    env.commands.override(
        torch.tensor([[0.6, 0.3], [0.6, -0.3]]), torch.tensor([0.5, -0.5]), torch.zeros(2), torch.full((2,), 1.0205)
    )
    env.reset()
    upright = torch.tensor([0.0, 0.0, 1.04, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    joints = env.sim.qpos[0, 7:]
    joints[11:] = 0.2
    joints = torch.stack((joints, symmetry.actions(joints.float()).double()))
    env.sim.reset(both, torch.cat((upright.repeat(2, 1), joints), 1), torch.zeros(2, 25, dtype=torch.float64))
    env.targets.reset(both, joints.float())
    env.commands._phase = torch.tensor([0.3, 0.8])
    env.state = env.reader.read()
    generator = torch.Generator().manual_seed(0)
    for step in range(20):
        action = 0.3 * torch.randn(19, generator=generator)
        obs, *_ = env.step(torch.stack((action, symmetry.actions(action))))
        if step < 5:
            continue  # the history still holds what was before the start
        for group in ("policy", "privileged"):
            image = symmetry.observations[group](obs[group][0])
            torch.testing.assert_close(image, obs[group][1], atol=0.15, rtol=0.02)
            assert float((image - obs[group][1]).abs().mean()) < 0.01
    assert float((obs["policy"][0] - obs["policy"][1]).abs().mean()) > 0.05
