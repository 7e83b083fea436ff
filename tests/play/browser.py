"""What a browser, or a program that pretends to be one, sends to the page."""

from __future__ import annotations

import contextlib
import http.client
import socket
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any

import msgspec
import viser
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [2.5, 0, 1], "fov": 0.8, "near": 0.01, "far": 1e3,
    "image_height": 720, "image_width": 1280, "look_at": [0, 0, 1], "up_direction": [0, 0, 1],
}  # fmt: skip
PATIENCE_S = 20.0


class Browser:
    """A websocket to the page at a port of this machine; without other words, one that the page itself opens."""

    def __init__(
        self, port: int, host: str = "", origin: str | None = "", headers: dict[str, str] | None = None, path: str = "/"
    ) -> None:
        host = host or f"localhost:{port}"
        self.socket: ClientConnection = connect(
            f"ws://{host}{path}",
            sock=socket.create_connection(("127.0.0.1", port)),
            origin=None if origin is None else Origin(origin or f"http://{host}"),
            additional_headers=headers,
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            compression=None,
            max_size=None,
            max_queue=None,
            close_timeout=1.0,
            proxy=None,
        )

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        self.socket.close()

    def send(self, kind: str, **fields: Any) -> None:
        """One message."""
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self) -> None:
        """What a browser sends first."""
        self.socket.send(msgspec.msgpack.encode(CAMERA))

    def set(self, handle: Any, value: object) -> None:
        """Set a control, as a hand on the page does."""
        self.send("GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})

    def closed(self) -> int:
        """The code with which the page closes the connection. Raises TimeoutError if it does not."""
        with contextlib.suppress(ConnectionClosed):
            while True:
                self.socket.recv(timeout=PATIENCE_S)
        return self.socket.close_code or 0


@contextlib.contextmanager
def looking(port: int, **options: Any) -> Iterator[Browser]:
    """A viewer whom the page counts among its own."""
    with Browser(port, **options) as browser:
        browser.look()
        yield browser


def refused(port: int, **options: Any) -> int:
    """The status with which a websocket is refused; 101 if it is opened."""
    try:
        with Browser(port, **options):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def get(port: int, path: str = "/", **headers: str) -> tuple[int, dict[str, str], str]:
    """Status, headers and text of what the page answers to a request for a file."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for name, value in ({"Host": f"localhost:{port}"} | headers).items():
        connection.putheader(name, value)
    connection.endheaders()
    response = connection.getresponse()
    text = response.read().decode(errors="replace")
    connection.close()
    return response.status, dict(response.getheaders()), text


def until(happened: Callable[[], bool]) -> None:
    """Wait for what another thread does; the test fails if it never does it."""
    deadline = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.01)
