"""Every example runs, does what its page says of it, is short, and is shown."""

from __future__ import annotations

import math
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

from cotap import evaluate
from cotap.agents.checkpoint import load_checkpoint
from cotap.compliance.laws import LAWS
from cotap.envs.config import RewardConfig
from cotap.envs.rewards import RewardGroup
from cotap.evaluation.policy import load_policy
from cotap.motions import MotionLibrary
from cotap.robots import h1
from cotap.train import _base_config
from examples import own_arm, own_motion, own_reward

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
LONG = ("demo.py", "run_policy.py")
"""A tour of the commands, and a file that is taken away whole."""


@pytest.mark.parametrize("file", [f for f in sorted(EXAMPLES.glob("*.py")) if f.name not in LONG], ids=lambda f: f.stem)
def test_it_is_short_and_on_a_page(file):
    assert file.read_text().count("\n") < 60
    pages = "".join(page.read_text() for page in (ROOT / "docs").rglob("*.md"))
    assert f'```{{.python}}\n--8<-- "examples/{file.name}"\n```' in pages
    assert f"examples/{file.name})" in pages  # a link, for who reads the page where snippets are not filled in


def test_stiffness_of_the_hands_becomes_torque(capsys):
    result = runpy.run_path(str(EXAMPLES / "compliance.py"))
    assert result["torque"].shape == (1, 2, 4)
    assert torch.isfinite(result["torque"]).all()
    assert "tensor" in capsys.readouterr().out


def test_a_law_of_ones_own_is_as_soft_as_it_says(monkeypatch):
    monkeypatch.setitem(LAWS, "floating-pd", None)  # so that what the example adds is taken out again
    soft, stiff = runpy.run_path(str(EXAMPLES / "own_law.py"))["sag"].tolist()
    # Joints 0.4 times as stiff: the hand gives 2.5 times as far.
    assert 0.005 < stiff < 0.015
    assert soft / stiff == pytest.approx(2.5, rel=0.1)


def test_the_passive_arm_gives_away_no_more_than_its_store_had():
    example = EXAMPLES / "passive_arm.py"
    assert set(re.findall(r"^(?:import|from) (\S+)", example.read_text(), re.M)) == {
        "torch",
        "cotap.compliance.passivity",
    }
    run = runpy.run_path(str(example))["run"]
    assert run(filtered=False, steps=600) > 3.0
    assert 0.5 < run(filtered=True, steps=600) < 1.01  # its first filling is 1 J; the rest is integration


@pytest.mark.parametrize("asked", [(500.0, 500.0, 100.0), (150.0, 900.0, 400.0)])
def test_an_arm_elsewhere_feels_as_was_asked(monkeypatch, asked):
    monkeypatch.setattr(own_arm, "ASKED", np.array(asked))
    for axis, force in enumerate(np.eye(3)):
        closed_form = force / asked
        np.testing.assert_allclose(own_arm.displacement(force), closed_form, atol=0.02 * closed_form[axis])


@pytest.mark.slow
@pytest.mark.usefixtures("in_tmp_path")
def test_a_motion_of_ones_own_is_played():
    own_motion.write_library("own.npz")
    (clip,) = MotionLibrary.load("own.npz", h1()).clips
    times = np.arange(len(clip.arms)) / 50.0
    elbow = clip.arms[:, h1().upper_joints.index("left_elbow")]
    np.testing.assert_allclose(elbow, 0.8 + 0.4 * np.sin(2.0 * math.pi * times), atol=2e-3)
    options = ["--library", "own.npz", "--motion", "waving", "--num-envs", "2", "--episode-seconds", "5"]
    result = evaluate.evaluate(["velocity-tracking", *options, "--threads", "1"])
    assert (result["arms"], result["settings"]["env"]["motions"]["clips"]["only"]) == ("moving", ["waving"])


def test_a_reward_of_ones_own_is_paid(make_env):
    env = make_env(2, rewards=RewardConfig(lower=own_reward.OwnRewards()))
    for _ in range(20):
        env.step(0.5 * torch.ones(2, env.num_actions))
    group = RewardGroup("lower", own_reward.OwnRewards(), env.dt)
    paid = dict(zip(group.terms, group(env.record)[1], strict=True))
    speed = env.state.foot_velocity_w[..., :2].square().sum(-1).sqrt().sum(1)
    assert (speed > 0.01).all()
    torch.testing.assert_close(paid["foot_speed"], -0.05 * 0.02 * speed)
    assert "track_velocity" in paid


@pytest.mark.usefixtures("in_tmp_path")
def test_a_training_with_it_makes_a_policy_like_any_other(capsys):
    folder = own_reward.train("run", num_envs=8)
    (checkpoint,) = folder.glob("checkpoint_*.pt")
    weights = load_checkpoint(checkpoint)["config"]["training"]["env"]["rewards"]["lower"]
    assert (weights["foot_speed"], weights["track_height"]) == (-0.05, 1.5)
    assert load_policy(checkpoint).env_config.rewards.lower.track_height == 1.5
    assert _base_config(str(checkpoint)).env.rewards.lower.track_height == 1.5
    assert "left out: foot_speed" in "".join(capsys.readouterr())


@pytest.mark.slow
def test_a_protocol_of_ones_own_runs(monkeypatch, tmp_path):
    monkeypatch.setitem(evaluate.PROTOCOLS, "turning", None)  # so that it is taken out again
    runpy.run_path(str(EXAMPLES / "own_protocol.py"))
    plot = tmp_path / "turning.png"
    options = ["--num-envs", "4", "--turning-rate", "-0.5", "--threads", "1", "--plot", str(plot)]
    result = evaluate.evaluate(["turning", *options])
    assert -0.6 < result["metrics"]["turned"]["mean"] < -0.1  # as far as the policy obeys
    assert 0.0 < result["metrics"]["strayed"]["mean"] < 1.0
    assert plot.stat().st_size > 5000
