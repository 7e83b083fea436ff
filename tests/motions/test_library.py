"""The library file, and what the shipped one promises."""

from __future__ import annotations

import os
import stat
from dataclasses import replace

import numpy as np
import pytest

from cotap.motions import MotionClip, MotionError, MotionLibrary, shipped_library
from cotap.motions.processing import JointMotion, limit_speed, make_clip, mirror_clip
from cotap.motions.quality import assess, forward_kinematics
from cotap.robots import ROBOTS

# Typed from the published parameters.
LOW = np.array([-2.87, -0.34, -1.3, -1.25, -2.87, -3.11, -4.45, -1.25])
HIGH = np.array([2.87, 3.11, 4.45, 2.61, 2.87, 0.34, 1.3, 2.61])
SPEED = np.array([9.0, 9.0, 20.0, 20.0] * 2)


def clip(name="a", frames=10, **changes) -> MotionClip:
    arms = np.linspace(0.0, 0.3, frames)[:, None] * np.arange(1.0, 9.0)
    arms[:, [5]] *= -1.0
    arms[:, 6] = 0.0
    root = np.column_stack((np.linspace(0, 1, frames), np.linspace(0, 0.5, frames), np.linspace(0, 0.2, frames)))
    fields = {"name": name, "arms": 0.3 * arms.astype(np.float32), "root": root.astype(np.float32),
              "source": "made", "licence": "none"}  # fmt: skip
    return MotionClip(**(fields | changes))


def test_a_library_comes_back(tmp_path, spec):
    library = MotionLibrary([clip("a"), clip("b", 25, mirrored=True)], spec)
    library.save(tmp_path / "x.npz")
    again = MotionLibrary.load(tmp_path / "x.npz", spec)
    for a, b in zip(library.clips, again.clips, strict=True):
        np.testing.assert_array_equal(a.arms, b.arms)
        np.testing.assert_array_equal(a.root, b.root)
        assert (a.name, a.source, a.licence, a.mirrored) == (b.name, b.source, b.licence, b.mirrored)
    assert list(tmp_path.iterdir()) == [tmp_path / "x.npz"]  # no temporary file is left


def test_a_library_is_readable_and_on_the_disk_or_not_written(tmp_path, spec, monkeypatch):
    """As any other file that the umask allows to be read; synced before it takes the old one's place."""
    done: list[str] = []
    fsync, replace_file = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append("sync"), fsync(handle)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append("rename"), replace_file(a, b)))
    path = tmp_path / "x.npz"
    before = os.umask(0o022)
    try:
        MotionLibrary([clip("a")], spec).save(path)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    assert done[:2] == ["sync", "rename"]
    whole = path.read_bytes()

    def fail(file, **_):
        file.write(b"part")
        raise OSError("full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="full"):
        MotionLibrary([clip("b")], spec).save(path)
    assert path.read_bytes() == whole
    assert list(tmp_path.iterdir()) == [path]


def test_select_and_unknown_names(spec):
    library = MotionLibrary([clip("a"), clip("b")], spec)
    assert library.select(["b"], spec).names() == ["b"]
    with pytest.raises(MotionError, match="no clip is called 'c'; clips: a, b"):
        library.select(["c"], spec)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arms": np.zeros((10, 7), np.float32)}, r"arms must have shape \(T, 8\), got \(10, 7\)"),
        ({"root": np.zeros((9, 3), np.float32)}, r"root must have shape \(10, 3\)"),
        ({"arms": np.zeros((1, 8), np.float32), "root": np.zeros((1, 3), np.float32)}, "has 1 frames"),
        ({"arms": np.full((10, 8), np.nan, np.float32)}, "not finite"),
        ({"arms": np.full((10, 8), 3.0, np.float32)}, "left_shoulder_pitch is 3.000 rad|right_shoulder_roll is 3.000"),
    ],
)
def test_bad_clips_are_refused(spec, change, message):
    with pytest.raises(MotionError, match=message):
        MotionLibrary([clip(**change)], spec)


def test_no_clips_and_double_names_are_refused(spec):
    with pytest.raises(MotionError, match="at least one clip"):
        MotionLibrary([], spec)
    with pytest.raises(MotionError, match="two clips are called 'a'"):
        MotionLibrary([clip("a"), clip("a")], spec)


