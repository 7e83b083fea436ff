"""The page's program without a browser: the loop, recordings, the port, the command line."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from random_policy import save_random_policy
from viser import ViserServer

from cotap.evaluation.recording import load_recording
from cotap.play import ROBOTS
from cotap.play.__main__ import PlayOptions, _live, main, restart
from cotap.play.app import START, STOP, App
from cotap.play.controls import Refused
from cotap.play.forces import Push
from cotap.play.mailbox import Record, Reset, Step
from cotap.play.panel import STEP
from cotap.play.plots import Plots, force_displacement
from cotap.play.scene import Scene
from cotap.play.server import PortTaken, open_server
from cotap.play.session import Session


def scene(server: ViserServer, session: Session) -> Scene:
    return Scene(server, session.env.spec, len(ROBOTS))


@pytest.fixture
def app(session, server, tmp_path):
    return App(server, scene(server, session), session, tmp_path / "out")


def test_mail_reaches_the_simulation_and_bad_mail_does_not(app):
    app.mailbox.set("a.left.stiffness_x", 700.0)
    for value in (float("nan"), "soft", None):
        with pytest.raises(Refused):
            app.mailbox.set("a.left.stiffness_x", value)
    app.mailbox.set("a.right.stiffness_x", 1e12)
    app.advance()
    stiffness = app.session.env.upper_body.parameters.stiffness[0, :, 0]
    assert stiffness.tolist() == [700.0, 1500.0]


@pytest.mark.parametrize("ending", [KeyboardInterrupt, RuntimeError])
def test_what_was_recorded_is_kept_whatever_ends_the_page(app, monkeypatch, capsys, ending):
    app.mailbox.ask(Record(True))
    app.advance()

    def end():
        raise ending

    monkeypatch.setattr(app, "_draw_until_stopped", end)
    with pytest.raises(ending):
        app.run()
    assert len(load_recording(app.archive.path).trajectory.fell) >= 1
    assert str(app.archive.path) in capsys.readouterr().out


def test_the_page_shows_what_was_accepted_not_what_was_sent(app):
    alpha = app.panel._handles["a.left.alpha"]
    for sent, shown in ((0.25, 0.25), (float("nan"), 0.25), (7.0, 1.0)):
        alpha._impl.value = sent  # as a browser's message does
        app.panel._set("a.left.alpha", sent, None)
        if sent != shown:
            assert alpha.value == shown
    app.advance()
    assert float(app.session.env.upper_body.parameters.alpha[0, 0]) == 1.0


@pytest.fixture
def notices(app, monkeypatch):
    shown = []
    monkeypatch.setattr(app.notices, "tell", lambda text, *_, **__: shown.append(text))
    return shown


def test_a_push_is_made_of_what_was_accepted_and_notices_say_what_was_not(app, notices):
    shown = app.panel._handles
    for name, sent, used in (
        ("hand", "right", "right"), ("hand", "head", "right"), ("force", 1e9, 600.0), ("force", float("nan"), 600.0),
        ("seconds", 99.0, 5.0), ("seconds", 0.1, 0.1),
    ):  # fmt: skip
        before = len(notices)
        shown[f"push.{name}"]._impl.value = sent  # as a browser's message does
        app.panel._set(f"push.{name}", sent, None)
        assert shown[f"push.{name}"].value == used
        assert len(notices) - before == (sent != used)
    assert app.panel._push((0.0, 0.0, -1.0)) == Push("right", (0.0, 0.0, -600.0), 0.1)


def shown(app, *names):
    return [app.panel._handles[name].value for name in names]


def test_a_velocity_ends_standing_and_standing_ends_velocities(app):
    def ask(name, value, newest=None):
        app.panel._handles[name].value = value if newest is None else newest
        app.mailbox.set(name, value)

    names = ("stand", "velocity_x", "velocity_y", "yaw_rate")
    ask("velocity_x", 0.3, newest=0.35)  # a slider is many values: the newest stays, though it is still on its way
    app.advance()
    assert app.session.values["velocity_x"] == 0.3
    assert shown(app, *names) == [False, 0.35, 0.0, 0.0]
    ask("yaw_rate", 0.2)
    app.advance()
    ask("stand", True)
    app.advance()
    assert shown(app, *names) == [True, 0.0, 0.0, 0.0]
    assert app.session.env.commands.asked_to_stand.all()
    ask("velocity_x", 0.3)
    ask("stand", True)
    app.advance()
    assert shown(app, *names) == [True, 0.0, 0.0, 0.0]


def choose(app, robot):
    """As a viewer does, who has the list open."""
    handle = next(h for h in app.server.gui._gui_input_handle_from_uuid.values() if getattr(h, "label", "") == "robot")
    handle._impl.value = robot
    event = SimpleNamespace(client_id=1, client=None, target=handle)
    asyncio.run(handle._impl.update_cb[0](event))
    return handle


@pytest.mark.usefixtures("two_shipped")
def test_another_robot_is_chosen_and_the_first_one_again(server, checkpoint, tmp_path):
    options = PlayOptions(checkpoint=(str(checkpoint),), output=str(tmp_path / "out"))
    app = _live(options)(server)
    assert choose(app, "h1").options == ("h1", "g1")
    app.mailbox.ask(Record(True))
    app.mailbox.set("a.left.stiffness_x", 700.0)
    app.advance()
    choose(app, "g1")
    assert app.run() == "g1"
    assert len(load_recording(app.archive.path).trajectory.fell) >= 1  # what was recorded is kept
    other = restart(server, options, "g1")
    assert other.session.env.spec.name == "g1"
    assert other.session.controls["a.checkpoint"].options == ("shipped g1-base",)
    assert other.session.values["a.left.stiffness_x"] == 300.0
    other.advance()
    other.scene.show(other._latest[1])
    assert choose(other, "h1").options == ("h1", "g1")
    first = restart(server, options, other.run())
    assert first.session.controls["a.checkpoint"].options == (str(checkpoint), "shipped h1-base")
    first.advance()
    first.scene.show(first._latest[1])


@pytest.mark.usefixtures("two_shipped")
def test_a_robot_that_is_not_offered_or_comes_while_a_film_is_made_is_refused(server, tmp_path):
    told = []
    app = _live(PlayOptions(output=str(tmp_path)))(server)
    app.notices.tell = lambda text, *_: told.append(text)
    assert choose(app, "atlas").value == "h1"
    app.archive.filming.set()
    assert choose(app, "g1").value == "h1"
    app.archive.filming.clear()
    assert told == [
        "robot 'atlas' is unknown; known: h1, g1",
        "a film is being made; choose a robot when it is done",
    ]
    assert not app._stop.is_set()


def test_what_does_nothing_at_present_is_grey(app):
    def grey():
        app.panel.grey(app.without_effect())
        return {name for name, handle in app.panel._handles.items() if handle.disabled}

    stiffness = {f"a.left.{part}" for part in ("stiffness_x", "stiffness_y", "stiffness_z", "alpha", "passive")}
    assert grey() >= {STEP, STOP}
    assert not grey() & {*stiffness, "speed", START}
    app.mailbox.set("a.left.law", "pd")
    app.mailbox.set("paused", True)
    app.mailbox.ask(Record(True))
    app.advance()
    assert grey() >= {*stiffness, "speed", START}
    assert not grey() & {"a.right.alpha", "a.left.law", STEP, STOP}
    app.mailbox.set("a.left.law", "cotap")
    app.advance()
    assert not grey() & stiffness


def test_a_drag_out_of_reach_gets_one_notice(app, notices):
    def drag(phase, *point):
        event = SimpleNamespace(instance_index=1, phase=phase, end_position=point, client=None)
        asyncio.run(app._drag(event))

    for _ in range(2):
        drag("start", 0.0, 0.0, 1.0)
        for _ in range(20):
            drag("update", 1e9, 0.0, 1.0)
            drag("update", float("nan"), 0.0, 1.0)
        app.advance()
        assert app.session.values["a.right.drag"] == (1e3, 0.0, 1.0)
        drag("end", 0.0, 0.0, 1.0)
    assert len(notices) == 2
    assert "drag 1e+09 is outside" in notices[0]
    app.advance()
    assert app.session.values["a.right.drag"] is None


@pytest.mark.parametrize("index", [None, -1, 4])
def test_a_drag_of_no_hand_on_the_page_does_nothing(app, notices, index):
    before = dict(app.session.values)
    event = SimpleNamespace(instance_index=index, phase="start", end_position=(0.0, 0.0, 1.0), client=None)
    asyncio.run(app._drag(event))
    app.advance()
    assert app.session.values == before
    assert not notices


def test_paused_it_stands_still_but_for_single_steps_and_reset_starts_over(app):
    app.advance()
    app.mailbox.set("paused", True)
    app.advance()
    before = app.session.num_steps
    app.advance()
    app.mailbox.ask(Step())
    app.advance()
    app.advance()
    assert app.session.num_steps == before + 1
    for _ in range(3):
        app.mailbox.ask(Step())
    app.advance()
    assert app.session.num_steps == before + 4
    app.archive.filming.set()
    app.mailbox.ask(Step())
    app.advance()
    assert app.session.num_steps == before + 4
    app.mailbox.ask(Reset())
    app.advance()
    assert int(app.session.env.episode_length_buf[0]) == 0


def test_a_recording_that_cannot_be_written_is_tried_again(app, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    keep = app.archive.keep
    monkeypatch.setattr(app.archive, "keep", full)
    for asked in (True, False):
        app.mailbox.ask(Record(asked))
        app.advance()
    assert "not recorded: " in capsys.readouterr().err
    monkeypatch.setattr(app.archive, "keep", keep)
    monkeypatch.setattr(app, "_draw_until_stopped", lambda: None)
    app.run()
    assert len(load_recording(app.archive.path).trajectory.fell) >= 1


def test_a_recording_holds_what_was_shown_and_a_change_of_robots_ends_it(app):
    app.mailbox.ask(Record(True))
    for step in range(30):
        if step == 10:
            app.mailbox.ask(Push("right", (0.0, 0.0, -30.0), 0.2))
        app.advance()
    app.mailbox.set("side_by_side", True)
    app.advance()
    recording = load_recording(app.archive.path)
    assert recording.trajectory.fell.shape == (30, 1)
    loaded = np.abs(recording.scene["hand_force_w"][:, 0, 1]).max(1) > 1.0
    assert loaded.nonzero()[0].tolist() == list(range(10, 20))
    app.mailbox.ask(Record(True))
    app.advance()
    app.mailbox.ask(Record(False))
    app.advance()
    assert app.archive.path.name == "recording_002.npz"


def test_a_recording_logs_what_came_into_force_pauses_included(app):
    app.mailbox.set("a.left.alpha", 0.75)
    app.mailbox.ask(Record(True))
    app.advance()
    app.mailbox.set("paused", True)
    app.mailbox.set("a.left.stiffness_x", 600.0)
    app.advance()
    app.mailbox.set("a.left.stiffness_x", 700.0)
    app.mailbox.set("a.checkpoint", "missing")  # cannot be read: not in force
    app.advance()
    app.mailbox.set("paused", False)
    app.advance()
    app.mailbox.set("stand", False)
    app.advance()
    app.mailbox.ask(Record(False))
    app.advance()
    settings = load_recording(app.archive.path).settings
    assert settings["values"]["a.left.alpha"] == 0.75
    assert settings["values"]["a.left.stiffness_x"] == 300.0
    dt = app.session.dt
    assert settings["changes"] == [
        {"time": dt, "values": {"a.left.stiffness_x": 700.0, "paused": False}},
        {"time": 2 * dt, "values": {"stand": False}},
    ]


def test_a_checkpoint_that_is_refused_is_shown_as_it_was(app):
    app.mailbox.set("a.checkpoint", "missing")
    app.advance()
    assert app.panel._handles["a.checkpoint"].value == "base"


def test_a_policy_that_was_trained_with_another_stride_runs_and_a_notice_says_so(
    server, tmp_path, checkpoint, monkeypatch
):
    two = Session({"one": checkpoint, "other": checkpoint})
    app = App(server, scene(server, two), two, tmp_path)
    notices = []
    monkeypatch.setattr(app.notices, "tell", lambda text, title: notices.append((title, text)))
    app.mailbox.set("b.checkpoint", "other")
    app.advance()
    assert notices == []
    monkeypatch.setattr(two.env.cfg.gait, "period_s", 1.0)
    app.mailbox.set("b.checkpoint", "one")
    app.advance()
    assert notices == [("robot B: another gait", "one was trained with a stride of 0.8 s; here it is 1 s")]
    assert app.session.num_steps == 2


def test_no_browser_is_asked_for_an_environment_map_and_for_shadows_only_when_they_are_wanted(app):
    def last(kind):
        messages = app.server._websock_server._broadcast_buffer.message_from_id.values()
        return [m for m in messages if type(m).__name__ == kind][-1]

    assert last("EnvironmentMapMessage").hdri_data is None
    assert not last("EnableLightsMessage").cast_shadow
    app.scene.cast_shadows(True)
    assert last("EnableLightsMessage").cast_shadow


def test_a_simulation_that_fails_ends_the_program_and_says_why(app, monkeypatch):
    monkeypatch.setattr(app.session, "step", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        app.run()


def test_a_camera_that_follows_keeps_robots_in_sight_and_one_that_does_not_finds_them_after_a_reset(app, session):
    def seen(sample):
        app.scene.show(sample)
        return app.scene.hands.batched_positions[0, :2] - (sample["hand_w"][0, 0, :2] - sample["qpos"][0, :2])

    def walked(sample, ahead):
        moved = {name: value.copy() for name, value in sample.items()}
        for name in ("qpos", "hand_w", "hand_reference_w"):
            moved[name][..., 0] += ahead
        return moved

    sample = session.step()
    for ahead in (0.0, 0.5, 1.0, 1.5):
        np.testing.assert_allclose(seen(walked(sample, ahead)), 0.0, atol=1e-5)
    app.scene.follow = False
    np.testing.assert_allclose(seen(walked(sample, 1.5)), 0.0, atol=1e-5)  # nothing moves as it is switched off
    np.testing.assert_allclose(seen(walked(sample, 2.0)), [0.5, 0.0], atol=1e-5)
    np.testing.assert_allclose(seen(walked(sample, 2.8)), [1.3, 0.0], atol=1e-5)
    np.testing.assert_allclose(seen(sample), 0.0, atol=1e-5)  # put back to where it started
    np.testing.assert_allclose(seen(walked(sample, 0.5)), [0.5, 0.0], atol=1e-5)


def test_the_plot_of_force_over_displacement_takes_loaded_steps_along_the_force(session):
    sample = session.step()
    loaded = {k: v.copy() for k, v in sample.items()}
    loaded["hand_force_w"][0, 0] = (0.0, 0.0, -20.0)
    loaded["hand_w"][0, 0] = loaded["hand_reference_w"][0, 0] + np.array([0.01, 0.0, -0.05])
    force, along = force_displacement([sample, loaded], 0, 0)
    assert force.tolist() == [20.0]
    assert along == pytest.approx([50.0], rel=1e-4)
    assert len(Plots.TITLES) == len(Plots.AXES) == 7


def test_of_a_taken_port_the_error_says_what_to_do(free_port, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", free_port))
        taken.listen()
        with pytest.raises(PortTaken, match=f"--port {free_port + 1}"):
            open_server("127.0.0.1", free_port)
        assert main(["--port", str(free_port)]) == 2
    assert "another cotap play" in capsys.readouterr().err


def test_what_cannot_be_shown_is_refused_before_anything_runs(free_port, tmp_path, capsys):
    assert main(["--port", "0"]) == 2
    assert main(["--port", str(free_port), "--replay", str(tmp_path / "none.npz")]) == 2
    assert main(["--port", str(free_port), "--checkpoint", str(tmp_path / "none.pt")]) == 2
    assert main(["--port", str(free_port), "--robot", "atlas"]) == 2
    assert main(["--port", str(free_port), "--checkpoint", "h1-base", str(tmp_path / "none-either.pt")]) == 2
    assert main(["--port", str(free_port), "--library", str(tmp_path / "none-of-mine.npz")]) == 2
    out, err = capsys.readouterr()
    assert "http" not in out  # no page was opened, nor announced
    assert "none-either.pt" in err
    assert "none-of-mine.npz' does not exist" in err
    assert "none.npz" in err
    assert "none.pt" in err
    assert "robot 'atlas' is unknown" in err
    for option in ("robot", "checkpoint"):
        assert main(["--port", str(free_port), "--replay", str(tmp_path / "none.npz"), f"--{option}", "h1"]) == 2
        assert "leave out --robot and --checkpoint with --replay" in capsys.readouterr().err
    for option in ("library", "output", "seed"):
        assert main(["--port", str(free_port), "--replay", str(tmp_path / "none.npz"), f"--{option}", "7"]) == 2
        assert f"--{option} does nothing with --replay" in capsys.readouterr().err
    assert main(["--port", str(free_port), "--checkpoint", "policy.pt", "--robot", "h1"]) == 2
    assert "leave out --robot with --checkpoint" in capsys.readouterr().err
    assert main(["--port", str(free_port), "--robot", "made-up"]) == 2  # nobody trains it
    out, err = capsys.readouterr()
    assert "no policy of robot 'made-up' is shipped" in err
    assert "http" not in out


def test_checkpoints_of_two_robots_are_refused(free_port, tmp_path, capsys):
    paths = [str(save_random_policy(tmp_path / f"{robot}.pt", robot=robot)) for robot in ("h1", "made-up")]
    assert main(["--port", str(free_port), "--checkpoint", *paths]) == 2
    assert f"checkpoint {paths[1]!r} is of robot 'made-up', the first one of 'h1'" in capsys.readouterr().err


def test_a_checkpoint_brings_its_robot_and_comes_before_the_shipped_policies(server, tmp_path, monkeypatch):
    path = save_random_policy(tmp_path / "policy.pt", robot="made-up")
    monkeypatch.setattr("cotap.evaluation.policy.shipped_names", lambda: ["h1-base", "made-up-base", "made-up-cotap"])
    monkeypatch.setattr("cotap.evaluation.policy.shipped_checkpoint", Path)
    app = _live(PlayOptions(checkpoint=(str(path),)))(server)
    assert app.session.env.spec.name == "made-up"
    assert app.session.controls["a.checkpoint"].options == (
        str(path), "shipped made-up-cotap", "shipped made-up-base",
    )  # fmt: skip
    for _ in range(4):  # two points of each plot
        app.advance()
    app.plots.draw(2)
    for plot, (x, y) in zip(app.plots._sets[2], Plots.AXES, strict=True):
        assert [axis.get("label") for axis in plot.axes or ()] == [x, y]
    app.scene.show(app._latest[1])
