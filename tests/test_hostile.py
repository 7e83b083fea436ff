"""Hostile input: whatever a file or a command line holds, it is used or refused with a clear error."""

from __future__ import annotations

import copy
import json
import math
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from recordings import small_recording

from cotap import compare, deploy, evaluate, export, train
from cotap.agents.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from cotap.agents.runner import DualRunner
from cotap.compliance.laws import LawConfig
from cotap.configs import BASE_RECIPES, BaseTraining, from_plain, to_plain
from cotap.deployment import graph, trials
from cotap.deployment.scenario import load_scenario
from cotap.envs import HumanoidEnv
from cotap.evaluation.law_options import parse_law
from cotap.evaluation.policy import load_policy
from cotap.evaluation.recording import (
    SCENE,
    Recording,
    RecordingError,
    RecordingProtocol,
    load_recording,
    measure,
)
from cotap.motions import __main__ as motions
from cotap.motions.formats import FORMATS
from cotap.motions.joblib_files import load_joblib
from cotap.motions.library import MotionError, MotionLibrary, shipped_library
from cotap.play import __main__ as play
from cotap.play import server
from cotap.play.session import Session
from cotap.robots import RobotSpec, h1

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

EXAMPLES = int(os.environ.get("COTAP_FUZZ_EXAMPLES", "0"))
"""How many inputs each property is tried on; 0 for a few that are always the same."""
# No shrinking: what is drawn is small as it is, and a failure should not take minutes to be seen.
few = settings(
    max_examples=EXAMPLES or 15,
    derandomize=not EXAMPLES,
    deadline=None,
    database=None,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
scalars = st.one_of(
    st.none(), st.booleans(), st.integers(), st.integers(-3, 3), st.floats(), st.text(max_size=8), st.binary(max_size=8)
)
plain = st.recursive(
    scalars,
    lambda v: st.lists(v, max_size=3) | st.dictionaries(st.text(max_size=4) | st.integers(), v, max_size=3),
    max_leaves=4,
)
tensors = st.builds(
    lambda shape, dtype: torch.zeros(shape, dtype=dtype),
    st.lists(st.integers(0, 3), max_size=3),
    st.sampled_from([torch.float32, torch.float64, torch.int64, torch.bool, torch.uint8]),
)


def paths(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in nested dicts and lists but the whole."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [p for key, v in items for p in [(*at, key), *paths(v, (*at, key))]]


def damage(content: dict[str, Any], draw: st.DataObject, values: st.SearchStrategy[Any]) -> dict[str, Any]:
    """A copy in which one or two places are gone or hold something else."""
    content = copy.deepcopy(content)
    for _ in range(draw.draw(st.integers(1, 2))):
        *way, last = draw.draw(st.sampled_from(paths(content)))
        place: Any = content
        for key in way:
            place = place[key]
        if draw.draw(st.booleans()):
            place[last] = draw.draw(values)
        else:
            del place[last]
    return content


def changed_bytes(data: bytes, draw: st.DataObject) -> bytes:
    """A copy with a few bytes changed, cut off or put in."""
    out = bytearray(data)
    for at in draw.draw(st.lists(st.integers(0, len(out) - 1), min_size=1, max_size=6)):
        out[at % len(out)] = draw.draw(st.integers(0, 255))
    at = draw.draw(st.integers(0, len(out)))
    way = draw.draw(st.sampled_from(["keep", "cut", "insert"]))
    if way == "cut":
        del out[max(at, 1) :]
    if way == "insert":
        out[at:at] = draw.draw(st.binary(max_size=20))
    return bytes(out)


@dataclass(repr=False)
class Trained:
    """The content of a tiny run's checkpoint, a runner that could go on from it, and a folder."""

    content: dict[str, Any]
    runner: DualRunner
    folder: Path


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("hostile")
    options = ["--num-envs", "2", "--iterations", "1", "--threads", "1", "--ppo.hidden", "4", "4", "--ppo.steps", "4"]
    assert train.main(["base", *options, "--ppo.precision", "fp32", "--run-dir", str(folder / "run")]) == 0
    content = load_checkpoint(folder / "run" / "checkpoint_000001.pt")
    training = from_plain(BaseTraining, content["config"]["training"])
    env = HumanoidEnv(training.env)
    return Trained(content, DualRunner(env, training.runner, training.ppo, folder, content["config"]), folder)


@few
@given(draw=st.data())
def test_a_checkpoint_with_changed_bytes_is_whole_or_refused(trained: Trained, draw: st.DataObject):
    runner, folder = trained.runner, trained.folder
    path = folder / "bytes.pt"
    path.write_bytes(changed_bytes((folder / "run" / "checkpoint_000001.pt").read_bytes(), draw))
    try:
        runner.load(str(path))
    except CheckpointError as error:
        assert str(path) in str(error)  # noqa: PT017


@few
@given(draw=st.data())
def test_a_checkpoint_with_changed_parts_is_whole_or_refused(trained: Trained, draw: st.DataObject):
    content, runner, folder = trained.content, trained.runner, trained.folder
    path = folder / "parts.pt"
    save_checkpoint(path, damage(content, draw, plain | tensors))
    uses = (runner.load, load_policy, train._base_config)
    for use in uses:
        try:
            use(str(path))
        except CheckpointError as error:
            assert "parts.pt" in str(error)  # noqa: PT017  whether it is raised depends on what was drawn


def evaluates(path: Path) -> None:
    """Raises ValueError as `cotap.evaluate` would report it."""
    args = ["velocity-tracking", "--checkpoint", str(path), "--num-envs", "2", "--threads", "1"]
    brief = ["--episode-seconds", "0.2", "--command-seconds", "0.2", "--settle-seconds", "0.04"]
    evaluate.evaluate([*args, *brief])


def plays(path: Path) -> None:
    """What the page does with a checkpoint, first of all and when it is chosen."""
    session = Session({"this": path})
    session.step()
    session.trained_otherwise("this")


def exports(path: Path) -> None:
    graph.export_policy(path, path.with_suffix(".onnx"), checks=2)


@pytest.mark.parametrize("use", [evaluates, plays, exports])
@pytest.mark.parametrize(
    ("env", "message"),
    [
        (None, "has no usable environment config: 'env' is missing"),
        (3, "has no usable environment config: HumanoidEnvConfig must be a table of fields, got int 3"),
        ({"control_dt": "x"}, "has no usable environment config: control_dt must be of type float, got str 'x'"),
        ({"control_dt": -1.0}, "has no usable environment config: control_dt must lie in"),
        ({"robot": "g7"}, "has no usable environment config: robot 'g7' is unknown"),
    ],
)
def test_a_checkpoint_without_its_environment_is_refused_by_name(trained: Trained, use: Any, env: Any, message: str):
    content = copy.deepcopy(trained.content)
    if env is None:
        del content["config"]["training"]["env"]
    else:
        content["config"]["training"]["env"] = env
    save_checkpoint(trained.folder / "env.pt", content)
    with pytest.raises(CheckpointError, match=rf"env\.pt' {message}"):
        use(trained.folder / "env.pt")


def goes_on(path: Path) -> None:
    """As `--resume` does."""
    train.train_base(
        train._parse_base(["--resume", str(path), "--iterations", "2", "--run-dir", str(path.parent / "on")])
    )


def is_guided(path: Path) -> None:
    """As a distillation's `--base-checkpoint` does."""
    train.train_distill(train._parse_distill(["--base-checkpoint", str(path), "--run-dir", str(path.parent / "on")]))


@pytest.mark.parametrize("use", [evaluates, plays, exports, goes_on, is_guided])
@pytest.mark.parametrize("value", [math.nan, -math.inf])
@pytest.mark.parametrize("part", ["actors", "critics", "normalizers", "moments", "rate"])
def test_weights_that_are_not_finite_are_refused_by_name(trained: Trained, use: Any, value: float, part: str):
    """Whoever loads them, and whether it needs them or not."""
    content = copy.deepcopy(trained.content)
    if part == "rate":
        weights, name = content["learner"]["optimizers"]["upper"]["param_groups"][0], "lr"
        weights[name] = value
    else:
        weights = content["learner"]["optimizers"]["lower"]["state"][0] if part == "moments" else content["model"]
        begins = "exp_avg" if part == "moments" else part
        name = next(n for n, v in weights.items() if n.startswith(begins) and v.is_floating_point() and v.dim())
        weights[name].view(-1)[0] = value
    path = trained.folder / "nan.pt"
    save_checkpoint(path, content)
    with pytest.raises(CheckpointError, match=rf"nan\.pt' has weights that are not finite: .*{name}$"):
        use(path)
    assert not (trained.folder / "on").exists()
    assert not path.with_suffix(".onnx").exists()


@pytest.mark.parametrize("use", [evaluates, plays, exports])
@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("action_slices", {"lower": [1, 12], "upper": [12, 20]}, "are not those of 19 joints in order"),
        ("action_slices", {"upper": [11, 19], "lower": [0, 11]}, "are not those of 19 joints in order"),
        ("obs_groups", {"actor": ["privileged"], "critic": ["policy"]}, "do not read the layout's observation of 430"),
        ("observation_widths", {"policy": 86, "privileged": 13}, "do not read the layout's observation of 430"),
    ],
)
def test_networks_for_another_robot_are_refused_by_name(
    trained: Trained, use: Any, part: str, value: Any, message: str
):
    """However well they fit their own weights, which are not looked at before."""
    content = copy.deepcopy(trained.content)
    content["agents"][part] = value
    save_checkpoint(trained.folder / "other.pt", content)
    with pytest.raises(CheckpointError, match=rf"(?s)other\.pt'.*{message}"):
        use(trained.folder / "other.pt")


