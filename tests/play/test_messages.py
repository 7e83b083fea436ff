"""What viewers send changes what controls stand at, and nothing else; it opens nothing, and nothing of it is kept."""

from __future__ import annotations

import dataclasses
import io
import os
import threading
from typing import get_args

import msgspec
import numpy as np
import pytest
import viser._messages
from browser import Browser, looking, until
from PIL import Image
from websockets.exceptions import InvalidStatus

from cotap.play import ROBOTS, messages
from cotap.play.app import App
from cotap.play.messages import MAX_BYTES, parse
from cotap.play.scene import Scene

DRAG = {
    "phase": "start", "name": "/hands", "instance_index": 0, "start_position": [0, 0, 1], "start_screen_pos": [0, 0],
    "end_position": [0, 0, 1], "end_screen_pos": [0, 0], "button": "left", "modifier": None, "owner": "",
}  # fmt: skip


@pytest.fixture
def slider(server):
    return server.gui.add_slider("speed", min=0.0, max=4.0, step=0.1, initial_value=1.0)


@pytest.fixture
def viewer(server):
    with looking(server.get_port()) as browser:
        until(lambda: len(server.get_clients()) == 1)
        yield browser


@pytest.fixture
def settled(server, viewer):
    """Waits until all that the viewer has sent so far was dealt with."""
    mark = server.gui.add_number("mark", 0.0)

    def wait():
        value = mark.value + 1.0
        viewer.set(mark, value)
        until(lambda: mark.value == value)

    return wait


def picture(kind, width=1280, height=720):
    file = io.BytesIO()
    Image.new("RGB", (width, height)).save(file, kind)
    return file.getvalue()


def test_controls_are_set_and_buttons_are_pressed(server, viewer, settled, slider):
    heard = []
    button = server.gui.add_button("Reset")
    choice = server.gui.add_dropdown("law", options=("pd", "cotap"))
    box = server.gui.add_checkbox("paused", False)

    async def hear(event):
        heard.append(event.target.value)

    for handle in (slider, choice, box):
        handle.on_update(hear)
    button.on_click(hear)
    for handle, value in ((slider, 2), (slider, 0.5), (choice, "cotap"), (box, True), (button, True)):
        viewer.set(handle, value)
    settled()
    assert heard == [2.0, 0.5, "cotap", True, True]


@pytest.mark.parametrize(
    "updates",
    [{"update_cb": []}, {"value": 2.0, "update_cb": []}, {"removed": True}, {"disabled": True}, {"sync_cb": None},
     {"is_button": True}, {"uuid": "x"}, {"gui_api": None}, {"props": {}}, {"update_timestamp": 0}, {"value": None},
     {"value": [1.0]}, {"value": {"a": 1}}, {"value": b"1"}, {"value": "1" * 5000}, {}],
)  # fmt: skip
def test_of_a_control_nobody_changes_anything_but_its_value(viewer, settled, slider, updates):
    heard = []

    async def hear(event):
        heard.append(event.target.value)

    slider.on_update(hear)
    before = dict(vars(slider._impl))
    viewer.send("GuiUpdateMessage", uuid=slider._impl.uuid, updates=updates)
    settled()
    after = dict(vars(slider._impl))
    for state in (before, after):
        state.pop("value")
        state.pop("update_timestamp")
    assert after == before
    viewer.set(slider, 3.0)
    settled()
    assert heard[-1] == 3.0


def test_a_stranger_drives_nothing_of_a_running_simulation_and_a_viewer_does(server, session, tmp_path):
    app = App(server, Scene(server, session.env.spec, len(ROBOTS)), session, tmp_path / "out")
    handles = {h.label: h for h in server.gui._gui_input_handle_from_uuid.values()}

    def drive(**options):
        with looking(server.get_port(), **options) as viewer:
            viewer.set(app.panel._handles["speed"], 4.0)
            for button in ("Start recording", "Stop and save"):
                viewer.set(handles[button], True)
                until(lambda: bool(app.mailbox._requests))
                app.advance()

    with pytest.raises(InvalidStatus, match="403"):
        drive(origin="https://evil.example")
    app.advance()
    assert app.session.values["speed"] == 1.0
    assert app.archive.path is None
    drive()
    assert app.session.values["speed"] == 4.0
    assert app.archive.path.exists()


def test_a_request_to_share_the_page_opens_nothing(server, viewer, settled, monkeypatch):
    opened = threading.Event()
    monkeypatch.setattr(server, "request_share_url", lambda *_: opened.set())
    monkeypatch.setattr(viser._viser, "ViserTunnel", lambda *_, **__: opened.set())
    viewer.send("ShareUrlRequest")
    viewer.send("ShareUrlDisconnect")
    settled()
    assert not opened.wait(0.5)
    kinds = server._websock_server._incoming_handlers
    assert not [kind for kind in kinds if "Share" in kind.__name__]


