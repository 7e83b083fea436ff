"""Policies that come with the package: where they come from, and that they still do what was measured, all of it."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from typing import Any

import pytest

from cotap.agents.checkpoint import load_checkpoint, sha256
from cotap.configs import from_plain
from cotap.evaluate import PROTOCOLS, evaluate
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.policy import load_policy, shipped_checkpoint, shipped_names
from release.publish import ENVS, EVALUATIONS

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
    assert said["command"].startswith(("cotap train", "python -m cotap.train"))
    assert said["commit"]
    commands = [said["command"], *(run["command"] for run in said["runs"])]
    assert not [word for command in commands for word in command.split() if word.startswith("/")]  # one machine's paths
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


def uncertainty(summary: dict[str, Any]) -> float:
    """Standard error of a mean; of a share by its interval, which has a width even where all envs agree."""
    low, high = summary["ci95"]
    return max(summary["std"] / math.sqrt(summary["n"]), (high - low) / 3.92)


@pytest.mark.slow
@pytest.mark.parametrize("evaluation", EVALUATIONS)
@pytest.mark.parametrize("name", shipped_names())
def test_a_shipped_evaluation_is_what_the_policy_does(name: str, evaluation: str):
    """Asked for again with 64 other envs: nothing differs by five standard errors, and settings are those it says."""
    path = shipped_checkpoint(name)
    kept = json.loads(path.with_name(f"{name}.{evaluation}.json").read_text())
    assert kept["settings"]["checkpoint_sha256"] == sha256(path)
    args = ["64" if arg == ENVS else arg for arg in EVALUATIONS[evaluation]]
    now = evaluate([*args, "--checkpoint", str(path), "--seed", "1", "--threads", "1"])
    settings = kept["settings"], json.loads(json.dumps(now["settings"]))
    known = settings[0].keys() & settings[1].keys()  # options and measures come and go
    changed = {name for name in known if settings[0][name] != settings[1][name]}
    assert len(known) > 20
    assert changed <= {"seed", "num_envs", "env"}
    compared = 0
    for measure in sorted(kept["metrics"].keys() & now["metrics"].keys()):
        before, after = kept["metrics"][measure], now["metrics"][measure]
        if min(before["n"], after["n"]) < 20:  # such as the time that those take to recover who leave their place
            assert before["n"] < 20 * 16 or after["n"] > 0, measure
            continue
        error = math.hypot(uncertainty(before), uncertainty(after))
        assert abs(after["mean"] - before["mean"]) <= 5.0 * error + 1e-9, measure
        compared += 1
    assert compared >= 10
    if 2 * kept["num_falls"] > kept["num_envs"]:  # who falls at once has hardly a slope
        return
    for axis, slope in kept.get("slopes", {}).items():
        low, high = now["slopes_ci95"][axis]
        error = (high - low) / 3.92 * math.sqrt(1.0 + now["num_envs"] / kept["num_envs"])
        assert abs(now["slopes"][axis] - slope) <= 5.0 * error, axis


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
