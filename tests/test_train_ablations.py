"""Ablations and seeds are trained one after another, go on where they stopped, and end in the next command."""

from __future__ import annotations

import pytest

from cotap.agents.checkpoint import save_checkpoint
from cotap.configs import DISTILL_RECIPES
from reports import train_ablations
from reports.paper.book import POLICIES
from reports.train_ablations import TRAININGS, main


@pytest.fixture
def asked(monkeypatch) -> list[list[str]]:
    """What was asked of the training of stage 2, which reaches its third iteration of as many as are given."""
    calls: list[list[str]] = []

    def run_stage(stage: str, args: list[str]) -> None:
        assert stage == "distill"
        calls.append(args)
        folder = train_ablations.Path(args[args.index("--run-dir") + 1])
        folder.mkdir(parents=True, exist_ok=True)
        iterations = int(args[args.index("--iterations") + 1])
        training = {"runner": {"iterations": iterations}}
        base = {"sha256": args[args.index("--base-checkpoint") + 1] if "--base-checkpoint" in args else "shipped"}
        content = {"iteration": 3, "config": {"training": training, "base": base}, "layout": {"robot": "g1"}}
        save_checkpoint(folder / "checkpoint_000003.pt", content)

    monkeypatch.setattr(train_ablations, "run_stage", run_stage)
    return calls


def test_each_has_a_row_in_the_tables_and_a_recipe():
    assert set(TRAININGS) == set(POLICIES) - {"cotap", "base"}
    assert {args[1] for args in TRAININGS.values()} <= DISTILL_RECIPES.keys()
    assert len({tuple(args) for args in TRAININGS.values()}) == len(TRAININGS)


def test_all_are_trained_and_the_next_command_names_them(asked, tmp_path, capsys):
    assert main(["--run-dir", str(tmp_path), "--iterations", "3", "--threads", "1"]) == 0
    for (name, own), args in zip(TRAININGS.items(), asked, strict=True):
        given, rest = ["--iterations", "3", "--threads", "1"], ["--run-dir", str(tmp_path / name), "--resume", "auto"]
        assert args == [*given, *own, *rest]
    said = capsys.readouterr().out
    assert f"--robot g1 --policies seed-0={tmp_path}/seed-0/checkpoint_000003.pt" in said
    assert f" facet={tmp_path}/facet/checkpoint_000003.pt\n" in said


def test_what_they_differ_in_is_not_overridden(asked, tmp_path):
    """Of an option given twice, the last counts; a seed is named, for that of the base is the default."""
    main(["--run-dir", str(tmp_path), "--iterations", "3", "--recipe", "default", "--seed", "1"])
    last = {name: {o: args[len(args) - args[::-1].index(o)] for o in ("--recipe", "--seed")}
            for name, args in zip(TRAININGS, asked, strict=True)}  # fmt: skip
    assert [last[f"seed-{seed}"]["--seed"] for seed in range(3)] == ["0", "1", "2"]
    assert {last[f"seed-{seed}"]["--recipe"] for seed in range(3)} == {"quick"}
    assert all(last[name]["--recipe"] == name for name in ("no-ratio", "torque-critic", "goals", "facet"))


def test_the_tables_have_the_base_that_all_began_from(asked, tmp_path, capsys):
    assert main(["--run-dir", str(tmp_path), "--iterations", "3", "--base-checkpoint", "b.pt", "--only", "goals"]) == 0
    assert asked[0][asked[0].index("--base-checkpoint") + 1] == "b.pt"
    assert f"--policies base=b.pt goals={tmp_path}/goals/" in capsys.readouterr().out


def test_those_of_different_bases_are_not_compared(asked, tmp_path, capsys, monkeypatch):
    """As where the shipped base was replaced between two of them."""
    said = ["--run-dir", str(tmp_path), "--iterations", "3", "--only", "goals", "facet", "seed-0"]
    sha = iter(["old", "new"])
    train_one = train_ablations.run_stage

    def run_stage(stage: str, args: list[str]) -> None:
        train_one(stage, [*args, "--base-checkpoint", next(sha)])

    monkeypatch.setattr(train_ablations, "run_stage", run_stage)
    assert main(said) == 2
    assert len(asked) == 2
    error = capsys.readouterr().err
    assert f"{tmp_path}/facet began from another base than {tmp_path}/goals" in error


def test_one_that_is_stopped_ends_it(asked, tmp_path, capsys):
    assert main(["--run-dir", str(tmp_path), "--only", "goals", "facet", "--iterations", "4"]) == 130
    assert len(asked) == 1
    assert "stopped at iteration 3 of 4 of" in capsys.readouterr().err


def test_bad_names_and_options_are_refused(tmp_path, capsys):
    assert main(["--only", "gaols"]) == 2
    assert "--only" in capsys.readouterr().err
    assert main(["--run-dir", str(tmp_path), "--base-checkpoint", str(tmp_path / "none.pt")]) == 2
    assert "none.pt" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_two_are_trained_from_the_shipped_base(tmp_path, capsys):
    small = ["--run-dir", str(tmp_path), "--num-envs", "8", "--iterations", "1", "--threads", "1"]
    for _ in range(2):  # the second time there is nothing left to do
        assert main([*small, "--only", "seed-1", "goals"]) == 0
        assert capsys.readouterr().out.count("checkpoint_000001.pt") >= 2
    assert len(list((tmp_path / "seed-1").glob("checkpoint_*.pt"))) == 1
