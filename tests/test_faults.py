"""Trainings that are killed and hurt in every way that `benchmarks.fault_injection` knows."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "fault_injection.py"
CAN_BE_REFUSED = {"full disk"}  # where file systems cannot be mounted


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
def test_every_fault_is_survived(tmp_path: Path):
    out = tmp_path / "faults.json"
    command = [sys.executable, str(SCRIPT), "--kills", "12", "--json", str(out)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=1500, cwd=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    rows = {r["fault"]: r for r in json.loads(out.read_text())}
    assert sum(r["injected"] for name, r in rows.items() if name.startswith("SIGKILL")) == 12
    for name, row in rows.items():
        assert row["survived"] == row["injected"], name
        assert row["injected"] > 0 or name in CAN_BE_REFUSED or name.startswith("SIGKILL"), name
        if name.startswith("SIGKILL"):
            assert row["most_lost"] <= 2, name
