"""The training command: what it refuses, what it leaves behind, and what it goes on from."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
from dataclasses import fields
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cotap import __version__, pipeline, train
from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256
from cotap.agents.runner import sole_writer
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES, BaseTraining, from_plain
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.rewards import LowerRewards, UpperRewards
from cotap.evaluation import policy
from cotap.pipeline import PipelineOptions, train_both
from cotap.sim import resolve_backend

# Every option that these tests use, as typed on the command line.
ENVS = "--num-envs"
ITERATIONS = "--iterations"
SEED = "--seed"
THREADS = "--threads"
DEVICE = "--device"
RUN_DIR = "--run-dir"
RESUME = "--resume"
RECIPE = "--recipe"
SAVE_INTERVAL = "--runner.save-interval"
HIDDEN = "--ppo.hidden"
STEPS = "--ppo.steps"
PRECISION = "--ppo.precision"
GAMMA = "--ppo.gamma"
LAM = "--ppo.lam"
ROBOT = "--env.robot"
COLLISION = "--env.collision"
CONTROL_DT = "--env.control-dt"
VELOCITY_X = "--env.commands.velocity-x"
REACH = "--env.motions.generator.reach"
BASE_CHECKPOINT = "--base-checkpoint"
BETA = "--distillation.beta"
EPISODE = "--env.terminations.episode-s"
REWARD = "--env.rewards.lower.track-velocity"
HISTORY = "--env.observations.history"

SMALL = [ENVS, "8", ITERATIONS, "2", THREADS, "1", HIDDEN, "8", "8", STEPS, "6", PRECISION, "fp32"]


def run(*args: Any) -> int:
    """Exit status, whether returned or raised (as the parser does)."""
    try:
        return train.main([str(a) for a in args])
    except SystemExit as stop:
        return int(stop.code or 0)


def run_small(run_dir: Path, *options: Any) -> dict[str, Any]:
    """Train for two tiny iterations and return the last checkpoint's content."""
    assert run("base", *SMALL, RUN_DIR, run_dir, *options) == 0
    return newest(run_dir)


def newest(run_dir: Path) -> dict[str, Any]:
    return load_checkpoint(max(run_dir.glob("checkpoint_*.pt")))


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with its content, and every folder."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in sorted(folder.rglob("*"))}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished tiny run, to look at only."""
    folder = tmp_path_factory.mktemp("runs") / "base"
    run_small(folder, GAMMA, 0.9)
    return folder


@pytest.fixture
def checkpoint(base: Path, tmp_path: Path) -> Path:
    """A copy of its checkpoint, in a folder of its own."""
    target = tmp_path / "first" / "checkpoint_000002.pt"
    target.parent.mkdir()
    target.write_bytes((base / target.name).read_bytes())
    return target


BAD = [
    ([ENVS, 0], ["num_envs", "got 0"]),
    ([ENVS, -3], ["num_envs", "got -3"]),
    ([f"{ENVS}=-3"], ["num_envs", "got -3"]),
    ([ENVS, "many"], ["many"]),
    ([ITERATIONS, 0], ["runner.iterations", "got 0"]),
    ([SAVE_INTERVAL, -1], ["runner.save_interval", "got -1"]),
    ([THREADS, -2], ["threads", "-2"]),
    ([DEVICE, "abacus"], ["device", "abacus"]),
    ([RECIPE, "papr"], ["'papr'", "did you mean 'paper'", "default"]),
    ([f"{RECIPE}=papr"], ["'papr'", "did you mean 'paper'", "default"]),
    ([GAMMA, "nan"], ["ppo.gamma", "nan"]),
    ([GAMMA, 1.5], ["ppo.gamma", "1.5"]),
    ([HIDDEN, 8, 0], ["ppo.hidden[1]", "got 0"]),
    ([STEPS, 0], ["ppo.steps", "got 0"]),
    ([PRECISION, "fp8"], ["precision", "'fp8'", "auto, bf16, fp32"]),
    ([ROBOT, "h2"], ["robot", "'h2'", "known: g1, h1"]),
    ([COLLISION, "foot"], ["collision", "'foot'", "feet", "full"]),
    ([CONTROL_DT, "nan"], ["control_dt", "nan"]),
    ([CONTROL_DT, 0], ["control_dt", "got 0.0"]),
    ([VELOCITY_X, "nan", 1], ["commands.velocity_x[0]", "nan"]),
    ([VELOCITY_X, 1, -1], ["commands.velocity_x", "(1.0, -1.0)"]),
    ([REACH, "inf"], ["motions.generator.reach", "inf"]),
    ([EPISODE, "nan"], ["terminations.episode_s", "nan"]),
    ([REWARD, "nan"], ["rewards.lower.track_velocity", "nan"]),
    ([HISTORY, 0], ["observations.history", "got 0"]),
    (["--no-such-option", 1], ["no-such-option"]),
]


@pytest.mark.parametrize(("options", "needles"), BAD, ids=[" ".join(map(str, o)) for o, _ in BAD])
def test_bad_options_are_named_and_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[Any], needles: list[str]
):
    before = os.getcwd()
    assert run("base", *SMALL, RUN_DIR, tmp_path / "run", *options) == 2
    message = capsys.readouterr().err
    for needle in needles:
        assert needle in message
    assert "Traceback" not in message
    assert tree(tmp_path) == {}
    assert os.getcwd() == before


