"""Examples in the documentation run, and are what the page shows."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
import torch

from cotap.compliance.laws import LAWS

DOCS = Path(__file__).parents[1] / "docs"


def test_the_compliance_example_runs_and_is_the_one_shown(capsys):
    example = DOCS / "examples" / "compliance.py"
    result = runpy.run_path(str(example))
    assert result["torque"].shape == (1, 2, 4)
    assert torch.isfinite(result["torque"]).all()
    assert "tensor" in capsys.readouterr().out
    shown = example.read_text().split('"""\n\n', 1)[1]
    assert shown in (DOCS / "compliance.md").read_text()


def test_the_law_of_ones_own_runs_and_is_the_one_shown(monkeypatch):
    monkeypatch.setitem(LAWS, "floating-pd", None)  # so that what the example adds is taken out again
    example = DOCS / "examples" / "law.py"
    soft, stiff = runpy.run_path(str(example))["sag"].tolist()
    # Joints 0.4 times as stiff: the hand gives 2.5 times as far.
    assert 0.005 < stiff < 0.015
    assert soft / stiff == pytest.approx(2.5, rel=0.1)
    assert example.read_text().split('"""\n\n', 1)[1] in (DOCS / "laws.md").read_text()
