"""Recordings: what goes in comes out, is measured, and nothing foreign is let in."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from cotap.evaluate import main as evaluate
from cotap.evaluation.recording import RecordingError, first_force, load_recording
from cotap.play.forces import Push
from cotap.play.recorder import Recorder, samples_of


@pytest.fixture(scope="module")
def recording(shared_session):
    session = shared_session
    recorder = Recorder(session.dt, 2, session.describe())
    session.set({"b.left.law": "pd"})
    for step in range(90):
        if step == 30:
            session.push(Push("left", (60.0, 0.0, 0.0), 0.1))
        changes = {"b.left.law": "pd", "a.left.drag": (0.0, 0.0, 0.0)} if step == 5 else {}
        recorder.append(session.step(), changes)
    return recorder.finish()


def test_what_was_recorded_is_read_back_and_measured(recording, tmp_path):
    path = tmp_path / "r.npz"
    recording.save(path)
    again = load_recording(path)
    assert again.settings == json.loads(json.dumps(recording.settings))
    assert again.settings["changes"] == [{"time": pytest.approx(0.1), "values": {"b.left.law": "pd"}}]
    for one, other in zip(samples_of(recording), samples_of(again), strict=True):
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name])
    assert first_force(again) == (pytest.approx(0.6), "left")
    status = evaluate(["recording", "--file", str(path), "--window-seconds", "0.5", "--json", str(tmp_path / "r.json")])
    assert status == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["num_envs"] == 2
    hit = recording.trajectory.hand_error[30:55, :, 0].mean(0)
    assert result["metrics"]["force_e_ee_hit"]["mean"] == pytest.approx(float(hit.mean()), rel=1e-5)
    assert [r["force_e_ee_hit"] for r in result["robots"]] == pytest.approx(hit.tolist(), rel=1e-5)
    assert hit[0] != pytest.approx(float(hit[1]), rel=0.02)  # the laws differ


def test_files_that_are_no_recordings_are_refused_by_name(recording, tmp_path, capsys):
    whole = tmp_path / "whole.npz"
    recording.save(whole)
    bad = {
        "absent.npz": None,
        "truncated.npz": whole.read_bytes()[:5000],
        "text.npz": b"hello",
    }
    for name, content in bad.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(RecordingError, match=name):
            load_recording(tmp_path / name)
    np.savez(tmp_path / "foreign.npz", a=np.zeros(3))
    with pytest.raises(RecordingError, match=r"foreign.npz"):
        load_recording(tmp_path / "foreign.npz")
    assert evaluate(["recording", "--file", str(tmp_path / "foreign.npz")]) == 2
    assert evaluate(["recording"]) == 2
    assert "--file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("scene.qpos", lambda a: a[:-1]),
        ("scene.qpos", lambda a: a * np.nan),
        ("trajectory.velocity", lambda a: a.astype(object)),
        ("trajectory.dt", lambda a: a * 0.0),
        ("trajectory.dt", lambda a: np.array([a, a])),
        ("trajectory.velocity", lambda a: a[..., :2]),
        ("trajectory.fell", lambda a: a.astype(np.float32)),
        ("trajectory.height", lambda a: a.astype(">f4")),
        ("trajectory.hand_error", lambda a: a[..., :1]),
        ("trajectory.arm_torque", lambda a: a[..., :0]),
        ("trajectory.arm_torque", lambda a: a * np.float32(1e30)),
        ("scene.hand_w", None),
    ],
)
def test_arrays_that_do_not_fit_are_refused_by_name(recording, tmp_path, name, change):
    path = tmp_path / "r.npz"
    recording.save(path)
    arrays = dict(np.load(path))
    if change is None:
        del arrays[name]
    else:
        arrays[name] = change(arrays[name])
    np.savez(path, **arrays)
    with pytest.raises(RecordingError, match=r"r\.npz"):
        load_recording(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.clear(), "settings.sides must name the hands"),
        (lambda s: s.update(gait_period_s=0.0), r"gait_period_s must lie in \[0.1, 10.0\], got 0.0"),
        (lambda s: s.update(gait_period_s=[1]), r"gait_period_s must be a finite number, got \[1\]"),
        (lambda s: s.update(sides=["left", "left"]), "settings.sides"),
        (lambda s: s.update(sides=["left"]), r"hand_offset has shape .* H = 1"),
        (lambda s: s.update(robot=["h1"]), "settings.robot must be a name"),
        (lambda s: s.update(values={"a": float("inf")}), "settings must be a finite number, got inf"),
        (lambda s: s.update(values=json.loads("[" * 20 + "]" * 20)), "nested more than 8 deep"),
    ],
)
def test_settings_that_are_none_are_refused_by_name(recording, tmp_path, change, message):
    path = tmp_path / "r.npz"
    settings = json.loads(json.dumps(recording.settings))
    change(settings)
    replace(recording, settings=settings).save(path)
    with pytest.raises(RecordingError, match=rf"r\.npz.*{message}"):
        load_recording(path)


def test_a_head_nested_without_end_is_refused(recording, tmp_path):
    path = tmp_path / "r.npz"
    recording.save(path)
    np.savez(path, **(dict(np.load(path)) | {"head": "[" * 100_000}))
    with pytest.raises(RecordingError, match=r"r\.npz"):
        load_recording(path)


def test_a_recording_without_steps_is_none(session):
    with pytest.raises(ValueError, match="nothing was recorded"):
        Recorder(session.dt, 1, session.describe()).finish()