def test_unknown_stage_is_named_with_the_known_ones(capsys: pytest.CaptureFixture[str]):
    assert run("bse", *SMALL) == 2
    assert "stage 'bse' is unknown (did you mean 'base'?)" in capsys.readouterr().err


def test_help_names_the_options(capsys: pytest.CaptureFixture[str]):
    assert run("base", "--help") == 0
    text = capsys.readouterr().out
    for option in (ENVS, ITERATIONS, SEED, RUN_DIR, RESUME, RECIPE, GAMMA, VELOCITY_X, REWARD):
        assert option in text, option


def damaged(checkpoint: Path, kind: str) -> tuple[Path, list[str]]:
    """A checkpoint that cannot be resumed, and what the error must say besides its path."""
    content = load_checkpoint(checkpoint)
    path = checkpoint.with_name("damaged.pt")
    if kind == "missing":
        return path, ["does not exist"]
    if kind == "folder":
        return checkpoint.parent, ["is no file"]
    if kind == "truncated":
        path.write_bytes(checkpoint.read_bytes()[:-1000])
        return path, ["truncated"]
    if kind == "foreign":
        path.write_text("not a checkpoint")
        return path, ["foreign"]
    if kind == "state dict":
        torch.save({"weight": torch.zeros(2)}, path)
        return path, ["is not a cotap checkpoint"]
    if kind == "version":
        torch.save(content | {"version": 99}, path)
        return path, ["99"]
    if kind == "robot":
        save_checkpoint(path, content | {"layout": content["layout"] | {"robot": "g1"}})
        return path, ["another robot", "'g1'", "'h1'"]
    if kind == "field":
        training = content["config"]["training"]
        save_checkpoint(path, content | {"config": {"training": training | {"colour": 1}}})
        return path, ["no field 'colour'"]
    assert kind == "no config"
    save_checkpoint(path, {k: v for k, v in content.items() if k != "config"})
    return path, ["config"]


@pytest.mark.parametrize(
    "kind", ["missing", "folder", "truncated", "foreign", "state dict", "version", "robot", "field", "no config"]
)
def test_a_checkpoint_that_cannot_be_resumed_is_named_and_leaves_nothing(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
):
    path, needles = damaged(checkpoint, kind)
    before = tree(tmp_path)
    assert run("base", RESUME, path, RUN_DIR, tmp_path / "run", ITERATIONS, 3) == 2
    message = capsys.readouterr().err
    for needle in (*needles, path.name):
        assert needle in message
    assert tree(tmp_path) == before


def test_another_observation_layout_is_refused(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    before = tree(tmp_path)
    assert run("base", RESUME, checkpoint, RUN_DIR, tmp_path / "run", ITERATIONS, 3, HISTORY, 4) == 2
    assert "another history: 5, here 4" in capsys.readouterr().err
    assert tree(tmp_path) == before


def test_other_networks_are_refused(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    before = tree(tmp_path)
    assert run("base", RESUME, checkpoint, RUN_DIR, tmp_path / "run", ITERATIONS, 3, HIDDEN, 16) == 2
    assert "other networks" in capsys.readouterr().err
    assert tree(tmp_path) == before


def test_a_used_run_directory_is_refused_with_what_to_do(checkpoint: Path, capsys: pytest.CaptureFixture[str]):
    before = tree(checkpoint.parent)
    assert run("base", *SMALL, RUN_DIR, checkpoint.parent) == 2
    message = capsys.readouterr().err
    assert f"--resume {checkpoint}" in message
    assert "another --run-dir" in message
    assert tree(checkpoint.parent) == before


def test_a_run_directory_in_use_is_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with sole_writer(tmp_path):
        assert run("base", *SMALL, RUN_DIR, tmp_path) == 2
    assert "another training writes to" in capsys.readouterr().err
    assert tree(tmp_path) == {}


def test_resuming_into_the_directory_of_a_third_run_is_refused(
    base: Path, checkpoint: Path, capsys: pytest.CaptureFixture[str]
):
    before = tree(checkpoint.parent)
    first = base / checkpoint.name
    assert run("base", RESUME, first, RUN_DIR, checkpoint.parent, ITERATIONS, 3) == 2
    assert "already holds a run" in capsys.readouterr().err
    assert tree(checkpoint.parent) == before


@pytest.mark.parametrize("below", ["", "run"])
def test_a_run_directory_that_cannot_be_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], below: str):
    file = tmp_path / "file"
    file.write_text("mine")
    assert run("base", *SMALL, RUN_DIR, file / below) == 2
    assert str(file) in capsys.readouterr().err
    assert tree(tmp_path) == {"file": b"mine"}