@pytest.mark.parametrize("use", [evaluates, plays, exports])
@few
@given(draw=st.data())
def test_a_changed_policy_is_used_or_refused(trained: Trained, use: Any, draw: st.DataObject):
    """By all who load one, with changes in the parts that they read."""
    parts = ("kind", "layout", "agents", "config", "model")
    read = {part: trained.content[part] for part in parts}
    path = trained.folder / "policy.pt"
    save_checkpoint(path, trained.content | damage(read, draw, plain | tensors))
    try:
        use(path)
    except ValueError as error:
        assert "policy.pt" in str(error)  # noqa: PT017


def test_a_checkpoint_does_not_say_how_its_optimisers_step(trained: Trained):
    """One that climbs instead of descending, say, or forgets at another rate."""
    content, path = copy.deepcopy(trained.content), trained.folder / "climbs.pt"
    for optimizer in content["learner"]["optimizers"].values():
        optimizer["param_groups"][0] |= {"maximize": True, "betas": (0.5, 5.0), "eps": 1.0, "weight_decay": 1e3}
    save_checkpoint(path, content)
    trained.runner.load(str(path))
    for optimizer in trained.runner.alg.optimizers.values():
        (group,) = optimizer.param_groups
        assert (group["maximize"], group["betas"], group["eps"], group["weight_decay"]) == (
            False, (0.9, 0.999), 1e-8, 0.0
        )  # fmt: skip


