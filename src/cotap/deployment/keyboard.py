"""Commands from the keyboard of a terminal."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from cotap.deployment.controller import Controller
from cotap.deployment.scenario import TimedCommand
from cotap.envs.commands import CommandConfig

HELP = "w/s faster/slower, a/d turn left/right, q/e step left/right, r/f higher/lower, space stand, x end"
_STEPS = {
    "w": ("forward", 0.1), "s": ("forward", -0.1), "q": ("leftward", 0.1), "e": ("leftward", -0.1),
    "a": ("yaw_rate", 0.1), "d": ("yaw_rate", -0.1), "r": ("height_offset", 0.02), "f": ("height_offset", -0.02),
}  # fmt: skip


class Stick:
    """What has been asked for so far, within the ranges of training."""

    def __init__(self, trained: CommandConfig) -> None:
        self._limits = {
            "forward": trained.velocity_x, "leftward": trained.velocity_y, "yaw_rate": trained.yaw_rate,
            "height_offset": trained.height_offset,
        }  # fmt: skip
        self._value = dict.fromkeys(self._limits, 0.0)
        self.ended = False

    def press(self, key: str) -> TimedCommand:
        """The command after a key; keys that mean nothing change nothing."""
        if key == "x":
            self.ended = True
        elif key == " ":
            self._value = dict.fromkeys(self._limits, 0.0)
        elif key in _STEPS:
            name, step = _STEPS[key]
            low, high = self._limits[name]
            self._value[name] = min(high, max(low, round(self._value[name] + step, 3)))
            # Height is commanded in stance, speed while walking.
            for other in self._limits:
                if (other == "height_offset") != (name == "height_offset"):
                    self._value[other] = 0.0
        v = self._value
        walking = any(v[name] for name in ("forward", "leftward", "yaw_rate"))
        return TimedCommand(0.0, (v["forward"], v["leftward"]), v["yaw_rate"], not walking, v["height_offset"])


class KeyboardPilot:
    """Reads keys at every control step, and keeps the loop to the clock on the wall."""

    def __init__(self, nominal_height_m: float, trained: CommandConfig) -> None:
        self._stick, self._nominal, self._start = Stick(trained), nominal_height_m, 0.0

    def __call__(self, controller: Controller, time_s: float) -> bool:
        """As `cotap.deployment.trial.Pilot`."""
        if time_s == 0.0:
            self._start = time.perf_counter()
        for key in _pressed():
            command = self._stick.press(key)
            command.give(controller.commands, self._nominal)
            shown = f"velocity {command.velocity}, yaw rate {command.yaw_rate}, height {command.height_offset:+}"
            print(f"\r{'stand' if command.stand else 'walk '} {shown}   ", end="", flush=True)
        time.sleep(max(0.0, self._start + time_s - time.perf_counter()))
        return not self._stick.ended


def _pressed() -> Iterator[str]:
    import select

    terminal = sys.stdin.fileno()
    while select.select([terminal], [], [], 0.0)[0]:
        keys = os.read(terminal, 64)  # not through a buffer, in which `select` would not see them
        if not keys:
            return
        yield from keys.decode(errors="ignore")


@contextmanager
def raw_terminal() -> Iterator[None]:
    """Keys arrive as they are pressed. Raises ValueError if standard input is no terminal."""
    if not sys.stdin.isatty():
        raise ValueError("--keyboard needs a terminal; commands can also come from a file (--scenario)")
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
        print()
