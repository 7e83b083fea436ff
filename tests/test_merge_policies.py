"""What scripts/merge_policies.py makes of two policies, and what it refuses."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import merge_policies as mp

from cotap.agents.actors import as_dict
from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256
from cotap.envs import H1Env
from cotap.evaluation.policy import load_policy, shipped_checkpoint

BASE, COTAP = shipped_checkpoint("base"), shipped_checkpoint("cotap")
SMALL = mp.Merging(num_envs=16, iterations=1, steps=5, epochs=1, mini_batches=2, noise=0.0, threads=1)
TINY = ("--num-envs", "16", "--iterations", "2", "--steps", "4", "--mini-batches", "2", "--threads", "1")


def run(monkeypatch: pytest.MonkeyPatch, *args: object) -> int:
    monkeypatch.setattr(sys, "argv", ["merge_policies.py", *map(str, args)])
    return mp.main()


def world(loaded_share: float, num_envs: int = 16) -> H1Env:
    cfg = load_policy(BASE).env_config
    cfg.num_envs, cfg.num_threads, cfg.hand_forces.enabled = num_envs, 1, True
    cfg.hand_forces.episode_share, cfg.hand_forces.curriculum_start = loaded_share, 1.0
    return H1Env(cfg)


def test_the_teacher_that_knows_best_answers_world_by_world():
    calm, loaded = load_policy(COTAP).model, load_policy(BASE).model
    observations = as_dict(world(0.0, 4).reset())
    pulled = torch.tensor([True, False, False, True])
    answers = mp.Lesson(calm, loaded).answers(observations, pulled)
    torch.testing.assert_close(answers[:, :19], torch.where(pulled[:, None], loaded(observations), calm(observations)))
    critic_in = loaded.read("critic", loaded.normalize(observations))
    values = torch.cat([loaded.critics[name](critic_in) for name in ("lower", "upper")], -1)
    torch.testing.assert_close(answers[pulled, 19:], values[pulled])


def test_loss_by_hand():
    lesson = mp.Lesson(load_policy(COTAP).model, load_policy(BASE).model)
    answers = torch.zeros(2, 21)
    answers[:, 19] = torch.tensor([1.0, 3.0])  # a spread of sqrt(2)
    answers[:, 20] = torch.tensor([0.0, 4.0])  # of sqrt(8)
    told = answers.clone()
    told[0, 0] += 2.0 * lesson.std[0]
    told[1, 18] -= lesson.std[18]
    told[0, 20] += 2.0
    # Of 38 actions one is off by two deviations, one by one; of four values one by half a variance.
    assert float(lesson.loss(told, answers)) == pytest.approx((4.0 + 1.0) / 38.0 + 4.0 / 8.0 / 4.0)


@pytest.mark.parametrize(("loaded_share", "off"), [(0.0, 1.0), (1.0, 0.2)])
def test_whether_hands_are_loaded_says_who_teaches(loaded_share, off):
    # The calm teacher sends every leg joint one deviation further; nobody is loaded in the first of five steps.
    calm, loaded, student = (load_policy(BASE).model for _ in range(3))
    with torch.no_grad():
        calm.actors["lower"].output_bias += loaded.log_std["lower"].exp()
    bias = calm.actors["lower"].output_bias
    moved = (0.5 * (bias + calm.actors["lower"]._mirror_output(bias)) - loaded.actors["lower"].output_bias).detach()
    lesson = mp.Lesson(calm, loaded)
    expected = float((moved / lesson.std[:11]).square().sum()) / 19.0
    cfg = mp.Merging(**(mp.asdict(SMALL) | {"learning_rate": 1e-8}))
    (loss,) = mp.teach(student, lesson, world(loaded_share), cfg)
    # bfloat16 alone is off by some hundredths.
    assert loss == pytest.approx(off * expected, abs=0.06)


def test_a_student_learns_and_its_normalisers_stay():
    policy, student = load_policy(BASE), load_policy(BASE).model
    with torch.no_grad():
        for weight in student.actors.parameters():
            weight += 0.03 * weight.std() * torch.randn(weight.shape, generator=torch.Generator().manual_seed(1))
    before = {name: value.clone() for name, value in student.normalizers.state_dict().items()}
    cfg = mp.Merging(num_envs=64, iterations=6, steps=8, mini_batches=4, threads=1)
    losses = mp.teach(student, mp.Lesson(policy.model, policy.model), world(0.5, 64), cfg)
    assert losses[-1] < 0.5 * losses[0]
    assert all(torch.equal(value, before[name]) for name, value in student.normalizers.state_dict().items())


def test_what_is_written_can_be_used_and_says_what_it_is_made_of(tmp_path, monkeypatch):
    out = tmp_path / "merged.pt"
    assert run(monkeypatch, "--calm", "base", "--loaded", BASE, "--start", COTAP, "--output", out, *TINY) == 0
    merged, base = load_checkpoint(out), load_checkpoint(BASE)
    assert merged["kind"] == "base"
    assert merged["samples"] == base["samples"] + 16 * 2 * 4
    assert torch.equal(merged["model"]["log_std.lower"], base["model"]["log_std.lower"])
    load_policy(out)
    described = json.loads(out.with_suffix(".json").read_text())["merged"]
    assert [(p["role"], p["sha256"], p["share"]) for p in described["policies"]] == [
        ("calm", sha256(BASE), 0.5),
        ("loaded", sha256(BASE), 0.5),
        ("start", sha256(COTAP), 0.0),
    ]
    assert described["options"]["iterations"] == 2
    assert merged["config"]["merged"] == described


@pytest.mark.parametrize(
    ("options", "needle"),
    [
        (("--num-envs", "0"), "num_envs must be"),
        (("--iterations", "-1"), "iterations must be"),
        (("--loaded-share", "1.5"), "loaded_share must lie in"),
        (("--learning-rate", "nan"), "learning_rate must"),
        (("--noise", "-0.1"), "noise must lie in"),
    ],
)
def test_options_out_of_range_are_refused(options, needle, tmp_path, monkeypatch, capsys):
    out = tmp_path / "merged.pt"
    assert run(monkeypatch, "--calm", "base", "--loaded", "base", "--output", out, *TINY, *options) == 2
    assert needle in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_policies_that_do_not_fit_are_refused_and_nothing_is_written(tmp_path, monkeypatch, capsys):
    content, other, out = load_checkpoint(BASE), tmp_path / "other.pt", tmp_path / "merged.pt"
    content["layout"]["robot"] = "g2"
    save_checkpoint(other, content)
    assert run(monkeypatch, "--calm", other, "--loaded", "base", "--output", out, *TINY) == 2
    assert "another robot: 'g2'" in capsys.readouterr().err
    assert not out.exists()


def test_an_output_that_cannot_be_is_refused_before_the_work(tmp_path, monkeypatch, capsys):
    out = tmp_path / "nowhere" / "merged.pt"
    assert run(monkeypatch, "--calm", "base", "--loaded", "base", "--output", out, *TINY) == 2
    assert "its folder does not exist" in capsys.readouterr().err