STATES = [
    ("env", "parts", "upper_body", "parameters", "alpha"),
    ("env", "parts", "commands", "gait", "stand"),
    ("env", "parts", "actuation", "delay_s"),
    ("env", "parts", "observer", "last_action"),
    ("env", "observations", "policy"),
    ("learner", "optimizers", "lower", "state", 0, "exp_avg"),
]


@pytest.mark.parametrize("way", STATES, ids=lambda way: str(way[-1]))
def test_a_state_of_another_size_is_refused(trained: Trained, way: tuple[Any, ...]):
    content, runner, folder = trained.content, trained.runner, trained.folder
    content = copy.deepcopy(content)
    *to, last = way
    place = content
    for key in to:
        place = place[key]
    place[last] = torch.zeros(7, dtype=torch.float32)
    save_checkpoint(folder / "size.pt", content)
    with pytest.raises(CheckpointError, match=r"states that do not fit this run: .*(shape|size|tensor)"):
        runner.load(str(folder / "size.pt"))


@few
@given(draw=st.data())
def test_a_config_with_changed_values_is_valid_or_refused(draw: st.DataObject):
    data = damage(to_plain(BASE_RECIPES["default"]()), draw, plain)
    try:
        config = from_plain(BaseTraining, data)
        config.env.check()
        config.ppo.check()
        config.runner.check()
    except ValueError as error:
        assert str(error)  # noqa: PT017


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"env": 3}, "env must be a table of fields, got int 3"),
        ({"seed": "0"}, "seed must be of type int, got str '0'"),
        ({"seed": True}, "seed must be of type int, got bool True"),
        ({"ppo": {"hidden": "ab"}}, r"ppo.hidden must be a list, got str 'ab'"),
        ({"ppo": {"hidden": [8, None]}}, r"ppo.hidden\[1\] must be of type int, got NoneType None"),
        ({"env": {"commands": {"velocity_x": [1.0]}}}, "env.commands.velocity_x must have 2 entries, got 1"),
        ({"env": {"assist": {"enabled": 1}}}, "env.assist.enabled must be of type bool, got int 1"),
        ({3: 1}, "BaseTraining has no field '3'"),
    ],
)
def test_a_value_of_another_type_is_named(data: Any, message: str):
    with pytest.raises(ValueError, match=message):
        from_plain(BaseTraining, data)