def test_a_run_leaves_config_checkpoint_and_logs(base: Path):
    assert sorted(p.name.split(".")[0] for p in base.iterdir()) == ["checkpoint_000002", "config", "events"]
    config = json.loads((base / "config.json").read_text())
    assert config["stage"] == "base"
    assert config["training"]["ppo"]["gamma"] == 0.9
    assert config["training"]["env"]["num_envs"] == 8
    assert GAMMA in config["command"]
    assert {"commit", "machine"} <= config.keys()
    assert config["simulation"] == f"{resolve_backend('auto')}, MuJoCo {mujoco.__version__}"
    content = newest(base)
    assert content["config"] == config
    assert (content["iteration"], content["samples"]) == (2, 2 * 6 * 8)
    assert content["layout"]["robot"] == "h1"


def test_every_reward_term_and_measure_is_logged_at_every_iteration(base: Path):
    logs = EventAccumulator(str(base))
    logs.Reload()
    tags = set(logs.Tags()["scalars"])
    groups = {"lower": LowerRewards(), "upper": UpperRewards()}
    terms = {f"{name}/{f.name}" for name, g in groups.items() for f in fields(g) if getattr(g, f.name) != 0.0}
    assert len(terms) > 20
    measures = {
        "command/error_velocity",
        "command/slope_x",
        "episode/falls_per_s",
        "throughput/steps_per_s",
        *(f"agents/{name}/{what}" for name in groups for what in ("action_std", "learning_rate", "kl", "value")),
    }
    assert terms | measures <= tags
    for tag in tags:
        events = logs.Scalars(tag)
        assert [e.step for e in events] == [48, 96], tag
        assert all(math.isfinite(e.value) for e in events), tag


def test_a_resumed_run_keeps_its_config_but_for_what_is_overridden(checkpoint: Path):
    folder = checkpoint.parent
    assert run("base", RESUME, checkpoint, ITERATIONS, 3, LAM, 0.8) == 0
    content = newest(folder)
    assert content["iteration"] == 3
    assert content["samples"] == 3 * 6 * 8
    training = content["config"]["training"]
    assert (training["ppo"]["gamma"], training["ppo"]["lam"]) == (0.9, 0.8)
    assert training["ppo"]["hidden"] == [8, 8]
    assert training["env"]["num_envs"] == 8
    assert training["runner"]["iterations"] == 3
    (earlier,) = content["config"]["earlier_runs"]
    assert GAMMA in earlier["command"]
    assert LAM in content["config"]["command"]


def test_a_resumed_run_ends_where_a_straight_one_does(checkpoint: Path, tmp_path: Path):
    assert run("base", RESUME, checkpoint, ITERATIONS, 3) == 0
    straight = run_small(tmp_path / "straight", GAMMA, 0.9, ITERATIONS, 3)
    resumed = newest(checkpoint.parent)
    for key, value in straight["model"].items():
        assert torch.equal(value, resumed["model"][key]), key
    assert torch.equal(straight["env"]["sim"]["state"], resumed["env"]["sim"]["state"])


def test_resume_auto_begins_where_there_is_nothing_and_goes_on_where_there_is(tmp_path: Path):
    folder = tmp_path / "run"
    first = run_small(folder, GAMMA, 0.9, RESUME, "auto")
    assert first["iteration"] == 2
    (folder / "config.json").unlink()
    assert run("base", f"{RESUME}=auto", RUN_DIR, folder, ITERATIONS, 3) == 0
    second = newest(folder)
    assert (second["iteration"], second["config"]["training"]["ppo"]["gamma"]) == (3, 0.9)


@pytest.mark.parametrize("stage", ["base", "distill"])
def test_one_command_with_a_recipe_begins_a_run_and_goes_on_with_it(checkpoint: Path, tmp_path: Path, stage: str):
    """As a scheduler that starts a job again would type it."""
    first = [BASE_CHECKPOINT, checkpoint] if stage == "distill" else []
    command = [stage, RECIPE, "facet", *first, *SMALL, RUN_DIR, tmp_path / "run", RESUME, "auto"]
    assert run(*command, ITERATIONS, 1) == 0
    assert run(*command, ITERATIONS, 2) == 0
    content = newest(tmp_path / "run")
    assert content["iteration"] == 2
    assert content["config"]["training"]["env"]["rewards"]["upper"]["track_hands_as_facet"] == 1.3


def test_resume_auto_begins_again_in_the_folder_of_a_run_without_checkpoints(tmp_path: Path):
    (tmp_path / "config.json").write_text("{}")
    assert run_small(tmp_path, RESUME, "auto")["iteration"] == 2


@pytest.mark.parametrize("twice", [False, True])
def test_names_with_underscores_and_the_last_of_two_options_count(
    checkpoint: Path, base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, twice: bool
):
    """The config comes from the file that the weights come from."""
    content = load_checkpoint(checkpoint)
    content["config"]["training"]["ppo"]["gamma"] = 0.7
    path = checkpoint.with_name("other.pt")
    save_checkpoint(path, content)
    out: list[train.DistillOptions] = []
    monkeypatch.setattr(train, "train_distill", lambda options: out.append(options) or Path("nowhere"))
    first = [BASE_CHECKPOINT, base / checkpoint.name] if twice else []
    assert run("distill", *first, "--base_checkpoint", path, "--num_envs=4", "--run_dir", tmp_path / "run") == 0
    assert out[0].base_checkpoint == str(path)
    assert out[0].training.ppo.gamma == 0.7
    assert out[0].training.env.num_envs == 4


