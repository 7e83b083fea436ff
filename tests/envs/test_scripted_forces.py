"""Forces that follow a script."""

from __future__ import annotations

import math

import pytest
import torch

from cotap.envs.scripted_forces import ForceProfile, ScriptedForces

SIDES = ("left", "right")
DT = 0.02


def test_a_force_lasts_as_long_as_it_should():
    """50 ms from 1 s on: control steps 50 and 51, and half of 52; 25 N s in all."""
    forces = ScriptedForces(ForceProfile((500.0, 0.0, 0.0), "left", 1.0, 0.05), SIDES, 1, DT)
    x = torch.stack([forces.at(torch.tensor([DT * i]))[0, 0, 0] for i in range(100)])
    assert x.nonzero().flatten().tolist() == [50, 51, 52]
    assert x[50:53].tolist() == pytest.approx([500.0, 500.0, 250.0], rel=1e-3)
    assert float(x.sum() * DT) == pytest.approx(25.0, rel=1e-3)
    assert not forces.at(torch.tensor([1.0]))[0, 1:].any()


def test_a_force_within_one_step_keeps_its_impulse():
    forces = ScriptedForces(ForceProfile((500.0, 0.0, 0.0), "left", 1.005, 0.01), SIDES, 1, DT)
    x = torch.stack([forces.at(torch.tensor([DT * i]))[0, 0, 0] for i in range(100)])
    assert x.nonzero().flatten().tolist() == [50]
    assert float(x.sum() * DT) == pytest.approx(5.0, rel=1e-3)


def test_a_force_on_the_base_leaves_the_hands_alone():
    forces = ScriptedForces(ForceProfile((0.0, 80.0, 0.0), "both", 0.0, place="base"), SIDES, 1, DT)
    assert forces.at(torch.zeros(1))[0].tolist() == [[0.0] * 3, [0.0] * 3, [0.0, 80.0, 0.0]]


@pytest.mark.parametrize(
    ("hand", "pushed"), [("left", [True, False]), ("right", [False, True]), ("both", [True, True])]
)
def test_hands_by_name(hand, pushed):
    forces = ScriptedForces(ForceProfile((0.0, 0.0, -15.0), hand, 0.0), SIDES, 2, DT)
    assert (forces.at(torch.zeros(2))[1, :2, 2] == -15.0).tolist() == pushed


def test_a_swinging_force_by_hand():
    forces = ScriptedForces(ForceProfile((30.0, 0.0, 0.0), "both", 1.0, period_s=4.0), SIDES, 3, DT)
    x = forces.at(torch.tensor([2.0, 3.0, 4.0]) - DT / 2)[:, 0, 0]  # it counts in the middle of a step
    torch.testing.assert_close(x, torch.tensor([30.0, 0.0, -30.0]), atol=1e-4, rtol=0)
    assert not forces.at(torch.tensor([0.5, 0.5, 0.5])).any()


@pytest.mark.parametrize("hours", [0, 1, 24, 270])
def test_a_force_without_end_stays_the_same(hours):
    """Single precision has steps of 0.06 s after 270 hours."""
    forces = ScriptedForces(ForceProfile((60.0, 0.0, 0.0), "both", 0.0, 1e6), SIDES, 50, DT)
    steps = hours * 180_000 + torch.arange(50)
    assert (forces.at(DT * steps.double())[:, 0, 0] == 60.0).all()


def test_random_directions_turn_about_the_vertical(rng):
    n = 2000
    forces = ScriptedForces(ForceProfile((3.0, 4.0, -7.0), "left", 0.0, random_direction=True), SIDES, n, DT)
    forces.reset(torch.ones(n, dtype=torch.bool), rng)
    f = forces.at(torch.zeros(n))[:, 0]
    torch.testing.assert_close(f[:, :2].norm(dim=1), torch.full((n,), 5.0))
    torch.testing.assert_close(f[:, 2], torch.full((n,), -7.0))
    assert float(f[:, :2].mean(0).norm()) < 0.3
    before = forces.amplitude_h.clone()
    mask = torch.zeros(n, dtype=torch.bool)
    mask[5] = True
    forces.reset(mask, rng)
    assert (forces.amplitude_h != before).any(2).any(1).nonzero().flatten().tolist() == [5]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("hand", "foot"),
        ("place", "moon"),
        ("force", (math.nan, 0.0, 0.0)),
        ("start_s", -1.0),
        ("duration_s", math.inf),
        ("period_s", -1.0),
    ],
)
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=rf"force\.{field}"):
        ScriptedForces(ForceProfile(**{field: value}), SIDES, 1, DT)
