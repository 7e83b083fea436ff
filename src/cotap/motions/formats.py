"""Readers of public motion formats. Each names the clips of a file, and reads one when asked to.

A reader returns `(name, read)` pairs, so that a clip that cannot be read takes no other with it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from cotap.checks import legible, quoted
from cotap.inputs import InputError, array_names, read_text
from cotap.motions.elbow import wrist_joints
from cotap.motions.joblib_files import load_joblib
from cotap.motions.library import FPS, MotionClip, MotionError, MotionLibrary, read_npz
from cotap.motions.processing import JointMotion, check_times
from cotap.motions.retarget import HumanMotion, retarget
from cotap.motions.rotations import Y_UP_TO_Z_UP, change_basis, from_axis_angle, from_wxyz, from_xyzw, heading
from cotap.robots import RobotSpec

Clips = list[tuple[str, Callable[[], JointMotion]]]


class Reader(Protocol):
    """Names the clips of a file, each with what reads it. A rate `fps` [Hz] takes the place of the file's own.

    Raises MotionError, now or when a clip is read, for what cannot be used.
    """

    def __call__(self, path: Path, spec: RobotSpec, fps: float | None = None) -> Clips: ...


@dataclass(frozen=True)
class _Entries:
    """How a layout of clips in pickles calls joint angles and the root's position; both call the rest alike."""

    joints: str
    position: str

    def names(self) -> tuple[str, ...]:
        return self.joints, self.position, "root_rot", "fps"


_PICKLED = (_Entries("dof", "root_trans_offset"), _Entries("dof_pos", "root_pos"))
_ASIDE_RAD = 1e-3
"""How far a joint of `pose_aa` may turn about another axis than its own."""
_JOINT_NAMES = ("joint_names", "dof_names")
"""Entries of pickles that tell which joints the angles are of."""
_DEEPMIMIC_COLUMNS = 44
_LAFAN_FPS = 30.0
SLOWEST_FPS, FASTEST_FPS = 1.0, 10_000.0
"""Frame rates that are read [Hz]."""
_LAFAN_ROOT = 7
_LARGEST_TABLE = 1 << 26
_AMASS_ENTRIES = ("poses", "trans", "mocap_framerate", "mocap_frame_rate")
_AMASS_JOINTS = {"collar": {"left": 13, "right": 14}, "shoulder": {"left": 16, "right": 17},
                 "elbow": {"left": 18, "right": 19}}  # fmt: skip
# From SMPL's body axes (x left, y up, z forward) to x forward, y left, z up.
_SMPL_TO_TORSO = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def read_deepmimic(path: Path, spec: RobotSpec, fps: float | None = None) -> Clips:
    """DeepMimic JSON: one clip a file; y up, quaternions scalar first, elbows as one angle."""
    return [(path.stem, lambda: _from_human(spec, _deepmimic(path, fps)))]


def read_amass(path: Path, spec: RobotSpec, fps: float | None = None) -> Clips:
    """AMASS npz: one clip a file; axis-angle of SMPL's joints, z up."""
    return [(path.stem, lambda: _from_human(spec, _amass(path, fps)))]


def read_phc(path: Path, spec: RobotSpec, fps: float | None = None) -> Clips:
    """Pickles of joint angles, by joblib or not: a dict of clips, or one clip; quaternions scalar last.

    A clip is as PHC and human2humanoid have it (`dof`, `root_trans_offset`) or as GMR has it (`dof_pos`, `root_pos`).
    Its joints are those that `joint_names` or `dof_names` says, else all in the robot's order. The wrists' may lack,
    and then rest at zero: without names only if the axes of `pose_aa` are those of the other joints.
    """
    content = load_joblib(path)
    if not isinstance(content, dict) or not content:
        raise MotionError(f"{str(path)!r} holds no dict of clips but {quoted(content)}")
    if any(entries.joints in content for entries in _PICKLED):
        return [(path.stem, lambda: _pickled(path.stem, content, spec, fps))]
    if not any(isinstance(clip, dict) for clip in content.values()):
        raise MotionError(
            f"{str(path)!r} is neither a clip nor a dict of clips: it holds {quoted(list(content))}; "
            f"a clip holds {_known_layouts()}"
        )
    named = [(key if isinstance(key, str) else quoted(key), clip) for key, clip in content.items()]
    return [(name, lambda n=name, c=clip: _pickled(n, c, spec, fps)) for name, clip in named]