def test_of_two_resumes_the_last_counts(checkpoint: Path, monkeypatch: pytest.MonkeyPatch):
    folder = ["--run_dir", checkpoint.parent]
    options = captured(monkeypatch, "base", RESUME, "nowhere.pt", *folder, f"{RESUME}=auto")
    assert options.resume == str(checkpoint)
    assert options.training.ppo.gamma == 0.9
    options = captured(monkeypatch, "base", RESUME, "auto", RESUME, checkpoint, RUN_DIR, "nowhere")
    assert options.resume == str(checkpoint)


def test_resume_auto_needs_to_know_where(capsys: pytest.CaptureFixture[str]):
    assert run("base", *SMALL, RESUME, "auto") == 2
    assert "--run-dir" in capsys.readouterr().err


def test_a_run_repeats_for_its_seed_and_for_no_other(base: Path, tmp_path: Path):
    first = newest(base)["model"]
    again = run_small(tmp_path / "again", GAMMA, 0.9)["model"]
    other = run_small(tmp_path / "other", GAMMA, 0.9, SEED, 1)["model"]
    assert all(torch.equal(v, again[k]) for k, v in first.items())
    assert not torch.equal(first["actors.lower.weights.0"], other["actors.lower.weights.0"])


def interrupt(monkeypatch: pytest.MonkeyPatch, at: int, number: int) -> None:
    """Raise a signal in the environment's step of that number."""
    step, calls = HumanoidEnv.step, []

    def interrupted(self: HumanoidEnv, actions: torch.Tensor) -> Any:
        calls.append(1)
        if len(calls) == at:
            signal.raise_signal(number)
        return step(self, actions)

    monkeypatch.setattr(HumanoidEnv, "step", interrupted)


def test_sigterm_saves_and_exits_cleanly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    interrupt(monkeypatch, 8, signal.SIGTERM)
    content = run_small(tmp_path / "run", ITERATIONS, 50)
    assert content["iteration"] == 2
    assert content["env"] != {}


def captured(monkeypatch: pytest.MonkeyPatch, *args: Any) -> train.BaseOptions:
    """The options that a command line amounts to."""
    out: list[train.BaseOptions] = []
    monkeypatch.setattr(train, "train_base", lambda options: out.append(options) or Path("nowhere"))
    assert run(*args) == 0
    return out[0]


@pytest.mark.parametrize("recipe", BASE_RECIPES)
def test_recipe_sets_the_defaults(monkeypatch: pytest.MonkeyPatch, recipe: str):
    options = captured(monkeypatch, "base", RECIPE, recipe, f"{ENVS}=16", SEED, 7)
    expected = BASE_RECIPES[recipe]()
    samples = expected.samples
    expected.env.num_envs, expected.seed = 16, 7
    expected.train_for(samples)
    assert options.training == expected
    assert options.recipe == recipe


def test_a_recipe_is_for_the_robot_that_is_asked_for_and_options_come_on_top(monkeypatch: pytest.MonkeyPatch):
    expected = BASE_RECIPES["default"]("g1")
    assert expected.env.actions != BASE_RECIPES["default"]().env.actions
    assert captured(monkeypatch, "base", "--robot", "g1").training == expected
    expected.env.actions.waist_share = 0.7
    asked = ["--robot=g1", "--env.actions.waist-share", 0.7]
    assert captured(monkeypatch, "base", *asked).training == expected
    assert PipelineOptions(robot="g1")._trainings()[0].env.actions.waist_share == 0.5


@pytest.mark.parametrize(
    ("given", "iterations"),
    [([], 12_207), ([ENVS, 4096], 3051), ([STEPS, 48], 6103), ([ENVS, 4096, ITERATIONS, 7], 7), ([ITERATIONS, 7], 7)],
)
def test_as_many_samples_are_taken_unless_iterations_are_given(
    monkeypatch: pytest.MonkeyPatch, given: list[Any], iterations: int
):
    assert captured(monkeypatch, "base", *given).training.runner.iterations == iterations


def test_a_run_that_goes_on_keeps_its_iterations(checkpoint: Path, monkeypatch: pytest.MonkeyPatch):
    options = captured(monkeypatch, "base", RESUME, checkpoint, ENVS, 2)
    assert (
        options.training.runner.iterations == load_checkpoint(checkpoint)["config"]["training"]["runner"]["iterations"]
    )


def test_ablations_keep_their_samples(checkpoint: Path):
    args = ["--recipe", "goals", BASE_CHECKPOINT, str(checkpoint), ENVS, "4096"]
    assert train._parse_distill(args).training.samples == pytest.approx(15e6, rel=7e-3)


def distill(run_dir: Path, base_checkpoint: Path, *options: Any) -> dict[str, Any]:
    """Distil for two tiny iterations and return the last checkpoint's content."""
    small = [ENVS, 8, ITERATIONS, 2, THREADS, 1, STEPS, 6, PRECISION, "fp32"]
    assert run("distill", *small, RUN_DIR, run_dir, BASE_CHECKPOINT, base_checkpoint, *options) == 0
    return newest(run_dir)