@few
@given(st.text(max_size=30) | st.builds("cotap:{}={}".format, st.text(max_size=9), st.text(max_size=9)))
def test_a_law_from_the_command_line_is_one_or_refused(text: str):
    try:
        parse_law("left", text, LawConfig()).check()
    except ValueError as error:
        assert str(error)  # noqa: PT017


words = st.sampled_from(
    ["base", "distill", "--resume", "--run-dir", "--num-envs", "--iterations", "--recipe", "--seed", "--threads",
     "--device", "--ppo.hidden", "--ppo.gamma", "--env.commands.velocity-x", "velocity-tracking", "impact", "--left",
     "--stiffness", "--force", "--checkpoint", "--hand", "--json", "paper", "cuda", "0", "-1", "1e400", "nan", "--"]
)  # fmt: skip


@few
@given(args=st.lists(words | st.text(max_size=6), max_size=6))
def test_a_command_line_is_obeyed_or_refused(
    args: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], in_tmp_path: None
):
    """Up to where work would begin."""
    del in_tmp_path
    monkeypatch.setattr(train, "_train", lambda _stage, options, _base: options.training.check() or Path("nowhere"))
    monkeypatch.setattr(train, "train_both", lambda options, _run_stage: options.check())

    def check(_: str, options: Any) -> None:
        options.protocol.check()
        options.laws.configure()

    monkeypatch.setattr(evaluate, "run", check)
    for main in (train.main, evaluate.main):
        try:
            status = main(list(args))
        except SystemExit as stop:  # the parser's way
            status = int(stop.code or 0)
        said = capsys.readouterr()
        assert status in (0, 2), said.err
        assert status == 0 or said.err or said.out


class Begun(Exception):
    """A command line was accepted, and work would begin."""


