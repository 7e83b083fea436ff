"""Motion files as people have them: what genuine data sets hold beside the motion, and what is wrong in them."""

from __future__ import annotations

import io
import json
import pickle
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from robots.made_up import made_up
from scipy.spatial.transform import Rotation
from test_formats import (
    SECONDS,
    all_joints,
    assert_came_back,
    imported,
    joblib_bytes,
    joints_at,
    phc_clip,
    quaternions,
    root_at,
    times_of,
    write_amass,
    write_deepmimic,
    write_lafan,
)
from test_retarget import human

from cotap.envs.path_following import PathConfig
from cotap.motions import MotionClip, MotionError, MotionLibrary
from cotap.motions.importer import ImportResult, import_motions, table
from cotap.motions.joblib_files import load_joblib
from cotap.motions.library import LARGEST_ROOT
from cotap.motions.processing import JointMotion, make_clip
from cotap.motions.quality import assess
from cotap.motions.reference import ClipConfig, ReferenceConfig
from cotap.motions.rotations import heading
from cotap.robots import ROBOTS


def reason(path: Path, spec, **options: Any) -> str:
    """Why a file could not be used; nothing of it was."""
    result = import_motions([path], spec, progress=False, **options)
    assert result.clips == []
    assert len(result.failures) == 1
    return result.failures[0][1]


# AMASS


def test_amass_of_smpl_x_is_read_past_its_objects(tmp_path: Path, spec):
    """As published: 55 joints, the rate under another name, and object arrays that nobody needs."""
    path = write_amass(tmp_path / "walk_stageii.npz", spec)
    content = dict(np.load(path))
    poses = np.concatenate((content.pop("poses"), np.zeros((len(content["trans"]), 9))), 1)
    content["mocap_frame_rate"] = content.pop("mocap_framerate")
    objects = {name: np.array([{"a": 1}, None], dtype=object) for name in ("marker_meta", "labels", "labels_obs")}
    np.savez(path, poses=poses, surface_model_type="smplx", **objects, **content)  # pyright: ignore[reportArgumentType]
    assert_came_back(imported(path, spec))


def test_an_object_array_that_is_needed_is_refused_by_name_and_never_loaded(tmp_path: Path, spec):
    path = write_amass(tmp_path / "walk.npz", spec)
    content = dict(np.load(path)) | {"trans": np.array([[1.0, 2.0, Trap(tmp_path / "sprung")]], dtype=object)}
    np.savez(path, **content)
    said = reason(path, spec)
    assert "walk.npz' has trans as Python objects, which could run code; numbers and text are read" in said
    assert "allow_pickle" not in said
    assert not (tmp_path / "sprung").exists()


class Trap:
    """Unpickling it would create a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        import os

        return os.mkdir, (str(self.path),)


# Pickles


def protocol_5(content: Any, module: str) -> bytes:
    """A pickle of protocol 5 whose arrays are made by `module`'s _frombuffer, as another numpy calls it."""
    file = io.BytesIO()
    pickler = pickle._Pickler(file, protocol=5)  # pyright: ignore[reportAttributeAccessIssue]
    pickler.framer.start_framing = lambda: None  # lengths of frames would have to be changed as well
    pickler.dump(content)
    own = np.zeros(1).__reduce_ex__(5)[0].__module__
    named = (b"\x8c" + bytes([len(name)]) + name.encode() for name in (own, module))
    data = file.getvalue().replace(*named)
    assert module.encode() + b"\x94\x8c\x0b_frombuffer" in data
    return data


@pytest.mark.parametrize("fortran", [True, False])
@pytest.mark.parametrize("module", ["numpy.core.numeric", "numpy._core.numeric"])
def test_pickles_of_protocol_5_are_read(tmp_path: Path, spec, module: str, fortran: bool):
    (tmp_path / "made.pkl").write_bytes(protocol_5({"a": phc_clip(30.0, fortran)}, module))
    assert_came_back(imported(tmp_path / "made.pkl", spec))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data.replace(b"f8", b"O8"), "holds numbers of type 'O8'"),
        (lambda data: data.replace(b"_frombuffer", b"_frombuffes"), r"numeric\._frombuffes, which no motion needs"),
        # Fewer bytes than the shape needs, and more of them claimed than any memory holds.
        (lambda data: data.replace(b"K\x04\x85", b"K\x05\x85"), "is damaged or no joblib file"),
        (lambda data: data.replace(b"\x96\x20\0\0\0\0\0\0\0", b"\x96\x20\0\0\0\0\0\0\x7f"), "is damaged or no joblib"),
    ],
)
def test_damaged_and_hostile_pickles_of_protocol_5_are_refused(tmp_path: Path, change, message: str):
    good = protocol_5({"a": np.zeros(4)}, "numpy._core.numeric")
    assert change(good) != good
    (tmp_path / "made.pkl").write_bytes(change(good))
    with pytest.raises(MotionError, match=rf"made\.pkl.*{message}"):
        load_joblib(tmp_path / "made.pkl")


