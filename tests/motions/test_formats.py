"""Known joint trajectories written in every format come back; files that are wrong are named and cost nothing else."""

from __future__ import annotations

import dataclasses
import gzip
import io
import json
import pickle
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_retarget import upper_arm_rotation

from cotap.motions import MotionClip, MotionError, MotionLibrary, formats
from cotap.motions.formats import FORMATS, detect_format
from cotap.motions.importer import import_motions
from cotap.motions.joblib_files import load_joblib
from cotap.motions.library import shipped_library
from cotap.motions.retarget import arm_frames

SECONDS = 3.0
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # y up to z up
SMPL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # x left, y up, z forward to ours


def joints_at(times: np.ndarray) -> np.ndarray:
    """Arm joints (T, 8), slow and inside limits, the elbows never straight."""
    t = times[:, None]
    left = np.array([0.2, 0.5, 0.3, 0.1]) + np.array([0.6, 0.4, 0.5, 0.6]) * np.sin(t * [1.1, 0.7, 0.9, 1.3] + 0.3)
    right = np.array([-0.1, -0.6, 0.2, 0.2]) + np.array([0.5, 0.3, 0.6, 0.5]) * np.sin(t * [0.8, 1.2, 0.6, 1.0] + 1.1)
    return np.concatenate((left, right), 1)


def root_at(times: np.ndarray) -> np.ndarray:
    """x, y, heading."""
    return np.column_stack((0.8 * times, 0.2 * np.sin(times), 0.4 * np.sin(0.7 * times)))


def times_of(fps: float) -> np.ndarray:
    return np.arange(int(SECONDS * fps) + 1) / fps


def all_joints(fps: float) -> np.ndarray:
    """(T, 19): something in the legs, so that a scrambled table shows."""
    t = times_of(fps)
    legs = np.column_stack([0.01 * i + 0.1 * np.sin(t + i) for i in range(11)])
    return np.concatenate((legs, joints_at(t)), 1)


def quaternions(fps: float) -> np.ndarray:
    """(T, 4) xyzw of the root's heading."""
    return Rotation.from_euler("z", root_at(times_of(fps))[:, 2:]).as_quat()


def human_arms(spec, fps):
    joints = joints_at(times_of(fps))
    return {
        a.side: (upper_arm_rotation(arm_frames(spec, a), joints[:, 4 * i :]), np.pi / 2 - joints[:, 4 * i + 3])
        for i, a in enumerate(spec.arms)
    }


def write_deepmimic(path: Path, spec, fps=30.0) -> Path:
    t = times_of(fps)
    rows = np.zeros((len(t), 44))
    rows[:, 0] = 1.0 / fps
    root = root_at(t)
    rows[:, 1:4] = np.column_stack((root[:, 0], np.full(len(t), 0.9), -root[:, 1]))
    heading = Y_UP.T @ Rotation.from_euler("z", root[:, 2:]).as_matrix() @ Y_UP
    rows[:, 4:8] = np.roll(Rotation.from_matrix(heading).as_quat(), 1, axis=1)
    rows[:, [8, 12, 16, 21, 30, 35]] = 1.0
    for side, column in (("right", 25), ("left", 39)):
        rotation, flexion = human_arms(spec, fps)[side]
        local = Y_UP.T @ rotation @ Y_UP
        rows[:, column : column + 4] = np.roll(Rotation.from_matrix(local).as_quat(), 1, axis=1)
        rows[:, column + 4] = flexion
    path.write_text(json.dumps({"Loop": "wrap", "Frames": rows.tolist()}))
    return path


def write_amass(path: Path, spec, fps=120.0) -> Path:
    t = times_of(fps)
    poses = np.zeros((len(t), 156))
    root = root_at(t)
    poses[:, :3] = (Rotation.from_euler("z", root[:, 2:]) * Rotation.from_matrix(SMPL)).as_rotvec()
    collar = Rotation.from_euler("xyz", [0.1, -0.05, 0.08])
    for side, joint, sign in (("left", 16, 1.0), ("right", 17, -1.0)):
        rotation, flexion = human_arms(spec, fps)[side]
        hang = Rotation.from_euler("x", sign * np.pi / 2).as_matrix()
        chest = Rotation.from_matrix(SMPL.T @ (rotation @ hang.T) @ SMPL)
        poses[:, 3 * (joint - 3) : 3 * (joint - 3) + 3] = collar.as_rotvec()
        poses[:, 3 * joint : 3 * joint + 3] = (collar.inv() * chest).as_rotvec()
        bend = Rotation.from_euler("y", -flexion[:, None]).as_matrix()
        elbow = joint + 2
        poses[:, 3 * elbow : 3 * elbow + 3] = Rotation.from_matrix(SMPL.T @ (hang @ bend @ hang.T) @ SMPL).as_rotvec()
    np.savez(path, poses=poses, trans=np.column_stack((root[:, :2], np.full(len(t), 0.9))), mocap_framerate=fps,
             gender="neutral", betas=np.zeros(16))  # fmt: skip
    return path


