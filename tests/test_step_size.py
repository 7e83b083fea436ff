"""What benchmarks.step_size says of a physics step, for any robot."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import step_size
from cotap.robots import ROBOTS


@pytest.mark.parametrize("robot", ["h1", "g1"])
def test_joints_are_nearer_to_the_truth_with_a_smaller_step(robot):
    spec = ROBOTS[robot]()
    rng = np.random.default_rng(0)
    targets = [joint.default_rad for joint in spec.joints] + 0.15 * rng.normal(size=(1, 4, len(spec.joints)))
    targets = np.repeat(targets, 10, axis=0)
    truth, _ = step_size.simulate(spec, 0.0005, True, targets)
    errors = [np.abs(step_size.simulate(spec, step, True, targets)[0] - truth).mean() for step in (0.0025, 0.005, 0.01)]
    assert errors == sorted(errors)
    assert 0.0 < errors[-1] < 0.05


def test_the_tables_are_of_the_robot_that_is_asked_for(monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(step_size, "tremor", lambda *arguments: asked.append(arguments) or (0.25, 0.5))
    options = ["--robot", "g1", "--envs", "2", "--seconds", "0.1", "--repeats", "1", "--poses", "3"]
    monkeypatch.setattr("sys.argv", ["step_size", *options])
    assert step_size.main() == 0
    assert asked[0] == ("g1", 2, 100.0, 3)
    page = capsys.readouterr().out
    assert "| 10 ms | implicit |" in page
    assert "| 2.5 ms | 1000 | 0.2500 | 0.5000 |" in page


@pytest.mark.slow
def test_arms_that_have_just_begun_to_move_are_not_at_rest(monkeypatch):
    monkeypatch.setattr(step_size, "REST_S", -0.8)
    rms, worst = step_size.tremor("g1", 2, 300.0, 2)
    assert 0.1 < rms <= worst