def test_keys_that_take_forever_to_be_hashed_are_refused(tmp_path: Path):
    """Sixty nested pairs of one tuple: a hundred bytes, and 2^60 steps."""
    for name, use in (
        ("dict", b"}(h\x00K\x01u."),
        ("one", b"}h\x00K\x01s."),
        ("old", b"(h\x00K\x01d."),
        ("set", b"h\x00\x91."),
    ):
        pairs = b")" + b"q\x00h\x00\x86" * 60 + b"q\x00"
        (tmp_path / f"{name}.pkl").write_bytes(b"\x80\x04" + pairs + (b"(" if name == "set" else b"") + use)
        with pytest.raises(MotionError, match=rf"{name}\.pkl"):
            load_joblib(tmp_path / f"{name}.pkl")


def test_one_row_in_many_places_is_no_table(tmp_path: Path, spec):
    """A few kilobytes that would become a hundred gigabytes."""
    row = [0.0] * 100_000
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"a": phc_clip() | {"dof": [row] * 100_000}}))
    assert "10000000000 numbers in lists; at most" in reason(tmp_path / "a.pkl", spec)


def gmr_clip(fps: float = 30.0, joints: np.ndarray | None = None) -> dict[str, Any]:
    """One clip as general motion retargeting writes it, not in a dict of clips."""
    root = root_at(times_of(fps))
    return {
        "fps": fps, "root_pos": np.column_stack((root[:, :2], np.full(len(root), 0.98))),
        "root_rot": quaternions(fps), "dof_pos": all_joints(fps) if joints is None else joints,
        "local_body_pos": None, "link_body_list": None,
    }  # fmt: skip


@pytest.mark.parametrize("wrap", [lambda clip: clip, lambda clip: {"made": clip}])
@pytest.mark.parametrize("make", [gmr_clip, phc_clip])
def test_a_clip_is_read_alone_and_among_others_under_either_naming(tmp_path: Path, spec, make, wrap):
    (tmp_path / "made.pkl").write_bytes(pickle.dumps(wrap(make())))
    clip = imported(tmp_path / "made.pkl", spec)
    assert clip.name == "made"
    assert_came_back(clip)


def test_a_robot_of_29_joints_takes_clips_of_29(tmp_path: Path, spec):
    joints = np.full((91, 29), 0.1) * np.sin(times_of(30.0))[:, None]
    (tmp_path / "made.pkl").write_bytes(pickle.dumps(gmr_clip(joints=joints)))
    clip = imported(tmp_path / "made.pkl", made_up())
    np.testing.assert_allclose(clip.arms[::5], joints[::3, 15:], atol=1e-6)
    said = reason(tmp_path / "made.pkl", spec)
    assert said == "clip 'made': dof_pos of h1 must have shape (T, 19), got (91, 29)"


def test_clips_of_g1_come_with_wrists(tmp_path: Path):
    g1 = ROBOTS["g1"]()
    joints = np.linspace(0.02, 0.3, 29) * np.sin(times_of(30.0))[:, None]  # every joint is another
    upper = g1.indices(g1.upper_joints)
    (tmp_path / "all.pkl").write_bytes(pickle.dumps(gmr_clip(joints=joints)))
    np.testing.assert_allclose(imported(tmp_path / "all.pkl", g1).arms[::5], joints[::3, upper], atol=1e-6)
    rows = np.column_stack((np.zeros((91, 6)), np.ones(91), joints))
    np.savetxt(tmp_path / "all.csv", rows, delimiter=",")
    np.testing.assert_allclose(imported(tmp_path / "all.csv", g1).arms[::5], joints[::3, upper], atol=1e-6)
    (tmp_path / "odd.pkl").write_bytes(pickle.dumps(gmr_clip(joints=joints[:, :22])))
    assert reason(tmp_path / "odd.pkl", g1) == "clip 'odd': dof_pos of g1 must have shape (T, 29), got (91, 22)"


