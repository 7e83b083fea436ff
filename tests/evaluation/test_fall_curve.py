"""Fall rate against impulse: known curves, and the blows that worlds are given."""

from __future__ import annotations

import pytest
import torch

from cotap.envs import H1Env, H1EnvConfig
from cotap.evaluate import main
from cotap.evaluation.fall_curve import FallCurve, half_point

IMPULSES = torch.linspace(0.0, 60.0, 13)


def worlds(rate: torch.Tensor, each: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    level = torch.arange(13).repeat(each)
    fell = torch.rand(13 * each, generator=torch.Generator().manual_seed(seed)) < rate[level]
    return level, fell


def test_half_point_by_hand():
    """None of four fall up to 20 N s, one at 25, three at 30, all beyond: half way between 25 and 30."""
    level = torch.arange(13).repeat_interleave(4)
    fell = level > 6
    fell[20], fell[24:27] = True, True
    assert half_point(IMPULSES, level, fell)["mean"] == pytest.approx(27.5)


def test_the_interval_covers_the_true_half_point():
    rate = torch.sigmoid((IMPULSES - 33.0) / 4.0)
    found = half_point(IMPULSES, *worlds(rate, 100))
    low, high = found["ci95"]
    assert low < 33.0 < high
    assert high - low < 4.0
    noisy = [half_point(IMPULSES, *worlds(rate, 30, seed), resamples=200)["ci95"] for seed in range(40)]
    assert sum(low <= 33.0 <= high for low, high in noisy) >= 34


def test_what_is_not_reached_is_null_with_a_reason():
    none = half_point(IMPULSES, *worlds(torch.full((13,), 0.1), 50))
    assert none["mean"] is None
    assert "fewer than half" in none["reason"]
    always = half_point(IMPULSES, *worlds(torch.ones(13), 5))
    assert always["mean"] is None
    assert "without a blow" in always["reason"]


def test_every_world_takes_the_impulse_it_is_counted_under():
    protocol = FallCurve(num_envs=13, force=(0.0, 3.0, 4.0), randomize=False)
    env = H1Env(protocol.configure(H1EnvConfig(num_threads=1)))
    protocol.prepare(env)
    env.reset()
    times = 0.02 * torch.arange(200)
    impulse = torch.stack([env.scripted.at(torch.full((13,), float(s)))[:, 0] for s in times]).sum(0) * 0.02
    torch.testing.assert_close(impulse.norm(dim=1), IMPULSES, atol=0.01, rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--levels", "1"], "levels"), (["--num-envs", "5"], "num_envs must be at least levels"),
     (["--impulse", "0"], "impulse"), (["--force", "0", "0", "0"], "force must not be zero")],
)  # fmt: skip
def test_bad_options_are_named(options, message, capsys):
    assert main(["fall-curve", *options]) == 2
    assert message in capsys.readouterr().err
