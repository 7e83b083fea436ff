"""What scripts/average_checkpoints.py makes of policies, and what it refuses."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import average_checkpoints as ac

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256
from cotap.evaluation.policy import load_policy, shipped_checkpoint

BASE, COTAP = shipped_checkpoint("base"), shipped_checkpoint("cotap")


def run(monkeypatch: pytest.MonkeyPatch, *args: object) -> int:
    monkeypatch.setattr(sys, "argv", ["average_checkpoints.py", *map(str, args)])
    return ac.main()


def test_average_by_hand():
    states = [
        {"w": torch.tensor([1.0, 4.0]), "b": torch.tensor(0.0), "n": torch.tensor(3)},
        {"w": torch.tensor([5.0, 0.0]), "b": torch.tensor(8.0), "n": torch.tensor(9)},
    ]
    mean = ac.average(states, [0.75, 0.25])
    assert mean["w"].tolist() == [2.0, 3.0]
    assert mean["b"] == 2.0
    assert mean["n"] == 3  # counts are the first's


def test_shares_below_zero_go_on_by_hand():
    states = [{"w": torch.tensor([1.0, 4.0])}, {"w": torch.tensor([5.0, 0.0])}]
    assert ac.average(states, [2.0, -1.0])["w"].tolist() == [-3.0, 8.0]


@pytest.mark.parametrize("name", ["normalizers.policy._std", "normalizers.policy._var"])
def test_deviations_that_would_be_negative_are_refused(name):
    states = [{name: torch.tensor([1.0, 0.4])}, {name: torch.tensor([0.5, 1.0])}]
    with pytest.raises(ValueError, match=f"2, -1 {name} is negative"):
        ac.average(states, [2.0, -1.0])


def test_average_of_shipped_policies_is_a_policy_and_says_what_it_is_made_of(tmp_path, monkeypatch):
    out = tmp_path / "mean.pt"
    assert run(monkeypatch, f"{COTAP}=0.75", f"{BASE}=0.25", "--output", out) == 0
    mean, cotap, base = (load_checkpoint(path) for path in (out, COTAP, BASE))
    for agent in ("lower", "upper"):
        parts = [content["model"][f"actors.{agent}.output_weight"] for content in (cotap, base, mean)]
        torch.testing.assert_close(parts[2], 0.75 * parts[0] + 0.25 * parts[1])
    assert mean["kind"] == "distill"
    assert mean["config"]["training"] == cotap["config"]["training"]
    load_policy(out)
    described = json.loads(out.with_suffix(".json").read_text())
    assert [part["share"] for part in described["averaged"]] == [0.75, 0.25]
    assert [part["sha256"] for part in described["averaged"]] == [sha256(COTAP), sha256(BASE)]
    assert described["averaged"][1]["command"] == base["config"]["command"]
    assert described["averaged"] == mean["config"]["averaged"]


@pytest.mark.parametrize(
    ("shares", "needle"),
    [
        (("=0.5", "=0.4"), "shares add up to 0.9"),
        (("=0", "=1"), "=0' is not CHECKPOINT=SHARE"),
        (("=5.5", "=-4.5"), "=5.5' is not CHECKPOINT=SHARE"),
        (("=nan", "=1"), "is not CHECKPOINT=SHARE"),
        (("", "=1"), "is not CHECKPOINT=SHARE"),
        (("=half", "=0.5"), "half"),
    ],
)
def test_shares_that_are_no_shares_are_refused(shares, needle, tmp_path, monkeypatch, capsys):
    parts = [f"{path}{share}" for path, share in zip((COTAP, BASE), shares, strict=True)]
    assert run(monkeypatch, *parts, "--output", tmp_path / "mean.pt") == 2
    assert needle in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def other_robot(content):
    content["layout"]["robot"] = "g2"


def other_parts(content):
    content["model"]["actors.upper.more"] = content["model"].pop("actors.upper.output_bias")


def other_shape(content):
    content["model"]["log_std.upper"] = torch.zeros(3)


def no_model(content):
    del content["model"]


@pytest.mark.parametrize(
    ("spoil", "needle"),
    [
        (other_robot, "another robot: 'g2'"),
        (other_parts, "not the same parts: actors.upper.more, actors.upper.output_bias"),
        (other_shape, "log_std.upper has not one shape in all checkpoints: [(8,), (3,)]"),
        (no_model, "lacks its part 'model'"),
    ],
)
def test_policies_that_do_not_fit_are_refused_and_nothing_is_written(spoil, needle, tmp_path, monkeypatch, capsys):
    content, other, out = load_checkpoint(BASE), tmp_path / "other.pt", tmp_path / "mean.pt"
    spoil(content)
    save_checkpoint(other, content)
    assert run(monkeypatch, f"{BASE}=0.5", f"{other}=0.5", "--output", out) == 2
    assert needle in capsys.readouterr().err
    assert not out.exists()
    assert not out.with_suffix(".json").exists()


def test_a_file_that_is_no_checkpoint_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "rubbish.pt").write_bytes(b"not a checkpoint")
    assert run(monkeypatch, f"{tmp_path / 'rubbish.pt'}=1", "--output", tmp_path / "mean.pt") == 2
    assert "rubbish.pt" in capsys.readouterr().err
