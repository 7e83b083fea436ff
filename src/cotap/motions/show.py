"""Pictures of a motion library: joints and hand paths of every clip, and the robot in a contact sheet."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from cotap.evaluation.render import contact_sheet, render_frames
from cotap.evaluation.report import pyplot
from cotap.files import write_atomically
from cotap.motions.library import FPS, MotionClip, MotionLibrary
from cotap.motions.quality import forward_kinematics
from cotap.robots import RobotSpec

_FRAMES_PER_CLIP = 8
_LARGEST_SHEET = 24
"""Clips in a contact sheet; more are unreadable."""
_LONGEST_NAME = 200
"""Bytes of a picture's name, which file systems bound."""


def draw(library: MotionLibrary, spec: RobotSpec, folder: Path) -> Iterator[Path]:
    """Write a plot of each clip and a contact sheet of the first 24; yields what was written."""
    folder.mkdir(parents=True, exist_ok=True)
    sheet = folder / "contact_sheet.png"
    taken = {sheet}
    for clip in library.clips:
        path = _free_path(folder, clip.name, taken)
        taken.add(path)
        plot_clip(path, clip, spec)
        yield path
    _sheet(sheet, library.clips[:_LARGEST_SHEET], spec)
    yield sheet


def _free_path(folder: Path, name: str, taken: set[Path]) -> Path:
    """Of a picture, after the clip's name, and numbered if another has that."""
    stem = name.replace("/", "_").encode()[:_LONGEST_NAME].decode(errors="ignore")
    path, number = folder / f"{stem}.png", 2
    while path in taken:
        path, number = folder / f"{stem}_{number}.png", number + 1
    return path


def plot_clip(path: Path, clip: MotionClip, spec: RobotSpec) -> None:
    """Joint angles over time, arm by arm, and the hands' paths seen from the side and from the front."""
    plt = pyplot()

    hands = forward_kinematics(spec, clip.arms)[2]
    times = np.arange(len(clip.arms)) / FPS
    arms = len(spec.arms)
    figure, axes = plt.subplots(1, arms + 2, figsize=(4.0 * (arms + 2), 3.4), constrained_layout=True)
    per_arm = len(spec.arms[0].joints)
    for i, arm in enumerate(spec.arms):
        for j, joint in enumerate(arm.joints):
            axes[i].plot(times, clip.arms[:, i * per_arm + j], label=joint.removeprefix(f"{arm.side}_"))
        axes[i].set(title=f"{arm.side} arm", xlabel="time [s]", ylabel="angle [rad]")
        axes[i].legend(fontsize=7, frameon=False)
    for axis, (column, label) in zip(axes[arms:], ((0, "forward"), (1, "leftward")), strict=True):
        for i, arm in enumerate(spec.arms):
            axis.plot(hands[:, i, column], hands[:, i, 2], label=arm.side)
            axis.plot(hands[0, i, column], hands[0, i, 2], "k.", ms=5)
        axis.set(title="hand paths in the torso frame", xlabel=f"{label} [m]", ylabel="up [m]", aspect="equal")
        axis.legend(fontsize=7, frameon=False)
    for axis in axes:
        axis.grid(alpha=0.2)
    figure.suptitle(f"{clip.name}, {clip.seconds:.2f} s")
    write_atomically(path, lambda p: figure.savefig(p, dpi=110, format="png"))
    plt.close(figure)


def _sheet(path: Path, clips: list[MotionClip], spec: RobotSpec) -> None:
    """One row per clip: the robot standing, its arms at evenly spaced moments."""
    legs = torch.tensor([j.default_rad for j in spec.joints[: len(spec.lower_joints)]], dtype=torch.float64)
    base = torch.tensor([0.0, 0.0, spec.base_height_m, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    poses = [
        torch.cat((base, legs, torch.as_tensor(clip.arms[i], dtype=torch.float64)))
        for clip in clips
        for i in np.linspace(0, len(clip.arms) - 1, _FRAMES_PER_CLIP).astype(int)
    ]
    contact_sheet(path, [f[::2, ::2] for f in render_frames(spec, torch.stack(poses))], _FRAMES_PER_CLIP)