class Wrapper:
    """What joblib writes in an array's place, by joblib's name for it."""

    def __init__(self, array: np.ndarray, order: str) -> None:
        self.subclass, self.shape, self.order = np.ndarray, array.shape, order
        self.dtype, self.allow_mmap, self.numpy_array_alignment_bytes = array.dtype, True, 16


Wrapper.__module__, Wrapper.__qualname__ = "joblib.numpy_pickle", "NumpyArrayWrapper"


class _JoblibPickler(pickle._Pickler):
    """Writes numpy arrays as joblib does: a wrapper object, one byte of padding length, padding, raw bytes."""

    def save(self, obj, save_persistent_id=True):
        if type(obj) is np.ndarray:
            order = "F" if obj.flags.f_contiguous and not obj.flags.c_contiguous else "C"
            wrapper = Wrapper(obj, order)
            self._save_wrapper(wrapper)
            # Opcodes are written out at once (no framing in protocol 3), so that bytes follow where they must.
            position = self.file.tell()
            padding = 16 - (position + 1) % 16
            self.file.write(bytes([padding]) + b"\xff" * padding + obj.tobytes(order=order))
            return
        super().save(obj, save_persistent_id)

    def _save_wrapper(self, wrapper):
        self.write(pickle.GLOBAL + b"joblib.numpy_pickle\nNumpyArrayWrapper\n" + pickle.EMPTY_TUPLE + pickle.NEWOBJ)
        super().save(dict(vars(wrapper)))
        self.write(pickle.BUILD)


def joblib_bytes(content) -> bytes:
    file = io.BytesIO()
    pickler = _JoblibPickler(file, protocol=3)
    pickler.file = file
    pickler.dump(content)
    return file.getvalue()


def phc_clip(fps=30.0, fortran=True) -> dict:
    dof = all_joints(fps).astype(np.float32)
    root = root_at(times_of(fps))
    return {
        "root_trans_offset": np.column_stack((root[:, :2], np.full(len(root), 0.98))),
        "pose_aa": np.zeros((len(root), 22, 3), np.float32),
        "dof": np.asfortranarray(dof) if fortran else dof,
        "root_rot": quaternions(fps),
        "fps": int(fps),
    }


def write_lafan(path: Path) -> Path:
    root = root_at(times_of(30.0))
    table = np.concatenate(
        (np.column_stack((root[:, :2], np.full(len(root), 0.98))), quaternions(30.0), all_joints(30.0)), 1
    )
    np.savetxt(path, table, delimiter=",", fmt="%.9f")
    return path


def imported(path: Path, spec, **options) -> MotionClip:
    result = import_motions([path], spec, progress=False, **options)
    assert result.failures == []
    assert len(result.clips) == 1
    return result.clips[0]


def assert_came_back(clip: MotionClip, joints_tolerance=1e-4):
    times = np.arange(len(clip.arms)) / 50.0
    assert len(clip.arms) == int(SECONDS * 50) + 1
    np.testing.assert_allclose(clip.arms, joints_at(times), atol=joints_tolerance)
    np.testing.assert_allclose(clip.root, root_at(times), atol=1e-3)


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
def test_deepmimic_comes_back(tmp_path, spec, fps):
    assert_came_back(imported(write_deepmimic(tmp_path / "made.txt", spec, fps), spec))


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
def test_amass_comes_back(tmp_path, spec, fps):
    assert_came_back(imported(write_amass(tmp_path / "made.npz", spec, fps), spec))


@pytest.mark.parametrize("fortran", [True, False])
@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
@pytest.mark.parametrize("pack", [bytes, zlib.compress, gzip.compress])
def test_phc_comes_back(tmp_path, spec, fps, fortran, pack):
    path = tmp_path / "made.pkl"
    path.write_bytes(pack(joblib_bytes({"a clip": phc_clip(fps, fortran)})))
    clip = imported(path, spec)
    assert clip.name == "a clip"
    assert_came_back(clip)


def test_phc_frames_at_common_times_are_exact(tmp_path, spec):
    path = tmp_path / "made.pkl"
    path.write_bytes(joblib_bytes({"a": phc_clip(30.0)}))
    clip = imported(path, spec)
    np.testing.assert_array_equal(clip.arms[::5], joints_at(times_of(30.0)).astype(np.float32)[::3])


