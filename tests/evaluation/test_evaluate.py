"""The evaluation command, end to end, on the shipped policy."""

import json
from pathlib import Path

import pytest
import torch
import tyro

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256
from cotap.configs import to_plain
from cotap.envs import H1EnvConfig
from cotap.evaluate import VelocityTrackingOptions, _leaning, main
from cotap.evaluation import policy
from cotap.evaluation.policy import load_policy, shipped_checkpoint, shipped_names
from cotap.evaluation.protocols import VelocityTracking
from cotap.evaluation.render import RenderingUnavailable, open_renderer
from cotap.robots import h1
from cotap.robots.mjcf import build_model

SMALL = ["velocity-tracking", "--num-envs", "64", "--episode-seconds", "10", "--threads", "1"]


def run(tmp_path: Path, *options: str, name: str = "result.json") -> dict:
    out = tmp_path / name
    assert main([*SMALL, "--json", str(out), *options]) == 0
    return json.loads(out.read_text())


@pytest.mark.parametrize("name", shipped_names())
def test_shipped_policy_reproduces_its_evaluation(tmp_path: Path, name: str):
    path = shipped_checkpoint(name)
    shipped = json.loads(path.with_name(f"{name}.velocity-tracking.small.json").read_text())
    law = ["--method", shipped["method"]]
    if not shipped["settings"]["env"]["upper_body"]["singularity_ratio"]:
        law.append("--no-singularity-ratio")
    result = run(tmp_path, "--checkpoint", str(path), *law)
    assert shipped["settings"]["checkpoint_sha256"] == sha256(path) == result["settings"]["checkpoint_sha256"]
    # Another processor rounds otherwise, and walking is chaotic: figures agree, digits need not.
    for key in ("e_lin_gait", "e_yaw_gait", "e_height", "e_upper", "swing_height"):
        assert result["metrics"][key]["mean"] == pytest.approx(shipped["metrics"][key]["mean"], rel=0.1), key
    assert result["num_falls"] <= shipped["num_falls"] + 1
    for axis in ("slope_x", "slope_y", "slope_yaw"):
        assert result["slopes"][axis] == pytest.approx(shipped["slopes"][axis], abs=0.08)


def test_a_name_whose_checkpoint_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(policy, "CHECKPOINTS", (*policy.CHECKPOINTS, "cotap-next"))
    with pytest.raises(ValueError, match="'cotap-next' is not shipped; shipped are: base, cotap, facet"):
        shipped_checkpoint("cotap-next")


@pytest.mark.parametrize("name", shipped_names())
def test_shipped_checkpoint_carries_its_provenance(name: str):
    path = shipped_checkpoint(name)
    provenance = json.loads(path.with_suffix(".json").read_text())
    assert provenance["sha256"] == sha256(path)
    assert {"commit", "command", "seed", "samples", "wall_seconds", "config"} <= provenance.keys()
    content = load_checkpoint(path)
    assert content["learner"] == {}
    assert content["env"] == {}
    assert path.stat().st_size < 6 * 2**20


def test_a_random_policy_does_not_pass_for_the_shipped_one(tmp_path: Path):
    content = load_checkpoint(shipped_checkpoint("base"))
    rng = torch.Generator().manual_seed(0)
    content["model"] = {
        k: torch.randn(v.shape, generator=rng) * 0.1 if k.startswith("actors") else v
        for k, v in content["model"].items()
    }
    save_checkpoint(tmp_path / "random.pt", content)
    result = run(tmp_path, "--checkpoint", str(tmp_path / "random.pt"))
    assert result["metrics"]["fall_fraction"]["mean"] > 0.5


def test_same_seed_same_json_but_for_seconds(tmp_path: Path):
    short = ("--num-envs", "8", "--episode-seconds", "6")
    first, second = (run(tmp_path, *short, name=f"{i}.json") for i in range(2))
    other = run(tmp_path, *short, "--seed", "1", name="other.json")
    for result in (first, second, other):
        del result["seconds"]
    assert first == second
    assert first["metrics"] != other["metrics"]


def test_robots_lean_into_loads_only_when_told_to(tmp_path: Path):
    short = ("--num-envs", "8", "--episode-seconds", "6", "--hand-force", "20")
    results = {how: run(tmp_path, *short, "--lean-into-loads", how, name=f"{how}.json") for how in ("yes", "no")}
    for how, result in results.items():
        assert result["settings"]["env"]["commands"]["lean_into_loads"] == (how == "yes")
    as_trained = run(tmp_path, *short, name="as-trained.json")
    assert as_trained["metrics"] == results["yes"]["metrics"]  # the shipped base leans
    assert results["yes"]["metrics"] != results["no"]["metrics"]