def test_distillation_begins_as_the_base_under_compliance(checkpoint: Path, tmp_path: Path):
    content = distill(
        tmp_path / "run", checkpoint, "--ppo.learning-rate", 1e-5, "--ppo.epochs", 1, "--ppo.mini-batches", 1, BETA, 0.3
    )
    base = load_checkpoint(checkpoint)
    assert content["kind"] == "distill"
    training = content["config"]["training"]
    assert training["ppo"]["hidden"] == [8, 8]  # the base's
    assert training["env"]["upper_body"]["left"]["name"] == training["env"]["upper_body"]["right"]["name"] == "cotap"
    assert training["env"]["upper_body"]["sampling"]["enabled"]
    assert not training["env"]["assist"]["enabled"]
    assert training["distillation"]["beta"] == 0.3
    for key, value in base["model"].items():
        if key.startswith("actors"):
            begun = torch.zeros_like(value) if key.startswith("actors.upper.output") else value
            torch.testing.assert_close(content["model"][key], begun, atol=1e-3, rtol=0)
        assert torch.equal(content["learner"]["guide"][key], value), key  # the guide is the base, unchanged
    logs = EventAccumulator(str(tmp_path / "run"))
    logs.Reload()
    tags = set(logs.Tags()["scalars"])
    assert {
        "agents/lower/base_kl", "agents/lower/base_beta", "agents/lower/base_share", "law/alpha",
        "law/smallest_eigenvalue", "law/largest_eigenvalue", "law/projected", "law/saturated",
        "upper/reference_closeness",
    } <= tags  # fmt: skip
    assert logs.Scalars("agents/lower/base_beta")[0].value == pytest.approx(0.3)


def test_a_resumed_distillation_ends_where_a_straight_one_does(checkpoint: Path, tmp_path: Path):
    first = tmp_path / "resumed"
    distill(first, checkpoint)
    checkpoint_kept = checkpoint.read_bytes()
    checkpoint.unlink()  # a run goes on without the file that it began from
    assert run("distill", RESUME, max(first.glob("checkpoint_*.pt")), ITERATIONS, 3) == 0
    checkpoint.write_bytes(checkpoint_kept)
    straight = distill(tmp_path / "straight", checkpoint, ITERATIONS, 3)
    for key, value in straight["model"].items():
        assert torch.equal(value, newest(first)["model"][key]), key


def shipped(folder: Path, content: dict[str, Any], name: str = "shipped.pt") -> Path:
    """A policy as the package ships it: no optimiser, no envs."""
    save_checkpoint(folder / name, content | {"learner": {}, "env": {}, "others": []})
    return folder / name


@pytest.mark.parametrize("stage", ["base", "distill"])
def test_a_shipped_policy_does_not_go_on(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], stage: str
):
    content = load_checkpoint(checkpoint) if stage == "base" else distill(tmp_path / "run", checkpoint)
    path = shipped(tmp_path, content)
    assert run(stage, RESUME, path, RUN_DIR, tmp_path / "more", ITERATIONS, 3) == 2
    assert "a shipped policy has no optimiser and cannot go on" in capsys.readouterr().err
    assert not (tmp_path / "more").exists()


def test_a_distillation_begins_from_a_shipped_base(checkpoint: Path, tmp_path: Path):
    """Its optimisers are new, and Adam's first steps are as large as its rate: at a rate for learning from nothing
    they would take the policy far away from itself in the first iteration."""
    path = shipped(tmp_path, load_checkpoint(checkpoint))
    distill(tmp_path / "run", path, ENVS, 64)
    scalars = EventAccumulator(str(tmp_path / "run")).Reload()
    for agent in ("lower", "upper"):
        assert 0.0 <= scalars.Scalars(f"agents/{agent}/kl")[0].value < 0.03


def test_a_stage_does_not_resume_the_other(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run("distill", RESUME, checkpoint) == 2
    assert "a checkpoint of stage 'base', not 'distill'" in capsys.readouterr().err
    distill(tmp_path / "run", checkpoint)
    before = tree(tmp_path / "run")
    assert run("base", RESUME, "auto", RUN_DIR, tmp_path / "run") == 2
    assert "a checkpoint of stage 'distill', not 'base'" in capsys.readouterr().err
    assert tree(tmp_path / "run") == before


@pytest.mark.parametrize("stage", ["base", "distill"])
def test_a_run_that_goes_on_takes_no_recipe(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], stage: str
):
    resumed = checkpoint
    if stage == "distill":
        distill(tmp_path / "run", checkpoint)
        resumed = max((tmp_path / "run").glob("checkpoint_*.pt"))
    assert run(stage, RESUME, resumed, RECIPE, "paper") == 2
    assert "--recipe 'paper': the run of --resume goes on with its own config" in capsys.readouterr().err


