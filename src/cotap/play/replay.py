"""A recording shown again: the same scene and plots, a slider for the time."""

from __future__ import annotations

import re
import threading
import time
from pathlib import Path
from typing import Any

import viser

from cotap.checks import legible, quoted
from cotap.evaluation.recording import Recording, RecordingError
from cotap.play import ROBOTS
from cotap.play.archive import Archive
from cotap.play.controls import SPEED, Number, Refused
from cotap.play.notices import Notices
from cotap.play.plots import SECONDS, Plots, plots_tab
from cotap.play.recorder import samples_of
from cotap.play.scene import Scene
from cotap.robots import ROBOTS as KNOWN_ROBOTS

DRAW_HZ = 25.0
_MARKS = re.compile(r"[!-/:-@\[-`{-~]")


def plain_text(name: str) -> str:
    """A name in Markdown: a file's name comes with the file, and viser's browsers show pictures from elsewhere, follow
    links and run HTML that they find in text."""
    return _MARKS.sub(r"\\\g<0>", legible(name))


class Replay:
    """Plays one recording over and over.

    Args:
        server: The page, opened.
        recording: What to show.
        path: Where it was read; a film is written beside it.

    Raises:
        RecordingError: it is of a robot that this cotap does not know, or not of that robot.
    """

    def __init__(self, server: viser.ViserServer, recording: Recording, path: Path) -> None:
        robot = recording.settings.get("robot")
        if robot not in KNOWN_ROBOTS:
            raise RecordingError(f"the recording's robot {quoted(robot)} is unknown; known: {', '.join(KNOWN_ROBOTS)}")
        self._samples, self._dt = samples_of(recording), recording.trajectory.dt
        spec = KNOWN_ROBOTS[robot]()
        width, sides = recording.scene["qpos"].shape[2], recording.settings["sides"]
        if width != 7 + len(spec.joints) or sides != [arm.side for arm in spec.arms]:
            raise RecordingError(
                f"a recording of {width} positions and the hands {quoted(sides)} is of no {spec.name!r}"
            )
        self._count = recording.trajectory.fell.shape[1]
        if self._count > len(ROBOTS):
            raise RecordingError(f"the page shows at most {len(ROBOTS)} robots, the recording has {self._count}")
        self._stop = threading.Event()
        self.scene = Scene(server, spec, self._count)
        self.scene.shown = self._count
        self._notices = Notices(server)
        self._archive = Archive(path.parent, self._notices)
        self._archive.newest, self._archive.path = recording, path
        gui = server.gui
        gui.add_markdown(f"**{plain_text(path.name)}**, {len(self._samples) * self._dt:.1f} s")
        self._playing = gui.add_checkbox("play", True)
        self._speed, self._at = SPEED.default, 0.0
        end = max(self._dt, round(self._dt * (len(self._samples) - 1), 6))
        self._range = Number("time [s]", 0.0, end, 0.0, self._dt)
        speed, self._time = (
            gui.add_slider(n.label, min=n.low, max=n.high, step=n.step, initial_value=n.default)
            for n in (SPEED, self._range)
        )
        speed.on_update(self._set_speed)

        async def play(event: viser.GuiEvent[Any]) -> None:
            speed.disabled = not event.target.value

        self._playing.on_update(play)
        self._time.on_update(self._seek)
        self._archive.add_buttons(gui, self.scene)
        with plots_tab(server) as tab:
            gui.add_markdown(f"The last {SECONDS:g} s before what is shown.")
        self._plots = Plots(server, tab, tuple(arm.side for arm in spec.arms), self._dt)

    def run(self) -> None:
        """Show it until `stop`, or Ctrl-C."""
        last, plotted = time.monotonic(), -1.0
        while not self._stop.wait(1.0 / DRAW_HZ):
            now = time.monotonic()
            passed, last = now - last, now
            if not self._archive.drawing.acquire(blocking=False):
                continue
            try:
                step = self.advance(passed)
            finally:
                self._archive.drawing.release()
            if now - plotted > 0.5:
                plotted = now
                self._plot(step)

    def advance(self, passed: float) -> int:
        """Go on by `passed` seconds of the clock's, if it plays, and draw. Returns the number of the step drawn."""
        playing = self._playing.value
        if playing:
            self._at = (self._at + passed * self._speed) % (len(self._samples) * self._dt)
        step = min(int(self._at / self._dt + 1e-6), len(self._samples) - 1)  # 0.58 / 0.02 is a little below 29
        self.scene.show(self._samples[step])
        if playing:
            self._time.value = round(step * self._dt, 6)
        return step

    def stop(self) -> None:
        """Let `run` return."""
        self._stop.set()

    def _plot(self, step: int) -> None:
        self._plots.clear()
        for i in range(max(0, step - round(SECONDS / self._dt)), step + 1):
            self._plots.append(i, self._samples[i])
        self._plots.draw(self._count)

    async def _seek(self, event: viser.GuiEvent[Any]) -> None:
        if event.client_id is not None:  # a person's hand, not the clock
            self._at = self._accepted(self._range, event, self._at)

    async def _set_speed(self, event: viser.GuiEvent[Any]) -> None:
        if event.client_id is not None:
            self._speed = self._accepted(SPEED, event, self._speed)

    def _accepted(self, number: Number, event: viser.GuiEvent[Any], before: float) -> float:
        """What was sent, as it can be used; where that differs, a notice says so, and the page shows it."""
        try:
            value, notice = number.clean(event.target.value)
        except Refused as refusal:
            value, notice = before, str(refusal)
        if notice:
            self._notices.tell(notice, event.client, "not as sent")
            event.target.value = value
        return value
