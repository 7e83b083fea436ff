"""Examples in the documentation run, and are what the page shows."""

from __future__ import annotations

import runpy
from pathlib import Path

import torch

DOCS = Path(__file__).parents[1] / "docs"


def test_the_compliance_example_runs_and_is_the_one_shown(capsys):
    example = DOCS / "examples" / "compliance.py"
    result = runpy.run_path(str(example))
    assert result["torque"].shape == (1, 2, 4)
    assert torch.isfinite(result["torque"]).all()
    assert "tensor" in capsys.readouterr().out
    shown = example.read_text().split('"""\n\n', 1)[1]
    assert shown in (DOCS / "compliance.md").read_text()
