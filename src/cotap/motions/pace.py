"""Playing a clip only as fast as a robot can follow: the same path, slowed down where it is too fast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cotap.motions.library import FPS, MotionClip

_PASSES = 20
_SMOOTH_FRAMES = 3


def pace(clip: MotionClip, max_speed: np.ndarray, max_acceleration: float) -> MotionClip:
    """The clip at a pace at which no arm joint exceeds its largest speed or acceleration, but for a tenth.

    Arms and root go where they went; passages that are slow enough keep their pace.

    Args:
        clip: At 50 Hz.
        max_speed: (U,) [rad/s].
        max_acceleration: Of every joint [rad/s^2].
    """
    frames = np.arange(len(clip.arms), dtype=np.float64)
    if len(frames) < 4:  # nothing to differentiate twice
        return clip
    from scipy.interpolate import CubicSpline  # half a second, which no other reader of configs needs
    from scipy.ndimage import gaussian_filter1d, minimum_filter1d

    path = CubicSpline(frames, np.concatenate((clip.arms, clip.root), 1))
    width, low, high = clip.arms.shape[1], clip.arms.min(0), clip.arms.max(0)
    at = frames
    for _ in range(_PASSES):
        arms = path(at)[:, :width].clip(low, high)  # a spline overshoots
        speed = np.abs(np.diff(arms, axis=0)) * FPS / max_speed
        acceleration = np.abs(np.diff(arms, 2, axis=0)) * FPS**2 / max_acceleration
        excess = np.maximum(1.0, speed.max(1))
        # Half as fast is a quarter of the acceleration. A second difference spans the steps on both of its sides.
        root = np.sqrt(np.maximum(1.0, acceleration.max(1)))
        excess[:-1] = np.maximum(excess[:-1], root)
        excess[1:] = np.maximum(excess[1:], root)
        if excess.max() < 1.02:
            break
        rate = minimum_filter1d(1.0 / excess, 2 * _SMOOTH_FRAMES + 1, mode="nearest")
        rate = gaussian_filter1d(rate, _SMOOTH_FRAMES / 2.0, mode="nearest")
        time = np.concatenate(([0.0], np.cumsum(1.0 / rate)))
        at = np.interp(np.linspace(0.0, time[-1], round(time[-1]) + 1), time, at)
    sampled = path(at).astype(np.float32)
    return replace(clip, arms=sampled[:, :width].clip(low, high), root=sampled[:, width:])