@pytest.mark.parametrize(("force", "size", "loaded"), [(0.0, 0.0, False), (20.0, 0.0, True), (0.0, 30.0, True)])
def test_hands_are_loaded_as_asked_by_axis_or_in_any_direction(force, size, loaded):
    hands = VelocityTracking(hand_force=force, hand_force_size=size).configure(H1EnvConfig()).hand_forces
    assert (hands.enabled, hands.size, hands.force_z) == (loaded, size, (-force, force))
    assert (hands.curriculum_start, hands.episode_share, hands.zero_probability) == (1.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("options", "leans", "tilt"),
    [((), True, 0.04), (("--lean-into-loads", "no"), False, 0.0), (("--brace-tilt-rad", "0"), True, 0.0),
     (("--lean-into-loads", "yes", "--brace-tilt-rad", "0.06"), True, 0.06)],
)  # fmt: skip
def test_robots_brace_themselves_as_trained_unless_told_otherwise(options, leans, tilt):
    trained = H1EnvConfig()
    trained.commands.lean_into_loads, trained.commands.brace_tilt_rad = True, 0.04
    parsed = tyro.cli(VelocityTrackingOptions, args=list(options))
    commands = _leaning(parsed, trained).commands
    assert (commands.lean_into_loads, commands.brace_tilt_rad) == (leans, tilt)
    commands.check()


def test_loaded_policy_is_deterministic_and_reads_430_numbers():
    policy = load_policy(shipped_checkpoint("base"))
    obs = {"policy": torch.randn(3, 430)}
    assert torch.equal(policy(obs), policy(obs))
    assert policy(obs).shape == (3, 19)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["velocity-trackin"], "velocity-tracking"),
        ([*SMALL, "--num-envs", "0"], "num_envs"),
        ([*SMALL, "--method", "magic"], "pd"),
        ([*SMALL, "--speed-x", "nan"], "speed_x"),
        ([*SMALL, "--checkpoint", "nowhere.pt"], "nowhere.pt"),
        ([*SMALL, "--json", "no/such/folder/x.json"], "no/such/folder"),
        ([*SMALL, "--torque-limit-scale", "-1"], "torque_limit_scale"),
        ([*SMALL, "--collision", "arms"], "collision 'arms'"),
        ([*SMALL, "--hand-force", "20", "--hand-force-size", "30"], "hand_force is 20 and hand_force_size 30"),
        ([*SMALL, "--hand-force-size", "-1"], "hand_force_size"),
        ([*SMALL, "--lean-into-loads", "maybe"], "known: as-trained, no, yes"),
        ([*SMALL, "--lean-into-loads", "no", "--brace-tilt-rad", "0.04"], "brace_tilt_rad is 0.04"),
    ],
)
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
    monkeypatch.setattr("cotap.envs.H1Env", None)  # the work must not begin
    assert main([*SMALL, *(option.format(tmp_path) for option in options)]) == 2
    assert says in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_plot_is_written(tmp_path: Path):
    run(tmp_path, "--num-envs", "4", "--episode-seconds", "6", "--plot", str(tmp_path / "plot.png"))
    assert (tmp_path / "plot.png").read_bytes()[:4] == b"\x89PNG"


def test_the_video_is_of_the_laws_that_were_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    filmed = []
    monkeypatch.setattr("cotap.evaluation.render.tour_video", lambda _path, cfg, *_: filmed.append(cfg.upper_body))
    options = ("--num-envs", "2", "--episode-seconds", "5", "--method", "cotap", "--no-singularity-ratio")
    result = run(tmp_path, *options, "--video", str(tmp_path / "tour.mp4"))
    assert to_plain(filmed[0]) == result["settings"]["env"]["upper_body"]
    assert not filmed[0].singularity_ratio


def test_without_a_renderer_the_message_says_what_to_do(monkeypatch: pytest.MonkeyPatch):
    import mujoco

    def broken(*_: object) -> None:
        raise RuntimeError("no GL")

    monkeypatch.setattr(mujoco, "Renderer", broken)
    with pytest.raises(RenderingUnavailable, match="MUJOCO_GL=osmesa"):
        open_renderer(build_model(h1()), 64, 64)