WITHOUT_WRISTS = [joint.name for joint in ROBOTS["g1"]().joints if "wrist" not in joint.name]
OTHER_23 = [*WITHOUT_WRISTS[:13], *WITHOUT_WRISTS[15:19], "left_wrist_roll_joint", *WITHOUT_WRISTS[19:],
            "right_wrist_roll_joint"]  # fmt: skip
"""Joints of the G1 that has 23: a waist of one joint, and wrists that roll."""


def g1_joints(names: list[str]) -> np.ndarray:
    """(91, names): every joint of the G1 moves differently."""
    joints = np.linspace(0.02, 0.3, 29) * np.sin(times_of(30.0) + 0.1)[:, None]
    return joints[:, ROBOTS["g1"]().indices(names)]


def pose_aa(names: list[str]) -> np.ndarray:
    """(91, 1 + names + 3, 3) rotations of the root, the joints and three points, as PHC has them."""
    axes = np.array([ROBOTS["g1"]().joint(name).axis for name in names])
    turns = g1_joints(names)[:, :, None] * axes
    return np.concatenate((np.full((91, 1, 3), 0.2), turns, np.zeros((91, 3, 3))), 1).astype(np.float32)


def expected_arms(names: list[str]) -> np.ndarray:
    """Joints that have no name rest at zero."""
    g1 = ROBOTS["g1"]()
    joints = np.zeros((91, 29))
    joints[:, g1.indices(names)] = g1_joints(names)
    return joints[::3, g1.indices(g1.upper_joints)]


@pytest.mark.parametrize("key", ["joint_names", "dof_names"])
@pytest.mark.parametrize("names", [WITHOUT_WRISTS, [joint.name for joint in ROBOTS["g1"]().joints]])
def test_joints_go_by_name_in_any_order(tmp_path: Path, key: str, names: list[str]):
    shuffled = [names[i] for i in np.random.default_rng(0).permutation(len(names))]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(gmr_clip(joints=g1_joints(shuffled)) | {key: shuffled}))
    clip = imported(tmp_path / "a.pkl", ROBOTS["g1"]())
    np.testing.assert_allclose(clip.arms[::5], expected_arms(names), atol=1e-6)


def test_names_may_lack_their_suffix(tmp_path: Path):
    short = np.array([name.removesuffix("_joint") for name in WITHOUT_WRISTS])
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(gmr_clip(joints=g1_joints(WITHOUT_WRISTS)) | {"joint_names": short}))
    clip = imported(tmp_path / "a.pkl", ROBOTS["g1"]())
    np.testing.assert_allclose(clip.arms[::5], expected_arms(WITHOUT_WRISTS), atol=1e-6)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (OTHER_23, "joint_names lacks 'waist_roll'; g1 needs all but the wrists'"),
        ([*WITHOUT_WRISTS[:-1], "tail_joint"], "joint_names must name joints of g1, each once, got 'tail'"),
        ([*WITHOUT_WRISTS[:-1], WITHOUT_WRISTS[0]], "joint_names must name joints of g1, each once, got 'left_hip_p"),
        (WITHOUT_WRISTS[:-1], "joint_names must be 23 names, one for each column, got ['left_hip_pitch_joint'"),
        ([*WITHOUT_WRISTS[:-1], 3], "joint_names must be 23 names"),
        ("left_hip_pitch_joint and so on", "joint_names must be 23 names"),
    ],
)
def test_names_that_do_not_fit_are_refused(tmp_path: Path, names, message: str):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(gmr_clip(joints=g1_joints(WITHOUT_WRISTS)) | {"joint_names": names}))
    assert message in reason(tmp_path / "a.pkl", ROBOTS["g1"]())


def test_fewer_joints_without_names_are_known_by_their_axes(tmp_path: Path):
    clip = gmr_clip(joints=g1_joints(WITHOUT_WRISTS)) | {"pose_aa": pose_aa(WITHOUT_WRISTS)}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(clip))
    clip = imported(tmp_path / "a.pkl", ROBOTS["g1"]())
    np.testing.assert_allclose(clip.arms[::5], expected_arms(WITHOUT_WRISTS), atol=1e-6)