def test_plain_pickles_of_arrays_are_read_as_well(tmp_path, spec):
    path = tmp_path / "made.pkl"
    path.write_bytes(pickle.dumps({"a": phc_clip(30.0)}))
    assert_came_back(imported(path, spec))


def test_joblib_itself_writes_what_is_read(tmp_path, spec):
    joblib = pytest.importorskip("joblib")
    for compress in (0, 3):
        joblib.dump({"a": phc_clip(30.0)}, tmp_path / "made.pkl", compress=compress)
        assert_came_back(imported(tmp_path / "made.pkl", spec))


def test_lafan_comes_back(tmp_path, spec):
    assert_came_back(imported(write_lafan(tmp_path / "made.csv"), spec))


def test_our_own_comes_back_exactly(tmp_path, spec):
    clip = imported(write_lafan(tmp_path / "made.csv"), spec)
    MotionLibrary([clip], spec).save(tmp_path / "own.npz")
    again = imported(tmp_path / "own.npz", spec)
    np.testing.assert_array_equal(again.arms, clip.arms)
    np.testing.assert_array_equal(again.root, clip.root)


def test_a_scrambled_or_swapped_reading_would_show(tmp_path, spec):
    """The tolerance above is worth something: wrong quaternion order or a naive reshape miss it by far."""
    clip = phc_clip(30.0)
    clip["root_rot"] = np.roll(clip["root_rot"], 1, axis=1)
    path = tmp_path / "made.pkl"
    path.write_bytes(joblib_bytes({"a": clip}))
    assert np.abs(imported(path, spec).root[:, 2] - root_at(np.arange(151) / 50.0)[:, 2]).max() > 0.1
    dof = all_joints(30.0)
    assert np.abs(dof.ravel(order="F").reshape(dof.shape) - dof).max() > 0.5


class Hostile:
    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self):
        import os

        return os.system, (f"touch {self.target}",)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_a_hostile_pickle_runs_nothing(tmp_path, spec, protocol):
    mark = tmp_path / "was_run"
    path = tmp_path / "evil.pkl"
    path.write_bytes(pickle.dumps({"a": Hostile(mark)}, protocol=protocol))
    with pytest.raises(MotionError, match=r"evil.pkl.*asks for (posix|nt)\.system, which no motion needs"):
        load_joblib(path)
    result = import_motions([path], spec, progress=False)
    assert result.clips == []
    assert "system" in result.failures[0][1]
    assert not mark.exists()


@pytest.mark.parametrize(
    "code",
    [
        b"cbuiltins\neval\n(S'1'\ntR.",
        b"cnumpy\nload\n(S'x'\ntR.",
        b"cnumpy.lib.npyio\nload\n(S'x'\ntR.",
        b"\x8c\x08builtins\x8c\x04exec\x93.",
        b"cjoblib.numpy_pickle\nNumpyArrayWrapper.__init__\n.",
        b"cnumpy\nndarray.tofile\n.",
    ],
)
def test_only_listed_names_are_found(tmp_path, code):
    (tmp_path / "x.pkl").write_bytes(code)
    with pytest.raises(MotionError, match="which no motion needs; nothing was run"):
        load_joblib(tmp_path / "x.pkl")


def test_object_arrays_in_joblib_files_are_refused(tmp_path):
    data = joblib_bytes({"a": np.zeros(3)}).replace(b"f8", b"O8")
    (tmp_path / "x.pkl").write_bytes(data)
    with pytest.raises(MotionError, match=r"x\.pkl.*holds numbers of type 'O8'"):
        load_joblib(tmp_path / "x.pkl")
    plain = pickle.dumps({"a": np.array([{}, 1], dtype=object)}, protocol=2)
    (tmp_path / "y.pkl").write_bytes(plain)
    with pytest.raises(MotionError, match=r"y\.pkl.*holds numbers of type 'O8'"):
        load_joblib(tmp_path / "y.pkl")


def test_truncated_files_are_named(tmp_path, spec):
    good = {
        "a.pkl": joblib_bytes({"a": phc_clip()}),
        "b.npz": write_amass(tmp_path / "b.npz", spec).read_bytes(),
        "c.txt": write_deepmimic(tmp_path / "c.txt", spec).read_bytes(),
        "d.csv": write_lafan(tmp_path / "d.csv").read_bytes(),
        "e.pkl": zlib.compress(joblib_bytes({"a": phc_clip()})),
    }
    for name, data in good.items():
        for share in (0.0, 0.1, 0.5, 0.95):
            path = tmp_path / name
            path.write_bytes(data[: int(share * len(data))])
            result = import_motions([path], spec, progress=False)
            # A table cut at a line's end is a shorter table; everything else fails.
            if name == "d.csv" and result.clips:
                continue
            assert result.clips == [], (name, share)
            assert "tmp" in result.failures[0][0]
            assert name in result.failures[0][0]


