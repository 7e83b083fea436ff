"""Slowing clips down: against closed forms of motions whose speed and acceleration are known."""

from __future__ import annotations

import numpy as np
import pytest

from cotap.motions.library import FPS, MotionClip, shipped_library
from cotap.motions.pace import pace
from cotap.motions.reference import ClipConfig, load_clips
from cotap.robots import ROBOTS

SPEED = np.full(2, 100.0)


def clip(arms: np.ndarray) -> MotionClip:
    steps = np.arange(len(arms))
    root = np.stack((0.02 * steps, 0.01 * steps, 0.0 * steps), 1)
    return MotionClip("a", arms.astype(np.float32), root.astype(np.float32), "", "")


def rates(arms: np.ndarray) -> tuple[float, float]:
    return float(np.abs(np.diff(arms, axis=0)).max() * FPS), float(np.abs(np.diff(arms, 2, axis=0)).max() * FPS**2)


def sine(amplitude: float, hertz: float, seconds: float = 4.0) -> np.ndarray:
    t = np.arange(round(seconds * FPS) + 1) / FPS
    return np.stack((amplitude * np.sin(2 * np.pi * hertz * t), 0.0 * t), 1)


def test_a_slow_clip_keeps_its_pace():
    slow = clip(sine(0.3, 0.5))
    paced = pace(slow, SPEED, 50.0)
    np.testing.assert_allclose(paced.arms, slow.arms, atol=1e-6)
    np.testing.assert_allclose(paced.root, slow.root, atol=1e-5)


def test_constant_speed_above_the_limit_is_played_at_the_limit():
    """4 rad/s, limited to 1: four times as long, and the whole way is gone."""
    t = np.arange(101) / FPS
    fast = clip(np.stack((4.0 * t, -2.0 * t), 1))
    paced = pace(fast, np.array([1.0, 100.0]), 1e6)
    assert paced.seconds == pytest.approx(4 * fast.seconds, rel=0.03)
    assert rates(paced.arms)[0] <= 1.03
    np.testing.assert_allclose(paced.arms[[0, -1]], fast.arms[[0, -1]], atol=1e-5)
    np.testing.assert_allclose(paced.root[[0, -1]], fast.root[[0, -1]], atol=1e-5)


@pytest.mark.parametrize("largest", [20.0, 60.0])
def test_acceleration_is_limited_and_the_path_is_kept(largest: float):
    """A sine of 0.5 rad at 3 Hz peaks at 178 rad/s^2. The second joint tells how far along the path a frame is."""
    arms = sine(0.5, 3.0)
    arms[:, 1] = np.linspace(0.0, 1.0, len(arms))
    paced = pace(clip(arms), SPEED, largest)
    assert rates(arms)[1] > 150.0
    assert rates(paced.arms)[1] <= 1.15 * largest
    assert paced.seconds < 1.5 * 4.0 * np.sqrt(178.0 / largest)
    np.testing.assert_allclose(paced.arms[:, 0], 0.5 * np.sin(2 * np.pi * 12.0 * paced.arms[:, 1]), atol=0.01)
    np.testing.assert_allclose(paced.root[:, 0], 0.02 * (len(arms) - 1) * paced.arms[:, 1], atol=0.01)


def test_clips_of_a_few_frames_stay_as_they_are():
    short = clip(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]))
    assert pace(short, np.ones(2), 1.0) is short


@pytest.mark.parametrize("largest", [40.0, 80.0])
@pytest.mark.parametrize("robot", sorted(ROBOTS))
def test_shipped_clips_are_played_within_the_limits_asked_for(robot, largest):
    spec = ROBOTS[robot]()
    cfg = ClipConfig(velocity_share=0.4, acceleration=largest, held_out=())
    played = load_clips(cfg, spec, margin_rad=0.1)
    original = shipped_library(spec)
    assert played.names() == original.names()
    limit = np.array([spec.joints[i].velocity_limit_rad_s for i in spec.indices(spec.upper_joints)])
    for before, after in zip(original.clips, played.clips, strict=True):
        assert after.seconds >= before.seconds - 0.5 / FPS
        assert (np.abs(np.diff(after.arms, axis=0)) * FPS <= 1.1 * 0.4 * limit).all(), after.name
        assert (np.abs(np.diff(after.arms, 2, axis=0)) * FPS**2 <= 1.1 * largest).all(), after.name


@pytest.mark.parametrize(("field", "value"), [("velocity_share", 0.0), ("velocity_share", 1.1), ("acceleration", 0.0)])
def test_bad_limits_are_named(field: str, value: float):
    with pytest.raises(ValueError, match=rf"clips\.{field} must .*{value:g}"):
        ClipConfig(**{field: value}).check()