@pytest.mark.parametrize(
    "pose",
    [None, pose_aa(OTHER_23), np.zeros((91, 27, 3)), pose_aa(WITHOUT_WRISTS)[:9], pose_aa(WITHOUT_WRISTS)[:, :9], "x"],
)
def test_fewer_joints_that_may_be_others_are_refused(tmp_path: Path, pose):
    clip = gmr_clip(joints=g1_joints(WITHOUT_WRISTS)) | {"pose_aa": pose}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(clip))
    said = reason(tmp_path / "a.pkl", ROBOTS["g1"]())
    assert "has 23 columns, and neither joint_names nor the axes of pose_aa say" in said


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"joint_pos": np.zeros((9, 19)), "fps": 3}, r"neither a clip nor a dict of clips: it holds \['joint_pos', 'f"),
        ({"a": {"joint_pos": np.zeros((9, 19))}}, r"clip 'a' holds \['joint_pos'\]"),
        ({"a": {"x": 1}, "b": 3}, "clip 'b' is no dict"),
        ([1, 2], r"holds no dict of clips but \[1, 2\]"),
    ],
)  # fmt: skip
def test_an_unknown_layout_is_named_with_those_known(tmp_path: Path, spec, content, message: str):
    (tmp_path / "made.pkl").write_bytes(pickle.dumps(content))
    result = import_motions([tmp_path / "made.pkl"], spec, progress=False)
    said = result.failures[-1][1]
    import re

    assert re.search(message, said), said
    if isinstance(content, dict):
        assert "dof, root_trans_offset, root_rot, fps or dof_pos, root_pos, root_rot, fps" in said


def test_a_packed_pickle_is_unpacked_no_further_than_it_should(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("cotap.motions.joblib_files._LARGEST_SMALL", 1 << 20)
    (tmp_path / "bomb.pkl").write_bytes(zlib.compress(bytes(50 << 20), 9))
    with pytest.raises(MotionError, match=r"bomb\.pkl' unpacks from \d+ to more than the \d+ bytes that are read"):
        load_joblib(tmp_path / "bomb.pkl")


# Rates and durations


@pytest.mark.parametrize("form", ["deepmimic", "amass", "phc", "lafan"])
def test_a_rate_that_is_given_takes_the_place_of_the_files(tmp_path: Path, spec, form: str):
    """Half of the stated rate: twice as long, and every other frame at 50 Hz is one of the source's at 25."""
    path = {
        "deepmimic": lambda: write_deepmimic(tmp_path / "made.txt", spec),
        "amass": lambda: write_amass(tmp_path / "made.npz", spec, 30.0),
        "phc": lambda: (
            (tmp_path / "made.pkl").write_bytes(joblib_bytes({"made": phc_clip()})) and tmp_path / "made.pkl"
        ),
        "lafan": lambda: write_lafan(tmp_path / "made.csv"),
    }[form]()
    clip = imported(path, spec, fps=25.0)
    assert clip.seconds == pytest.approx(SECONDS * 30.0 / 25.0)
    np.testing.assert_allclose(clip.arms[::2], joints_at(times_of(30.0)), atol=1e-4)


def test_a_file_without_a_usable_rate_is_read_at_the_given_one(tmp_path: Path, spec):
    for rate in ({"mocap_framerate": 0.0}, {}):
        path = write_amass(tmp_path / "made.npz", spec, 100.0)
        content = dict(np.load(path))
        del content["mocap_framerate"]
        np.savez(path, **content, **rate)  # pyright: ignore[reportArgumentType]
        assert "mocap_framerate" in reason(path, spec) or "frame rate must be in [1, 10000] Hz" in reason(path, spec)
        assert_came_back(imported(path, spec, fps=100.0))
    clip = phc_clip()
    del clip["fps"]
    (tmp_path / "made.pkl").write_bytes(joblib_bytes({"a": clip}))
    assert_came_back(imported(tmp_path / "made.pkl", spec, fps=30.0))


@pytest.mark.parametrize("fps", [0.0, -30.0, 1e5, float("nan")])
def test_a_rate_that_no_clip_has_is_refused(tmp_path: Path, spec, fps: float):
    write_lafan(tmp_path / "made.csv")
    with pytest.raises(MotionError, match=r"--fps must be in \[1, 10000\] Hz, got"):
        import_motions([tmp_path / "made.csv"], spec, progress=False, fps=fps)


def test_a_library_has_its_own_rate(tmp_path: Path, spec):
    MotionLibrary([imported(write_lafan(tmp_path / "made.csv"), spec)], spec).save(tmp_path / "own.npz")
    assert "is a motion library, which is at 50 Hz" in reason(tmp_path / "own.npz", spec, fps=30.0)


@pytest.mark.parametrize("duration", [1e9, 1e7, 100.0])
def test_a_clip_that_lasts_too_long_is_refused_before_it_is_resampled(
    tmp_path: Path, spec, duration: float, monkeypatch: pytest.MonkeyPatch
):
    path = write_deepmimic(tmp_path / "made.txt", spec)
    content = json.loads(path.read_text())
    content["Frames"][3][0] = duration
    for row in content["Frames"][4:50]:
        row[0] = duration
    path.write_text(json.dumps(content))
    monkeypatch.setattr("cotap.motions.formats.retarget", None)  # nor retargeted
    assert "it must last 0.02 to 3600 s" in reason(path, spec)


# Numbers


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"root_trans_offset": (5, 0, 3e38)}, r"the root's x is 3e+38 at frame 5; it must lie in [-10000, 10000] m"),
        ({"root_trans_offset": (5, 1, -1e5)}, r"the root's y is -100000 at frame 5"),
        ({"dof": (5, 15, 1e300)}, "an arm joint is turned by 1e+300 rad; at most 1000 rad are read"),
        ({"root_rot": (5, 1, 1e200)}, "a quaternion has length 1e+200 at frame 5; it must lie in [0.1, 10]"),
        ({"root_rot": (slice(5, 6), slice(None), 0.0)}, "a quaternion has length 0 at frame 5"),
    ],
)
def test_numbers_beyond_all_that_moves_are_named_and_cost_no_other_clip(tmp_path: Path, spec, change, message: str):
    bad = phc_clip()
    ((name, (row, column, value)),) = change.items()
    bad[name] = bad[name].astype(float)
    bad[name][row, column] = value
    (tmp_path / "made.pkl").write_bytes(joblib_bytes({"bad": bad, "good": phc_clip()}))
    result = import_motions([tmp_path / "made.pkl"], spec, progress=False)
    assert [c.name for c in result.clips] == ["good"]
    assert message in result.failures[0][1]


