"""What scripts/ship_checkpoint.py writes down of a policy: its runs, and what was changed after them."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import ship_checkpoint as sc

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint
from cotap.configs import BASE_RECIPES, BaseTraining, DistillTraining, from_plain, to_plain
from cotap.evaluation.policy import load_policy, shipped_checkpoint

LEANS, BRACES = "env.commands.lean_into_loads", "env.commands.brace_tilt_rad"
HOLD_BACK, CATCH_LIFT = "env.commands.step_hold_back_m", "env.commands.step_catch_lift"


def test_runs_are_listed_oldest_first_and_a_shipped_policy_stands_for_all_of_its_own(tmp_path):
    def run(name: str) -> dict[str, str]:
        return {"command": f"train {name}", "commit": name}

    shipped, folder = tmp_path / "old.json", tmp_path / "run"
    shipped.write_text(json.dumps(run("b") | {"earlier_runs": [run("a")], "seed": 0}))
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(run("c") | {"machine": "m"}))
    assert sc.earlier_runs([shipped, folder]) == [run("a"), run("b"), run("c")]


@pytest.mark.parametrize(("stage", "kind"), [("base", BaseTraining), ("distill", DistillTraining)])
def test_only_what_is_named_is_changed(stage, kind):
    training = to_plain(kind())
    before = json.dumps(training)
    changed = sc.changed(training, stage, {HOLD_BACK: 0.45, CATCH_LIFT: 0.5})
    expected = json.loads(before)
    expected["env"]["commands"] |= {"step_hold_back_m": 0.45, "step_catch_lift": 0.5}
    assert changed == expected
    assert json.dumps(training) == before
    assert from_plain(kind, changed).env.commands.step_hold_back_m == 0.45


@pytest.mark.parametrize(
    ("change", "needle"),
    [
        ("env.commands.no_such=1", "'env.commands.no_such' is no number"),
        ("env.commands=1", "'env.commands' is no number"),
        ("nowhere.at.all=1", "'nowhere.at.all' is no number"),
        ("env.num_envs=2", "'env.num_envs' is no number"),
        (f"{HOLD_BACK}=yes", f"'{HOLD_BACK}' is no switch"),
        (f"{LEANS}=1", f"'{LEANS}' is no number"),
        (f"{HOLD_BACK}=-1", "commands.step_hold_back_m"),
        (f"{HOLD_BACK}=far", "far"),
        (HOLD_BACK, "could not convert"),
    ],
)
def test_changes_that_cannot_be_made_are_named_and_nothing_is_shipped(change, needle, tmp_path, monkeypatch, capsys):
    target = tmp_path / "out" / "base.pt"
    monkeypatch.setattr(sc, "checkpoint_path", lambda _: target)
    training = to_plain(BASE_RECIPES["default"]())
    content = {"kind": "base", "model": {}, "config": {"command": "train", "training": training}}
    monkeypatch.setattr(sc, "load_checkpoint", lambda _: content)
    monkeypatch.setattr(sys, "argv", ["ship_checkpoint.py", "c.pt", "--change", change])
    assert sc.main() == 2
    assert needle in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("*"))


def layered() -> dict:
    """What `scaled` looks at of a checkpoint: two leg joints and an arm's."""
    model = {f"actors.lower.{part}": torch.ones(2) for part in ("output_weight", "output_bias")}
    model |= {f"actors.upper.{part}": torch.ones(1) for part in ("output_weight", "output_bias")}
    slices = {"lower": [0, 2], "upper": [2, 3]}
    return {"model": model, "agents": {"action_slices": slices}, "layout": {"joints": ["hip_roll", "knee", "arm_roll"]}}


def test_outputs_of_the_joints_that_are_named_are_scaled_and_no_others():
    before = layered()
    model = sc.scaled(before, {"roll": 0.5, "knee": 2.0})["model"]
    for part in ("output_weight", "output_bias"):
        assert model[f"actors.lower.{part}"].tolist() == [0.5, 2.0]
        assert model[f"actors.upper.{part}"].tolist() == [0.5]
    assert torch.equal(before["model"]["actors.lower.output_weight"], torch.ones(2))


@pytest.mark.parametrize(("factors", "needle"), [({"wheel": 0.9}, "'wheel' is in no"), ({"knee": 0.0}, "got 0.0")])
def test_outputs_that_cannot_be_scaled_are_named(factors, needle):
    with pytest.raises(ValueError, match=needle):
        sc.scaled(layered(), factors)


def test_a_scaled_policy_moves_its_joint_by_that_much_and_the_others_as_before(tmp_path):
    path, scaled = shipped_checkpoint("cotap"), tmp_path / "scaled.pt"
    content = load_checkpoint(path)
    save_checkpoint(scaled, sc.scaled(content, {"hip_pitch": 0.9}))
    width = content["agents"]["observation_widths"]["policy"]
    observation = {"policy": torch.randn(3, width, generator=torch.Generator().manual_seed(0))}
    before, after = load_policy(path)(observation), load_policy(scaled)(observation)
    pitch = torch.tensor(["hip_pitch" in joint for joint in content["layout"]["joints"]])
    torch.testing.assert_close(after, before * torch.where(pitch, 0.9, 1.0))
    assert pitch.sum() == 2