@pytest.mark.parametrize(("recipe", "wider"), [("goals", 50), ("torque-critic", -40)])
def test_an_ablation_begins_from_a_base_that_saw_something_else(
    checkpoint: Path, tmp_path: Path, recipe: str, wider: int
):
    content = distill(tmp_path / "run", checkpoint, RECIPE, recipe)
    key = "actors.lower.weights.0"
    assert content["model"][key].shape[1] == load_checkpoint(checkpoint)["model"][key].shape[1] + wider
    assert content["config"]["training"]["distillation"]["beta"] > 0.0
    # And goes on as any other.
    assert run("distill", RESUME, max((tmp_path / "run").glob("checkpoint_*.pt")), ITERATIONS, 3) == 0
    assert newest(tmp_path / "run")["iteration"] == 3


@pytest.mark.parametrize("recipe", DISTILL_RECIPES)
def test_every_recipe_distils(checkpoint: Path, tmp_path: Path, recipe: str):
    content = distill(tmp_path / "run", checkpoint, RECIPE, recipe)
    expected = DISTILL_RECIPES[recipe](from_plain(BaseTraining, load_checkpoint(checkpoint)["config"]["training"]))
    training = from_plain(type(expected), content["config"]["training"])
    assert training.env.upper_body == expected.env.upper_body
    assert training.env.rewards == expected.env.rewards
    assert training.env.observations == expected.env.observations
    assert training.ppo.initial_std == expected.ppo.initial_std


def test_a_modulation_begins_as_a_distilled_policy_and_goes_on(checkpoint: Path, tmp_path: Path):
    """From the policy of a distillation, as its guide, with that policy's past in the record of its own."""
    first = distill(tmp_path / "distilled", checkpoint, "--ppo.initial-std", 0.2)
    start = shipped(tmp_path, first)
    folder = tmp_path / "modulated"
    slowly = ["--ppo.learning-rate", 1e-5, "--ppo.epochs", 1, "--ppo.mini-batches", 1]
    content = distill(folder, start, RECIPE, "modulated", *slowly)
    training = content["config"]["training"]
    assert (content["kind"], training["env"]["upper_body"]["modulation"]["kind"]) == ("distill", "stiffness")
    assert training["env"]["rewards"]["lower"] == first["config"]["training"]["env"]["rewards"]["lower"]
    guide, was = content["learner"]["guide"], first["model"]
    for name, value in was.items():
        if name.startswith("actors.lower") and not name.endswith("weights.0"):
            assert torch.equal(guide[name], value), name
            torch.testing.assert_close(content["model"][name], value, atol=1e-3, rtol=0)
    arms = len(was["log_std.upper"])
    assert torch.equal(guide["log_std.upper"][:arms], was["log_std.upper"])
    assert torch.equal(guide["log_std.upper"][arms:], torch.zeros(8))  # a standard deviation of one
    assert content["learner"]["begun_std"]["upper"][arms:] == [1.0] * 8
    assert float(content["model"]["log_std.upper"][arms:].exp().min()) > 0.9  # not cut down to the trained actions'
    assert content["layout"]["modulation"]["targets"][0] == "left alpha"
    base = content["config"]["base"]
    assert base["sha256"] == sha256(start)
    assert RUN_DIR in base["runs"][-1]["command"]
    assert base["base"] == first["config"]["base"]
    assert [len(base["runs"]), len(base["base"]["runs"])] == [1, 1]
    scalars = EventAccumulator(str(folder)).Reload()
    assert scalars.Scalars("law/asked_alpha")[0].value == pytest.approx(0.75, abs=0.2)
    assert 80.0 < scalars.Scalars("law/asked_stiffness")[0].value < 1200.0
    assert {"law/store_energy", "law/held_back"} <= set(scalars.Tags()["scalars"])
    start.unlink()
    assert run("distill", RESUME, "auto", RUN_DIR, folder, ITERATIONS, 3) == 0
    resumed = newest(folder)
    assert resumed["config"]["base"] == base
    assert resumed["learner"]["begun_std"] == content["learner"]["begun_std"]


