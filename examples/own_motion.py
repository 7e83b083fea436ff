"""A motion of your own: joint angles at any frame rate become a library, which an evaluation plays."""

import math
import sys
from pathlib import Path

import numpy as np

from cotap.evaluate import main
from cotap.motions import MotionLibrary
from cotap.motions.processing import JointMotion, make_clip
from cotap.robots import h1

FRAME_RATE = 30.0  # of the recording [Hz]


def waving(seconds: float = 4.0) -> JointMotion:
    """The left arm is raised and its elbow swings once a second; the right arm hangs; the robot stays where it is."""
    robot, times = h1(), np.arange(0.0, seconds, 1.0 / FRAME_RATE)
    arms = np.tile([robot.joint(name).default_rad for name in robot.upper_joints], (len(times), 1))  # (T, U) [rad]
    arms[:, robot.upper_joints.index("left_shoulder_roll")] = 1.0
    arms[:, robot.upper_joints.index("left_elbow")] = 0.8 + 0.4 * np.sin(2.0 * math.pi * times)
    root = np.zeros((len(times), 3))  # x, y [m] and heading [rad]
    return JointMotion("waving", times, arms, root)


def write_library(path: str) -> None:
    """Resample to 50 Hz, keep within the joints' limits, say by how much the motion had to change, and save."""
    clip, report = make_clip(h1(), waving(), source="made up", licence="yours")
    print(f"clipped {report.clipped_fraction:.0%} of frames, slowed {report.slowed_fraction:.0%}")
    MotionLibrary([clip], h1()).save(path)


if __name__ == "__main__":
    Path("runs").mkdir(exist_ok=True)
    write_library("runs/own_motion.npz")
    own = ["--library", "runs/own_motion.npz", "--motion", "waving"]
    sys.exit(main(["velocity-tracking", *own, *sys.argv[1:]]))
