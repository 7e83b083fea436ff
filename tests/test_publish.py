"""release.publish: what is shipped of a checkpoint, and what stands beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from random_policy import save_random_policy

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES, to_plain
from cotap.evaluation.policy import load_policy
from release import publish
from release.recipe import require_default

TINY = ["velocity-tracking", "--episode-seconds", "2", "--command-seconds", "1.5", "--threads", "1"]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in place of the package's, and evaluations that take seconds."""
    monkeypatch.setattr(publish, "checkpoint_path", lambda name: tmp_path / "checkpoints" / f"{name}.pt")
    evaluations = {"velocity-tracking": [*TINY, "--num-envs", "ENVS"], "small": [*TINY, "--num-envs", "2"]}
    monkeypatch.setattr(publish, "EVALUATIONS", evaluations)
    monkeypatch.setattr(publish, "require_default", lambda _content: None)  # networks of tests are tiny
    return tmp_path / "checkpoints"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "stage", "method"), [("h1-base", "base", "pd"), ("h1-cotap", "distill", "cotap")])
def test_weights_provenance_and_evaluations_are_written(
    tmp_path: Path, package: Path, name: str, stage: str, method: str
):
    source = save_random_policy(tmp_path / "run.pt", stage, seed=3)
    assert publish.main([str(source), name, "--envs", "3"]) == 0
    assert sorted(p.name for p in package.iterdir()) == sorted(
        f"{name}{end}" for end in (".pt", ".json", ".velocity-tracking.json", ".small.json")
    )
    before, after = load_checkpoint(source), load_checkpoint(package / f"{name}.pt")
    assert before["learner"]
    assert before["env"]
    assert after["learner"] == after["env"] == {}
    assert not {"rng", "device_rng"} & after.keys()
    for key, value in before["model"].items():
        assert torch.equal(after["model"][key], value), key
    assert load_policy(package / f"{name}.pt").stage == stage
    said = json.loads((package / f"{name}.json").read_text())
    assert said["sha256"] == sha256(package / f"{name}.pt")
    assert (said["robot"], said["stage"], said["seed"], said["hours"]) == ("h1", stage, 3, 0.0)
    assert {"command", "commit", "samples", "iterations", "machine"} <= said.keys()
    assert {k: v["num_envs"] for k, v in said["evaluations"].items()} == {"velocity-tracking": 3, "small": 2}
    result = json.loads((package / f"{name}.small.json").read_text())
    assert result["settings"]["checkpoint_sha256"] == said["sha256"]
    assert result["method"] == method


def test_all_runs_that_a_policy_went_through_are_named(tmp_path: Path, package: Path):
    content = load_checkpoint(save_random_policy(tmp_path / "run.pt"))
    content["config"] |= {"earlier_runs": [{"command": "first", "commit": "a"}], "command": f"{Path.cwd()}/second"}
    save_checkpoint(tmp_path / "run.pt", content)
    assert publish.main([str(tmp_path / "run.pt"), "h1-base", "--envs", "2"]) == 0
    said = json.loads((package / "h1-base.json").read_text())
    assert [run["command"] for run in said["runs"]] == ["first", "second"]  # and no folder of this machine


@pytest.mark.parametrize(("content", "message"), [(None, "does not exist"), ({"model": {}}, "lacks its part 'kind'")])
def test_what_is_no_checkpoint_of_a_run_is_refused_and_leaves_nothing(
    tmp_path: Path, package: Path, capsys: pytest.CaptureFixture[str], content: dict | None, message: str
):
    if content is not None:
        save_checkpoint(tmp_path / "odd.pt", content)
    assert publish.main([str(tmp_path / "odd.pt"), "h1-base"]) == 2
    assert message in capsys.readouterr().err
    assert not list(package.iterdir())


def test_a_policy_is_published_under_its_own_name_only(tmp_path: Path, package: Path, capsys: pytest.CaptureFixture):
    source = save_random_policy(tmp_path / "run.pt", "distill")
    assert publish.main([str(source), "h1-base"]) == 2
    assert "is of h1-cotap, it cannot be published as h1-base" in capsys.readouterr().err
    assert not list(package.iterdir())


def of_default(stage: str) -> dict[str, Any]:
    """A checkpoint's config of a run of the recipe `default`, whose base had 60 M samples."""
    training = BASE_RECIPES["default"]("g1")
    training.threads, training.seed = 1, 3
    config: dict[str, Any] = {"stage": stage}
    if stage == "distill":
        training.train_for(60e6)
        config["base"] = {"runs": [{"samples": 1}, {"samples": training.samples}]}
        training = DISTILL_RECIPES["default"](training)
    return {"config": config | {"training": json.loads(json.dumps(to_plain(training)))}}


@pytest.mark.parametrize("stage", ["base", "distill"])
def test_what_ships_is_of_the_recipe_default(stage: str):
    content = of_default(stage)
    require_default(content)
    del content["config"]["training"]["env"]["forces"]["punches"]  # of before there were any
    require_default(content)
    content["config"]["training"]["ppo"]["gamma"] = 0.5
    content["config"]["training"]["env"]["rewards"]["lower"] |= {"foot_slip": -9.0, "gone": 1.0}
    said = r"recipe default: env\.rewards\.lower\.foot_slip is -9\.0, not .*gamma is 0\.5"
    with pytest.raises(ValueError, match=said) as caught:
        require_default(content)
    assert "env.rewards.lower.gone is 1.0, not None" in str(caught.value)


def test_a_run_of_another_recipe_does_not_ship(tmp_path: Path, package: Path, monkeypatch: Any, capsys: Any):
    monkeypatch.setattr(publish, "require_default", require_default)
    source = save_random_policy(tmp_path / "run.pt")  # of other networks
    assert publish.main([str(source), "h1-base"]) == 2
    assert "ppo.hidden is [8, 8], not [256, 128, 64]" in capsys.readouterr().err
    assert not list(package.iterdir())


def test_what_ships_may_be_evaluated_again_whatever_the_recipe_is_now(tmp_path: Path, package: Path, monkeypatch: Any):
    shipped = package / "h1-base.pt"
    package.mkdir()
    save_random_policy(shipped)
    before = sha256(shipped)

    def refuse(_content: dict) -> None:
        raise ValueError("not of the recipe")

    monkeypatch.setattr(publish, "require_default", refuse)
    assert publish.main([str(shipped), "h1-base", "--envs", "2"]) == 0
    assert json.loads((package / "h1-base.json").read_text())["sha256"] == sha256(shipped) == before
    other = save_random_policy(tmp_path / "run.pt", seed=3)
    assert publish.main([str(other), "h1-base", "--envs", "2"]) == 2