def saved(tmp_path, spec, **changes):
    MotionLibrary([clip("a")], spec).save(tmp_path / "x.npz")
    content = dict(np.load(tmp_path / "x.npz")) | changes
    np.savez(tmp_path / "x.npz", **{k: v for k, v in content.items() if v is not None})
    return tmp_path / "x.npz"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arms": None}, "lacks 'arms'"),
        ({"joints": np.array(["a"] * 8)}, "is for the arms of"),
        ({"robot": "g1"}, "is for the arms of 'g1'"),
        ({"fps": 30.0}, "at 30.0 Hz"),
        ({"version": 2}, "has version 2"),
        ({"lengths": np.array([11])}, "do not add up"),
        ({"lengths": np.array([5, 5])}, "entries for 1 clips"),
        ({"fps": "abc"}, r"fps must have 0 dimensions and dtype kind f or i or u, got <U3 of shape \(\)"),
        ({"fps": np.array([50.0, 50.0])}, r"fps must have 0 dimensions .* of shape \(2,\)"),
        ({"version": 1.5}, "version must have 0 dimensions and dtype kind i or u, got float64"),
        ({"names": np.array("a")}, "names must have 1 dimensions"),
        ({"lengths": np.array([10.0])}, "lengths must have 1 dimensions and dtype kind i or u, got float64"),
        # 64 bits wrap to the right number of frames.
        ({"lengths": np.array([2**63 - 1, 2**63 - 1, 12]), "names": np.array(["a", "b", "c"]),
          "sources": np.array(3 * ["-"]), "licences": np.array(3 * ["-"]), "mirrored": np.zeros(3, bool)},
         "do not add up"),
        ({"lengths": np.array([], int), "names": np.array([], str), "sources": np.array([], str),
          "licences": np.array([], str), "mirrored": np.array([], bool)}, "do not add up"),
        ({"joints": np.arange(8)}, "joints must have 1 dimensions and dtype kind U, got int64"),
        ({"joints": np.array("a")}, "joints must have 1 dimensions"),
        ({"arms": np.full((10, 8), "x")}, "arms must have 2 dimensions and dtype kind f, got <U1"),
        ({"root": np.zeros(10)}, "root must have 2 dimensions"),
        ({"arms": np.array([{"evil": 1}], dtype=object)}, "has arms as Python objects, which could run code"),
    ],
)  # fmt: skip
def test_files_that_are_wrong_are_named(tmp_path, spec, changes, message):
    with pytest.raises(MotionError, match=message):
        MotionLibrary.load(saved(tmp_path, spec, **changes), spec)


def test_missing_and_damaged_files(tmp_path, spec):
    with pytest.raises(MotionError, match="does not exist"):
        MotionLibrary.load(tmp_path / "no.npz", spec)
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(MotionError, match="is no file but a folder"):
        MotionLibrary.load(tmp_path, spec)
    with pytest.raises(MotionError, match="damaged"):
        MotionLibrary.load(tmp_path / "text.npz", spec)


def test_mirroring_reflects_the_hands(spec):
    """Against forward kinematics: the mirrored left hand is the right hand's reflection."""
    original = clip(frames=30)
    mirrored = mirror_clip(spec, original)
    hands = forward_kinematics(spec, original.arms)[2]
    image = forward_kinematics(spec, mirrored.arms)[2]
    np.testing.assert_allclose(image[:, 0], hands[:, 1] * [1, -1, 1], atol=1e-5)
    np.testing.assert_allclose(image[:, 1], hands[:, 0] * [1, -1, 1], atol=1e-5)
    np.testing.assert_array_equal(mirrored.root, original.root * np.array([1, -1, -1], np.float32))
    again = mirror_clip(spec, mirrored)
    np.testing.assert_array_equal(again.arms, original.arms)


def test_speed_limit_by_hand():
    """A step of 4 at 1 a frame: forwards it lags, backwards it leads, the mean is a ramp about the step."""
    x = np.array([0.0, 0, 0, 0, 4, 4, 4, 4, 4])[:, None]
    limited = limit_speed(x, np.array([1.0]))[:, 0]
    assert np.abs(np.diff(limited)).max() <= 1.0
    assert limited.tolist() == [0.0, 0.5, 1.0, 1.5, 2.5, 3.0, 3.5, 4.0, 4.0]
    np.testing.assert_array_equal(limit_speed(x, np.array([5.0])), x)


