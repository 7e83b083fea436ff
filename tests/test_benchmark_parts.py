"""Benchmarks: parts of `training` run and do what they are to time; bad input is refused before the work."""

from __future__ import annotations

import sys

import pytest
import torch

from benchmarks import fault_injection, scaling, soak, training
from cotap.compliance.laws import LAWS


def run(part: training.Compliance, steps: int) -> None:
    for _ in range(steps):
        part.once()


@pytest.mark.parametrize("law", LAWS)
def test_every_law_can_be_timed(law):
    part = training.Compliance(3, 0.0, law)
    run(part, 3)
    assert part.step == 3
    assert not part.fresh.any()


@pytest.mark.parametrize("kind", [training.InverseKinematics, training.LiteralCompliance])
def test_what_laws_are_compared_with_can_be_timed(kind):
    run(kind(3, 0.0), 2)


def test_stores_that_are_timed_hold_changes_back():
    part = training.Compliance(32, 0.0, passive=True)
    run(part, 60)
    assert 0.01 < part.held / part.step < 0.5
    spread = part.stiffness.amax(0) / part.stiffness.amin(0)
    torch.testing.assert_close(spread, torch.full_like(spread, 16.0), rtol=0.05, atol=0)


@pytest.mark.parametrize(("module", "arguments"), [(fault_injection, []), (scaling, ["measure"]), (soak, [])])
def test_a_file_that_cannot_be_written_is_refused_before_the_work(module, arguments, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", ["it", *arguments, "--json", str(tmp_path / "nowhere" / "result.json")])
    with pytest.raises(SystemExit, match="2"):
        module.main()
    assert "its folder does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["2", "0x1", "1x0", "1x-1", "x", "1x2x3"])
def test_layouts_that_are_none_are_refused(text, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["it", "measure", "--layouts", "2x1", text])
    with pytest.raises(SystemExit, match="2"):
        scaling.main()
    assert "must be PROCESSESxTHREADS, got" in capsys.readouterr().err
    assert scaling.layout("2x11") == (2, 11)


def test_what_was_not_survived_is_not_called_so():
    good, bad = (fault_injection.Row("a fault", 2, survived, 0, "ends equal") for survived in (2, 1))
    assert "| 2 | 2 | 0 | ends equal |" in fault_injection.table([good])
    assert "| 2 | 1 | 0 | not as it should be |" in fault_injection.table([bad])


@pytest.mark.slow
def test_messages_of_two_processes_are_counted():
    counted = scaling.count()
    assert counted["messages"].keys() == counted["bytes"].keys() == {"gradients", "normalisers", "scalars"}
    assert counted["bytes"]["gradients"] > 4 * sum(counted["weights"].values())  # of all weights, in float32
