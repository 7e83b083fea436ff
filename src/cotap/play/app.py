"""The page and the simulation together: one thread simulates, one draws, the server's own threads listen."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from typing import Any

import viser

from cotap.evaluation.recording import Recording
from cotap.play import ROBOTS
from cotap.play.archive import Archive
from cotap.play.controls import Choice, Refused
from cotap.play.drive import Drive
from cotap.play.forces import Push
from cotap.play.guard import PARAMETER
from cotap.play.link import from_text, to_text
from cotap.play.mailbox import Mailbox, Record, Reset, Step
from cotap.play.notices import Notices
from cotap.play.pace import Pace
from cotap.play.panel import STEP, Panel
from cotap.play.plots import Plots, plots_tab
from cotap.play.readout import Readout
from cotap.play.recorder import Recorder
from cotap.play.rules import consistent, without_effect
from cotap.play.sample import Sample
from cotap.play.scene import Scene
from cotap.play.script import add_script
from cotap.play.session import Session
from cotap.play.tour import add_tour

DRAW_HZ, PLOT_HZ, STATUS_HZ = 25.0, 4.0, 4.0
START, STOP = "Start recording", "Stop and save"
PLOTS_AFTER_S = 1.5
"""The robot and its controls come first; a browser takes half a second to make the plots [s]."""


class App:
    """Everything that runs while a page is open.

    Args:
        server: The page, opened.
        scene: Where it is drawn, of all robots.
        session: What is simulated.
        folder: Where recordings go.
        robots: Names of robots to choose from; the session's is among them, or there are none.
    """

    def __init__(
        self, server: viser.ViserServer, scene: Scene, session: Session, folder: Path, robots: tuple[str, ...] = ()
    ) -> None:
        self.session, self.server, self.scene = session, server, scene
        self.mailbox = Mailbox(session.controls)
        self.notices = Notices(server)
        self.archive = Archive(folder, self.notices)
        self.pace = Pace(session.dt)
        self.drive = Drive(session.controls)
        self.readout = Readout(session.sides)
        self._stop = threading.Event()
        self._chosen = ""
        robot = session.env.spec.name
        self._robot = Choice("robot", robots or (robot,), robot)
        self._failure: BaseException | None = None
        self._recorder: Recorder | None = None
        self._unwritten: list[Recording] = []
        self._changes: dict[str, Any] = {}
        self._noticed: set[str] = set()
        self._latest: tuple[int, Sample] | None = None
        with server.atomic():
            self.panel = Panel(server, self.mailbox, session.sides, self.notices)
            with self.panel.robot_tab:
                self._add_chooser()
            add_script(server, {"drive": self._drive, "link": self._open_link})
            self._add_tabs()
        self.scene.hands.on_drag("left")(self._drag)

    def run(self) -> str:
        """Simulate and draw until `stop`, Ctrl-C or the choice of another robot. Returns the robot chosen, or "".

        Raises what the simulation raises.
        """
        thread = threading.Thread(target=self._simulate, name="simulation", daemon=True)
        thread.start()
        try:
            self._draw_until_stopped()
        finally:
            self.stop()
            thread.join(5.0)
            self._keep_recording()
        if self._failure is not None:
            raise self._failure
        return self._chosen

    def stop(self) -> None:
        """Let `run` return."""
        self._stop.set()

    def advance(self) -> None:
        """One turn of the simulation's loop: take the mail, then step, or wait where there is nothing to do."""
        self.panel.apply(self.drive.let_go())
        values, requests = self.mailbox.take()
        before = dict(self.session.values)
        asked = consistent(values)
        notices = self.session.set(asked)
        now = self.session.values
        changes = {name: value for name, value in now.items() if value != before[name]}
        self._changes |= changes
        # Not what people have just set themselves: the newest of a slider's many values is still to come.
        self.panel.show({name: now[name] for name in asked if name not in values or now[name] != values[name]})
        for notice in notices:
            self.notices.tell(notice, title="not possible")
        for robot in ROBOTS:
            checkpoint = changes.get(f"{robot}.checkpoint")
            if checkpoint and (text := self.session.trained_otherwise(checkpoint)):
                self.notices.tell(text, title=f"robot {robot.upper()}: another gait")
        if "side_by_side" in changes:
            self._keep_recording()
        for request in requests:
            if isinstance(request, Push):
                self.session.push(request)
            elif isinstance(request, Reset):
                self.session.reset()
                self.readout.clear()
            elif isinstance(request, Step):
                if self.session.values["paused"] and not self.archive.filming.is_set():
                    self._step()
            elif request.on:
                self._begin_recording()
            else:
                self._keep_recording()
        if self.session.values["paused"] or self.archive.filming.is_set():
            self.pace.rest()
            return
        self._step()
        self.pace.wait(self.session.values["speed"])

    def without_effect(self) -> set[str]:
        """Names of the controls, and labels of the buttons, that do nothing at present."""
        values = self.session.values
        idle = without_effect(self.session.controls, values)
        idle.add(START if self._recorder is not None else STOP)
        return idle if values["paused"] and not self.archive.filming.is_set() else idle | {STEP}

    def _step(self) -> None:
        session = self.session
        falls = list(session.falls)
        sample = session.step()
        self._latest = (session.num_steps, sample)
        self.plots.append(session.num_steps, sample)
        self.readout.take(sample)
        for i in range(self._shown()):
            if session.falls[i] > falls[i]:
                self.notices.tell(f"robot {ROBOTS[i].upper()} fell and is back on its feet", title="fall")
        changes, self._changes = self._changes, {}  # of this step, and of the pause before it
        if self._recorder is not None:
            self._recorder.append(sample, changes)
            if self._recorder.full:
                self._keep_recording()

    def _shown(self) -> int:
        return len(ROBOTS) if self.session.values["side_by_side"] else 1

    def _simulate(self) -> None:
        try:
            while not self._stop.is_set():
                self.advance()
        except BaseException as error:  # whatever ends the simulation must end the program, and say so
            self._failure = error
            self._stop.set()

    def _draw_until_stopped(self) -> None:
        due = {"plots": time.monotonic() + PLOTS_AFTER_S, "status": 0.0}
        drawn = None
        while not self._stop.wait(1.0 / DRAW_HZ):
            now = time.monotonic()
            latest = self._latest
            if latest is None:
                continue
            self.panel.grey(self.without_effect())
            if now >= due["status"]:
                due["status"] = now + 1.0 / STATUS_HZ
                self._show_status()
                self._felt.content = self.readout.table(self._shown())
            if not self.archive.drawing.acquire(blocking=False):
                continue
            try:
                self.scene.shown = self._shown()
                self.scene.show(latest[1])
            finally:
                self.archive.drawing.release()
            if now >= due["plots"] and latest is not drawn and self._live_plots.value:
                due["plots"] = now + 1.0 / PLOT_HZ
                self.plots.draw(self._shown())
            drawn = latest

    def _show_status(self) -> None:
        s = self.session
        rate = self.pace.rate
        parts = [
            f"**{s.num_steps * s.dt:.1f} s**",
            "filming" if self.archive.filming.is_set() else "paused" if s.values["paused"] else
            f"{rate:.0f} control steps/s ({rate * s.dt:.2f} of real time)",
            f"falls: {', '.join(str(n) for n in s.falls[: self._shown()])}",
        ]  # fmt: skip
        if self._recorder is not None:
            parts.append(f"**recording {self._recorder.seconds:.1f} s**")
        self.panel.status.content = " · ".join(parts)
        query = f"?{PARAMETER}={to_text(s.env.spec.name, s.controls, s.values)}"
        link = f"[Copy a link to these settings]({query}). The address bar shows it, too."
        if self._link.content != link:
            self._link.content = link

    def _add_tabs(self) -> None:
        gui = self.server.gui
        with self.panel.tabs.add_tab("View"):
            self._add_view()
        with self.panel.tabs.add_tab("Record"):
            self.panel.button(START, Record(True))
            self.panel.button(STOP, Record(False))
            self.archive.add_buttons(gui, self.scene)
            self._link = gui.add_markdown("")
        with self.panel.tabs.add_tab("Tour"):
            add_tour(gui, self.session.controls, self.session.sides, self.panel.do)
        with plots_tab(self.server) as tab:
            self._felt = gui.add_markdown("")
        self.plots = Plots(self.server, tab, self.session.sides, self.session.dt)

    def _add_chooser(self) -> None:
        robot = self._robot
        chooser = self.server.gui.add_dropdown(
            robot.label, robot.options, initial_value=robot.default, disabled=len(robot.options) < 2,
            order=-1.0, hint="those of which a policy is shipped; the page begins anew",
        )  # fmt: skip

        async def choose(event: viser.GuiEvent[Any]) -> None:
            if event.client_id is None:
                return
            try:
                name, _ = robot.clean(event.target.value)
                if self.archive.filming.is_set():
                    raise Refused("a film is being made; choose a robot when it is done")
            except Refused as refusal:
                self.notices.tell(str(refusal), event.client, "refused")
                chooser.value = robot.default
                return
            if name != robot.default:
                self._chosen = name
                self.stop()

        chooser.on_update(choose)

    def _add_view(self) -> None:
        gui, scene = self.server.gui, self.scene
        for label, name in (
            ("camera follows", "follow"), ("ellipsoids of stiffness", "ellipsoids"), ("contacts", "contacts"),
        ):  # fmt: skip
            box = gui.add_checkbox(label, True)

            async def update(event: viser.GuiEvent[Any], name: str = name) -> None:
                setattr(scene, name, bool(event.target.value))

            box.on_update(update)
        self._live_plots = gui.add_checkbox("live plots", True)
        shadows = gui.add_checkbox("shadows", False, hint="slow in a browser without a GPU")

        async def cast(event: viser.GuiEvent[Any]) -> None:
            scene.cast_shadows(bool(event.target.value))

        shadows.on_update(cast)
        gui.add_markdown(
            "Green: where the reference has the hand. Orange ball: the hand; drag it. Red arrow: force on it. "
            "Blue wires: the stiffness asked for; orange: the effective one (30 cm for 1000 N/m). "
            f"Shapes: {scene.shapes}."
        )

    def _drive(self, text: object, client: viser.ClientHandle | None) -> None:
        try:
            self.panel.apply(self.drive.read(text))
        except Refused as refusal:
            self.notices.tell(str(refusal), client, "refused")

    def _open_link(self, text: object, client: viser.ClientHandle | None) -> None:
        try:
            self.panel.apply(from_text(str(text).rstrip(" "), self.session.env.spec.name, self.session.controls))
        except Refused as refusal:
            self.notices.tell(f"{refusal}; nothing was changed", client, "link refused")
        else:
            self.notices.tell("its settings are in force", client, "link")

    async def _drag(self, event: viser.SceneNodeDragEvent[Any]) -> None:
        index, hands = event.instance_index, len(self.session.sides)
        if index is None or not 0 <= index < len(ROBOTS) * hands:  # no browser showing this page sends that
            return
        robot, hand = divmod(index, hands)
        name = f"{ROBOTS[robot]}.{self.session.sides[hand]}.drag"
        if event.phase == "start":
            self._noticed.discard(name)
        point = None if event.phase == "end" else self.scene.to_robot(event.end_position, robot)
        try:
            _, notice = self.mailbox.set(name, point)
        except Refused as refusal:
            notice = str(refusal)
        if notice and name not in self._noticed:  # a drag is many events: its first notice stands for all
            self._noticed.add(name)
            self.notices.tell(notice, event.client, "not as sent")

    def _begin_recording(self) -> None:
        if self._recorder is None:
            self._recorder = Recorder(self.session.dt, self._shown(), self.session.describe())
            self._changes.clear()  # they are in what describes the recording

    def _keep_recording(self) -> None:
        """End the recording, if there is one, and write it. What cannot be written is tried again with the next, and at
        the end."""
        recorder, self._recorder = self._recorder, None
        try:
            if recorder is not None:
                self._unwritten.append(recorder.finish())
            while self._unwritten:
                path = self.archive.keep(self._unwritten[0])
                kept = self._unwritten.pop(0)
                text = f"{len(kept.trajectory.fell) * self.session.dt:.1f} s written to {path}"
                print(text, flush=True)  # the page may be closed, or about to be
                self.notices.tell(text, title="recorded")
        except (OSError, ValueError) as error:
            print(f"not recorded: {error}", file=sys.stderr, flush=True)
            self.notices.tell(str(error), title="not recorded")
