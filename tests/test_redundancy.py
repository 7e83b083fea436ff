"""What reports.redundancy says of two robots' changes from PD to CoTaP."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from reports import redundancy
from reports.paper import constant_load, impact, periodic, relative
from reports.paper.book import Book


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


def write(path: Path, robot: str, mean: float, modes: tuple[str, ...], rows: dict[str, Any] | None = None) -> str:
    tables = {mode: table for table in redundancy.TABLES.values() for mode in table.modes}
    changes = {
        mode: {arms: {m: change(mean) for m in tables[mode].measures} for arms in tables[mode].arms} for mode in modes
    }
    path.write_text(json.dumps({"robot": robot, "changes": changes, "rows": rows or {}}))
    return str(path)


LOADS = ("constant load", "periodic load")


def test_the_page_compares_every_mode(tmp_path):
    h1 = write(tmp_path / "h1.json", "h1", -0.1, ("stance", "walking", *LOADS))
    g1 = write(tmp_path / "g1.json", "g1", -0.2, ("stance", "walking", "stance, impulse by mass", *LOADS))
    out = tmp_path / "docs.md"
    assert redundancy.main(["--h1", h1, "--g1", g1, "--output", str(out)]) == 0
    page = out.read_text()
    assert page.count("Robots that stood under both laws: H1 100 to 100, G1 100 to 100.") == 5
    assert page.count("Robots that stood under both laws: H1 100 to 100, G1 not measured.") == 1
    assert page.count("| K 100 | -10.0±1.0 / -20.0±1.0, **more** |") == 3
    # Impacts: 5 measures of 5 arms in 4 tables; constant load: 3 of 4 arms; periodic load: 3 of one.
    assert "**Of 90 comparisons 90 say more, 0 less, and 0 cannot be distinguished; 25 were not measured.**" in page
    assert "| K 100 | not measured |" in page.split("## Impact, walking")[2]
    assert "| e_torso | 19 | 0 | 0 | 5 |" in page
    assert "| elbow torque, rms | 1 | 0 | 0 | 0 |" in page
    assert "| K_z 500 |" + " -10.0±1.0 / -20.0±1.0, **more** |" * 3 in page
    assert "| arms | elbow torque, amplitude | elbow torque, rms | work of the arm |" in page
    for table in re.findall(r"(?:^\|.*\n)+", page, re.M):
        assert len({line.count("|") for line in table.splitlines()}) == 1


def test_what_may_say_why_is_compared(tmp_path):
    def rows(singular: float, null: float) -> dict[str, Any]:
        measures = {"condition_number": change(5.0), "singular_share": change(singular), "null_share": change(null)}
        left = {f"{name}_left": value for name, value in measures.items()}
        return {"impact-stance-K-100": {"metrics_without_falls": measures}, "periodic": {"metrics_without_falls": left}}

    h1 = write(tmp_path / "h1.json", "h1", -0.1, LOADS, rows(0.3, 0.1))
    g1 = write(tmp_path / "g1.json", "g1", -0.1, LOADS, rows(0.05, 0.4))
    redundancy.main(["--h1", h1, "--g1", g1, "--output", str(tmp_path / "out.md")])
    page = (tmp_path / "out.md").read_text()
    name = "share of time above 10 [%]"
    assert f"| {name} | impact, stance, K 100 | 30.0±1.0 | 5.0±1.0 | lower |" in page
    assert "| 10.0±1.0 | 40.0±1.0 | higher |" in page
    assert "| periodic load, left arm | 5.000±0.010 | 5.000±0.010 | cannot be distinguished |" in page
    assert f"| {name} | constant load, K_z 100 | (not measured) | (not measured) | not measured |" in page


def test_the_rows_of_the_causes_are_evaluations_of_the_page():
    """Their names are made of those of arms, elsewhere."""
    assert redundancy.ROWS["impact, stance, K 100"][0] == impact.key("stance", "K 100")
    assert redundancy.ROWS["impact, walking, K 100"][0] == impact.key("walking", "K 100")
    assert redundancy.ROWS["constant load, K_z 100"][0] == constant_load.key("K_z 100")


def test_changes_from_pd_are_kept_of_loads_too(tmp_path):
    """Twice the torque at the elbow, half of it under PD on the right; a hand that goes three times as far."""
    book = Book("h1", tmp_path, tmp_path)
    stood = {"stood": [1.0, 1.0]}
    far = {m: [1.0, 1.0] for m in constant_load.CHANGING}
    book.results["load-PD"] = {"per_env": stood | far}
    book.results["load-K-z-500"] = {"per_env": stood | far | {"e_ee_hit": [3.0, 3.0]}}
    relative.keep_changes(book, "constant load", "load", constant_load.COMPLIANT, constant_load.CHANGING)
    ((arms, changes),) = book.changes["constant load"].items()
    assert arms == "K_z 500"
    assert {m: c["mean"] for m, c in changes.items()} == {"e_torso": 0.0, "e_ee_hit": 2.0, "j_upper": 0.0}
    sides = {f"{m}_{side}": [value] * 2 for m in periodic.CHANGING for side, value in (("left", 1.0), ("right", 2.0))}
    book.results["periodic"] = {"per_env": stood | sides}
    relative.keep_changes_of_sides(book, "periodic load", "periodic", "x", periodic.CHANGING)
    assert [c["mean"] for c in book.changes["periodic load"]["x"].values()] == [-0.5] * 3


def test_a_cell_names_what_is_more_or_less_and_no_more():
    pair = [change(-0.1), change(-0.114)]
    assert redundancy.compared(pair, "less") == "-10.0±1.0 / -11.4±1.0, *less*"
    assert redundancy.compared(pair, "cannot be distinguished") == "-10.0±1.0 / -11.4±1.0"


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
