"""Notices on the page, few enough to read."""

from __future__ import annotations

import threading
import time

import viser

LEAST_S = 0.5
"""A viewer gets a notice this often at most [s]; what comes in between is dropped."""


class Notices:
    """Tells one viewer, or all. Safe from any thread."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._lock = server, threading.Lock()
        self._last: dict[int, float] = {}

    def tell(self, text: str, client: viser.ClientHandle | None = None, title: str = "cotap") -> None:
        """Show `text` to `client`, or to every viewer."""
        for viewer in self._server.get_clients().values():
            if client in (None, viewer) and self._due(viewer.client_id):
                viewer.add_notification(title, text, auto_close_seconds=6.0)

    def _due(self, client_id: int) -> bool:
        now = time.monotonic()
        with self._lock:
            if now - self._last.get(client_id, -LEAST_S) < LEAST_S:
                return False
            self._last[client_id] = now
        return True