def read_lafan(path: Path, spec: RobotSpec, fps: float | None = None) -> Clips:
    """LAFAN1 retargeting CSV: one clip a file, 30 Hz; root position, quaternion scalar last, all joints."""
    return [(path.stem, lambda: _lafan(path, spec, fps))]


def read_library(path: Path, spec: RobotSpec, fps: float | None = None) -> Clips:
    """Our own npz."""
    if fps is not None:
        raise MotionError(f"{str(path)!r} is a motion library, which is at {FPS:g} Hz; --fps is for other formats")
    library = MotionLibrary.load(path, spec)
    names = set(library.names())
    images = {
        n: f"{n}_mirrored" in names or (n.endswith("_mirrored") and n.removesuffix("_mirrored") in names) for n in names
    }
    return [(c.name, lambda c=c: _from_clip(c, images[c.name])) for c in library.clips]


FORMATS: dict[str, Reader] = {
    "deepmimic": read_deepmimic,
    "amass": read_amass,
    "phc": read_phc,
    "lafan": read_lafan,
    "npz": read_library,
}
SUFFIXES = (".txt", ".json", ".npz", ".pkl", ".joblib", ".csv")
"""Files that are looked at in a folder."""


def detect_format(path: Path) -> str:
    """Which of `FORMATS` a file has, from its name and, for npz, its content. Raises MotionError if none."""
    suffix = path.suffix.lower()
    if suffix in (".txt", ".json"):
        return "deepmimic"
    if suffix in (".pkl", ".joblib"):
        return "phc"
    if suffix == ".csv":
        return "lafan"
    if suffix == ".npz":
        try:
            keys = array_names(path)
        except InputError as error:
            raise MotionError(f"motion file {str(path)!r} {error}") from error
        if "poses" in keys:
            return "amass"
        if "arms" in keys:
            return "npz"
        raise MotionError(f"{str(path)!r} is neither AMASS (no 'poses') nor a motion library (no 'arms')")
    raise MotionError(f"{str(path)!r} has no known suffix; known: {', '.join(SUFFIXES)}")


def _from_clip(clip: MotionClip, has_image: bool) -> JointMotion:
    times_s = np.arange(len(clip.arms)) / FPS
    arms, root = clip.arms.astype(float), clip.root.astype(float)
    return JointMotion(clip.name, times_s, arms, root, clip=clip, has_image=has_image)


def _from_human(spec: RobotSpec, human: HumanMotion) -> JointMotion:
    check_times(human.name, human.times_s)
    for side, rotation in human.upper_arms.items():
        if not (np.isfinite(rotation).all() and np.isfinite(human.flexions[side]).all()):
            raise MotionError(f"clip {quoted(human.name)}: the {side} arm is not finite")
    return JointMotion(human.name, human.times_s, retarget(spec, human), human.root, human)


def _table(rows: Any) -> list[list[float]]:
    """Rows of numbers as such. In a pickle one row may stand in many places, and lists may lie in it without end."""
    count = sum(len(row) for row in rows)
    if count > _LARGEST_TABLE:
        raise ValueError(f"{count} numbers in lists; at most {_LARGEST_TABLE} are read")
    return [[float(number) for number in row] for row in rows]