def broken_phc(**changes) -> dict:
    clip = phc_clip() | changes
    return {k: v for k, v in clip.items() if v is not None}


def test_a_bad_clip_takes_no_other_with_it(tmp_path, spec):
    nan = phc_clip()["dof"].copy(order="F")
    nan[7, 15] = np.nan
    clips = {
        "good": phc_clip(),
        "nan": broken_phc(dof=nan),
        "empty": broken_phc(dof=np.zeros((0, 19)), root_rot=np.zeros((0, 4)), root_trans_offset=np.zeros((0, 3))),
        "narrow": broken_phc(dof=np.zeros((91, 12))),
        "no_fps": broken_phc(fps=None),
        "bad_fps": broken_phc(fps=0),
        "vast_fps": broken_phc(fps=10**400),
        "uneven": broken_phc(root_rot=quaternions(30.0)[:-1]),
        "zero_quaternion": broken_phc(root_rot=np.zeros((91, 4))),
        "text": "not a clip",
    }
    path = tmp_path / "many.pkl"
    path.write_bytes(joblib_bytes(clips))
    result = import_motions([path], spec, progress=False)
    assert [c.name for c in result.clips] == ["good"]
    reasons = dict(result.failures)
    assert len(reasons) == 9
    for name, reason in {
        "nan": "dof of h1 is not finite at frame 7",
        "narrow": r"dof of h1 must have shape \(T, 19\), got \(91, 12\)",
        "no_fps": "lacks 'fps'",
        "bad_fps": "frame rate must be in",
        "vast_fps": r"frame rate 10+\.\.\.0+ is no number",
        "uneven": "91 frames of joints, but 91 of the root's position and 90 of its rotation",
        "text": "is no dict",
    }.items():
        assert pytest.approx(1) == len([k for k in reasons if k.endswith(f":{name}")])
        import re

        assert re.search(reason, reasons[f"{path}:{name}"]), reasons[f"{path}:{name}"]


def test_mixed_folders_keep_what_can_be_read(tmp_path, spec):
    folder = tmp_path / "deep" / "er"
    folder.mkdir(parents=True)
    write_lafan(folder / "walk.csv")
    write_amass(tmp_path / "deep" / "dance.npz", spec)
    write_deepmimic(tmp_path / "punch.json", spec)
    (tmp_path / "notes.md").write_text("no motion")
    (tmp_path / "legs.csv").write_text("1,2,3\n4,5,6\n")
    (tmp_path / "ragged.csv").write_text("1,2,3\n4,5\n")
    (tmp_path / "letters.csv").write_text("a,b\n")
    (tmp_path / "beyond.json").write_text(json.dumps({"Frames": [44 * [10**400]] * 2}))
    (tmp_path / "deep.json").write_text("[" * 100_000)
    (tmp_path / "other.npz").write_bytes(b"PK\x03\x04 not really")
    np.savez(tmp_path / "pictures.npz", pixels=np.zeros(3))
    result = import_motions([tmp_path], spec, progress=False)
    assert sorted(c.name for c in result.clips) == ["dance", "punch", "walk"]
    reasons = {Path(k).name: v for k, v in result.failures}
    assert reasons.keys() == {"legs.csv", "ragged.csv", "letters.csv", "beyond.json", "deep.json", "other.npz",
                              "pictures.npz"}  # fmt: skip
    assert "clip 'beyond': Frames is no table of numbers" in reasons["beyond.json"]
    assert (
        "must have 26 columns in every line, 7 of the root and one for each joint of h1, got [3]" in reasons["legs.csv"]
    )
    assert "got [2, 3]" in reasons["ragged.csv"]
    assert "neither AMASS (no 'poses') nor a motion library" in reasons["pictures.npz"]


def test_clips_of_one_name_are_told_apart_and_mirrored(tmp_path, spec):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_lafan(tmp_path / folder / "walk.csv")
    result = import_motions([tmp_path], spec, mirror=True, progress=False)
    assert [c.name for c in result.clips] == ["walk", "walk_mirrored", "walk_2", "walk_2_mirrored"]
    assert [c.mirrored for c in result.clips] == [False, True, False, True]


