"""The web server: opened where it was asked for, or not at all."""

from __future__ import annotations

import contextlib
import socket

import viser

from cotap.checks import require_range
from cotap.play.guard import Guard
from cotap.play.websocket import guarded_server


class PortTaken(OSError):
    """The page cannot be opened where it was asked for; the message says what to do."""


def open_server(host: str, port: int, token: str = "") -> viser.ViserServer:
    """A page at `http://host:port`, closed to other websites and, where it has a token, to who does not know that.

    Raises:
        PortTaken: another program has the port, or the address is not this machine's.
        ValueError: the port is out of its range, or the page can be reached from elsewhere and there is no token.
    """
    require_range("port", port, 1, 65535)
    _require_free(host, port)
    server = guarded_server(Guard(host, port, token), host=host, port=port, label="cotap", verbose=False)
    if server.get_port() != port:  # taken in between: viser goes on to the next
        server.stop()
        raise PortTaken(_advice(host, port, "another program has just taken it"))
    _prepare(server)
    return server


def empty(server: viser.ViserServer) -> None:
    """Take all from a page that was on it, and leave it as a new one."""
    server.gui.reset()
    server.scene.reset()
    _prepare(server)


def _prepare(server: viser.ViserServer) -> None:
    server.gui.configure_theme(show_share_button=False, show_logo=False, control_width="large")
    server.gui.main_panel.dock_right()  # beside the scene, not upon it
    # A browser that draws without a GPU takes seconds to prepare an environment map, and as long for every
    # few frames with it or with shadows.
    server.scene.configure_environment_map(hdri=None)
    server.scene.configure_default_lights(cast_shadow=False)


def _require_free(host: str, port: int) -> None:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with contextlib.closing(socket.socket(family, kind, protocol)) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise PortTaken(_advice(host, port, error.strerror or str(error))) from error


def _advice(host: str, port: int, reason: str) -> str:
    return (
        f"cannot open the page at {host}:{port} ({reason}). Is another cotap play running? Take another port with "
        f"--port {port + 1 if port < 65535 else 8080}, or stop the program that has it"
    )