def _numbers(name: str, what: str, value: Any, columns: int | None = None, at_least: int = 0) -> np.ndarray:
    """`value` as a finite (T, columns) array of floats, or a MotionError that names the clip."""
    try:
        if not isinstance(value, np.ndarray):
            value = _table(value)
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        reason = legible(str(error))
        raise MotionError(f"clip {quoted(name)}: {what} is no table of numbers ({reason})") from error
    wanted = f"(T, {columns})" if columns is not None else f"(T, at least {at_least})"
    if array.ndim != 2 or array.shape[1] < at_least or (columns is not None and array.shape[1] != columns):
        raise MotionError(f"clip {quoted(name)}: {what} must have shape {wanted}, got {array.shape}")
    if len(array) < 2:
        raise MotionError(f"clip {quoted(name)} has {len(array)} frames; at least 2 are needed")
    if not np.isfinite(array).all():
        raise MotionError(
            f"clip {quoted(name)}: {what} is not finite at frame {np.argwhere(~np.isfinite(array))[0][0]}"
        )
    return array


def _text(path: Path) -> str:
    try:
        return read_text(path)
    except InputError as error:
        raise MotionError(f"motion file {str(path)!r} {error}") from error


def _deepmimic(path: Path, fps: float | None) -> HumanMotion:
    try:
        content = json.loads(_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise MotionError(f"{str(path)!r} is not readable as JSON: {error}") from error
    if not isinstance(content, dict) or "Frames" not in content:
        raise MotionError(f"{str(path)!r} is no DeepMimic clip: it has no 'Frames'")
    frames = _numbers(path.stem, "Frames", content["Frames"], _DEEPMIMIC_COLUMNS)
    duration = frames[:-1, 0] if fps is None else np.full(len(frames) - 1, 1.0 / fps)
    if (duration <= 0.0).any():
        raise MotionError(f"clip {quoted(path.stem)}: frame {int((duration <= 0.0).argmax())} has no positive duration")
    root = change_basis(Y_UP_TO_Z_UP, _rotations(path.stem, from_wxyz, frames[:, 4:8]))
    position = frames[:, 1:4] @ Y_UP_TO_Z_UP.T
    shoulders = {"right": frames[:, 25:29], "left": frames[:, 39:43]}
    return HumanMotion(
        path.stem,
        np.concatenate(([0.0], np.cumsum(duration))),
        {s: change_basis(Y_UP_TO_Z_UP, _rotations(path.stem, from_wxyz, q)) for s, q in shoulders.items()},
        {"right": frames[:, 29], "left": frames[:, 43]},
        np.column_stack((position[:, :2], heading(root))),
    )


def _rotations(name: str, convert: Callable[[np.ndarray], np.ndarray], quaternions: np.ndarray) -> np.ndarray:
    try:
        return convert(quaternions)
    except ValueError as error:
        raise MotionError(f"clip {quoted(name)}: {error}") from error


def _amass(path: Path, fps: float | None) -> HumanMotion:
    content = read_npz(path, _AMASS_ENTRIES)
    rate = content.get("mocap_framerate", content.get("mocap_frame_rate"))
    missing = [name for name in ("poses", "trans") if name not in content]
    if missing or (rate is None and fps is None):
        raise MotionError(f"{str(path)!r} is no AMASS clip: it lacks {(missing or ['mocap_framerate'])[0]!r}")
    poses = _numbers(path.stem, "poses", content["poses"], at_least=66)
    trans = _numbers(path.stem, "trans", content["trans"], 3)
    fps = _rate(path.stem, rate, fps)
    if len(trans) != len(poses):
        raise MotionError(f"clip {quoted(path.stem)}: {len(poses)} poses but {len(trans)} root positions")

    def rotation(joint: int) -> np.ndarray:
        return from_axis_angle(poses[:, 3 * joint : 3 * joint + 3])

    arms = {side: _smpl_arm(side, rotation) for side in ("left", "right")}
    facing = rotation(0) @ _SMPL_TO_TORSO.T
    return HumanMotion(
        path.stem,
        np.arange(len(poses)) / fps,
        {side: arm[0] for side, arm in arms.items()},
        {side: arm[1] for side, arm in arms.items()},
        np.column_stack((trans[:, :2], heading(facing))),
    )


def _rate(name: str, value: Any, instead: float | None) -> float:
    """The frame rate that a file states [Hz], or the one to be taken instead."""
    if instead is not None:
        return instead
    try:
        fps = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise MotionError(f"clip {quoted(name)}: frame rate {quoted(value)} is no number") from error
    if not SLOWEST_FPS <= fps <= FASTEST_FPS:
        raise MotionError(
            f"clip {quoted(name)}: frame rate must be in [{SLOWEST_FPS:g}, {FASTEST_FPS:g}] Hz, got {fps}; "
            "--fps gives another"
        )
    return fps


def _smpl_arm(side: str, rotation: Callable[[int], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Upper arm rotation (T, 3, 3) and flexion (T,) from SMPL's, whose arms point sideways at rest.

    SMPL's elbow is a ball. Its forearm's direction gives the flexion, and a turn of the upper arm about itself that
    brings the forearm into the plane of a hinge; the turn fades out as the arm straightens, where it is undefined.
    """
    sideways = 1.0 if side == "left" else -1.0
    hang = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -sideways], [0.0, sideways, 0.0]])  # from hanging to the T-pose
    chest = rotation(_AMASS_JOINTS["collar"][side]) @ rotation(_AMASS_JOINTS["shoulder"][side])
    upper = change_basis(_SMPL_TO_TORSO, chest) @ hang
    elbow = hang.T @ change_basis(_SMPL_TO_TORSO, rotation(_AMASS_JOINTS["elbow"][side])) @ hang
    forearm = -elbow[:, :, 2]
    bent = np.hypot(forearm[:, 0], forearm[:, 1])
    sign = np.where(forearm[:, 0] < 0.0, -1.0, 1.0)
    turn = np.arctan2(sign * forearm[:, 1], np.abs(forearm[:, 0])) * np.minimum(1.0, np.square(bent / 0.15))
    c, s, zero, one = np.cos(turn), np.sin(turn), np.zeros_like(turn), np.ones_like(turn)
    about_z = np.stack((np.stack((c, -s, zero), 1), np.stack((s, c, zero), 1), np.stack((zero, zero, one), 1)), 1)
    return upper @ about_z, np.arctan2(sign * bent, -forearm[:, 2])


def _known_layouts() -> str:
    return " or ".join(", ".join(entries.names()) for entries in _PICKLED)


def _pickled(name: str, clip: Any, spec: RobotSpec, fps: float | None) -> JointMotion:
    if not isinstance(clip, dict):
        raise MotionError(f"clip {quoted(name)} is no dict; a clip holds {_known_layouts()}")
    entries = next((e for e in _PICKLED if e.joints in clip), None)
    if entries is None:
        raise MotionError(f"clip {quoted(name)} holds {quoted(list(clip))}; a clip holds {_known_layouts()}")
    missing = [n for n in entries.names() if n not in clip and not (n == "fps" and fps is not None)]
    if missing:
        raise MotionError(f"clip {quoted(name)} lacks {missing[0]!r}")
    angles = clip[entries.joints]
    angles = angles.squeeze() if isinstance(angles, np.ndarray) else angles
    what = f"{entries.joints} of {spec.name}"
    angles = _numbers(name, what, angles, at_least=1)
    columns = _named_columns(name, clip, angles.shape[1], spec) or _assumed_columns(name, what, clip, angles, spec)
    joints = np.zeros((len(angles), len(spec.joints)))
    joints[:, columns] = angles
    position = _numbers(name, entries.position, clip[entries.position], 3)
    quaternion = _numbers(name, "root_rot", clip["root_rot"], 4)
    return _joint_motion(name, _rate(name, clip.get("fps"), fps), position, quaternion, joints, spec)


def _named_columns(name: str, clip: dict[Any, Any], count: int, spec: RobotSpec) -> list[int] | None:
    """Which of the robot's joints each of `count` columns is of, by the clip's own names; None where it has none."""
    key = next((key for key in _JOINT_NAMES if clip.get(key) is not None), None)
    if key is None:
        return None
    given = clip[key]
    names = list(given) if isinstance(given, (list, tuple, np.ndarray)) else []
    if len(names) != count or not all(isinstance(joint, str) for joint in names):
        raise MotionError(f"clip {quoted(name)}: {key} must be {count} names, one for each column, got {quoted(given)}")
    places = {joint.name.removesuffix("_joint"): i for i, joint in enumerate(spec.joints)}
    short = [joint.removesuffix("_joint") for joint in names]
    odd = [joint for i, joint in enumerate(short) if joint not in places or joint in short[:i]]
    if odd:
        raise MotionError(
            f"clip {quoted(name)}: {key} must name joints of {spec.name}, each once, got {quoted(odd[0])}"
        )
    wrists = {joint.removesuffix("_joint") for joint in wrist_joints(spec)}
    if lacking := [joint for joint in places if joint not in wrists and joint not in short]:
        raise MotionError(f"clip {quoted(name)}: {key} lacks {lacking[0]!r}; {spec.name} needs all but the wrists'")
    return [places[joint] for joint in short]


def _assumed_columns(name: str, what: str, clip: dict[Any, Any], angles: np.ndarray, spec: RobotSpec) -> list[int]:
    """The same where the clip has no names: all joints in the robot's order, or all but the wrists' if the axes of its
    `pose_aa` say so. Other joints may be as many: a G1 of 23 joints has one in the waist, and wrists that roll."""
    wrists = set(wrist_joints(spec))
    others = [i for i, joint in enumerate(spec.joints) if joint.name not in wrists]
    if angles.shape[1] != len(others) or not wrists:
        _numbers(name, what, angles, len(spec.joints))
        return list(range(len(spec.joints)))
    pose = clip.get("pose_aa")
    shape = np.shape(pose) if isinstance(pose, np.ndarray) and pose.dtype.kind == "f" else ()
    if len(shape) == 3 and shape[0] == len(angles) and shape[1] > len(others) and shape[2] == 3:
        turns = np.asarray(pose, dtype=float)[:, 1 : 1 + len(others)]  # the root's comes first
        axes = np.array([spec.joints[i].axis for i in others])
        aside = turns - (turns * axes).sum(-1, keepdims=True) * axes
        arms = [k for k, i in enumerate(others) if spec.joints[i].name in spec.upper_joints]
        if turns[:, arms].any() and np.abs(aside).max() < _ASIDE_RAD:
            return others
    raise MotionError(
        f"clip {quoted(name)}: {what} has {len(others)} columns, and neither joint_names nor the axes of pose_aa say "
        "that they are all but the wrists'; add joint_names"
    )


def _lafan(path: Path, spec: RobotSpec, fps: float | None) -> JointMotion:
    try:
        rows = [[float(value) for value in line.split(",")] for line in _text(path).splitlines() if line.strip()]
    except MotionError:
        raise
    except ValueError as error:
        raise MotionError(f"{str(path)!r} is no table of numbers: {legible(str(error))}") from error
    widths = {len(row) for row in rows}
    wanted = _LAFAN_ROOT + len(spec.joints)
    if widths - {wanted}:
        raise MotionError(
            f"{str(path)!r} must have {wanted} columns in every line, {_LAFAN_ROOT} of the root and one for each joint "
            f"of {spec.name}, got {quoted(sorted(widths))}"
        )
    table = _numbers(path.stem, "table", rows, wanted)
    rate = _LAFAN_FPS if fps is None else fps
    return _joint_motion(path.stem, rate, table[:, :3], table[:, 3:7], table[:, 7:], spec)


def _joint_motion(
    name: str, fps: float, position: np.ndarray, quaternion: np.ndarray, joints: np.ndarray, spec: RobotSpec
) -> JointMotion:
    if not len(position) == len(quaternion) == len(joints):
        raise MotionError(
            f"clip {quoted(name)}: {len(joints)} frames of joints, but {len(position)} of the root's position and "
            f"{len(quaternion)} of its rotation"
        )
    facing = heading(_rotations(name, from_xyzw, quaternion))
    upper = joints[:, spec.indices(spec.upper_joints)]
    return JointMotion(name, np.arange(len(joints)) / fps, upper, np.column_stack((position[:, :2], facing)))