def test_what_only_looks_like_a_file_is_listed_and_costs_no_other(tmp_path, spec):
    write_lafan(tmp_path / "good.csv")
    (tmp_path / "endless.csv").symlink_to("/dev/zero")
    (tmp_path / "broken.pkl").symlink_to(tmp_path / "nowhere")
    (tmp_path / "folder.csv").mkdir()
    result = import_motions([tmp_path], spec, progress=False)
    assert [c.name for c in result.clips] == ["good"]
    reasons = {Path(k).name: v for k, v in result.failures}
    assert reasons.keys() == {"endless.csv", "broken.pkl"}
    assert "is no file but a device or pipe" in reasons["endless.csv"]
    assert "does not exist" in reasons["broken.pkl"]


def test_missing_sources_and_empty_folders(tmp_path, spec):
    with pytest.raises(MotionError, match="does not exist"):
        import_motions([tmp_path / "nowhere"], spec)
    with pytest.raises(MotionError, match="no motion files there"):
        import_motions([tmp_path], spec)


def test_unknown_suffixes_are_named(tmp_path):
    path = tmp_path / "clip.bvh"
    path.write_text("HIERARCHY")
    with pytest.raises(MotionError, match=r"no known suffix; known: \.txt"):
        detect_format(path)
    assert set(FORMATS) == {"deepmimic", "amass", "phc", "lafan", "npz"}


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_ball_elbow_becomes_a_hinge_whose_forearm_points_the_same_way(side):
    """SMPL's arms point sideways at rest; left is x there, and up is y."""
    rng = np.random.default_rng(0)
    turns = {name: Rotation.from_rotvec(rng.normal(size=(50, 3))) for name in ("collar", "shoulder", "elbow")}
    joint = {formats._AMASS_JOINTS[name][side]: turn.as_matrix() for name, turn in turns.items()}
    upper, flexion = formats._smpl_arm(side, joint.__getitem__)
    rest = [1.0 if side == "left" else -1.0, 0.0, 0.0]
    arm = turns["collar"] * turns["shoulder"]
    forearm = (arm * turns["elbow"]).apply(rest)[:, [2, 0, 1]]  # forward, left, up
    bent = np.abs(np.sin(flexion)) > 0.2  # else the turn of the upper arm fades
    hinge = np.stack((np.sin(flexion), 0.0 * flexion, -np.cos(flexion)), 1)
    np.testing.assert_allclose((upper @ hinge[..., None])[bent, :, 0], forearm[bent], atol=1e-9)
    np.testing.assert_allclose(-upper[:, :, 2], arm.apply(rest)[:, [2, 0, 1]], atol=1e-9)
    assert bent.sum() > 40


def test_a_file_that_is_named_twice_is_read_once(tmp_path, spec):
    path = write_lafan(tmp_path / "walk.csv")
    result = import_motions([path, tmp_path, tmp_path / ".." / tmp_path.name], spec, progress=False)
    assert result.read == ["walk"]


def test_a_mirrored_clip_alone_gets_its_image(tmp_path, spec):
    shipped_library(spec).select(["dance_b_mirrored"], spec).save(tmp_path / "one.npz")
    result = import_motions([tmp_path / "one.npz"], spec, mirror=True, progress=False)
    assert [c.mirrored for c in result.clips] == [True, False]


def test_a_library_keeps_whose_its_clips_are_and_has_no_image_twice(tmp_path, spec):
    shipped_library(spec).select(["dance_b", "dance_b_mirrored", "punch"], spec).save(tmp_path / "three.npz")
    result = import_motions([tmp_path / "three.npz"], spec, mirror=True, source="me", licence="mine", progress=False)
    assert [c.name for c in result.clips] == ["dance_b", "dance_b_mirrored", "punch", "punch_mirrored"]
    assert [c.mirrored for c in result.clips] == [False, True, False, True]
    of = {c.name: c for c in shipped_library(spec).clips}
    for clip in result.clips:
        origin = of[clip.name]
        assert (clip.source, clip.licence) == (origin.source, origin.licence)


def test_a_name_that_grows_too_long_costs_its_own_clip_only(tmp_path, spec):
    punch = shipped_library(spec).select(["punch"], spec).clips[0]
    for stem in ("good", "x" * 195):
        MotionLibrary([dataclasses.replace(punch, name=stem)], spec).save(tmp_path / f"{stem[:9]}.npz")
    result = import_motions([tmp_path], spec, mirror=True, progress=False)
    assert [c.name for c in result.clips] == ["good", "good_mirrored"]
    assert ["at most 200 characters" in reason for _, reason in result.failures] == [True]
