"""What is printed of a file: short, and nothing that a terminal would obey."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch

from cotap import compare, deploy, evaluate, export
from cotap.agents.checkpoint import load_checkpoint, save_checkpoint
from cotap.checks import shortened
from cotap.deployment.graph import export_policy
from cotap.evaluation.policy import shipped_checkpoint
from cotap.motions import __main__ as motions

NAMES = {"long": "N" * 1_000_000, "commands": "a\x1b[2J\x1b]0;owned\x07\u202eb\r"}
MEASURE = {"mean": 0.1, "std": 0.1, "ci95": [0.0, 0.2]}


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    """A name as a hostile file may have it."""
    return NAMES[request.param]


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed since, all of it fit to be."""
    out = "".join(capsys.readouterr())
    assert out
    assert len(out) < 6000
    assert all(c.isprintable() or c in "\n\t" for c in out)
    return out


def evaluation(**parts: Any) -> str:
    return json.dumps({"protocol": "p", "method": "pd", "settings": {"seed": 0}, "metrics": {"x": MEASURE}} | parts)


@pytest.mark.parametrize("where", ["measure", "setting", "value", "protocol", "method", "reason"])
def test_compare_prints_no_name_as_it_comes(where: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    parts: dict[str, dict[str, Any]] = {
        "measure": {"metrics": {name: MEASURE}}, "setting": {"settings": {name: 1}},
        "value": {"settings": {"seed": name}},
        "protocol": {"protocol": name}, "method": {"method": name},
        "reason": {"metrics": {"x": {"mean": None, "ci95": None, "reason": name}}},
    }  # fmt: skip
    a.write_text(evaluation(**parts[where]))
    b.write_text(evaluation(**(parts[where] if where == "measure" else {})))
    assert compare.main([str(a), str(b)]) == (2 if where == "protocol" else 0)
    said(capsys)


def test_compare_lists_a_hundred_changed_settings_and_reads_a_thousand_measures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    a.write_text(evaluation())
    b.write_text(evaluation(settings={"seed": 0} | {f"s{k:03d}": 1 for k in range(150)}))
    assert compare.main([str(a), str(b)]) == 0
    out = said(capsys)
    assert "s099: None -> 1\nand 50 more settings\n" in out
    assert "s100" not in out
    b.write_text(evaluation(metrics={f"m{k}": MEASURE for k in range(1001)}))
    assert compare.main([str(a), str(b)]) == 2
    assert "metrics has 1001 measures; at most 1000 are read" in said(capsys)


@pytest.mark.parametrize("where", ["kind", "config", "robot", "term", "weight"])
def test_no_name_in_a_checkpoint_is_printed_as_it_comes(
    where: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    content = copy.deepcopy(load_checkpoint(shipped_checkpoint()))
    env = content["config"]["training"]["env"]
    if where == "kind":
        content["kind"] = name
    elif where == "config":
        env[name] = 1
    elif where == "robot":
        env["robot"] = name
    elif where == "term":
        content["layout"]["terms"][0][0] = name
    else:
        content["model"][name] = torch.zeros(2)
    path = tmp_path / "c.pt"
    save_checkpoint(path, content)
    assert export.main(["--checkpoint", str(path), "--output", str(tmp_path / "c.onnx"), "--checks", "2"]) == 2
    said(capsys)
    assert evaluate.main(["velocity-tracking", "--checkpoint", str(path), "--num-envs", "2"]) == 2
    said(capsys)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "h1.onnx"
    export_policy(shipped_checkpoint(), path, 2)
    return path


@pytest.mark.parametrize("where", ["stage", "robot", "joints", "law", "input"])
def test_no_name_in_an_exported_policy_is_printed_as_it_comes(
    where: str, name: str, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    proto = onnx.load(exported)
    if where == "input":
        proto.graph.input[0].name = name
        for node in proto.graph.node:
            node.input[:] = [name if read == "observation" else read for read in node.input]
    else:
        value: Any = {"joints": [name], "law": {"left": {name: 1}}}.get(where, name)
        next(p for p in proto.metadata_props if p.key == where).value = json.dumps(value)
    onnx.save(proto, tmp_path / "p.onnx")
    assert deploy.main(["--policy", str(tmp_path / "p.onnx"), "--episode-seconds", "0.1"]) == 2
    said(capsys)


@pytest.mark.parametrize(
    "text", ["{name} = 1", "left = {name}", "[arms]\nclip = {name}", "[[force]]\nforce = [1, 2, 3]\nhand = {name}"]
)
def test_no_name_in_a_scenario_is_printed_as_it_comes(
    text: str, name: str, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "s.toml"
    path.write_text(text.format(name=json.dumps(name[:1_000_000])))
    assert deploy.main(["--policy", str(exported), "--scenario", str(path)]) == 2
    said(capsys)


def test_no_name_of_a_file_is_printed_as_it_comes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of motion files, which come by the folder."""
    (tmp_path / "a\x1b[2J\u202e.csv").write_text("rubbish")
    (tmp_path / "b\x1b]0;owned\x07.txt").write_text("rubbish")
    assert motions.main(["import", str(tmp_path), "--output", str(tmp_path / "o.npz")]) == 2
    said(capsys)


def test_a_message_keeps_its_lines_and_letters_and_nothing_else():
    assert shortened("läuft\n\ta 3 m/s²") == "läuft\n\ta 3 m/s²"
    assert shortened("a\x1b[2J\x07\u202e\r\x00b") == r"a\x1b[2J\x07\u202e\r\x00b"
