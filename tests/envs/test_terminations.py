"""When an episode ends."""

from __future__ import annotations

import math

import pytest
import torch

from cotap.envs.terminations import TerminationConfig, diverged, fallen


def gravity(tilt: float) -> torch.Tensor:
    """What a torso tilted forward by `tilt` [rad] feels."""
    return torch.tensor([[math.sin(tilt), 0.0, -math.cos(tilt)]])


@pytest.mark.parametrize(
    ("height", "tilt", "fell"),
    [
        (1.0, 0.0, False),
        (0.51, 0.99, False),
        (0.49, 0.0, True),
        (1.0, 1.01, True),
        (1.0, -1.01, True),
        (1.0, 3.1, True),
    ],
)
def test_fallen_is_too_low_or_too_tilted(height, tilt, fell):
    assert fallen(torch.tensor([height]), gravity(tilt), 0.5, 1.0).item() == fell


def test_the_least_height_is_a_share_of_the_robots(any_spec):
    cfg = TerminationConfig(min_height=0.6)
    assert cfg.min_height_m(any_spec) == pytest.approx(0.6 * any_spec.nominal_height_m)
    by_hand = {"h1": 0.6 * 1.0205, "g1": 0.6 * 0.828699, "made-up": 0.6 * 0.8028}
    assert cfg.min_height_m(any_spec) == pytest.approx(by_hand[any_spec.name])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_diverged_finds_what_is_not_finite(value):
    qpos, qvel = torch.zeros(3, 5), torch.zeros(3, 4)
    qpos[1, 2], qvel[2, 0] = value, value
    assert diverged(qpos, qvel).tolist() == [False, True, True]


def test_diverged_finds_what_is_too_fast():
    qvel = torch.tensor([[999.0], [-1001.0], [1001.0]])
    assert diverged(torch.zeros(3, 1), qvel).tolist() == [False, True, True]


@pytest.mark.parametrize(("field", "value"), [("episode_s", 0.0), ("min_height", 1.5), ("max_tilt_rad", -0.1)])
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=rf"terminations\.{field}"):
        TerminationConfig(**{field: value}).check()