def tiny_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the pipeline begin with small networks and short rollouts."""
    parse = train._parse_base

    def tiny(args: list[str]) -> train.BaseOptions:
        options = parse(args)
        options.training.ppo.hidden, options.training.ppo.steps = (8, 8), 6
        return options

    monkeypatch.setattr(train, "_parse_base", tiny)


BOTH = [ENVS, 8, THREADS, 1, "--base-iterations", 2, "--distill-iterations", 1]


def test_stopped_in_a_stage_the_pipeline_ends_there_and_goes_on_from_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
):
    """The second stage must not begin from half a first one."""
    tiny_networks(monkeypatch)
    monkeypatch.setattr(pipeline, "expected", lambda _options: "")  # which steps environments, too
    out = tmp_path / "both"
    interrupt(monkeypatch, 3, signal.SIGINT)
    assert run(*BOTH, RUN_DIR, out) == 130
    said = capsys.readouterr().err
    assert f"stopped at iteration 1 of 2 of {out / 'base'}" in said
    assert f"--run-dir {out} --resume" in said
    assert sorted(p.name for p in out.iterdir()) == ["base", "pipeline.json"]
    assert run(*BOTH, RUN_DIR, out, RESUME) == 0
    assert "| distill | 1 | 48 |" in capsys.readouterr().out
    assert newest(out / "base")["iteration"] == 2
    kept = (out / "distill" / "checkpoint_000001.pt").read_bytes()
    assert run(*BOTH, RUN_DIR, out, RESUME) == 0  # there is nothing left to do
    assert (out / "distill" / "checkpoint_000001.pt").read_bytes() == kept


def test_a_pipeline_goes_on_with_the_options_that_it_began_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Neither quick, seed nor the iterations are typed again; what would make another policy is refused."""
    asked: list[list[str]] = []

    def stage(name: str, args: list[str]) -> Path:
        asked.append([name, *args])
        folder = Path(args[args.index("--run-dir") + 1])
        folder.mkdir(parents=True, exist_ok=True)
        steps = args[args.index("--iterations") + 1]
        save_checkpoint(
            folder / f"checkpoint_{int(steps):06d}.pt", {"iteration": int(steps), "samples": 0, "wall_seconds": 0.0}
        )
        return folder

    monkeypatch.setattr(pipeline, "expected", lambda _options: "")
    out = tmp_path / "both"
    train_both(PipelineOptions(run_dir=str(out), quick=True, seed=5, threads=1), stage)
    began = list(asked)
    asked.clear()
    train_both(PipelineOptions(run_dir=str(out), resume=True), stage)
    for before, after in zip(began, asked, strict=True):
        for option in ("--seed", "--iterations", "--threads"):
            assert before[before.index(option) + 1] == after[after.index(option) + 1]
        assert "--resume" in after
    with pytest.raises(ValueError, match=r"--robot 'g1': the runs in .* began with 'h1'"):
        train_both(PipelineOptions(run_dir=str(out), resume=True, robot="g1"), stage)
    with pytest.raises(ValueError, match=r"already holds 'base/checkpoint_001220\.pt': go on with --resume"):
        train_both(PipelineOptions(run_dir=str(out)), stage)
    kept = (out / "pipeline.json").read_bytes()
    with sole_writer(out), pytest.raises(ValueError, match="another training writes to"):
        train_both(PipelineOptions(run_dir=str(out), resume=True, threads=2), stage)
    assert (out / "pipeline.json").read_bytes() == kept
    (out / "pipeline.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="has no usable options"):
        train_both(PipelineOptions(run_dir=str(out), resume=True), stage)
    (out / "pipeline.json").write_text("{")
    with pytest.raises(ValueError, match="has no usable options"):
        train_both(PipelineOptions(run_dir=str(out), resume=True), stage)
    (out / "pipeline.json").unlink()
    with pytest.raises(ValueError, match="its stages go on one by one"):
        train_both(PipelineOptions(run_dir=str(out), resume=True), stage)


def test_a_distillation_that_is_there_is_found_before_anything_is_trained(tmp_path: Path):
    (tmp_path / "distill").mkdir()
    save_checkpoint(tmp_path / "distill" / "checkpoint_000001.pt", {"iteration": 1})
    with pytest.raises(ValueError, match=r"already holds 'distill/checkpoint_000001\.pt'"):
        train_both(PipelineOptions(run_dir=str(tmp_path)), lambda *_: pytest.fail("a stage was trained"))


def test_going_on_with_the_pipeline_needs_to_know_where(capsys: pytest.CaptureFixture[str]):
    assert run(*BOTH, RESUME) == 2
    assert "--run-dir" in capsys.readouterr().err


def test_shipped_checkpoints_go_by_their_names(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = shipped(tmp_path, load_checkpoint(checkpoint), "h1-base.pt")
    monkeypatch.setattr(policy, "checkpoint_path", lambda name: tmp_path / f"{name}.pt")
    for given in ([BASE_CHECKPOINT, "h1-base"], []):  # named, and by default
        assert train._parse_distill([str(a) for a in given]).base_checkpoint == str(path)


def test_a_base_that_is_not_shipped_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(policy, "checkpoint_path", lambda name: tmp_path / f"{name}.pt")
    for robot, options in (("h1", []), ("g1", ["--robot", "g1"])):
        assert run("distill", RUN_DIR, tmp_path / "run", *options) == 2
        assert f"no base policy of robot '{robot}' is shipped; shipped are: none" in capsys.readouterr().err


def test_a_distillation_takes_the_shipped_base_of_a_robot(checkpoint: Path, tmp_path: Path, monkeypatch: Any):
    path = shipped(tmp_path, load_checkpoint(checkpoint), "g1-base.pt")
    monkeypatch.setattr(policy, "checkpoint_path", lambda name: tmp_path / f"{name}.pt")
    monkeypatch.setattr(train, "_base_config", lambda _: BaseTraining(env=HumanoidEnvConfig(robot="g1")))
    options = train._parse_distill(["--robot", "g1"])
    assert (options.base_checkpoint, options.training.env.robot) == (str(path), "g1")


def test_a_base_of_another_robot_is_refused_by_name(checkpoint: Path, capsys: pytest.CaptureFixture[str]):
    assert run("distill", BASE_CHECKPOINT, checkpoint, "--robot=g1") == 2
    said = f"checkpoint '{checkpoint}' is of robot 'h1', not of 'g1' (--robot)"
    assert said in capsys.readouterr().err.replace("\n", " ")


def test_going_on_from_a_checkpoint_of_no_run_begins_a_run_of_its_own(
    checkpoint: Path, tmp_path: Path, monkeypatch: Any
):
    mine = checkpoint.rename(checkpoint.with_name("mine.pt"))
    before = tree(mine.parent)
    monkeypatch.chdir(tmp_path)
    assert run("base", RESUME, mine, ITERATIONS, 3) == 0
    assert tree(mine.parent) == before
    (folder,) = (tmp_path / "runs").iterdir()
    assert newest(folder)["iteration"] == 3


def test_a_base_that_would_be_ignored_is_refused(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    distill(tmp_path / "run", checkpoint)
    resumed = max((tmp_path / "run").glob("checkpoint_*.pt"))
    assert run("distill", RESUME, resumed, BASE_CHECKPOINT, checkpoint, ITERATIONS, 3) == 2
    assert "brings the base that guides it" in capsys.readouterr().err
    # One command that begins a run and, started again, goes on with it.
    again = ["distill", RESUME, "auto", RUN_DIR, tmp_path / "run", BASE_CHECKPOINT, checkpoint, ITERATIONS, 3]
    assert run(*again) == 0
    assert newest(tmp_path / "run")["iteration"] == 3
    checkpoint.unlink()  # the run has all that it needs of it
    assert run(*again[:-1], 4) == 0
    assert newest(tmp_path / "run")["iteration"] == 4


def test_a_name_that_is_not_shipped_lists_those_that_are(capsys: pytest.CaptureFixture[str]):
    assert run("distill", BASE_CHECKPOINT, "nosuch") == 2
    assert "checkpoint 'nosuch' does not exist; shipped are: " in capsys.readouterr().err.replace("\n", " ")


def test_without_a_stage_both_run_and_are_summed_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any):
    tiny_networks(monkeypatch)
    out = tmp_path / "both"
    assert run(*BOTH, RUN_DIR, out) == 0
    assert newest(out / "base")["kind"] == "base"
    assert newest(out / "distill")["kind"] == "distill"
    said = capsys.readouterr().out
    assert re.search(
        r"\| base \| 384 \| [\d,]+ \| 0\.0 \|\n\| distill \| 192 \|", said
    )  # beforehand, 24 steps an iteration
    assert "| base | 2 | 96 |" in said
    assert "| distill | 1 | 48 |" in said
    assert f"cotap play --checkpoint {out / 'distill' / 'checkpoint_000001.pt'}" in said


@pytest.mark.slow
def test_the_quick_pipeline_is_a_small_version_of_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert PipelineOptions(quick=True).iterations() == (1220, 610)
    assert PipelineOptions().iterations() == (12_207, 3051)
    assert PipelineOptions(num_envs=2048).iterations() == (6103, 1525)  # as many samples
    assert PipelineOptions(recipe="paper").iterations() == (20_000, 20_000)
    assert PipelineOptions(recipe="paper", num_envs=1024).iterations() == (80_000, 80_000)
    tiny_networks(monkeypatch)
    assert run("--quick", *BOTH, RUN_DIR, tmp_path) == 0
    for stage in ("base", "distill"):
        assert not newest(tmp_path / stage)["config"]["training"]["env"]["forces"]["pushes"]["enabled"]


@pytest.mark.slow
def test_a_recipe_is_that_of_both_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    tiny_networks(monkeypatch)
    assert run("--recipe", "facet", *BOTH, RUN_DIR, tmp_path) == 0
    for stage in ("base", "distill"):
        rewards = newest(tmp_path / stage)["config"]["training"]["env"]["rewards"]["upper"]
        assert (rewards["track_hands_as_facet"], rewards["track_key_points"]) == (1.3, 0.0)


@pytest.mark.parametrize(
    ("options", "needle"),
    [
        ([ENVS, -1], "num_envs"),
        (["--base-iterations", -1], "base_iterations"),
        ([THREADS, -1], "threads"),
        ([DEVICE, "abacus"], "device 'abacus'"),
        (["--seed", -1, "--quick", "--backend", "abacus"], "'abacus'"),
        (["--robot", "h2"], "known: g1, h1"),
        (["--recipe", "goals"], "default, facet, paper, quick"),
        (["--quick", "--recipe", "paper"], "--recipe 'paper'"),
    ],
)
def test_bad_options_of_both_stages_are_named(options: list[Any], needle: str, capsys: pytest.CaptureFixture[str]):
    assert run(*options) == 2
    assert needle in capsys.readouterr().err


def test_a_commit_is_recorded_only_of_the_repository_that_the_package_is_part_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Installed into another project's folder, the package lies in that project's repository."""
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    (tmp_path / "train.py").write_text("")
    (tmp_path / "own.py").write_text("")
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "add", "own.py"], check=True)
    subprocess.run([*git, "commit", "-qm", "theirs"], check=True)
    monkeypatch.setattr(train, "__file__", str(tmp_path / "train.py"))
    assert train.provenance("", "mujoco")["commit"] == f"cotap {__version__}"
    subprocess.run([*git, "add", "train.py"], check=True)
    subprocess.run([*git, "commit", "-qm", "ours"], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    assert train.provenance("", "mujoco")["commit"] == head
