"""A library of motion clips: arm joints and root path at one frame rate, in one file that is validated on load."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Collection
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from cotap.checks import legible, quoted
from cotap.files import write_arrays
from cotap.inputs import InputError, read_arrays, read_bytes
from cotap.robots import RobotSpec

FPS = 50.0
"""Frame rate of all libraries [Hz]."""
_VERSION = 1
ENTRIES = {
    "version": ("iu", 0), "fps": ("fiu", 0), "robot": ("U", 0), "joints": ("U", 1), "names": ("U", 1),
    "lengths": ("iu", 1), "sources": ("U", 1), "licences": ("U", 1), "mirrored": ("b", 1), "arms": ("f", 2),
    "root": ("f", 2),
}  # fmt: skip
"""What is in a library's file: numpy's kinds of dtype, and the number of dimensions."""
LARGEST_ROOT = 1e4
"""How far a root may go [m], and how far it may turn [rad], either way."""
_LARGEST_FILE = 1 << 30
"""Bytes of arrays that are read: a hundred hours of motion."""
_LONGEST_NAME = 200


class MotionError(ValueError):
    """A motion file or clip that cannot be used; the message names it and says why."""


@dataclass(frozen=True)
class MotionClip:
    """One clip at 50 Hz."""

    name: str
    arms: np.ndarray
    """(T, U) arm joint angles in the order of the robot's upper joints [rad], float32."""
    root: np.ndarray
    """(T, 3) where the root is: x, y [m] and heading [rad], z up, float32."""
    source: str
    """Where it comes from."""
    licence: str
    """Under which terms."""
    mirrored: bool = False
    """Whether it is the left-right mirror image of what was recorded."""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return (len(self.arms) - 1) / FPS


def check_clip(clip: MotionClip, spec: RobotSpec) -> None:
    """Raise MotionError if `clip` has no usable name, wrong shapes or too few frames, or values beyond limits."""
    if len(clip.name) > _LONGEST_NAME or not clip.name.isprintable():
        raise MotionError(
            f"clip {quoted(clip.name)} must have a name of at most {_LONGEST_NAME} characters, all of them printable"
        )
    upper = spec.upper_joint_specs
    if clip.arms.ndim != 2 or clip.arms.shape[1] != len(upper):
        raise MotionError(f"clip {clip.name!r}: arms must have shape (T, {len(upper)}), got {clip.arms.shape}")
    if clip.root.shape != (len(clip.arms), 3):
        raise MotionError(f"clip {clip.name!r}: root must have shape ({len(clip.arms)}, 3), got {clip.root.shape}")
    if len(clip.arms) < 2:
        raise MotionError(f"clip {clip.name!r} has {len(clip.arms)} frames; at least 2 are needed")
    if not (np.isfinite(clip.arms).all() and np.isfinite(clip.root).all()):
        raise MotionError(f"clip {clip.name!r} has values that are not finite")
    check_root(clip.name, clip.root)
    low, high = np.array([j.range_rad for j in upper], dtype=np.float32).T
    excess = np.maximum(low - clip.arms, clip.arms - high)
    if excess.max() > 1e-5:
        frame, joint = np.unravel_index(excess.argmax(), excess.shape)
        raise MotionError(
            f"clip {clip.name!r}: {upper[joint].name} is {clip.arms[frame, joint]:.3f} rad at frame {frame}; "
            f"its limits are {upper[joint].range_rad}"
        )


def check_root(name: str, root: np.ndarray) -> None:
    """Raise MotionError if a root (T, 3) of x, y [m] and heading [rad] is farther than any clip leads."""
    beyond = np.abs(root) > LARGEST_ROOT
    if beyond.any():
        frame, column = np.argwhere(beyond)[0]
        raise MotionError(
            f"clip {quoted(name)}: the root's {('x', 'y', 'heading')[column]} is {root[frame, column]:g} "
            f"at frame {frame}; it must lie in [-{LARGEST_ROOT:g}, {LARGEST_ROOT:g}] {'rad' if column == 2 else 'm'}"
        )


