"""Policies that come with the package: where they come from, and that they still do what was measured."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

import pytest
from publish import EVALUATIONS

from cotap.agents.checkpoint import load_checkpoint, sha256
from cotap.configs import from_plain
from cotap.evaluate import PROTOCOLS, evaluate
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.policy import load_policy, shipped_checkpoint, shipped_names

SMALL = "velocity-tracking.small"


@pytest.mark.parametrize("name", shipped_names())
def test_a_shipped_policy_is_small_and_says_where_it_comes_from(name: str):
    path = shipped_checkpoint(name)
    content, said = load_checkpoint(path), json.loads(path.with_suffix(".json").read_text())
    assert path.stat().st_size < 6 * 2**20
    assert content["learner"] == content["env"] == {}
    assert load_policy(path).stage == content["kind"] == said["stage"]
    assert said["sha256"] == sha256(path)
    assert said["samples"] == content["samples"] > 0
    assert said["hours"] == pytest.approx(content["wall_seconds"] / 3600.0, abs=0.01)
    assert said["seed"] == content["config"]["training"]["seed"]
    assert said["command"].startswith("python -m cotap.train")
    assert said["commit"]
    assert said["evaluations"].keys() == EVALUATIONS.keys()


@pytest.mark.parametrize("name", shipped_names())
def test_a_shipped_evaluation_can_be_asked_for_again(name: str):
    """Its settings are still those of its protocol, and are allowed."""
    for path in shipped_checkpoint(name).parent.glob(f"{name}.*.json"):
        kept = json.loads(path.read_text())
        protocol = from_plain(PROTOCOLS[kept["protocol"]], own(PROTOCOLS[kept["protocol"]], kept["settings"]))
        protocol.check()
        LawOptions(**own(LawOptions, kept["settings"])).configure()


def own(kind: type, settings: dict[str, Any]) -> dict[str, Any]:
    """Of all settings, those of one dataclass."""
    return {f.name: settings[f.name] for f in fields(kind) if f.name in settings}


@pytest.mark.parametrize("name", shipped_names())
def test_a_shipped_policy_repeats_its_small_evaluation(name: str):
    """Another processor rounds otherwise, and walking is chaotic: then intervals must overlap."""
    path = shipped_checkpoint(name)
    kept = json.loads(path.with_name(f"{name}.{SMALL}.json").read_text())
    assert kept["settings"]["checkpoint_sha256"] == sha256(path)
    result = evaluate([*EVALUATIONS[SMALL], "--checkpoint", str(path)])
    for measure, before in kept["metrics"].items():
        now = result["metrics"][measure]
        if before["mean"] is None or now["mean"] is None:
            assert before["mean"] == now["mean"], measure
        elif now["mean"] != pytest.approx(before["mean"], rel=1e-3):
            assert max(before["ci95"][0], now["ci95"][0]) <= min(before["ci95"][1], now["ci95"][1]), measure
