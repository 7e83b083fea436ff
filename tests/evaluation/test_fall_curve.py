"""Fall rate against impulse: known curves, and the pushes that envs are given."""

from __future__ import annotations

import json
import math

import pytest
import torch

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import main
from cotap.evaluation.fall_curve import FallCurve, half_point

IMPULSES = torch.linspace(0.0, 60.0, 13)


def envs(rate: torch.Tensor, each: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    level = torch.arange(13).repeat(each)
    fell = torch.rand(13 * each, generator=torch.Generator().manual_seed(seed)) < rate[level]
    return level, fell


def test_half_point_by_hand():
    """None of four fall up to 20 N s, one at 25, three at 30, all beyond: half way between 25 and 30."""
    level = torch.arange(13).repeat_interleave(4)
    fell = level > 6
    fell[20], fell[24:27] = True, True
    assert half_point(IMPULSES, level, fell)["mean"] == pytest.approx(27.5)


def test_without_an_env_that_stood_until_the_push_there_is_no_half_point():
    nobody = torch.zeros(0, dtype=torch.long)
    assert half_point(IMPULSES, nobody, nobody.bool())["reason"] == "no env stood until the push"


def test_the_interval_covers_the_true_half_point():
    rate = torch.sigmoid((IMPULSES - 33.0) / 4.0)
    found = half_point(IMPULSES, *envs(rate, 100))
    low, high = found["ci95"]
    assert low < 33.0 < high
    assert high - low < 4.0
    noisy = [half_point(IMPULSES, *envs(rate, 30, seed), resamples=200)["ci95"] for seed in range(40)]
    assert sum(low <= 33.0 <= high for low, high in noisy) >= 34


def test_what_is_not_reached_is_null_with_a_reason():
    none = half_point(IMPULSES, *envs(torch.full((13,), 0.1), 50))
    assert none["mean"] is None
    assert "fewer than half" in none["reason"]
    always = half_point(IMPULSES, *envs(torch.ones(13), 5))
    assert always["mean"] is None
    assert "without a push" in always["reason"]


@pytest.mark.parametrize("place", ["hand", "base"])
def test_every_env_takes_the_impulse_it_is_counted_under(robot, place):
    protocol = FallCurve(num_envs=13, force=(0.0, 3.0, 4.0), place=place, impulse=60.0, levels=13, motion=("none",))
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig(robot, num_threads=1)))
    protocol.prepare(env)
    env.reset()
    times = 0.02 * torch.arange(200)
    where = 0 if place == "hand" else -1
    impulse = torch.stack([env.forces.scripted.at(torch.full((13,), float(s)))[:, where] for s in times]).sum(0) * 0.02
    torch.testing.assert_close(impulse.norm(dim=1), IMPULSES, atol=0.01, rtol=1e-3)


@pytest.mark.slow
def test_the_command_prints_the_curve(checkpoint, tmp_path, capsys):
    arguments = ["--num-envs", "6", "--levels", "3", "--mode", "walking", "--place", "base", "--threads", "1",
                 "--json", str(tmp_path / "out.json"), "--plot", str(tmp_path / "p.png")]  # fmt: skip
    assert main(["fall-curve", "--checkpoint", str(checkpoint), *arguments]) == 0
    result = json.loads((tmp_path / "out.json").read_text())
    assert result["fall_curve"]["impulse"] == [0.0, 37.5, 75.0]
    assert result["arms"] == "moving"
    assert "fall-curve, pd, arms moving: " in capsys.readouterr().out
    assert (tmp_path / "p.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--levels", "1"], "levels"), (["--num-envs", "5"], "num_envs must be at least levels"),
     (["--impulse", "0"], "impulse"), (["--force", "0", "0", "0"], "force must not be zero")],
)  # fmt: skip
def test_bad_options_are_named(options, message, capsys):
    assert main(["fall-curve", *options]) == 2
    assert message in capsys.readouterr().err


def test_the_interval_of_the_half_point_is_of_95_percent():
    """Nobody falls unpushed, a share p at 10 N s: half would at 5 / p, whose interval follows from p's normal one."""
    level = torch.tensor([0, 1]).repeat_interleave(torch.tensor([100, 400]))
    fell = torch.arange(500) >= 180  # 320 of the 400
    fell[:100] = False
    found = half_point(torch.tensor([0.0, 10.0]), level, fell, resamples=3000)
    error = math.sqrt(0.8 * 0.2 / 400)
    assert found["mean"] == pytest.approx(5.0 / 0.8)
    low, high = found["ci95"]
    assert (5.0 / low - 0.8) / error == pytest.approx(1.96, abs=0.13)
    assert (0.8 - 5.0 / high) / error == pytest.approx(1.96, abs=0.13)