OPTIONS = {
    "motions": ["import", "show", "good.npz", "nowhere", "--output", "--format", "auto", "amass", "--mirror", "--clip",
                "--robot", "h1"],
    "export": ["--output", "p.onnx", "nowhere/p.onnx", "--checkpoint", "h1-base", "--checks", "--seed"],
    "deploy": ["--policy", "good.onnx", "--scenario", "good.toml", "--trials", "--episode-seconds", "--motion",
               "mixture", "--left", "cotap:alpha=0.7", "--seed", "--engine", "mujoco", "--timestep",
               "--delay-steps", "--json"],
    "compare": ["good.json", "--without-falls", "--json", "nowhere/o.json"],
    "play": ["--host", "127.0.0.1", "--port", "--checkpoint", "good.pt", "--robot", "h1", "--replay", "--seed"],
}  # fmt: skip
NUMBERS = ["0", "1", "2", "-1", "2.5", "1e400", "nan", "9" * 30, ""]
BEGINNINGS = {
    "motions": [["import", "nowhere", "--output", "o.npz"], ["show", "good.npz"]],
    "export": [["--output", "p.onnx"]],
    "deploy": [["--policy", "good.onnx"], ["--policy", "good.onnx", "--scenario", "good.toml"]],
    "compare": [["good.json", "good.json"]],
    "play": [["--checkpoint", "good.pt"], ["--port", "8080"]],
}


@pytest.fixture(scope="module")
def good_files(trained: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good file of each kind that command lines name."""
    folder = tmp_path_factory.mktemp("good")
    graph.export_policy(trained.folder / "run" / "checkpoint_000001.pt", folder / "good.onnx", checks=2)
    save_checkpoint(folder / "good.pt", trained.content)
    (folder / "good.toml").write_text(SCENARIO)
    (folder / "good.json").write_text(json.dumps(RESULT))
    spec = h1()
    MotionLibrary(shipped_library(spec).clips[:1], spec).save(folder / "good.npz")
    return folder


@pytest.mark.parametrize("command", sorted(OPTIONS))
@few
@given(draw=st.data())
def test_every_command_is_obeyed_or_refused(
    command: str, good_files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    draw: st.DataObject,
):  # fmt: skip
    """Up to where work would begin, or a page would be opened."""

    def begin(*_: Any, **__: Any) -> None:
        raise Begun

    monkeypatch.chdir(good_files)
    for module, work in (
        (motions, "import_motions"), (motions, "describe"), (graph, "export_policy"), (trials, "run_trials"),
        (compare, "table"), (server.viser, "ViserServer"),
    ):  # fmt: skip
        monkeypatch.setattr(module, work, begin)
    word = st.sampled_from(OPTIONS[command]) | st.sampled_from(NUMBERS) | st.text(max_size=6)
    args = [*draw.draw(st.sampled_from([*BEGINNINGS[command], []])), *draw.draw(st.lists(word, max_size=4))]
    main = {"motions": motions, "export": export, "deploy": deploy, "compare": compare, "play": play}[command].main
    try:
        status = main(args)
    except Begun:
        return
    except SystemExit as stop:  # the parser's way
        status = int(stop.code or 0)
    said = capsys.readouterr()
    asked = {"-h", "--help"} & set(args)
    assert status == (0 if asked and not said.err else 2), said.err
    assert said.err or said.out


SCENARIO = """
seconds = 0.06
left = "cotap:alpha=0.5"
[arms]
clip = ""
[[command]]
at = 0.0
velocity = [0.3, 0.0]
[[command]]
at = 0.02
stand = true
[[force]]
force = [10.0, 0.0, 0.0]
hand = "left"
"""


def deploys(args: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A file is used on a robot, or refused with an error that names it."""
    status = deploy.main([*args] if "--scenario" in args else [*args, "--episode-seconds", "0.06"])
    said = capsys.readouterr().err
    assert status in (0, 2)
    assert status == 0 or re.match(f"error: .*({named})", said, re.DOTALL), said


@few
@given(draw=st.data())
def test_an_onnx_file_with_changed_bytes_is_used_or_refused(
    good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], draw: st.DataObject
):
    path = tmp_path / "changed.onnx"
    path.write_bytes(changed_bytes((good_files / "good.onnx").read_bytes(), draw))
    deploys(["--policy", str(path)], "changed.onnx|the policy's metadata|the policy was trained", capsys)


