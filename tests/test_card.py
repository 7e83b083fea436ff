"""release.card: the page of what ships says what the files say, and marks what is missed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cotap.evaluation.policy import checkpoint_path, shipped_names
from release import card


def test_the_page_that_ships_is_of_the_files_beside_it():
    folder = checkpoint_path("h1-base").parent
    kept = (folder / "README.md").read_text(encoding="utf-8")
    assert kept == card.card(shipped_names(), folder), "run python -m release.card"


def write(folder: Path, name: str, robot: str, falls: float, yaw: float) -> None:
    """A policy's files with one figure each."""
    (folder / f"{name}.json").write_text(json.dumps({"robot": robot, "samples": 12_400_000}))
    share = {"mean": falls, "ci95": [falls / 2.0, falls * 2.0]}
    result = {"metrics": {"fall_fraction": share}, "slopes": {"slope_yaw": yaw}}
    result["slopes_ci95"] = {"slope_yaw": [yaw - 0.01, yaw + 0.01]}
    (folder / f"{name}.some.json").write_text(json.dumps(result))


def test_what_is_missed_is_bold_by_what_is_asked_of_the_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(card, "MEASURES", (
        card.Measure("falls [%]", "some", card.percent, card.most(0.5), card.most(1.0), 1),
        card.Measure("slope yaw", "some", card.slope("yaw"), (0.93, 1.07), None, 2),
    ))  # fmt: skip
    write(tmp_path, "h1-base", "h1", falls=0.008, yaw=1.08)
    write(tmp_path, "g1-base", "g1", falls=0.008, yaw=0.94)
    lines = card.card(["h1-base", "g1-base"], tmp_path).splitlines()
    assert "| samples | 300 M, CoTaP 75 M | the same | 12 M | 12 M |" in lines
    assert "| falls [%] | at most 0.5 | at most 1 | **0.8 (0.4 to 1.6)** | 0.8 (0.4 to 1.6) |" in lines
    assert "| slope yaw | 0.93 to 1.07 | 0.93 to 1.07 | **1.08 (1.07 to 1.09)** | 0.94 (0.93 to 0.95) |" in lines


def test_what_was_not_measured_is_a_dash():
    measure = card.Measure("a", "some", card.metric("a"), card.most(1.0))
    assert card.cell(measure, {"mean": None, "ci95": None}, "h1") == "-"


@pytest.mark.parametrize(
    ("bounds", "said"),
    [(card.most(0.1), "at most 0.1"), ((0.9, 1.0), "at least 0.9"), ((0.8, float("inf")), "at least 0.8"),
     ((0.93, 1.07), "0.93 to 1.07"), ((float("-inf"), float("inf")), "")],
)  # fmt: skip
def test_goals_are_said_in_words(bounds: tuple[float, float], said: str):
    assert card.goal(bounds) == said
