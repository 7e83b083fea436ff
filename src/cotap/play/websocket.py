"""How viser's web server is opened: guarded."""

from __future__ import annotations

from collections.abc import Callable
from http import HTTPStatus
from typing import Any

import viser
import websockets.asyncio.server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from cotap.play.guard import Guard

MAX_VIEWERS = 32
"""How many look on at once."""

Answer = Callable[[ServerConnection, Request], Response | None]


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
    return server


def _guarded_serve(guard: Guard, opened: list[bool]) -> Callable[..., Any]:
    """websockets' `serve` with a guard; `opened` has an entry once it was called."""
    serve = websockets_server.serve

    def guarded_serve(*args: Any, process_request: Answer, **options: Any) -> Any:
        opened.append(True)
        return serve(*args, process_request=_answer(guard, process_request), **options)

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
