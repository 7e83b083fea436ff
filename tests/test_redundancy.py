"""What reports.redundancy says of two robots' changes from PD to CoTaP."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from reports import redundancy
from reports.paper.arms import COMPLIANT
from reports.paper.words import LABELS


def change(mean: float, half: float = 0.01) -> dict[str, Any]:
    return {"mean": mean, "ci95": [mean - half, mean + half], "n": 100}


@pytest.mark.parametrize(
    ("h1", "g1", "verdict"),
    [(-0.10, -0.20, "more"), (-0.20, -0.10, "less"), (0.2, 0.1, "more"), (-0.10, -0.114, "cannot be distinguished")],
)
def test_a_change_is_more_or_less_beyond_the_interval_of_the_difference(h1, g1, verdict):
    """With a half width of 0.01 each, that of the difference is 0.01414."""
    assert redundancy.verdict(change(h1), change(g1)) == verdict


def test_what_was_not_measured_has_no_verdict():
    none = {"mean": None, "ci95": None, "n": 0, "reason": "fewer than two envs stood in both"}
    assert redundancy.verdict(change(0.1), none) == "not measured"


def write(path: Path, robot: str, mean: float, modes: tuple[str, ...]) -> str:
    changes = {mode: {arms: {m: change(mean) for m in LABELS} for arms in COMPLIANT} for mode in modes}
    path.write_text(json.dumps({"robot": robot, "changes": changes}))
    return str(path)


def test_the_page_compares_every_mode(tmp_path):
    h1 = write(tmp_path / "h1.json", "h1", -0.1, ("stance", "walking"))
    g1 = write(tmp_path / "g1.json", "g1", -0.2, ("stance", "walking", "stance, impulse by mass"))
    out = tmp_path / "docs.md"
    assert redundancy.main(["--h1", h1, "--g1", g1, "--output", str(out)]) == 0
    page = out.read_text()
    assert "| e_torso | K 100 | -10.0 [-11.0,-9.0] | -20.0 [-21.0,-19.0] | more |" in page
    assert "**Of 75 comparisons 75 say more, 0 less, and 0 cannot be distinguished; 25 were not measured.**" in page
    assert "| e_torso | K 100 | -10.0 [-11.0,-9.0] | (not measured) | not measured |" in page.split("## Walking")[2]


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "reproduce_paper --robot g1 writes it"),
        ("{", "is not JSON"),
        ('{"robot": "h1", "changes": {}}', "must be of robot 'g1', got 'h1'"),
        ('{"robot": "g1", "changes": {}}', "has no changes"),
        ("[]", "must be of robot 'g1', got None"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(content, named, tmp_path, capsys):
    h1, g1 = write(tmp_path / "h1.json", "h1", 0.1, ("stance",)), tmp_path / "g1.json"
    if content is not None:
        g1.write_text(content)
    out = tmp_path / "docs.md"
    with pytest.raises(SystemExit) as stop:
        redundancy.main(["--h1", h1, "--g1", str(g1), "--output", str(out)])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert named in " ".join(error.split())
    assert str(g1) in error
    assert not out.exists()