@few
@given(draw=st.data())
def test_an_onnx_file_with_changed_metadata_is_used_or_refused(
    good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], draw: st.DataObject
):
    proto = onnx.load(good_files / "good.onnx")
    entries = damage({p.key: json.loads(p.value) for p in proto.metadata_props}, draw, json_values)
    onnx.helper.set_model_props(proto, {name: json.dumps(value) for name, value in entries.items()})
    path = tmp_path / "changed.onnx"
    onnx.save(proto, path)
    deploys(["--policy", str(path)], "changed.onnx|the policy's metadata|the policy was trained", capsys)


@few
@given(draw=st.data())
def test_a_scenario_with_changed_bytes_is_used_or_refused(
    good_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], draw: st.DataObject
):
    path = tmp_path / "changed.toml"
    path.write_bytes(changed_bytes(SCENARIO.encode(), draw))
    deploys(["--policy", str(good_files / "good.onnx"), "--scenario", str(path)], "changed.toml|clip", capsys)


def as_toml(value: Any) -> str:
    """A value of plain data in TOML; what TOML lacks as text."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(k))} = {as_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    return repr(value) if isinstance(value, float) else json.dumps("" if value is None else value)


@few
@given(draw=st.data())
def test_a_scenario_with_changed_values_is_used_or_refused(spec: RobotSpec, tmp_path: Path, draw: st.DataObject):
    values = damage(tomllib.loads(SCENARIO), draw, json_values)
    path = tmp_path / "changed.toml"
    path.write_text("\n".join(f"{json.dumps(k)} = {as_toml(v)}" for k, v in values.items()), encoding="utf-8")
    try:
        scenario = load_scenario(path, spec)
        scenario.forces(spec, 0.02)
        scenario.arms.reference(spec, 0.02)
    except ValueError as error:
        assert "changed.toml" in str(error) or "clip" in str(error)  # noqa: PT017


def test_a_scenario_nested_without_end_is_refused(spec: RobotSpec, tmp_path: Path):
    (tmp_path / "deep.toml").write_text("seconds = " + "[" * 100_000)
    with pytest.raises(ValueError, match=r"deep\.toml' is not TOML"):
        load_scenario(tmp_path / "deep.toml", spec)


def motion_files(spec: RobotSpec, folder: Path) -> dict[str, Path]:
    """A good file of every format that is text or numpy's."""
    rows = np.zeros((4, 44))
    rows[:, 0] = 0.03
    rows[:, [4, 8, 12, 16, 21, 25, 30, 35, 39]] = 1.0
    out = {name: folder / f"good.{suffix}" for name, suffix in (("deepmimic", "txt"), ("lafan", "csv"))}
    out["deepmimic"].write_text(json.dumps({"Frames": rows.tolist()}))
    table = np.zeros((4, 7 + len(spec.arms)))
    table[:, 6] = 1.0
    out["lafan"].write_text("\n".join(",".join(map(str, r)) for r in table))
    out["amass"] = folder / "amass.npz"
    np.savez(out["amass"], poses=np.zeros((4, 66)), trans=np.zeros((4, 3)), mocap_framerate=30.0)
    out["npz"] = folder / "library.npz"
    MotionLibrary(shipped_library(spec).clips[:1], spec).save(out["npz"])
    return out


@pytest.mark.parametrize("form", ["deepmimic", "lafan", "amass", "npz"])
@few
@given(draw=st.data())
def test_a_motion_file_with_changed_bytes_is_read_or_refused(
    form: str, spec: RobotSpec, tmp_path: Path, draw: st.DataObject
):
    good = motion_files(spec, tmp_path)[form]
    path = tmp_path / f"changed{good.suffix}"
    path.write_bytes(changed_bytes(good.read_bytes(), draw))
    try:
        clips = [read() for _, read in FORMATS[form](path, spec)]
    except MotionError as error:
        assert str(error)  # noqa: PT017
    else:
        assert all(np.isfinite(c.arms).all() for c in clips)


def is_recording(path: Path) -> None:
    """A file is read and measured, or refused by name."""
    try:
        read = load_recording(path)
    except RecordingError as error:
        assert path.name in str(error)  # noqa: PT017
    else:
        json.dumps(measure(read, RecordingProtocol(str(path))))


