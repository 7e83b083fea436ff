"""What reports.learning_curve takes from a run's checkpoints, and when a run has reached its goal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from random_policy import save_random_policy

from cotap.agents.checkpoint import save_checkpoint
from reports import learning_curve
from reports.learning_curve import every, first_at_goal, main

SLOPES = {1: 0.5, 2: 0.9, 3: 0.95}
FALLS = {1: 0, 2: 8, 3: 1}
"""By millions of samples; of 100 envs."""


@pytest.fixture
def run(tmp_path, monkeypatch) -> Path:
    """A run of three checkpoints, evaluated without simulation. The list of what was evaluated is `run / "asked"`."""
    folder = tmp_path / "run"
    folder.mkdir()
    for millions in SLOPES:
        save_checkpoint(
            folder / f"checkpoint_{25 * millions:06d}.pt",
            {"samples": millions * 10**6, "wall_seconds": 720.0 * millions},
        )

    def evaluate(arguments: list[str]) -> dict[str, Any]:
        with (tmp_path / "asked").open("a") as log:
            log.write(" ".join(arguments) + "\n")
        (checkpoint,) = (argument for argument in arguments if argument.startswith("--checkpoint="))
        millions = int(checkpoint.rpartition("_")[2].removesuffix(".pt")) // 25
        if arguments[0] == "tour":
            return {"metrics": {name: {"mean": 10.0 * millions} for name in ("survival_s", "completed_fraction")}}
        slopes = {f"slope_{axis}": SLOPES[millions] for axis in ("x", "y", "yaw")} | {"slope_height": None}
        return {"slopes": slopes, "num_falls": FALLS[millions], "num_envs": 100}

    monkeypatch.setattr(learning_curve, "evaluate", evaluate)
    monkeypatch.setattr(learning_curve, "plot", lambda *_: None)
    return folder


def report(run: Path, *options: str) -> tuple[dict[str, Any], str, list[str]]:
    """The JSON, the page and what was evaluated."""
    out = run.parent / "out"
    assert main([str(run), "--output", str(out), "--num-envs", "100", *options]) == 0
    asked = (run.parent / "asked").read_text().splitlines()
    (run.parent / "asked").write_text("")
    return json.loads((out / "learning_curve.json").read_text()), (out / "learning_curve.md").read_text(), asked


def test_the_goal_is_reached_where_slope_and_falls_are(run):
    content, page, asked = report(run, "--every-samples", "1e6", "--threads", "3", "--seed", "5")
    assert [row["samples"] for row in content["rows"]] == [1_000_000, 2_000_000, 3_000_000]
    assert asked[0] == (
        f"velocity-tracking --checkpoint={run / 'checkpoint_000025.pt'} --num-envs=100 --seed=5 --threads=3"
    )
    assert f"| {run} | 2.0 | 0.40 | 0.900 | 0.900 | 0.900 | 0.080 |" in page  # walks, and too many fall
    assert page.split("first checkpoint:")[1].split("\n")[4] == f"| {run} | 3.0 | 0.60 |"


def test_a_goal_that_is_not_reached_is_said(run):
    assert f"| {run} | not reached | - |" in report(run, "--slope", "0.96")[1]
    assert f"| {run} | not reached | - |" in report(run, "--falls", "0.005")[1]
    assert f"| {run} | 2.0 | 0.40 |\n" in report(run, "--falls", "0.08", "--every-samples", "1e6")[1]


def test_survival_is_that_of_the_tour(run):
    content, page, asked = report(run, "--protocols", "tour", "--every-samples", "2e6")
    assert [line.split()[0] for line in asked] == ["tour"] * 3
    assert [row["measures"]["tour"]["survival_s"] for row in content["rows"]] == [10.0, 20.0, 30.0]
    assert f"| {run} | 3.0 | 0.60 | 30.000 | 30.000 |" in page
    assert "first checkpoint" not in page


def test_pushed_robots_stand_and_are_struck_on_the_base(run):
    content, page, asked = report(run, "--protocols", "push", "--every-samples", "2e6")
    assert asked[0].startswith("impact --place=base --force 500 0 0 --random-direction --checkpoint=")
    assert [row["measures"]["push"]["falls_pushed"] for row in content["rows"]] == [0.0, 0.08, 0.01]
    assert "| share that fell when pushed |" in page
    assert f"| {run} | 2.0 | 0.40 | 0.080 |" in page


def test_what_was_evaluated_is_kept_if_it_is_asked_for(run):
    first, page, asked = report(run, "--every-samples", "3e6")
    assert len(asked) == 2
    again = report(run, "--every-samples", "3e6", "--reuse")
    assert again == (first, page, [])
    assert len(report(run, "--every-samples", "1e6", "--reuse")[2]) == 1
    both = report(run, "--every-samples", "1e6", "--reuse", "--protocols", "velocity-tracking", "tour")[2]
    assert [line.split()[0] for line in both] == ["tour"] * 3
    assert len(report(run, "--every-samples", "1e6", "--reuse", "--seed", "1")[2]) == 3
    newest = run / "checkpoint_000075.pt"
    save_checkpoint(newest, {"samples": 3 * 10**6, "wall_seconds": 1.0})  # another run of that name
    assert [line.split("=")[1] for line in report(run, "--seed", "1", "--reuse")[2]] == [f"{newest} --num-envs"]
    assert len(report(run, "--seed", "1")[2]) == 2


def test_an_interrupted_report_is_gone_on_with(run, monkeypatch):
    evaluate, left = learning_curve.evaluate, [1]

    def once(arguments: list[str]) -> dict[str, Any]:
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return evaluate(arguments)

    monkeypatch.setattr(learning_curve, "evaluate", once)
    assert main([str(run), "--output", str(run.parent / "out"), "--num-envs", "100", "--every-samples", "1e6"]) == 130
    monkeypatch.setattr(learning_curve, "evaluate", evaluate)
    (run.parent / "asked").write_text("")
    assert len(report(run, "--every-samples", "1e6", "--reuse")[2]) == 2


def test_the_plot_has_a_panel_for_each_measure_over_samples_and_hours(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(learning_curve, "save_figure", lambda figure, _: figures.append(figure))
    measures = {"velocity-tracking": {"slope_x": 0.5, "falls": 0.1}, "tour": {"survival_s": None}}
    row = {"run": "a", "samples": 2_000_000, "wall_seconds": 7200.0, "measures": measures}
    bare = row | {"run": "b", "measures": {"velocity-tracking": {"slope_x": None, "falls": 0.3}}}
    learning_curve.plot(tmp_path / "x.png", [bare, row], learning_curve.Options(("b", "a")))
    axes = figures[0].axes
    assert [a.get_xlabel() for a in axes] == ["samples [M]", "hours"] * 2
    drawn = [[line.get_xydata().tolist() for line in a.lines[:2]] for a in axes]
    assert drawn == [[[], [[2.0, 0.5]]]] * 2 + [[[[2.0, 0.3]], [[2.0, 0.1]]]] * 2  # nothing that was not measured
    assert [a.lines[2].get_ydata()[0] for a in axes] == [0.85, 0.85, 0.02, 0.02]
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["b", "a"]


def test_checkpoints_are_taken_at_every_multiple():
    rows = [{"samples": s} for s in (3, 6, 9, 12, 15, 18, 21)]
    assert [r["samples"] for r in every(rows, 10)] == [3, 12, 21]
    assert [r["samples"] for r in every(rows, 1)] == [3, 6, 9, 12, 15, 18, 21]
    assert [r["samples"] for r in every(rows, 100)] == [3, 21]
    assert [r["samples"] for r in every(rows[:1], 100)] == [3]


def test_a_slope_that_cannot_be_measured_is_no_goal():
    row = {"measures": {"velocity-tracking": {"slope_x": None, "falls": 0.0}}}
    assert first_at_goal([row], 0.0, 1.0) is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none"], "run directory 'none' has no checkpoint_*.pt"),
        (["run", "--every-samples", "0"], "every_samples must lie in"),
        (["run", "--protocols", "impact"], "protocols 'impact' is unknown; known: push, tour, velocity-tracking"),
        (["run", "--num-envs", "0"], "num_envs must be"),
        (["run", "--falls", "2"], "falls must lie in"),
        (["run", "--reuse"], "learning_curve.json' is no report of learning curves"),
        (["torn"], "cannot be read"),
    ],
)
@pytest.mark.usefixtures("in_tmp_path", "run")
def test_bad_input_is_named(arguments, message, capsys):
    Path("torn").mkdir()
    Path("torn/checkpoint_000001.pt").write_bytes(b"PK")
    Path("out").mkdir()
    Path("out/learning_curve.json").write_text("[1]")
    assert main([*arguments, "--output", "out"]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_checkpoints_of_a_training_are_evaluated(tmp_path):
    torch.set_num_threads(1)
    run = tmp_path / "run"
    run.mkdir()
    save_random_policy(run / "checkpoint_000001.pt")
    out = tmp_path / "out"
    protocols = ["--protocols", "velocity-tracking", "push"]
    assert main([str(run), "--output", str(out), "--num-envs", "2", "--threads", "1", *protocols]) == 0
    (row,) = json.loads((out / "learning_curve.json").read_text())["rows"]
    assert row["measures"]["velocity-tracking"]["falls"] == 1.0  # nobody has learned to stand
    assert row["measures"]["push"]["falls_pushed"] == 1.0
    assert "not reached" in (out / "learning_curve.md").read_text()