@pytest.mark.parametrize("far", [3e38, 1.1e4])
def test_a_library_whose_root_goes_too_far_is_refused(tmp_path: Path, spec, far: float):
    path = library_to(tmp_path / "far.npz", spec, 1.0)
    content = dict(np.load(path))
    content["root"][5, 1] = -far
    np.savez(path, **content)
    with pytest.raises(
        MotionError, match=r"clip 'far': the root's y is -\S+ at frame 5; it must lie in \[-10000, 10000\]"
    ):
        MotionLibrary.load(path, spec)


def test_the_farthest_root_leaves_every_observation_finite(tmp_path: Path, spec, make_env):
    """To and fro between the ends of what is allowed, a robot being led along."""
    clips = ClipConfig(share=1.0, library=str(library_to(tmp_path / "far.npz", spec, LARGEST_ROOT)))
    env = make_env(motions=ReferenceConfig(clips=clips), path=PathConfig(share=1.0))
    for _ in range(20):
        env.step(torch.zeros(env.num_envs, env.num_actions))
        assert all(bool(value.isfinite().all()) for value in env.get_observations().values())


def library_to(path: Path, spec, far: float) -> Path:
    """A library of one clip whose root is at `far` and at minus that in turn."""
    root = np.full((50, 3), far, np.float32) * np.where(np.arange(50) % 2, 1.0, -1.0).astype(np.float32)[:, None]
    MotionLibrary([MotionClip("far", np.zeros((50, 8), np.float32), root, "made", "none")], spec).save(path)
    return path


def test_a_rotation_vector_beyond_all_turns_is_named(tmp_path: Path, spec):
    path = write_amass(tmp_path / "made.npz", spec)
    content = dict(np.load(path))
    content["poses"][7, 0] = 1e200
    np.savez(path, **content)
    assert "a rotation vector has length 1e+200 at frame 7; it must lie in [0, 1000]" in reason(path, spec)


# The root


def report(path: Path, spec) -> tuple[ImportResult, dict[str, str]]:
    """An import, and the first row of its table by the names of its columns."""
    result = import_motions([path], spec, progress=False)
    head, _, row, *_ = table(result).splitlines()
    names, values = ([cell.strip() for cell in line.strip("|").split("|")] for line in (head, row))
    return result, dict(zip(names, values, strict=True))


def test_a_jump_of_the_root_is_seen_in_the_report(tmp_path: Path, spec):
    path = write_lafan(tmp_path / "made.csv")
    smooth = float(report(path, spec)[1]["root m/s"])
    assert smooth == pytest.approx(0.82, abs=0.02)
    rows = np.loadtxt(path, delimiter=",")
    rows[40:, 0] += 0.92
    np.savetxt(path, rows, delimiter=",")
    assert float(report(path, spec)[1]["root m/s"]) > 0.92 * 30.0


