"""Scores of runs that are worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from cotap.evaluation.tour.scores import TourMeasures, TourScorer

DT = 0.5
NAN = math.nan


def scored(heights: list[list[float]], broken: int | None = None) -> TourMeasures:
    """Two runs of two joints over two segments of two steps; the second run breaks in step `broken`."""
    scorer = TourScorer(2, 2, 2, 2, DT, 0.2)
    rates = torch.tensor([[1.0, 0.0], [1.0, -2.0], [3.0, -2.0], [2.0, -2.0]])
    torques = torch.tensor([[10.0, 5.0], [-2.0, 3.0], [1.0, 1.0], [4.0, -1.0]])
    for k, height in enumerate(heights):
        way = torch.tensor([[0.3, 0.4], [0.0, float(k)]])
        turn = torch.tensor([-0.5, 0.1 * k])
        bad = torch.tensor([False, k == broken])
        scorer.step(torch.tensor(height), rates[k].expand(2, 2), torques[k].expand(2, 2), way, turn, bad)
    return scorer.measures()


def test_a_run_that_stays_up():
    """Work: 0.5 (10 + 0) + 0.5 (2 + 6) + 0.5 (3 + 2) + 0.5 (8 + 2). Accelerations: (2, 0), (0, -4), (4, 0), (-2, 0);
    the first is not known from the one before it, so that what counts is 8 and 6."""
    m = scored([[0.8, 0.8]] * 4)
    assert m.survival_s.tolist() == [2.0, 2.0]
    assert m.completed.tolist() == [True, True]
    assert m.energy.tolist() == pytest.approx([16.5, 16.5])
    assert m.vibration.tolist() == pytest.approx([14.0, 14.0])
    torch.testing.assert_close(m.position_error, torch.tensor([[0.5, 0.5], [1.0, 3.0]]))
    torch.testing.assert_close(m.yaw_error, torch.tensor([[0.5, 0.5], [0.1, 0.3]]))


def test_what_follows_a_fall_does_not_count():
    """The second run is down at the end of the third step, after 1.5 s, and stays so though it comes up again. Of the
    second waypoint it has the error at its fall, 2 m; where it breaks, it has none that can be measured."""
    low = scored([[0.8, 0.8], [0.8, 0.2], [0.8, 0.19], [0.8, 0.8]])
    for m, far, turned in ((low, 2.0, 0.2), (scored([[0.8, 0.8]] * 4, broken=2), NAN, NAN)):
        assert m.survival_s.tolist() == [2.0, 1.5]
        assert m.completed.tolist() == [True, False]
        assert m.energy.tolist() == pytest.approx([16.5, 9.0])
        assert m.vibration.tolist() == pytest.approx([14.0, 0.0])
        torch.testing.assert_close(m.position_error, torch.tensor([[0.5, 0.5], [1.0, far]]), equal_nan=True)
        torch.testing.assert_close(m.yaw_error, torch.tensor([[0.5, 0.5], [0.1, turned]]), equal_nan=True)


def test_of_a_run_that_breaks_the_last_error_before_that_counts():
    assert scored([[0.8, 0.8]] * 4, broken=3).position_error[1].tolist() == [1.0, 2.0]
    assert scored([[0.8, 0.8]] * 4, broken=1).position_error[1].tolist() == pytest.approx([0.0, NAN], nan_ok=True)


def test_a_state_that_is_not_a_number_spoils_no_score():
    scorer = TourScorer(1, 1, 1, 2, DT, 0.2)
    for value, bad in ((1.0, False), (NAN, True)):
        rate = torch.full((1, 1), value)
        scorer.step(rate[:, 0], rate, rate, rate.expand(1, 2), rate[:, 0], torch.tensor([bad]))
    m = scorer.measures()
    assert (float(m.survival_s), float(m.energy), float(m.vibration)) == (1.0, 0.5, 0.0)


def test_the_report_by_hand():
    """Three runs: two completed; energy is of these, errors are of all five waypoints that were begun."""
    m = TourMeasures(
        torch.tensor([10.0, 10.0, 7.5]), torch.tensor([True, True, False]),
        torch.tensor([[0.1, 0.3], [0.2, 0.2], [0.6, NAN]]), torch.tensor([[0.0, 0.2], [0.1, 0.1], [0.4, NAN]]),
        torch.tensor([100.0, 300.0, 900.0]), torch.tensor([1.0, 2.0, 9.0]),
    )  # fmt: skip
    result = m.report(5.0, 2.5, 0)
    means = {name: value["mean"] for name, value in result["metrics"].items()}
    assert means == pytest.approx({
        "survival_s": 27.5 / 3, "completed_fraction": 2 / 3, "position_error": 1.4 / 5, "yaw_error": 0.8 / 5,
        "energy": 200.0, "vibration": 1.5,
    })  # fmt: skip
    assert result["metrics"]["completed_fraction"]["ci95"] == pytest.approx([0.2077, 0.9385], abs=1e-4)  # Wilson's
    assert result["num_falls"] == 1
    first, last = result["segments"]
    assert (first["end_s"], first["position_error"]["mean"], first["position_error"]["n"]) == (
        5.0, pytest.approx(0.3), 3,
    )  # fmt: skip
    assert (last["end_s"], last["yaw_error"]["mean"], last["yaw_error"]["n"]) == (10.0, pytest.approx(0.15), 2)
    assert result["window"] == {"start": 0.0, "end": 10.0}
    assert result["curve"] == {"time": [2.5, 5.0, 7.5, 10.0], "upright": pytest.approx([1.0, 1.0, 2 / 3, 2 / 3])}
    assert result["metrics_without_falls"]["position_error"]["mean"] == pytest.approx(0.8 / 4)
    assert "per_env" not in result
    assert m.report(5.0, 2.5, 0, per_env=True)["per_env"] == {
        "stood": [1.0, 1.0, 0.0], "survival_s": [10.0, 10.0, 7.5], "completed_fraction": [1.0, 1.0, 0.0],
        "energy": [100.0, 300.0, None], "vibration": [1.0, 2.0, None],
    }  # fmt: skip
    joined = TourMeasures.join([m, m])
    assert joined.energy.tolist() == [100.0, 300.0, 900.0] * 2
    assert joined.position_error.shape == (6, 2)
