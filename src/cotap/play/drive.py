"""Driving by keys or a gamepad: what the page's script says of them becomes velocities."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

from cotap.checks import quoted
from cotap.play.controls import Control, Number, Refused
from cotap.play.rules import VELOCITIES

SILENCE_S = 0.5
"""Who drives and is not heard for so long has let go: a closed page holds no key [s]."""


class Drive:
    """Reads what viewers' browsers say. Safe from any thread.

    Args:
        controls: Those of the page, of which velocities have their ranges.
    """

    def __init__(self, controls: Mapping[str, Control]) -> None:
        self._ranges = {name: control for name in VELOCITIES if isinstance(control := controls[name], Number)}
        self._lock = threading.Lock()
        self._heard: float | None = None

    def read(self, text: object) -> dict[str, Any]:
        """Values of controls.

        Args:
            text: Shares of the largest velocity ahead, to the left and of turning left, each from -1 to 1, whether to
                stand (0 or 1), and a number that makes it another text than the last one.

        Raises:
            Refused: it is not that.
        """
        try:
            *given, stand, _ = map(float, str(text).split())
            if len(given) != len(VELOCITIES) or not all(abs(share) <= 1.0 for share in given) or stand not in (0, 1):
                raise ValueError
        except ValueError:
            raise Refused(f"driving is three shares from -1 to 1, 0 or 1, and a count, got {quoted(text)}") from None
        with self._lock:
            self._heard = time.monotonic() if any(given) else None
        if stand:
            return {"stand": True}
        ends = (
            (name, share, r.high if share > 0.0 else -r.low)
            for (name, r), share in zip(self._ranges.items(), given, strict=True)
        )
        return {name: share * end for name, share, end in ends}

    def let_go(self) -> dict[str, Any]:
        """Values that end what is driven by who has fallen silent; none if nobody has."""
        with self._lock:
            if self._heard is None or time.monotonic() - self._heard < SILENCE_S:
                return {}
            self._heard = None
        return dict.fromkeys(VELOCITIES, 0.0)
