"""Keeping step with the clock."""

from __future__ import annotations

import time

LAG_S = 1.0
"""Further behind than this, what was lost is given up rather than caught up with [s]."""


class Pace:
    """Waits so that steps of `dt` follow each other in real time, or `speed` times as fast, and counts them."""

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._due = self._begin = time.perf_counter()
        self._steps = 0
        self.rate = 0.0
        """Steps per second over about the last second."""

    def wait(self, speed: float) -> None:
        """Wait until the next step is due, a step having just been made."""
        now = time.perf_counter()
        self._due += self._dt / speed
        if self._due > now:
            time.sleep(self._due - now)
        elif now - self._due > LAG_S:
            self._due = now
        self._count()

    def rest(self) -> None:
        """Nothing is to be done for a moment."""
        time.sleep(0.02)
        self._due = self._begin = time.perf_counter()
        self._steps, self.rate = 0, 0.0

    def _count(self) -> None:
        self._steps += 1
        now = time.perf_counter()
        if now - self._begin >= 1.0:
            self.rate = self._steps / (now - self._begin)
            self._begin, self._steps = now, 0
