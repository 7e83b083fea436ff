"""A recording shown again: the time and the speed that people ask for, what is drawn then, and its download."""

from __future__ import annotations

import asyncio
import html
import re
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from viser import GuiEvent

from cotap.checks import legible
from cotap.play.recorder import samples_of
from cotap.play.replay import Replay, plain_text


@pytest.fixture
def replay(server, record, tmp_path, monkeypatch):
    recording = record(40, 2)
    path = tmp_path / "walk.npz"
    recording.save(path)
    replay = Replay(server, recording, path)
    replay.notices = []
    monkeypatch.setattr(replay._notices, "tell", lambda text, *_: replay.notices.append(text))
    return replay


def send(handle, value):
    """What the server does with a browser's message."""
    handle._impl.value = value

    async def update():
        for callback in handle._impl.update_cb:
            await callback(GuiEvent(None, 1, handle))

    asyncio.run(update())


def slider(replay, label):
    handles = replay.scene._server.gui._gui_input_handle_from_uuid.values()
    (handle,) = (h for h in handles if getattr(h, "label", "") == label)
    return handle


def test_it_goes_on_with_the_clock_and_begins_again_at_its_end(replay):
    assert replay.advance(0.1) == 5
    assert replay._time.value == pytest.approx(0.1)
    send(slider(replay, "speed"), 2.0)
    assert replay.advance(0.1) == 15
    assert replay.advance(0.3) == 5
    replay._playing.value = False
    assert replay.advance(0.1) == 5
    assert replay.notices == []


def test_what_is_drawn_is_the_step_that_was_sought(replay):
    replay._playing.value = False
    samples = samples_of(replay._archive.newest)
    for step in (29, 0, 39):
        send(replay._time, round(step * 0.02, 6))
        assert replay.advance(0.0) == step
        hands = replay.scene.hands.batched_positions.reshape(2, 2, 3)
        drawn = [replay.scene.to_robot(hands[i, 1], i) for i in range(2)]
        np.testing.assert_allclose(drawn, samples[step]["hand_w"][:, 1], atol=1e-5)
    assert replay.notices == []


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_time_or_speed_that_is_no_number_is_refused_and_what_was_is_shown(replay, value):
    speed = slider(replay, "speed")
    send(replay._time, 0.2)
    send(speed, 0.5)
    for handle, kept in ((replay._time, 0.2), (speed, 0.5)):
        send(handle, value)
        assert handle.value == kept
    assert len(replay.notices) == 2
    assert all("must be a finite number" in text for text in replay.notices)
    assert replay.advance(0.2) == 15


def test_a_time_or_speed_out_of_range_is_moved_to_its_end_and_a_notice_says_so(replay):
    speed = slider(replay, "speed")
    for handle, sent, used in ((replay._time, 1e9, 0.78), (speed, 1e9, 4.0), (replay._time, -1.0, 0.0)):
        send(handle, sent)
        assert handle.value == pytest.approx(used)
    assert len(replay.notices) == 3
    assert all("is outside" in text for text in replay.notices)
    assert replay.advance(0.05) == 10


def test_it_runs_until_it_is_stopped_and_draws_nothing_while_a_film_is_made(replay, monkeypatch):
    drawn = threading.Event()
    monkeypatch.setattr(replay, "advance", lambda _: drawn.set() or 3)
    replay._archive.drawing.acquire()
    thread = threading.Thread(target=replay.run, daemon=True)
    thread.start()
    assert not drawn.wait(0.3)
    replay._archive.drawing.release()
    assert drawn.wait(10.0)
    replay.stop()
    thread.join(10.0)
    assert not thread.is_alive()


def test_the_recording_is_downloaded_as_it_was_read(replay):
    sent = []
    client = SimpleNamespace(send_file_download=lambda name, content: sent.append((name, content)))
    button = slider(replay, "Download the recording")
    for callback in button._impl.update_cb:
        callback(GuiEvent(client, 1, button))
    assert sent == [("walk.npz", replay._archive.path.read_bytes())]
    for callback in button._impl.update_cb * 20:
        callback(GuiEvent(client, 1, button))
    assert len(sent) == 1
    assert replay.notices == ["once in 10 s"] * 20
    for callback in button._impl.update_cb:
        callback(GuiEvent(client, 2, button))
    assert len(sent) == 2


@pytest.mark.parametrize(
    "name",
    [
        "<img src=x onerror=alert(1)>.npz", "![a](https:evil.example).npz", "[a](https:evil.example).npz",
        "www.evil.example", "a**b_c_`d`~~e~~.npz", "&lt;b&gt;&#47;.npz", "\\![](https:evil.example)", "{alert(1)}.npz",
    ],
)  # fmt: skip
def test_the_name_of_the_file_is_text(server, record, tmp_path, name):
    """Neither HTML, nor a picture that would be fetched from elsewhere, nor a link, as viser's Markdown has them."""
    Replay(server, record(5, 1), tmp_path / name)
    messages = server._websock_server._broadcast_buffer.message_from_id.values()
    texts = [m.props._markdown for m in messages if type(m).__name__ == "GuiMarkdownMessage"]
    (shown,) = (text for text in texts if text.endswith(", 0.1 s"))
    assert re.fullmatch(r"\*\*([a-z0-9 ]|\\[^a-z0-9 ])*\*\*, 0\.1 s", shown)  # every mark is one that is shown
    assert re.sub(r"\\(.)", r"\1", shown) == f"**{name}**, 0.1 s"


def test_the_name_of_the_file_starts_no_line_of_its_own():
    assert plain_text("a\n# b") == r"\'a\\n\# b\'"
    markdown = pytest.importorskip("markdown_it").MarkdownIt("commonmark").enable(["strikethrough", "table"])
    for name in ("![a](https:evil.example)", "<b>", "&lt;", "a\n# b", "`x`", "_y_", "1. z", "- z", "> z"):
        rendered = re.fullmatch("<p>(.*)</p>\n", markdown.render(plain_text(name)), re.DOTALL)
        assert rendered is not None
        assert html.unescape(rendered[1]) == legible(name)
