"""Notices on the page, few enough to read."""

from __future__ import annotations

import threading
import time

import viser

LEAST_S = 0.5
"""A viewer gets a notice this often at most [s]; what comes in between is dropped."""


class RateLimit:
    """Grants something to each viewer once in so many seconds. Safe from any thread."""

    def __init__(self, seconds: float) -> None:
        self._seconds, self._lock = seconds, threading.Lock()
        self._last: dict[int, float] = {}

    def grants(self, client_id: int) -> bool:
        """Whether this viewer's turn has come; if so, it is taken."""
        now = time.monotonic()
        with self._lock:
            self._last = {viewer: last for viewer, last in self._last.items() if now - last < self._seconds}
            if client_id in self._last:
                return False
            self._last[client_id] = now
        return True


class Notices:
    """Tells one viewer, or all. Safe from any thread."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._limit = server, RateLimit(LEAST_S)

    def tell(self, text: str, client: viser.ClientHandle | None = None, title: str = "cotap") -> None:
        """Show `text` to `client`, or to every viewer."""
        for viewer in self._server.get_clients().values():
            if client in (None, viewer) and self._limit.grants(viewer.client_id):
                viewer.add_notification(title, text, auto_close_seconds=6.0)
