"""The evaluation command, end to end, on policies with random weights."""

import copy
import json
from pathlib import Path

import pytest
import torch

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.evaluate import evaluate, main
from cotap.evaluation.policy import load_policy, shipped_checkpoint, shipped_names
from cotap.evaluation.velocity_tracking import VelocityTracking
from cotap.robots import h1

SMALL = ["velocity-tracking", "--num-envs", "8", "--episode-seconds", "6", "--threads", "1"]


def run(tmp_path: Path, checkpoint: Path, *options: str, name: str = "result.json") -> dict:
    out = tmp_path / name
    assert main([*SMALL, "--checkpoint", str(checkpoint), "--json", str(out), *options]) == 0
    return json.loads(out.read_text())


def test_a_name_whose_checkpoint_is_not_there_is_refused():
    with pytest.raises(ValueError, match="'h1-base' is not shipped" if "h1-base" not in shipped_names() else "unknown"):
        shipped_checkpoint("h1-base" if "h1-base" not in shipped_names() else "h2-base")


@pytest.mark.slow
def test_same_seed_same_json_but_for_seconds(tmp_path: Path, checkpoint: Path):
    first, second = (run(tmp_path, checkpoint, name=f"{i}.json") for i in range(2))
    other = run(tmp_path, checkpoint, "--seed", "1", name="other.json")
    for result in (first, second, other):
        del result["seconds"]
    assert first == second
    assert first["metrics"] != other["metrics"]


@pytest.mark.parametrize("loaded", [False, True])
def test_hands_are_loaded_as_asked(loaded):
    loads = VelocityTracking(hand_loads=loaded).configure(HumanoidEnvConfig()).forces.hand_loads
    assert loads.enabled == loaded
    assert (loads.force_x, loads.force_y, loads.force_z) == ((-40.0, 40.0), (-40.0, 40.0), (-50.0, 5.0))
    assert (loads.zero_probability, loads.hold_s, loads.episode_share) == (0.25, (3.0, 5.0), 1.0)
    assert loads.ramp.share(0.0) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("option", "arms"), [([], "moving"), (["--motion", "none"], "held")])
def test_results_say_whether_arms_move(checkpoints, robot, option, arms, capsys):
    options = ("--num-envs", "2", "--episode-seconds", "3", "--command-seconds", "2", "--threads", "1", "--hand-loads")
    result = evaluate(["velocity-tracking", "--checkpoint", str(checkpoints(robot)), *options, *option])
    assert result["arms"] == arms
    assert f"velocity-tracking, pd, arms {arms}: " in capsys.readouterr().out
    assert result["settings"]["env"]["robot"] == robot


def test_loaded_policy_is_deterministic_and_reads_what_it_was_trained_on(checkpoints, robot):
    policy = load_policy(checkpoints(robot))
    width = policy.layout["history"] * sum(width for _, width, _ in policy.layout["terms"])
    obs = {"policy": torch.randn(3, width)}
    assert torch.equal(policy(obs), policy(obs))
    assert policy(obs).shape == (3, len(policy.layout["joints"]))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["velocity-trackin"], "velocity-tracking"),
        ([*SMALL, "--num-envs", "0"], "num_envs"),
        ([*SMALL, "--method", "magic"], "pd"),
        ([*SMALL, "--speed-x", "nan"], "speed_x"),
        ([*SMALL, "--checkpoint", "nowhere.pt"], "nowhere.pt"),
        ([*SMALL, "--robot", "h2"], "robot 'h2' is unknown; known: g1, h1"),
        ([*SMALL, "--checkpoint", "h1-base", "--robot", "g1"], "'h1-base' is of robot 'h1', not of 'g1' (--robot)"),
        ([*SMALL, "--json", "no/such/folder/x.json"], "no/such/folder"),
        ([*SMALL, "--torque-limit-scale", "-1"], "torque_limit_scale"),
        ([*SMALL, "--collision", "arms"], "collision 'arms'"),
        ([*SMALL, "--motion", "moonwalk"], "moonwalk"),
    ],
)
@pytest.mark.usefixtures("shipped")
def test_bad_input_is_named(options: list[str], says: str, capsys: pytest.CaptureFixture[str]):
    assert main(options) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--json", "{}"], "is a folder"),
        (["--json", "{}/none/x.json"], "its folder does not exist"),
        (["--plot", "{}/x.xyz"], "must end in .png"),
        (["--video", "{}/x.avi"], "must end in .mp4"),
        (["--json", "{}/a.png", "--plot", "{}/a.png"], "are one file"),
        (["--plot", "{}/a_frames.png", "--video", "{}/a.mp4"], "are one file"),
    ],
)
def test_outputs_that_cannot_be_are_found_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, options: list[str], says: str
):
    monkeypatch.setattr("cotap.envs.HumanoidEnv", None)  # the work must not begin
    assert main([*SMALL, *(option.format(tmp_path) for option in options)]) == 2
    assert says in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_plot_is_written(tmp_path: Path, checkpoint: Path):
    run(tmp_path, checkpoint, "--plot", str(tmp_path / "plot.png"))
    assert (tmp_path / "plot.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_a_held_load_is_filmed_from_its_start(tmp_path: Path, checkpoint: Path, monkeypatch: pytest.MonkeyPatch):
    filmed = []
    monkeypatch.setattr("cotap.evaluation.render.film_video", lambda _path, _env, film, _sheet: filmed.append(film))
    held = ["--num-envs", "2", "--settle-seconds", "2", "--threads", "1"]
    options = {
        "static-stiffness": [*held, "--levels", "2"],
        "fidelity": [*held, "--pelvis", "fixed", "--stiffness-values", "300"],
        "stability": ["--poses", "2", "--num-envs", "2", "--settle-seconds", "2", "--episode-seconds", "2"],
    }
    for protocol, own in options.items():
        arguments = [protocol, *own, "--checkpoint", str(checkpoint), "--video", str(tmp_path / "film.mp4")]
        evaluate(arguments)
    assert [len(film) for film in filmed] == [200, 200, 200]
    width = len(h1().joints) + 7 + 12
    assert {film.shape[1] for film in filmed} == {width}


def test_robots_of_an_evaluation_are_not_those_of_the_training(robot):
    """Masses are drawn once, from the seed: with that of the training they would be what the policy knows."""
    trained = HumanoidEnvConfig(robot=robot, num_envs=8, num_threads=1, randomization=RandomizationConfig(enabled=True))
    protocol = VelocityTracking(num_envs=8, seed=trained.seed)
    ours, theirs = (HumanoidEnv(cfg) for cfg in (protocol.configure(copy.deepcopy(trained)), trained))
    mass, other = (env.sim.field("body_mass") for env in (ours, theirs))
    moving = mass.std(0) > 0.0
    assert moving.any()
    assert not (mass == other)[:, moving].any()
