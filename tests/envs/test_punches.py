"""Punches: one in every segment of time, of exact impulse, growing as published, the same for a run wherever it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cotap.envs.punches import PunchConfig, Punches, draw_punches

DT = 0.02
TOUR = PunchConfig(500.0)


def over_time(cfg: PunchConfig, num_envs: int, seconds: float, dt: float = DT) -> torch.Tensor:
    """Forces (T, N, 3) over time."""
    punches = Punches(cfg, 29, num_envs, dt)
    return torch.stack([punches.at(torch.full((num_envs,), dt * k))[1] for k in range(round(seconds / dt))])


def test_punches_begin_a_tenth_of_a_second_into_each_segment_and_last_four_control_steps():
    on = over_time(TOUR, 3, 95.0).norm(dim=2) > 0.0
    expected = [250 * segment + 5 + k for segment in range(18) for k in range(4)]
    for env in range(3):
        assert on[:, env].nonzero().flatten().tolist() == expected


def test_the_impulse_is_exact_whatever_the_step():
    for dt in (0.02, 0.03, 0.07):
        force = over_time(TOUR, 2, 5.0, dt)
        impulse = dt * force.sum(0)
        torch.testing.assert_close(impulse, 0.08 * Punches(TOUR, 29, 2, dt).force_w[:, 0], rtol=1e-3, atol=1e-3)


def test_the_ceiling_by_hand():
    """A third of 500 N at release, 500 N after 60 s, 333 N half way, no more later."""
    assert TOUR.ceiling_n(np.array([0.0, 30.0, 60.0, 85.1])) == pytest.approx([500 / 3, 1000 / 3, 500.0, 500.0])


def test_forces_lie_between_half_and_all_of_the_ceiling_uniformly():
    drawn = np.stack([np.linalg.norm(draw_punches(TOUR, run, 29)[1], axis=1) for run in range(2000)])
    for segment, ceiling in ((0, 500 / 3 * (1 + 2 * 0.1 / 60)), (6, 500 / 3 * (1 + 2 * 30.1 / 60)), (17, 500.0)):
        force = drawn[:, segment] / ceiling
        assert 0.5 <= force.min() < 0.502
        assert 0.998 < force.max() <= 1.0
        assert force.mean() == pytest.approx(0.75, abs=0.01)
        assert force.std() == pytest.approx(0.5 / np.sqrt(12.0), abs=0.005)


def test_every_joint_is_struck_alike_and_directions_are_isotropic():
    joints, forces = zip(*(draw_punches(TOUR, run, 29) for run in range(3000)), strict=True)
    share = np.bincount(np.concatenate(joints), minlength=29) / (3000 * 18)
    assert share == pytest.approx(1 / 29, abs=0.004)
    unit = np.concatenate(forces)
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    assert np.abs(unit.mean(0)).max() < 0.015
    # On the sphere each coordinate is uniform between -1 and 1.
    for axis in unit.T:
        assert np.quantile(axis, [0.1, 0.25, 0.5, 0.75, 0.9]) == pytest.approx([-0.8, -0.5, 0.0, 0.5, 0.8], abs=0.02)


def test_a_run_has_its_punches_wherever_it_is():
    many, one = Punches(TOUR, 29, 5, DT), Punches(TOUR, 29, 1, DT, first_run=3)
    assert torch.equal(many.force_w[3], one.force_w[0])
    assert torch.equal(many.joint[3], one.joint[0])
    assert not torch.equal(many.force_w[3], many.force_w[4])
    other = Punches(PunchConfig(500.0, seed=1), 29, 1, DT, first_run=3)
    assert not torch.equal(other.force_w, one.force_w)


def test_no_force_no_punches():
    assert not Punches(PunchConfig(), 8, 5, DT).active


@pytest.mark.parametrize(
    ("field", "value"),
    [("force_n", -1.0), ("duration_s", -0.1), ("segment_s", 0.15), ("first_s", -0.1), ("count", 0), ("ramp_s", 0.0),
     ("seed", -1)],
)  # fmt: skip
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=rf"punches\.{field}"):
        Punches(PunchConfig(**{field: value}), 8, 1, DT)


def test_a_punch_may_fill_its_segment_however_the_sum_rounds():
    PunchConfig(segment_s=0.3, first_s=0.1, duration_s=0.2).check()