@few
@given(draw=st.data())
def test_a_recording_with_changed_bytes_is_read_or_refused(tmp_path: Path, draw: st.DataObject):
    path = tmp_path / "r.npz"
    small_recording().save(path)
    path.write_bytes(changed_bytes(path.read_bytes(), draw))
    is_recording(path)


@few
@given(draw=st.data())
def test_a_recording_with_changed_settings_is_read_or_refused(tmp_path: Path, draw: st.DataObject):
    path, whole = tmp_path / "r.npz", small_recording()
    json_values = st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
        lambda v: st.lists(v, max_size=3) | st.dictionaries(st.text(max_size=4), v, max_size=3),
        max_leaves=4,
    )
    Recording(whole.trajectory, whole.scene, damage(whole.settings, draw, json_values)).save(path)
    is_recording(path)


@few
@given(name=st.sampled_from(sorted(SCENE)), shape=st.lists(st.integers(0, 6), max_size=4), kind=st.sampled_from("fi?U"))
def test_a_recording_with_another_array_is_read_or_refused(tmp_path: Path, name: str, shape: list[int], kind: str):
    path, whole = tmp_path / "r.npz", small_recording()
    Recording(whole.trajectory, whole.scene | {name: np.zeros(shape, kind)}, whole.settings).save(path)
    is_recording(path)


@few
@given(st.binary(max_size=200))
def test_bytes_that_are_no_motion_are_refused(tmp_path: Path, data: bytes):
    path = tmp_path / "x.pkl"
    path.write_bytes(b"\x80\x04" + data)
    try:
        load_joblib(path)
    except MotionError as error:
        assert str(path) in str(error)  # noqa: PT017


def test_numbers_beyond_floats_in_a_config_are_refused():
    data = to_plain(BASE_RECIPES["default"]())
    data["env"]["control_dt"] = math.inf
    with pytest.raises(ValueError, match="control_dt must be a finite number"):
        from_plain(BaseTraining, data).env.check()


RESULT = {
    "protocol": "impact", "method": "pd", "window": {"start": 1.0, "end": 2.0},
    "settings": {"seed": 0, "env": {"a": [1]}},
    "metrics": {"e_ee": {"mean": 0.1, "std": 0.1, "ci95": [0.09, 0.11]},
                "fell": {"mean": None, "ci95": None, "reason": "-"}},
    "metrics_without_falls": {"e_ee": {"mean": 0.1, "std": 0.1, "ci95": [0.09, 0.11]}},
}  # fmt: skip
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**400), 10**400) | st.floats() | st.text(max_size=8),
    lambda v: st.lists(v, max_size=3) | st.dictionaries(st.text(max_size=4), v, max_size=3),
    max_leaves=4,
)


@few
@given(draw=st.data())
def test_an_evaluation_with_changed_parts_is_compared_or_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], draw: st.DataObject
):
    a, b, out = (tmp_path / f"{name}.json" for name in "abo")
    a.write_text(json.dumps(RESULT))
    b.write_text(json.dumps(damage(RESULT, draw, json_values)))
    options = draw.draw(st.sampled_from([[], ["--without-falls"]]))
    status = compare.main([str(a), str(b), *options, "--json", str(out)])
    said = capsys.readouterr().err
    assert (status == 0 and not said) or (status == 2 and said.startswith("error: "))


@few
@given(data=st.binary(max_size=60) | st.integers(1, 200_000).map(lambda n: b"[" * n))
def test_bytes_that_are_no_evaluation_are_refused(tmp_path: Path, data: bytes):
    path = tmp_path / "a.json"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"is (not JSON|not an evaluation|no text)"):
        compare.read(str(path))


def test_settings_nested_too_deep_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "a.json"
    text = json.dumps(RESULT).replace('{"a": [1]}', '{"a":' * 900 + "1" + "}" * 900)
    path.write_text(text)
    assert compare.main([str(path), str(path)]) in (0, 2)
    assert "Traceback" not in capsys.readouterr().err