def test_a_policy_that_is_told_more_acts_as_if_commands_were_larger(tmp_path):
    content = load_checkpoint(shipped_checkpoint("base"))
    gains = {"forward": 1.1, "sideways": 0.8, "turning": 1.3}
    terms, steps = content["layout"]["terms"], content["layout"]["history"]
    width = content["agents"]["observation_widths"]["policy"]
    seen = torch.randn(3, width, generator=torch.Generator().manual_seed(0))
    larger, start = seen.clone(), 0
    for term, wide, _ in terms:
        factors = {"command_velocity": [1.1, 0.8], "command_yaw_rate": [1.3]}.get(term, [1.0] * wide)
        larger[:, start : start + wide * steps] *= torch.tensor(factors).repeat(steps)
        start += wide * steps

    def act(content: dict, observation: torch.Tensor) -> torch.Tensor:
        save_checkpoint(tmp_path / "policy.pt", content)
        return load_policy(tmp_path / "policy.pt")({"policy": observation})

    expected, plain = act(content, larger), act(content, seen)
    told = act(sc.told_more(content, gains), seen)
    assert (expected - plain).abs().max() > 0.05
    # rsl_rl adds 0.01 to the deviation that it divides by.
    torch.testing.assert_close(told, expected, atol=0.01, rtol=0.0)


@pytest.mark.parametrize(("gains", "needle"), [({"up": 1.1}, "'up' is unknown"), ({"forward": 3.0}, "got 3.0")])
def test_commands_that_cannot_be_told_are_named(gains, needle):
    with pytest.raises(ValueError, match=needle):
        sc.told_more(load_checkpoint(shipped_checkpoint("base")), gains)


def test_switches_are_changed_too():
    changes = sc.settings([f"{LEANS}=yes", f"{BRACES}=0.05"])
    commands = sc.changed(to_plain(BaseTraining()), "base", changes)["env"]["commands"]
    assert (commands["lean_into_loads"], commands["brace_tilt_rad"]) == (True, 0.05)
    back = sc.settings([f"{LEANS}=no", f"{BRACES}=0"])
    commands = sc.changed(to_plain(BaseTraining()), "base", back)["env"]["commands"]
    assert (commands["lean_into_loads"], commands["brace_tilt_rad"]) == (False, 0.0)


def test_a_policy_that_is_shipped_already_keeps_its_provenance(tmp_path, monkeypatch):
    source = shipped_checkpoint("cotap")
    known = json.loads(source.with_suffix(".json").read_text())
    target = tmp_path / "out" / "cotap.pt"
    monkeypatch.setattr(sc, "checkpoint_path", lambda _: target)
    monkeypatch.setattr(sc, "EVALUATIONS", {"cotap": {}})
    options = ["--name", "cotap", "--change", f"{HOLD_BACK}=0.4", "--scale", "knee=0.9", "--tell", "forward=1.1"]
    monkeypatch.setattr(sys, "argv", ["ship_checkpoint.py", "cotap", *options])
    assert sc.main() == 0
    new = json.loads(target.with_suffix(".json").read_text())
    kept = ("stage", "commit", "command", "averaged", "earlier_runs", "seed", "iterations", "samples", "machine")
    assert {key: new[key] for key in kept} == {key: known[key] for key in kept}
    assert new["changed_after_training"] == known["changed_after_training"] | {HOLD_BACK: 0.4}
    before = known["outputs_scaled_after_training"]
    assert new["outputs_scaled_after_training"] == pytest.approx(before | {"knee": 0.9 * before["knee"]})
    assert new["commands_scaled_after_training"]["forward"] == pytest.approx(
        1.1 * known.get("commands_scaled_after_training", {}).get("forward", 1.0)
    )
    assert load_policy(target).env_config.commands.step_hold_back_m == 0.4


def test_where_the_repository_is_kept_is_left_out_however_deep():
    here = Path.cwd()
    told = {"a": [{"command": f"run {here}/runs/x.pt={here}/y"}], "n": 3, "t": f"{here.parent}/elsewhere"}
    left = {"a": [{"command": "run runs/x.pt=y"}], "n": 3, "t": f"{here.parent}/elsewhere"}
    assert sc.without_folder(told) == left


def test_a_description_of_another_checkpoint_is_refused(tmp_path):
    (tmp_path / "c.pt").write_bytes(b"one")
    assert sc.shipped_description(tmp_path / "c.pt") == {}
    (tmp_path / "c.json").write_text(json.dumps({"averaged": []}))  # an average's
    assert sc.shipped_description(tmp_path / "c.pt") == {}
    (tmp_path / "c.json").write_text(json.dumps({"sha256": "another's"}))
    with pytest.raises(ValueError, match="describes another checkpoint"):
        sc.shipped_description(tmp_path / "c.pt")


def test_factors_of_names_that_overlap_are_refused():
    assert sc.combined({"knee": 0.9}, {"hip": 0.5, "knee": 0.5}) == {"knee": 0.45, "hip": 0.5}
    with pytest.raises(ValueError, match="'hip' meets 'hip_pitch'"):
        sc.combined({"hip_pitch": 0.9}, {"hip": 0.5})
