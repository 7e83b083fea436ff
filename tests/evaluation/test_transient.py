"""How hands come to rest, on damped oscillations with known energies, overshoots and settling times."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from test_metrics import trajectory

from cotap.evaluation.rollout import Trajectory
from cotap.evaluation.transient import back_within, transient_measures

DT, SECONDS, ONSET_S, RATE = 0.002, 6.0, 1.0, 2.0 * math.pi * 2.0
SPEED = 1.5
DIRECTION = torch.tensor([0.6, -0.8, 0.0])


def struck(damping_ratio: float, envs: int = 1, rate: float = RATE) -> Trajectory:
    """Left hands that are struck to `SPEED` at the onset, 3 cm from their reference, and swing freely (exact)."""
    time = torch.arange(1, round(SECONDS / DT) + 1, dtype=torch.float64) * DT - ONSET_S
    damped = rate * math.sqrt(abs(1.0 - damping_ratio**2))
    wave = torch.sin(damped * time) if damping_ratio < 1.0 else torch.sinh(damped * time)
    moved = torch.where(time > 0.0, SPEED / damped * torch.exp(-damping_ratio * rate * time) * wave, 0.0)
    t = replace(trajectory(steps=len(time), envs=envs), dt=DT)
    t.hand_offset[:, :, 0] = (moved[:, None] * DIRECTION.double() + 0.03).float()[:, None]
    return t


def measured(t: Trajectory) -> dict[str, float]:
    onset = round(ONSET_S / DT)
    measures = transient_measures(t, onset, onset, len(t.fell), [0], 0.5)
    return {name: float(value[0]) for name, value in measures.items()}


@pytest.mark.parametrize("damping_ratio", [0.1, 0.2, 0.4])
def test_a_damped_oscillator_has_its_closed_form(damping_ratio):
    m = measured(struck(damping_ratio))
    window = SECONDS - ONSET_S
    decay = math.pi * damping_ratio / math.sqrt(1.0 - damping_ratio**2)  # of the logarithm in half a period
    energy = SPEED**2 / (8.0 * damping_ratio * RATE) / window
    assert m["transient_energy"] == pytest.approx(energy, rel=0.01)
    assert m["oscillation_energy"] == pytest.approx(energy * math.exp(-2.0 * decay), rel=0.02)
    assert m["overshoot"] == pytest.approx(math.exp(-decay), rel=0.01)
    assert m["overshoots"] == math.floor(math.log(10.0) / decay)
    assert m["settled_fraction"] == 1.0
    # The last peak above a tenth is that of the last overshoot counted; half a period later it has been left for good.
    half = math.pi / (RATE * math.sqrt(1.0 - damping_ratio**2))
    swings = m["overshoots"]
    assert half * swings < m["settle_s"] < half * (swings + 1.0)


def test_a_hand_that_creeps_back_does_not_oscillate():
    """Overdamped: all energy is that of the way out and back."""
    m = measured(struck(1.5))
    assert m["transient_energy"] == pytest.approx(SPEED**2 / (8.0 * 1.5 * RATE) / (SECONDS - ONSET_S), rel=0.02)
    assert m["oscillation_energy"] == pytest.approx(0.0, abs=1e-9)
    assert m["overshoot"] == pytest.approx(0.0, abs=1e-6)
    assert m["overshoots"] == 0.0
    slow, fast = (RATE * (1.5 + sign * math.sqrt(1.25)) for sign in (-1.0, 1.0))
    at = math.log(fast / slow) / (fast - slow)
    peak = math.exp(-slow * at) - math.exp(-fast * at)
    assert m["settle_s"] == pytest.approx(-math.log(0.1 * peak) / slow, rel=0.02)  # the fast one is long over


def test_the_energy_of_an_oscillation_tells_damping_not_pitch():
    """As many swings, faster: as much energy per swing, but of the whole only what damping leaves."""
    slow, fast = (measured(struck(0.2, rate=rate)) for rate in (RATE, 2.0 * RATE))
    share = [m["oscillation_energy"] / m["transient_energy"] for m in (slow, fast)]
    assert share[0] == pytest.approx(share[1], rel=0.02)
    assert fast["overshoots"] == slow["overshoots"]
    assert fast["settle_s"] == pytest.approx(0.5 * slow["settle_s"], rel=0.02)


def test_the_push_itself_is_left_out_and_both_hands_are_averaged():
    t = struck(0.2)
    onset, release = round(ONSET_S / DT), round((ONSET_S + 0.1) / DT)
    late = transient_measures(t, onset, release, len(t.fell), [0], 0.5)
    whole = transient_measures(t, onset, onset, len(t.fell), [0], 0.5)
    assert late["transient_energy"] * (SECONDS - ONSET_S - 0.1) < whole["transient_energy"] * (SECONDS - ONSET_S) * 0.8
    assert late["overshoots"] == whole["overshoots"]
    both = transient_measures(t, onset, onset, len(t.fell), [0, 1], 0.5)
    assert float(both["oscillation_energy"]) == pytest.approx(0.5 * float(whole["oscillation_energy"]))
    assert float(both["settle_s"].isnan())  # the other hand never left


def test_a_world_that_falls_has_no_transient():
    t = struck(0.2, envs=3)
    onset = round(ONSET_S / DT)
    t.fell[onset + 200, 0] = True
    t.fell[onset + 700, 1] = True
    m = transient_measures(t, onset, onset, onset + 500, [0], 0.5)
    assert m["oscillation_energy"].isnan().tolist() == [True, False, False]
    assert m["settle_s"].isnan().tolist() == [True, True, False]
    assert m["settled_fraction"].tolist() == [False, False, True]


def test_back_within_looks_at_every_column():
    error = torch.zeros(10, 1, 2)
    error[4, 0, 0] = error[:, 0, 1] = 1.0
    seconds, back = back_within(error, torch.full((1, 2), 0.5), torch.ones(10, 1, dtype=torch.bool), 2, 0.1)
    assert float(seconds[0, 0]) == pytest.approx(0.3)
    assert seconds[0, 1].isnan()
    assert back.tolist() == [[True, False]]
