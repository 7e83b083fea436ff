"""The demo, with nothing trained or measured: what it asks for, and what it tells to do next."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cotap.evaluate import parse
from examples import demo


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Policies of H1 are shipped; nothing reads them."""
    for name in ("h1-base", "h1-cotap"):
        (tmp_path / f"{name}.pt").touch()
    monkeypatch.setattr("cotap.evaluation.policy.checkpoint_path", lambda name: tmp_path / f"{name}.pt")


@pytest.mark.usefixtures("in_tmp_path", "shipped")
def test_it_ends_with_the_command_that_the_readme_has_for_the_page(monkeypatch, capsys):
    def evaluate(arguments):
        assert Path(arguments[arguments.index("--checkpoint") + 1]).name == "h1-cotap.pt"
        parse(arguments)
        if "--json" in arguments:
            value = {"mean": 0.5, "ci95": [0.4, 0.6]}
            Path(arguments[arguments.index("--json") + 1]).write_text(
                json.dumps({"metrics": dict.fromkeys(demo.MEASURES, value)})
            )
        return 0

    def train(arguments):
        assert arguments[:2] == ["distill", "--base-checkpoint"]
        (demo.OUT / "training").mkdir()
        (demo.OUT / "training" / f"checkpoint_{demo.ITERATIONS:06d}.pt").touch()
        return 0

    monkeypatch.setattr("cotap.evaluate.main", evaluate)
    monkeypatch.setattr("cotap.train.main", train)
    assert demo.main([]) == 0
    out = capsys.readouterr().out
    assert "| envs that fell | 0.500 (0.400 to 0.600) | 0.500 (0.400 to 0.600) |" in out
    command = ".venv/bin/cotap play"
    assert command in out.splitlines()[-1]
    assert f"`{command.removeprefix('.venv/bin/')}`" in (Path(__file__).parents[1] / "README.md").read_text()


@pytest.mark.usefixtures("in_tmp_path", "shipped")
def test_it_ends_where_its_training_is_stopped(monkeypatch):
    monkeypatch.setattr("cotap.train.main", lambda _: 0)  # a training that is asked to stop ends in order
    monkeypatch.setattr("cotap.evaluate.main", None)
    assert demo.main([]) == 130


@pytest.mark.usefixtures("in_tmp_path")
def test_without_a_shipped_base_it_says_so(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("cotap.evaluation.policy.checkpoint_path", lambda name: tmp_path / f"{name}.pt")
    assert demo.main([]) == 2
    assert "checkpoint 'h1-base' is not shipped" in capsys.readouterr().err
    assert not demo.OUT.exists()
