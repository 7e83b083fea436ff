"""benchmarks.soak: what of a change in throughput is the training's own, and how sure that is."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import soak

ITERATION_S, EVERY_S, PAUSE_S = 5.0, 45.0, 2.0


def soaked(
    machine: float = 0.0, training: float = 0.0, noise: float = 0.0, seed: int = 0, references: bool = True
) -> soak.Soaked:
    """An hour in which the machine and the training each lose a share of their speed, evenly. Pauses stop the
    training in the midst of an iteration, as the script does."""
    rng, total = np.random.default_rng(seed), 3600.0
    now, ends, pauses, due = 0.0, [], [], EVERY_S if references else np.inf
    while now < total:
        speed = (1.0 - machine * now / total) * (1.0 - training * now / total)
        begin, now = now, now + ITERATION_S / speed * (1.0 + noise * rng.normal())
        if now > due:
            rate = 1000.0 * (1.0 - machine * due / total) * (1.0 + noise * rng.normal())
            begin = max(begin, due)
            pauses.append((begin, begin + PAUSE_S, rate))
            now, due = now + PAUSE_S, begin + PAUSE_S + EVERY_S
        ends.append((now, 0.0))
    return soak.Soaked(np.zeros((1, 2)), np.array(pauses).reshape(-1, 3), np.array(ends))


def test_a_drift_of_the_machine_is_no_change_of_the_training():
    drifting = soaked(machine=0.3)
    assert len(drifting.speeds()) > 50
    assert soak.change(drifting.speeds()[:, 1]) == pytest.approx(0.0, abs=0.01)
    alone = soaked(machine=0.3, references=False)
    assert soak.change(alone.speeds()[:, 1]) == pytest.approx(0.73 / 0.91 - 1.0, abs=0.02)


def test_a_slow_down_of_the_training_alone_stays():
    expected = (1.0 - 0.1 * 0.9) / (1.0 - 0.1 * 0.3) - 1.0  # from the middle of the second fifth to that of the last
    for machine in (0.0, 0.3):
        slowing = soaked(machine=machine, training=0.1).speeds()[:, 1]
        assert soak.change(slowing) == pytest.approx(expected, abs=0.01)


def test_iterations_with_a_pause_in_them_are_left_out():
    steady = soaked()
    np.testing.assert_allclose(steady.speeds()[:, 1], 1.0 / (1000.0 * ITERATION_S), rtol=1e-9)
    durations = np.diff(steady.rates[:, 0])
    assert durations.max() == pytest.approx(ITERATION_S + PAUSE_S)  # there were such


def test_without_references_every_iteration_counts():
    steady = soaked(references=False)
    times, speeds = steady.speeds().T
    np.testing.assert_array_equal(times, steady.rates[1:, 0])
    np.testing.assert_allclose(speeds, 1.0 / ITERATION_S, rtol=1e-9)


def test_the_interval_covers_what_is_true_as_often_as_it_says():
    intervals = [soak.trend(soaked(noise=0.05, seed=seed).speeds()[:, 1])[1] for seed in range(200)]
    covered = np.mean([low <= 0.0 <= high for low, high in intervals])
    # Of 200 at 0.95 all but one in a thousand lie above 0.90.
    assert 0.90 <= covered < 1.0
    assert np.median([high - low for low, high in intervals]) < 0.12