class MotionLibrary:
    """Clips of one robot's arms.

    Raises:
        MotionError: no clips, two of one name, or a clip that `check_clip` refuses.
    """

    def __init__(self, clips: list[MotionClip], spec: RobotSpec) -> None:
        if not clips:
            raise MotionError("a motion library needs at least one clip, got none")
        for clip in clips:
            check_clip(clip, spec)
        names = [c.name for c in clips]
        seen: set[str] = set()
        for name in names:
            if name in seen:
                raise MotionError(f"two clips are called {quoted(name)}")
            seen.add(name)
        self.clips, self.robot, self.joints = clips, spec.name, spec.upper_joints

    def names(self) -> list[str]:
        """Names of all clips, in order."""
        return [c.name for c in self.clips]

    def select(self, names: list[str], spec: RobotSpec) -> MotionLibrary:
        """The clips of these names. Raises MotionError for an unknown one, listing those known."""
        known = {c.name: c for c in self.clips}
        for name in names:
            if name not in known:
                raise MotionError(f"no clip is called {quoted(name)}; clips: {legible(', '.join(sorted(known)), 2000)}")
        return MotionLibrary([known[n] for n in names], spec)

    def save(self, path: str | Path) -> None:
        """Write to `path` (.npz), whole or not at all."""
        arrays = {
            "version": np.array(_VERSION),
            "fps": np.array(FPS),
            "robot": np.array(self.robot),
            "joints": np.array(self.joints),
            "names": np.array(self.names()),
            "lengths": np.array([len(c.arms) for c in self.clips]),
            "sources": np.array([c.source for c in self.clips]),
            "licences": np.array([c.licence for c in self.clips]),
            "mirrored": np.array([c.mirrored for c in self.clips]),
            "arms": np.concatenate([c.arms for c in self.clips]).astype(np.float32),
            "root": np.concatenate([c.root for c in self.clips]).astype(np.float32),
        }
        write_arrays(Path(path), arrays)

    @classmethod
    def load(cls, path: str | Path, spec: RobotSpec) -> MotionLibrary:
        """Read a library; nothing in the file is run.

        Raises:
            MotionError: the file is missing, damaged, of another kind or for another robot.
        """
        content = read_npz(path, ENTRIES)
        missing = ENTRIES.keys() - content.keys()
        if missing:
            raise MotionError(f"{str(path)!r} is no motion library: it lacks {sorted(missing)[0]!r}")
        for key, (kinds, dimensions) in ENTRIES.items():
            if content[key].dtype.kind not in kinds or content[key].ndim != dimensions:
                raise MotionError(
                    f"{str(path)!r} is no motion library: {key} must have {dimensions} dimensions and dtype kind "
                    f"{' or '.join(kinds)}, got {content[key].dtype} of shape {content[key].shape}"
                )
        if tuple(content["joints"].tolist()) != spec.upper_joints or str(content["robot"]) != spec.name:
            raise MotionError(
                f"{str(path)!r} is for the arms of {quoted(str(content['robot']))} "
                f"({quoted(content['joints'].tolist())}), not of {spec.name!r} ({', '.join(spec.upper_joints)})"
            )
        if content["fps"] != FPS or content["version"] != _VERSION:
            raise MotionError(
                f"{str(path)!r} has version {content['version']} at {content['fps']} Hz; "
                f"this release reads version {_VERSION} at {FPS:g} Hz"
            )
        lengths = content["lengths"].tolist()
        count = len(content["names"])
        for key in ("lengths", "sources", "licences", "mirrored"):
            if content[key].shape != (count,):
                raise MotionError(f"{str(path)!r}: {key} has {content[key].shape} entries for {count} clips")
        if min(lengths, default=0) < 1 or sum(lengths) != len(content["arms"]):
            raise MotionError(f"{str(path)!r}: clip lengths do not add up to its {len(content['arms'])} frames")
        stops = itertools.accumulate(lengths)
        clips = [
            MotionClip(
                str(content["names"][i]), content["arms"][stop - n : stop], content["root"][stop - n : stop],
                str(content["sources"][i]), str(content["licences"][i]), bool(content["mirrored"][i]),
            )
            for i, (n, stop) in enumerate(zip(lengths, stops, strict=True))
        ]  # fmt: skip
        return cls(clips, spec)


def read_npz(path: str | Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """The arrays of an npz file that are called one of `names`. Raises MotionError as `read_arrays` does."""
    try:
        return read_arrays(path, names, _LARGEST_FILE)
    except InputError as error:
        raise MotionError(f"motion file {str(path)!r} {error}") from error


def library_sha256(path: str | Path) -> str:
    """Hex digest of a library's file. Raises MotionError if it cannot be read."""
    try:
        return hashlib.sha256(read_bytes(path, _LARGEST_FILE)).hexdigest()
    except InputError as error:
        raise MotionError(f"motion file {str(path)!r} {error}") from error


def _shipped_name(spec: RobotSpec) -> str:
    return f"{spec.name}_motions.npz"


def has_shipped_library(spec: RobotSpec) -> bool:
    """Whether a library for this robot comes with the package."""
    return files("cotap.motions").joinpath(_shipped_name(spec)).is_file()


def shipped_library(spec: RobotSpec) -> MotionLibrary:
    """The library that comes with the package. Raises MotionError if there is none for this robot."""
    resource = files("cotap.motions").joinpath(_shipped_name(spec))
    if not resource.is_file():
        raise MotionError(f"no motion library is shipped for robot {spec.name!r}; import one with cotap motions")
    with as_file(resource) as path:
        return MotionLibrary.load(path, spec)
