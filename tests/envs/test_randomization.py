from __future__ import annotations

import pytest
import torch

from cotap.envs.randomization import RandomizationConfig, Randomizer
from cotap.sim import BatchSimulation

N = 200


@pytest.fixture
def sim(model) -> BatchSimulation:
    return BatchSimulation(model, N, 2, 1, Randomizer.FIELDS)


@pytest.fixture
def randomizer(spec, sim) -> Randomizer:
    return Randomizer(RandomizationConfig(), spec, sim)


def everyone() -> torch.Tensor:
    return torch.ones(N, dtype=torch.bool)


def test_masses_and_inertias_scale_together(sim, model, randomizer, rng):
    randomizer.randomize_bodies(rng)
    nominal = torch.from_numpy(model.body_mass.copy())
    mass, inertia = sim.field("body_mass"), sim.field("body_inertia")
    assert not mass[:, 0].any()  # the world has none
    ratio = mass[:, 1:] / nominal[1:]
    links = ratio[:, 1:]
    assert 0.9 <= float(links.min()) < 0.91
    assert 1.19 < float(links.max()) <= 1.2
    inertia_ratio = inertia[:, 1:] / torch.from_numpy(model.body_inertia[1:].copy())
    torch.testing.assert_close(inertia_ratio, ratio.unsqueeze(-1).expand(-1, -1, 3))
    base = mass[:, model.body("pelvis").id]
    assert 5.39 * 0.9 - 1.0 <= float(base.min()) < 5.39 * 0.9 - 0.6
    assert 5.39 * 1.2 + 2.4 < float(base.max()) <= 5.39 * 1.2 + 3.0
    assert model.body_mass.sum() == pytest.approx(51.437)  # the shared model is untouched


def test_friction_of_the_feet_only(sim, model, randomizer, rng):
    floor = model.geom("floor").id
    nominal = torch.from_numpy(model.geom_friction.copy())
    randomizer.randomize_episode(everyone(), torch.zeros(N), rng)
    friction = sim.field("geom_friction")
    feet = [g for g in range(model.ngeom) if model.geom(g).name.startswith(("left_ankle", "right_ankle"))]
    assert len(feet) == 6
    sliding = friction[:, feet, 0]
    assert torch.equal(sliding, sliding[:, :1].expand(-1, 6))  # one ground under both feet
    assert 0.5 <= float(sliding.min()) < 0.52
    assert 1.23 < float(sliding.max()) <= 1.25
    others = [g for g in range(model.ngeom) if g not in feet]
    assert floor in others
    assert torch.equal(friction[:, others], nominal[others].expand(N, -1, -1))
    assert torch.equal(friction[:, feet, 1:], nominal[feet, 1:].expand(N, -1, -1))


def test_gains_reach_the_actuators(sim, randomizer, rng):
    delay = torch.zeros(N)
    randomizer.randomize_episode(everyone(), delay, rng)
    kp, kd = randomizer.gains()
    assert 180 <= float(kp[:, 3].min()) < 182  # the knee's 200 Nm/rad, +-10 %
    assert 218 < float(kp[:, 3].max()) <= 220
    assert 1.8 <= float(kd[:, 18].min()) < 1.82  # the elbow's 2 Nms/rad
    assert 2.18 < float(kd[:, 18].max()) <= 2.2
    assert float((kp[:, 0] / 150 - kp[:, 1] / 150).abs().max()) > 0.05  # joints differ from each other
    bias = sim.field("actuator_biasprm").float()
    torch.testing.assert_close(bias[:, :, 1], -kp)
    torch.testing.assert_close(bias[:, :, 2], -kd)
    assert 0.0 <= float(delay.min()) < 0.001
    assert 0.019 < float(delay.max()) <= 0.02


def test_an_episode_changes_only_its_worlds(sim, randomizer, rng):
    delay = torch.zeros(N)
    randomizer.randomize_episode(everyone(), delay, rng)
    before = delay.clone(), sim.field("geom_friction").clone(), sim.field("actuator_biasprm").clone()
    mask = torch.zeros(N, dtype=torch.bool)
    mask[[3, 7]] = True
    randomizer.randomize_episode(mask, delay, rng)
    for old, new in zip(before, (delay, sim.field("geom_friction"), sim.field("actuator_biasprm")), strict=True):
        changed = (old != new).flatten(1).any(1) if old.dim() > 1 else old != new
        assert torch.equal(changed, mask)


def test_disabled_randomisation_leaves_the_nominal_robot(spec, sim, model, rng):
    randomizer = Randomizer(RandomizationConfig(enabled=False), spec, sim)
    delay = torch.zeros(N)
    randomizer.randomize_bodies(rng)
    randomizer.randomize_episode(everyone(), delay, rng)
    assert not delay.any()
    for name in Randomizer.FIELDS:
        nominal = torch.from_numpy(getattr(model, name).copy())
        assert torch.equal(sim.field(name), nominal.expand_as(sim.field(name)))
    assert randomizer.gains()[0][5].tolist() == [j.kp for j in spec.joints]


@pytest.mark.parametrize(
    ("field", "value"),
    [("friction", (0.0, 1.0)), ("delay_s", (0.0, 0.03)), ("kp_scale", (1.1, 0.9)), ("base_mass_kg", (0.0,))],
)
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=f"randomization.{field}"):
        RandomizationConfig(**{field: value}).check(0.02)