def test_a_turn_of_the_root_is_seen_in_the_report(tmp_path: Path, spec):
    path = write_lafan(tmp_path / "made.csv")
    assert float(report(path, spec)[1]["turn rad/s"]) == pytest.approx(0.28, abs=0.05)


def tilted(*turns: tuple[str, np.ndarray]) -> np.ndarray:
    """(T, 3, 3) about the body's axes in turn."""
    out = Rotation.identity(len(turns[0][1]))
    for axis, angles in turns:
        out = out * Rotation.from_euler(axis, angles[:, None])
    return out.as_matrix()


def test_a_heading_is_kept_while_the_body_lies_flips_and_rolls():
    steady, over = np.full(300, 0.7), np.linspace(0.0, 2.0 * np.pi, 300)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((3, 300))
    np.testing.assert_allclose(heading(tilted(("z", over))), over, atol=1e-9)
    for lying in (("y", np.full(300, np.pi / 2)), ("y", np.full(300, -np.pi / 2)), ("x", np.full(300, np.pi / 2))):
        shaken = tilted(("z", steady + noise[0]), lying, ("y", noise[1]), ("x", noise[2]))
        np.testing.assert_allclose(heading(shaken), 0.7, atol=0.01)
    for axis in "xy":  # all the way over, and back on the feet
        np.testing.assert_allclose(heading(tilted(("z", steady), (axis, over + noise[0]))), 0.7, atol=0.01)


def test_a_heading_is_defined_where_the_body_never_is():
    np.testing.assert_array_equal(heading(tilted(("x", np.full(5, np.pi)))), 0.0)


def test_a_heading_of_a_body_that_lies_down_does_not_turn_in_the_report(tmp_path: Path, spec):
    path = write_lafan(tmp_path / "made.csv")
    rows = np.loadtxt(path, delimiter=",")
    pitch = np.pi / 2 + 0.01 * np.sin(np.arange(len(rows)))
    rows[:, 3:7] = (Rotation.from_quat(rows[:, 3:7]) * Rotation.from_euler("y", pitch[:, None])).as_quat()
    np.savetxt(path, rows, delimiter=",")
    assert float(report(path, spec)[1]["turn rad/s"]) < 0.4


# The elbow


def elbow_correlation(spec, flexion: np.ndarray) -> float:
    joints = joints_at(np.arange(len(flexion)) / 50.0)
    joints[:, [3, 7]] = np.pi / 2 - flexion[:, None]
    source = human(spec, joints)
    motion = JointMotion("made", source.times_s, joints, source.root, source)
    return assess(spec, motion, *make_clip(spec, motion, "made", "none")).elbow_correlation


def test_a_straight_arm_that_is_followed_correlates_with_itself():
    """Beyond straight, an angle without a sign would grow again."""
    from cotap.robots import h1

    wave = np.sin(np.linspace(0.0, 6.0, 150))
    assert elbow_correlation(h1(), -0.15 + 0.1 * wave) == pytest.approx(1.0, abs=1e-3)
    assert elbow_correlation(h1(), 0.02 * wave) == pytest.approx(1.0, abs=1e-3)


def test_an_elbow_that_does_not_move_correlates_with_nothing(tmp_path: Path, spec):
    assert np.isnan(elbow_correlation(spec, np.full(150, 0.0)))
    assert np.isnan(elbow_correlation(spec, 1e-5 * np.sin(np.arange(150.0))))
    path = write_deepmimic(tmp_path / "made.txt", spec)
    content = json.loads(path.read_text())
    for row in content["Frames"]:
        row[29] = row[43] = 0.0
    path.write_text(json.dumps(content))
    assert report(path, spec)[1]["elbow corr."] == "-"


# Names


def test_a_long_name_inside_a_file_is_shortened_wherever_it_is_shown(tmp_path: Path, spec):
    long = "n" * 10_000_000
    clips = {long: phc_clip(), long + "2": phc_clip() | {"fps": 0}, "good": phc_clip(), "a\x1b[31m\ud800": phc_clip()}
    (tmp_path / "made.pkl").write_bytes(joblib_bytes(clips))
    result = import_motions([tmp_path / "made.pkl"], spec, progress=False)
    assert [c.name for c in result.clips] == ["good"]
    assert len(result.failures) == 3
    shown = table(result)
    assert len(shown) < 5000
    assert "must have a name of at most 200 characters, all of them printable" in shown
    assert "\x1b" not in shown
    shown.encode()  # what a terminal is given
