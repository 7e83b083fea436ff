"""Domain randomisation: what is drawn, and that it reaches the model and nothing else."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from env_tools import mujoco_of

from cotap.envs.randomization import RandomizationConfig, Randomizer
from cotap.sim import Simulation, make_simulation

N = 200


@pytest.fixture
def sim(any_model) -> Simulation:
    return make_simulation("mujoco", any_model, N, 2, 1, Randomizer.FIELDS)


@pytest.fixture
def randomizer(any_spec, sim) -> Randomizer:
    return Randomizer(RandomizationConfig(), any_spec, sim)


def everyone() -> torch.Tensor:
    return torch.ones(N, dtype=torch.bool)


def test_masses_and_inertias_scale_together(sim, any_model, randomizer, rng):
    total = any_model.body_mass.sum()
    randomizer.randomize_bodies(rng)
    nominal = torch.from_numpy(any_model.body_mass.copy())
    mass, inertia = sim.field("body_mass"), sim.field("body_inertia")
    assert not mass[:, 0].any()  # the world has none
    ratio = mass[:, 1:] / nominal[1:]
    inertia_ratio = inertia[:, 1:] / torch.from_numpy(any_model.body_inertia[1:].copy())
    torch.testing.assert_close(inertia_ratio, ratio.unsqueeze(-1).expand(-1, -1, 3))
    assert any_model.body_mass.sum() == total  # the shared model is untouched


def test_mass_is_added_to_the_torso_and_to_no_other(sim, any_model, any_spec, randomizer, rng):
    """Base and torso are two bodies: the paper's base is the torso link."""
    randomizer.randomize_bodies(rng)
    nominal = torch.from_numpy(any_model.body_mass.copy())
    torso = any_model.body(any_spec.torso_body).id
    others = [b for b in range(1, any_model.nbody) if b != torso]
    ratio = sim.field("body_mass")[:, others] / nominal[others]
    assert 0.9 <= float(ratio.min()) < 0.91
    assert 1.19 < float(ratio.max()) <= 1.2
    mass, own = sim.field("body_mass")[:, torso], float(nominal[torso])
    assert 0.9 * own - 1.0 <= float(mass.min()) < 0.9 * own + 0.15 * own
    assert 1.2 * own + 3.0 >= float(mass.max()) > 1.05 * own + 2.0
    fixed = RandomizationConfig(link_mass_scale=(1.0, 1.0), base_mass_kg=(2.5, 2.5))
    Randomizer(fixed, any_spec, sim).randomize_bodies(rng)
    added = sim.field("body_mass") - nominal
    assert added[:, torso].tolist() == pytest.approx([2.5] * N)
    added[:, torso] = 0.0
    assert float(added.abs().max()) < 1e-9


def test_friction_of_the_feet_only(sim, any_model, any_spec, randomizer, rng):
    nominal = torch.from_numpy(any_model.geom_friction.copy())
    randomizer.randomize_episode(everyone(), torch.zeros(N), rng)
    friction = sim.field("geom_friction")
    names = [f"{foot.body}_collision" for foot in any_spec.feet]
    feet = [g for g in range(any_model.ngeom) if any_model.geom(g).name.startswith(tuple(names))]
    assert len(feet) == {"h1": 6, "g1": 8, "made-up": 2}[any_spec.name]
    sliding = friction[:, feet, 0]
    assert torch.equal(sliding, sliding[:, :1].expand(-1, len(feet)))  # one ground under both feet
    assert 0.5 <= float(sliding.min()) < 0.52
    assert 1.23 < float(sliding.max()) <= 1.25
    others = [g for g in range(any_model.ngeom) if g not in feet]
    assert any_model.geom("floor").id in others
    assert torch.equal(friction[:, others], nominal[others].expand(N, -1, -1))
    assert torch.equal(friction[:, feet, 1:], nominal[feet, 1:].expand(N, -1, -1))


