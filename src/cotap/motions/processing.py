"""From joint angles at any frame rate to a clip at 50 Hz that the robot can follow."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from cotap.checks import quoted
from cotap.motions.library import FPS, MotionClip, MotionError, check_clip, check_root
from cotap.motions.refine import slow_down
from cotap.motions.retarget import HumanMotion
from cotap.robots import RobotSpec

LONGEST_S = 3600.0
"""How long a clip may last [s]."""
_LARGEST_ANGLE = 1e3
"""How far a joint may be turned in a source [rad]; limits come later."""


@dataclass(frozen=True)
class JointMotion:
    """Arm joints and root over time, as they come from a source."""

    name: str
    times_s: np.ndarray
    """(T,) [s]."""
    arms: np.ndarray
    """(T, U) [rad]."""
    root: np.ndarray
    """(T, 3) x, y [m] and heading [rad]."""
    human: HumanMotion | None = None
    """What it was retargeted from, if it was."""
    clip: MotionClip | None = None
    """The clip of a motion library that it is, if it is one; source, licence and mirroring stay that clip's."""
    has_image: bool = False
    """Whether its mirror image is there already."""


@dataclass(frozen=True)
class ClipReport:
    """How much a clip had to be changed."""

    clipped_fraction: float
    """Share of frames in which a joint was beyond its limits."""
    slowed_fraction: float
    """Share of steps in which a joint was faster than its limit."""


def make_clip(spec: RobotSpec, motion: JointMotion, source: str, licence: str) -> tuple[MotionClip, ClipReport]:
    """Resample, keep within position and velocity limits.

    Raises:
        MotionError: too few frames, times that do not grow or go on for more than `LONGEST_S`, values that are not
            finite or beyond all that a robot does, or a clip that `check_clip` refuses.
    """
    _check(spec, motion)
    upper = spec.upper_joint_specs
    low, high = np.array([j.range_rad for j in upper]).T
    speed = np.array([j.velocity_limit_rad_s for j in upper])
    arms = resample(motion.times_s, motion.arms)
    inside = np.clip(arms, low, high)
    too_fast = (np.abs(np.diff(inside, axis=0)) > speed / FPS).any(1)
    slow = limit_speed(slow_down(spec, inside) if too_fast.any() else inside, speed / FPS)
    root = motion.root.copy()
    root[:, 2] = np.unwrap(root[:, 2])
    report = ClipReport(float((np.abs(inside - arms) > 1e-6).any(1).mean()), float(too_fast.mean()))
    clip = MotionClip(
        motion.name, slow.astype(np.float32), resample(motion.times_s, root).astype(np.float32), source, licence
    )
    clip = replace(clip, arms=np.clip(clip.arms, low.astype(np.float32), high.astype(np.float32)))
    check_clip(clip, spec)
    return clip, report


def check_times(name: str, times_s: np.ndarray) -> None:
    """Raise MotionError unless the times (T,) of a clip's frames [s] grow, and last neither too short nor too long."""
    if len(times_s) < 2:
        raise MotionError(f"clip {quoted(name)} has {len(times_s)} frames; at least 2 are needed")
    if not np.isfinite(times_s).all():
        raise MotionError(f"clip {quoted(name)}: times are not finite at frame {int((~np.isfinite(times_s)).argmax())}")
    if not (np.diff(times_s) > 0.0).all():
        raise MotionError(f"clip {quoted(name)}: times do not grow")
    seconds = times_s[-1] - times_s[0]
    if not 1.0 / FPS <= seconds <= LONGEST_S:
        raise MotionError(f"clip {quoted(name)} lasts {seconds:g} s; it must last {1.0 / FPS:g} to {LONGEST_S:g} s")


def _check(spec: RobotSpec, motion: JointMotion) -> None:
    check_times(motion.name, motion.times_s)
    frames = len(motion.times_s)
    if motion.arms.shape != (frames, len(spec.upper_joints)) or motion.root.shape != (frames, 3):
        raise MotionError(
            f"clip {quoted(motion.name)}: arms {motion.arms.shape} and root {motion.root.shape} do not fit"
        )
    for what, values in (("arm joints", motion.arms), ("root", motion.root)):
        if not np.isfinite(values).all():
            first = np.argwhere(~np.isfinite(values))[0][0]
            raise MotionError(f"clip {quoted(motion.name)}: {what} are not finite at frame {first}")
    if (largest := np.abs(motion.arms).max()) > _LARGEST_ANGLE:
        raise MotionError(
            f"clip {quoted(motion.name)}: an arm joint is turned by {largest:g} rad; "
            f"at most {_LARGEST_ANGLE:g} rad are read"
        )
    check_root(motion.name, motion.root)


def resample(times_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """`values` (T, C) at 50 Hz from the first time on, by a cubic spline through all frames."""
    count = int(np.floor((times_s[-1] - times_s[0]) * FPS + 1e-6)) + 1
    at = times_s[0] + np.arange(count) / FPS
    return CubicSpline(times_s, values, axis=0)(np.minimum(at, times_s[-1]))


def limit_speed(values: np.ndarray, largest_step: np.ndarray) -> np.ndarray:
    """`values` (T, C) with no step beyond `largest_step` (C,): the mean of a pass forwards and a pass backwards.

    Either pass lags behind what is too fast; their mean does not, and obeys the same bound.
    """
    if (np.abs(np.diff(values, axis=0)) <= largest_step).all():
        return values

    def follow(x: np.ndarray) -> np.ndarray:
        out = x.copy()
        for t in range(1, len(x)):
            out[t] = out[t - 1] + np.clip(x[t] - out[t - 1], -largest_step, largest_step)
        return out

    return 0.5 * (follow(values) + follow(values[::-1])[::-1])


def mirror_clip(spec: RobotSpec, clip: MotionClip) -> MotionClip:
    """The left-right mirror image of a clip."""
    joints = spec.upper_joint_specs
    index = [spec.upper_joints.index(j.mirror_name) for j in joints]
    arms = clip.arms[:, index] * np.array([j.mirror_sign for j in joints], dtype=np.float32)
    root = clip.root * np.array([1.0, -1.0, -1.0], dtype=np.float32)
    return MotionClip(f"{clip.name}_mirrored", arms, root, clip.source, clip.licence, not clip.mirrored)