def motion(arms: np.ndarray, fps=50.0) -> JointMotion:
    return JointMotion("made", np.arange(len(arms)) / fps, arms, np.zeros((len(arms), 3)))


def test_made_clips_keep_to_all_limits(spec):
    """Wild joints: what comes out is inside limits and speeds, and says how much was changed."""
    t = np.arange(200)[:, None] / 50.0
    wild = 4.0 * np.sin(t * np.array([5.0, 9.0, 13.0, 7.0, 6.0, 8.0, 12.0, 11.0]))
    made, report = make_clip(spec, motion(wild), "made", "none")
    assert (made.arms >= LOW.astype(np.float32)).all()
    assert (made.arms <= HIGH.astype(np.float32)).all()
    assert (np.abs(np.diff(made.arms, axis=0)) * 50.0 <= SPEED + 1e-3).all()
    assert report.clipped_fraction > 0.5
    assert report.slowed_fraction > 0.5


def test_tame_clips_are_left_alone(spec):
    t = np.arange(200)[:, None] / 50.0
    tame = 0.2 * np.sin(t * np.arange(1.0, 9.0) / 4.0)
    made, report = make_clip(spec, motion(tame), "made", "none")
    np.testing.assert_allclose(made.arms, tame, atol=1e-6)
    assert (report.clipped_fraction, report.slowed_fraction) == (0.0, 0.0)
    quality = assess(spec, motion(tame), made, report)
    assert quality.hand_path_error_m == pytest.approx(0.0, abs=1e-5)
    assert quality.seconds == pytest.approx(3.98)


def test_headings_are_unwrapped(spec):
    angle = np.linspace(0.0, 4.0, 100)
    root = np.column_stack((np.zeros(100), np.zeros(100), (angle + np.pi) % (2 * np.pi) - np.pi))
    made, _ = make_clip(spec, replace(motion(np.zeros((100, 8))), root=root), "made", "none")
    np.testing.assert_allclose(made.root[:, 2], angle, atol=1e-5)


@pytest.mark.parametrize(
    ("arms", "times", "message"),
    [
        (np.zeros((1, 8)), np.zeros(1), "has 1 frames"),
        (np.full((5, 8), np.inf), np.arange(5.0), "arm joints are not finite at frame 0"),
        (np.zeros((5, 8)), np.array([0.0, 1.0, 1.0, 2.0, 3.0]), "times do not grow"),
        (np.zeros((5, 8)), np.arange(5.0) * 1e-3, "lasts 0.004 s; it must last 0.02 to 3600 s"),
        (np.zeros((5, 7)), np.arange(5.0), "do not fit"),
    ],
)
def test_motions_that_cannot_become_clips(spec, arms, times, message):
    with pytest.raises(MotionError, match=message):
        make_clip(spec, JointMotion("made", times, arms, np.zeros((len(arms), 3))), "made", "none")


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_the_shipped_library_keeps_its_promises(name):
    spec = ROBOTS[name]()
    joints = [spec.joints[i] for i in spec.indices(spec.upper_joints)]
    low, high = np.array([j.range_rad for j in joints]).T
    library = shipped_library(spec)
    assert len(library.clips) == 40
    assert {"walk", "run", "punch", "kick", "dance_a", "dance_b", "jump", "spin", "crawl"} <= set(library.names())
    for c in library.clips:
        assert (c.arms >= low.astype(np.float32)).all(), c.name
        assert (c.arms <= high.astype(np.float32)).all(), c.name
        speed = np.array([j.velocity_limit_rad_s for j in joints])
        assert (np.abs(np.diff(c.arms, axis=0)) * 50.0 <= speed + 1e-2).all(), c.name
        assert c.licence == "MIT"
        assert "DeepMimic" in c.source
    originals = [c for c in library.clips if not c.mirrored]
    for original, image in zip(originals, [c for c in library.clips if c.mirrored], strict=True):
        np.testing.assert_array_equal(mirror_clip(spec, original).arms, image.arms)
    run = library.select(["run"], spec).clips[0]
    assert np.linalg.norm(run.root[-1, :2] - run.root[0, :2]) / run.seconds > 2.0  # it runs