def test_gains_reach_the_actuators(sim, any_spec, randomizer, rng):
    delay = torch.zeros(N)
    randomizer.randomize_episode(everyone(), delay, rng)
    kp, kd = randomizer.gains()
    scales = []
    for i, joint in enumerate(any_spec.joints):
        for values, nominal in ((kp[:, i], joint.kp), (kd[:, i], joint.kd)):
            assert 0.9 <= float(values.min() / nominal) + 1e-6 < 0.91
            assert 1.09 < float(values.max() / nominal) - 1e-6 <= 1.1
            scales.append(values / nominal)
    assert float(torch.corrcoef(torch.stack(scales)).triu(1).abs().max()) < 0.4  # each is drawn by itself
    bias = sim.field("actuator_biasprm").float()
    torch.testing.assert_close(bias[:, :, 1], -kp)
    torch.testing.assert_close(bias[:, :, 2], -kd)
    assert 0.0 <= float(delay.min()) < 0.001
    assert 0.019 < float(delay.max()) <= 0.02


def test_an_episode_changes_only_its_envs(sim, randomizer, rng):
    delay = torch.zeros(N)
    randomizer.randomize_episode(everyone(), delay, rng)
    before = delay.clone(), sim.field("geom_friction").clone(), sim.field("actuator_biasprm").clone()
    mask = torch.zeros(N, dtype=torch.bool)
    mask[[3, 7]] = True
    randomizer.randomize_episode(mask, delay, rng)
    for old, new in zip(before, (delay, sim.field("geom_friction"), sim.field("actuator_biasprm")), strict=True):
        changed = (old != new).flatten(1).any(1) if old.dim() > 1 else old != new
        assert torch.equal(changed, mask)


def test_disabled_randomisation_leaves_the_nominal_robot(any_spec, sim, any_model, rng):
    randomizer = Randomizer(RandomizationConfig(enabled=False), any_spec, sim)
    delay = torch.zeros(N)
    randomizer.randomize_bodies(rng)
    randomizer.randomize_episode(everyone(), delay, rng)
    assert not delay.any()
    for name in Randomizer.FIELDS:
        nominal = torch.from_numpy(getattr(any_model, name).copy())
        assert torch.equal(sim.field(name), nominal.expand_as(sim.field(name)))
    assert torch.allclose(randomizer.gains()[0][5], torch.tensor([j.kp for j in any_spec.joints]))
    assert torch.allclose(randomizer.gains()[1][5], torch.tensor([j.kd for j in any_spec.joints]))


def test_dynamics_follow_the_masses_that_were_drawn(make_env, robot):
    """Under a held actuator torque in the air, joints of every env accelerate as MuJoCo has it for its own masses."""
    env = make_env(3, robot=robot)
    env.sim.qpos[:, 2] += 1.0
    env.state = env.reader.read()
    robots = [mujoco_of(env, i) for i in range(3)]
    env.sim.ctrl[:] = 5.0
    torque = env.sim.ctrl.clone()
    env.sim.step(lambda _: torque)
    for i, (model, data) in enumerate(robots):
        data.ctrl[:] = 5.0
        for _ in range(2):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(env.sim.qvel[i], data.qvel, atol=1e-9)


@pytest.mark.parametrize(
    ("field", "value"),
    [("friction", (0.0, 1.0)), ("delay_s", (0.0, 0.03)), ("kp_scale", (1.1, 0.9)), ("base_mass_kg", (0.0,))],
)
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=f"randomization.{field}"):
        RandomizationConfig(**{field: value}).check(0.02)


def test_a_torso_without_mass_is_refused(make_env, robot):
    heavy = make_env(1, robot=robot).spec.mass_kg  # the torso weighs less
    with pytest.raises(ValueError, match=r"randomization\.base_mass_kg\[0\] .* would leave a torso of -"):
        make_env(1, robot=robot, randomization=RandomizationConfig(base_mass_kg=(-heavy, 0.0)))
