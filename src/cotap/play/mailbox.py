"""Between the page's threads and the simulation's: values are cleaned at the door, and a flood takes no room."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cotap.play.controls import Control, Refused
from cotap.play.forces import Push

QUEUE = 32
"""How many requests wait at most: a person does not press more buttons within a control step."""


@dataclass(frozen=True)
class Reset:
    """Put the robots back on their feet, both in the same state."""


@dataclass(frozen=True)
class Step:
    """Advance by one control step while paused."""


@dataclass(frozen=True)
class Record:
    """Begin a recording, or end it."""

    on: bool


Request = Push | Reset | Step | Record


class Mailbox:
    """Values, of which the newest counts, and requests, which wait in order. Safe from any thread."""

    def __init__(self, controls: Mapping[str, Control]) -> None:
        self.controls = dict(controls)
        self._lock = threading.Lock()
        self._values: dict[str, Any] = {}
        self._requests: deque[Request] = deque()

    def set(self, name: str, value: object) -> tuple[Any, str | None]:
        """Leave a value. Returns it as it will be used, and a notice where that differs from what was sent.

        Raises:
            Refused: there is no such control, or the value cannot be used; nothing is left.
        """
        if name not in self.controls:
            raise Refused(f"there is no control {name[:60]!r}")
        clean, notice = self.controls[name].clean(value)
        with self._lock:
            self._values[name] = clean
        return clean, notice

    def ask(self, request: Request) -> None:
        """Leave a request. Raises Refused when too many are waiting, or for a push that cannot be."""
        if isinstance(request, Push):
            request.check()
        with self._lock:
            if len(self._requests) >= QUEUE:
                raise Refused(f"{QUEUE} requests are waiting already; this one is dropped")
            self._requests.append(request)

    def take(self) -> tuple[dict[str, Any], list[Request]]:
        """Empty it: the newest value of each control that was set, and the requests in order."""
        with self._lock:
            values, requests = self._values, list(self._requests)
            self._values, self._requests = {}, deque()
        return values, requests
