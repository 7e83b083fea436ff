"""The gait's phase: when it runs, where it rests, and what it asks of the feet."""

from __future__ import annotations

import pytest
import torch

from cotap.envs.gait_phase import GaitConfig, GaitPhase, desired_contact, foot_phases, swing_progress

DT = 0.02


def gait(num_envs: int = 1, **cfg) -> GaitPhase:
    return GaitPhase(GaitConfig(**cfg), num_envs, DT)


@pytest.mark.parametrize(
    ("phase", "left", "right"),
    [(0.0, True, True), (0.05, True, True), (0.1, True, False), (0.49, True, False), (0.55, True, True),
     (0.6, False, True), (0.95, False, True)],
)  # fmt: skip
def test_desired_contact_alternates(phase, left, right):
    assert desired_contact(torch.tensor([phase]), torch.zeros(1), 2).tolist() == [[left, right]]
    assert desired_contact(torch.tensor([phase]), torch.ones(1), 2).tolist() == [[True, True]]


def test_swing_progress_runs_from_lift_off_to_touch_down():
    phase = torch.tensor([0.3, 0.58, 0.79, 0.999])
    left = swing_progress(phase, 2)[:, 0]
    torch.testing.assert_close(left, torch.tensor([0.0, 0.0, 0.5, 0.9976]), atol=1e-3, rtol=0)
    torch.testing.assert_close(swing_progress(phase - 0.5, 2)[:, 1], left, atol=1e-5, rtol=0)


def test_feet_are_evenly_apart_in_phase():
    torch.testing.assert_close(foot_phases(torch.tensor([0.2]), 2), torch.tensor([[0.2, 0.7]]))
    torch.testing.assert_close(foot_phases(torch.tensor([0.9]), 4), torch.tensor([[0.9, 0.15, 0.4, 0.65]]))


@pytest.mark.parametrize("period", [0.5, 0.8, 1.0])
def test_a_stride_takes_its_period(rng, period):
    g = gait(1, period_s=period)
    g.reset(torch.ones(1, dtype=torch.bool), torch.zeros(1), rng)
    start = float(g.phase)
    g.step(torch.tensor([False]))
    assert (float(g.phase) - start) % 1.0 == pytest.approx(DT / period, abs=1e-6)
    for _ in range(round(period / DT) - 1):
        g.step(torch.tensor([False]))
    assert float(g.phase) == pytest.approx(start, abs=1e-5)
    assert float(g.stand) == 0.0


def test_phases_begin_at_random_or_at_rest(rng):
    n = 8000
    g = gait(n)
    stand = (torch.arange(n) % 2).float()
    g.reset(torch.ones(n, dtype=torch.bool), stand, rng)
    rest, running = g.phase[stand > 0.5], g.phase[stand < 0.5]
    assert set(rest.tolist()) == {0.0, 0.5}
    assert float((rest == 0.5).float().mean()) == pytest.approx(0.5, abs=0.03)
    assert torch.histc(running, 4, 0.0, 1.0).tolist() == pytest.approx([1000.0] * 4, rel=0.12)
    assert torch.equal(g.stand, stand)


def test_it_comes_to_rest_with_both_feet_down_by_hand():
    """From 0.12, at 0.025 a step: a stride is 40 steps; then 0.38 to go are 15.2 steps, so the 56th ends at 0.5."""
    g = gait(1)
    g.phase = torch.tensor([0.12])
    phases, stands = [], []
    for _ in range(60):
        g.step(torch.tensor([True]))
        phases.append(float(g.phase))
        stands.append(float(g.stand))
    assert stands == [0.0] * 55 + [1.0] * 5
    assert phases[54] == pytest.approx(0.12 + 15 * 0.025, abs=1e-5)
    assert phases[55:] == [0.5] * 5


def test_a_stride_begins_anew_where_standing_is_no_longer_asked_for():
    g = gait(1)
    g.phase = torch.tensor([0.12])
    for asked in (*[True] * 39, False, *[True] * 40):
        g.step(torch.tensor([asked]))
        assert float(g.stand) == 0.0
    for _ in range(15):
        g.step(torch.tensor([True]))
    assert float(g.stand) == 0.0  # 95 steps from 0.12 are 2.495 strides, and the next one ends at 2.5
    g.step(torch.tensor([True]))
    assert (float(g.phase), float(g.stand)) == (0.5, 1.0)


def test_it_comes_to_rest_at_the_end_of_a_stride_too():
    g = gait(1)
    g.phase = torch.tensor([0.97])
    for _ in range(41):
        g.step(torch.tensor([True]))
    assert float(g.stand) == 0.0
    g.step(torch.tensor([True]))
    assert (float(g.phase), float(g.stand)) == (0.0, 1.0)


@pytest.mark.parametrize("rest", [0.0, 0.5])
def test_it_goes_on_from_where_it_rested(rest):
    g = gait(2)
    g.phase, g.stand = torch.full((2,), rest), torch.ones(2)
    g.step(torch.tensor([False, True]))
    assert g.phase.tolist() == pytest.approx([rest + 0.025, rest])
    assert g.stand.tolist() == [0.0, 1.0]
    # Asked to stand again at once: a stride, and on to where both feet are down.
    for _ in range(58):
        g.step(torch.tensor([True, True]))
        assert float(g.stand[0]) == 0.0
    g.step(torch.tensor([True, True]))
    assert g.phase.tolist() == [(rest + 0.5) % 1.0, rest]
    assert g.stand.tolist() == [1.0, 1.0]


def test_reset_touches_only_its_envs(rng):
    g = gait(2)
    g.phase = torch.tensor([0.3, 0.3])
    g.reset(torch.tensor([False, True]), torch.ones(1), rng)
    assert float(g.phase[0]) == pytest.approx(0.3)
    assert g.stand.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_bad_fields_are_named(value):
    with pytest.raises(ValueError, match=r"gait\.period_s"):
        gait(period_s=value)