def test_a_file_for_a_control_that_takes_none_is_not_kept(server, viewer, settled, slider):
    source = {"source_component_uuid": slider._impl.uuid, "transfer_uuid": "t"}
    viewer.send("FileTransferStartUpload", **source, filename="f", mime_type="", part_count=99, size_bytes=99 * 2**20)
    for index in range(8):
        viewer.send("FileTransferPart", **source, part_index=index, content=os.urandom(2**20))
    settled()
    clients = server.get_clients().values()
    assert not server.gui._current_file_upload_states
    assert not any(client.gui._current_file_upload_states for client in clients)
    assert slider.value == 1.0


def test_a_message_larger_than_any_of_the_pages_ends_its_connection_only(server, viewer, settled, slider):
    with looking(server.get_port()) as other:
        other.send("GetRenderResponseMessage", payload=bytes(MAX_BYTES), render_uuid="x")
        assert other.closed() == 1009
    viewer.set(slider, 2.0)
    settled()
    assert slider.value == 2.0


@pytest.mark.parametrize(
    "garbage", [b"", b"\xc1", b"not msgpack", b"\x91" * 100_000, os.urandom(1000), "text", b"\x81\xa4type\xa1\xff"]
)
def test_garbage_ends_its_connection_only(server, viewer, settled, slider, garbage):
    with looking(server.get_port()) as other:
        other.socket.send(garbage)
        assert other.closed() in (1007, 1011)
    viewer.set(slider, 2.0)
    settled()
    assert slider.value == 2.0


def test_messages_that_the_page_has_no_use_for_are_neither_kept_nor_passed_on(server, viewer, settled):
    settled()
    buffer = server._websock_server._broadcast_buffer
    before = len(buffer.message_from_id)
    for i in range(200):
        viewer.send("GuiFormDirtyMessage", uuid=f"{i}")
        viewer.send("GuiFormSubmitMessage", uuid=f"{i}")
        viewer.send("RunJavascriptMessage", source="1")
    settled()
    assert len(buffer.message_from_id) <= before + 2


def test_of_a_viewer_that_never_looked_nothing_is_kept(server, slider):
    server.scene.add_icosphere("/hands")
    with Browser(server.get_port()) as other:
        other.send("SceneNodeDragMessage", **DRAG)
        other.set(slider, 2.0)
        other.look()
        until(lambda: len(server.get_clients()) == 1)
        assert not server.scene._active_drag_handles
        assert slider.value == 1.0
        other.send("SceneNodeDragMessage", **DRAG)
        until(lambda: len(server.scene._active_drag_handles) == 1)
    until(lambda: not server.scene._active_drag_handles)


def test_a_film_gets_its_pictures(server):
    drawn = []
    with looking(server.get_port()) as viewer:
        until(lambda: len(server.get_clients()) == 1)
        (client,) = server.get_clients().values()
        sent = []
        client._websock_connection.queue_message = lambda message: sent.append(message)
        film = threading.Thread(target=lambda: drawn.append(client.get_render(720, 1280, timeout=20.0)))
        film.start()
        until(lambda: bool(sent))
        viewer.send("GetRenderResponseMessage", payload=picture("PNG"), render_uuid=sent[0].render_uuid)
        viewer.send("GetRenderResponseMessage", payload=picture("JPEG"), render_uuid=sent[0].render_uuid)
        film.join(20.0)
    assert drawn[0].shape == (720, 1280, 3)


@pytest.mark.parametrize(
    "payload",
    [picture("PNG"), picture("GIF"), picture("EPS", 8, 8), picture("JPEG", 60_000, 200), b"\xff\xd8\xff", b"%!PS"],
    ids=["png", "gif", "postscript", "of a film's size many times", "cut off", "program"],
)
def test_no_picture_is_decoded_but_a_jpeg_of_a_bearable_size(payload):
    fields = {"type": "GetRenderResponseMessage", "render_uuid": "x"}
    assert parse(msgspec.msgpack.encode(fields | {"payload": payload})) is None
    assert parse(msgspec.msgpack.encode(fields | {"payload": b""})) is not None


def test_the_messages_are_visers():
    for kind in get_args(messages.Message):
        theirs = getattr(viser._messages, kind.__name__)
        assert [f.name for f in msgspec.structs.fields(kind)] == [f.name for f in dataclasses.fields(theirs)]
        read = viser._messages.Message.deserialize
        if kind is messages.SceneNodeDragMessage:
            parsed = parse(msgspec.msgpack.encode({"type": kind.__name__, **DRAG, "more": [1]}))
            assert read(msgspec.msgpack.encode(parsed)) == theirs(**{k: _tuple(v) for k, v in DRAG.items()})


def test_numbers_that_are_none_reach_the_controls_which_refuse_them(viewer, settled, slider):
    viewer.set(slider, float("nan"))
    settled()
    assert np.isnan(slider.value)


def _tuple(value):
    return tuple(value) if isinstance(value, list) else value
