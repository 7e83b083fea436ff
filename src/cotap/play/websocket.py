"""How viser's web server is opened: guarded, and deaf to all but a few messages."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from http import HTTPStatus
from typing import Any, cast

import msgspec
import viser
import websockets.asyncio.server as websockets_server
from viser._messages import ShareUrlDisconnect, ShareUrlRequest
from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from cotap.play.guard import Guard
from cotap.play.messages import MAX_BYTES, ViewerCameraMessage, parse

MAX_VIEWERS = 32
"""How many look on at once."""
MAX_CONNECTIONS = 128
"""How many connections are open at once, of viewers and of those that have not said yet what they want: for each the
system keeps a file open, and it lets a program have some thousand."""
MAX_QUEUE = 4
"""How many messages of a viewer wait to be read."""

Answer = Callable[[ServerConnection, Request], Response | None]


class Viewer(ServerConnection):
    """A browser's connection. What a browser may not say never reaches viser."""

    _counted = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take a connection, or let it go if there are too many."""
        if len(self.server.handlers) < MAX_CONNECTIONS:
            super().connection_made(transport)
            return
        transport.set_protocol(asyncio.Protocol())  # this one has nothing that could be lost
        cast(asyncio.Transport, transport).abort()

    async def recv(self, decode: bool | None = None) -> bytes:
        """The next message that may be said."""
        while True:
            data = await super().recv(decode)
            try:
                message = parse(data if isinstance(data, bytes) else data.encode())
            except ValueError:
                await self.close(CloseCode.INVALID_DATA, "no message of the page's")
                continue  # and find the connection closed
            # viser counts a browser among its clients, and forgets what it keeps of one, from its first camera on.
            self._counted |= isinstance(message, ViewerCameraMessage)
            if message is not None and self._counted:
                # Written anew: viser reads what was checked, not what else the same bytes may mean to another reader.
                return msgspec.msgpack.encode(message)


def guarded_server(guard: Guard, **options: Any) -> viser.ViserServer:
    """viser's server with these options, guarded.

    Raises:
        ValueError: this viser starts its server in another way, so that it would not be guarded; it is stopped.
    """
    opened: list[bool] = []
    # viser does not let its user choose what it opens its websocket with, so websockets' own entrance is another one
    # for as long as viser takes to start.
    serve = websockets_server.serve
    websockets_server.serve = _guarded_serve(guard, opened)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        server = viser.ViserServer(**options)
    finally:
        websockets_server.serve = serve
    if not opened:
        server.stop()
        raise ValueError(f"viser {viser.__version__} cannot be guarded against strangers; install viser 1.1.1")
    # Browsers are not heard when they ask for a public tunnel, and nothing is left that would open one.
    for message in (ShareUrlRequest, ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
    return server


def _guarded_serve(guard: Guard, opened: list[bool]) -> Callable[..., Any]:
    """websockets' `serve` with a guard; `opened` has an entry once it was called."""
    serve = websockets_server.serve
    limits = {"max_size": MAX_BYTES, "max_queue": MAX_QUEUE, "create_connection": Viewer}

    def guarded_serve(*args: Any, process_request: Answer, **options: Any) -> Any:
        opened.append(True)
        return serve(*args, process_request=_answer(guard, process_request), **options | limits)

    return guarded_serve


def _answer(guard: Guard, served: Answer) -> Answer:
    """What is answered to a request, of which viser has `served` to say; None where a websocket may be opened."""

    def answer(connection: ServerConnection, request: Request) -> Response | None:
        refusal = guard.refusal(request)
        response = None if refusal else served(connection, request)
        if refusal is None and response is None:
            if not request.headers.get_all("Origin"):  # there is no browser that leaves it out
                refusal = HTTPStatus.FORBIDDEN, "a websocket needs an Origin"
            elif len(connection.server.connections) >= MAX_VIEWERS:
                refusal = HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_VIEWERS} viewers are looking on already"
        if refusal:
            return connection.respond(refusal[0], refusal[1] + "\n")
        if response is not None:
            response.headers.update(guard.headers())
        return response

    return answer
