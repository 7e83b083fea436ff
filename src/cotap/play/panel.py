"""The page's controls. They only leave messages in the mailbox; what they show is what was accepted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import viser

from cotap.play import ROBOTS
from cotap.play.controls import AXES, Choice, Control, Flag, Number, Refused
from cotap.play.forces import Push
from cotap.play.mailbox import Mailbox, Request, Reset, Step
from cotap.play.notices import Notices

STEP = "Step"
"""Label of the button for a single step."""
DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "forward": (1.0, 0.0, 0.0), "backward": (-1.0, 0.0, 0.0), "left": (0.0, 1.0, 0.0), "right": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0), "down": (0.0, 0.0, -1.0),
}  # fmt: skip


class Panel:
    """Every control, in tabs.

    Args:
        server: The page.
        mailbox: Where settings and requests go.
        sides: The arms.
        notices: Say what was refused.
    """

    def __init__(self, server: viser.ViserServer, mailbox: Mailbox, sides: tuple[str, ...], notices: Notices) -> None:
        self._gui, self._mailbox, self._sides, self._notices = server.gui, mailbox, sides, notices
        self._handles: dict[str, Any] = {}
        self._good: dict[str, Any] = {name: control.default for name, control in mailbox.controls.items()}
        self._second: list[viser.GuiFolderHandle] = []
        self._grey: set[str] = set()
        self.status = server.gui.add_markdown("")
        self._add_time()
        self.tabs = server.gui.add_tab_group()
        with self.tabs.add_tab("Walk"):
            self._add_walk()
        with self.tabs.add_tab("Arms"):
            for robot in ROBOTS:
                self._add_arms(robot)
        with self.tabs.add_tab("Push"):
            self._add_push()
        self.robot_tab = self.tabs.add_tab("Robot")
        with self.robot_tab:
            self._add_domain()
        self._show_second(False)

    def show(self, values: Mapping[str, Any]) -> None:
        """Show values as the simulation has them, where that is not what people have set."""
        for name, value in values.items():
            self._good[name] = value
            if name in self._handles and self._handles[name].value != value:
                self._handles[name].value = value
        if "side_by_side" in values:
            self._show_second(values["side_by_side"])

    def apply(self, values: Mapping[str, Any]) -> None:
        """Set controls as a hand does. Raises Refused for what cannot be; nothing is set then."""
        clean = {name: self._mailbox.controls[name].clean(value)[0] for name, value in values.items()}
        for name, value in clean.items():
            self._mailbox.set(name, value)
        self.show(clean)

    def grey(self, names: set[str]) -> None:
        """Grey out these controls and buttons, and no others."""
        for name in self._grey ^ names:
            if name in self._handles:
                self._handles[name].disabled = name in names
        self._grey = names

    def bind(self, name: str) -> Any:
        """The control called `name`, added in the present container."""
        control = self._mailbox.controls[name]
        handle = self._add(control)
        self._handles[name] = handle

        # Coroutines run one by one on the server's loop: a flood cannot pile up threads, and order is kept.
        async def update(event: viser.GuiEvent[Any]) -> None:
            if event.client_id is not None:  # else it is this program that writes
                self._set(name, event.target.value, event.client)

        handle.on_update(update)
        return handle

    def _add(self, control: Control) -> Any:
        if isinstance(control, Number):
            return self._gui.add_slider(
                control.label, min=control.low, max=control.high, step=control.step, initial_value=control.default
            )
        if isinstance(control, Choice):
            return self._gui.add_dropdown(control.label, options=control.options, initial_value=control.default)
        if isinstance(control, Flag):
            return self._gui.add_checkbox(control.label, initial_value=control.default)
        raise TypeError(f"{control.label} is not a control of the panel")

    def _set(self, name: str, value: Any, client: viser.ClientHandle | None) -> None:
        try:
            clean, notice = self._mailbox.set(name, value)
        except Refused as refusal:
            clean, notice = self._good[name], str(refusal)
        if notice:
            self._notices.tell(notice, client, "not as sent")
            self._handles[name].value = clean
        self._good[name] = clean
        if name == "side_by_side":
            self._show_second(clean)

    def do(self, values: Mapping[str, Any], requests: Sequence[Request], client: viser.ClientHandle | None) -> None:
        """Set controls, then ask for something. Raises Refused for what cannot be set."""
        self.apply(values)
        for request in requests:
            self._ask(request, client)

    def _ask(self, request: Request, client: viser.ClientHandle | None) -> None:
        try:
            self._mailbox.ask(request)
        except Refused as refusal:
            self._notices.tell(str(refusal), client, "refused")

    def button(self, label: str, request: Request) -> None:
        """A button, in the present container, that leaves a request."""
        self._button(label, lambda: request)

    def _button(self, label: str, request: Callable[[], Request]) -> None:
        async def click(event: viser.GuiEvent[Any]) -> None:
            self._ask(request(), event.client)

        self._handles[label] = self._gui.add_button(label)
        self._handles[label].on_click(click)

    def _add_time(self) -> None:
        with self._gui.add_folder("Time"):
            self.bind("paused")
            self.bind("speed")
            self.button(STEP, Step())
            self.button("Reset", Reset())
            self.bind("side_by_side")

    def _add_walk(self) -> None:
        self._gui.add_markdown("Keys: W S, A D, Q E; shift: faster; space: stand. Or a gamepad.")
        for name in ("stand", "velocity_x", "velocity_y", "yaw_rate", "height_offset", "motion", "arm_actions"):
            self.bind(name)

    def _add_arms(self, robot: str) -> None:
        for side in self._sides:
            with self._gui.add_folder(f"Robot {robot.upper()}, {side} arm", expand_by_default=robot == "a") as folder:
                for part in ("law", *(f"stiffness_{axis}" for axis in AXES), "null_stiffness", "alpha"):
                    self.bind(f"{robot}.{side}.{part}")
                with self._gui.add_folder("more", expand_by_default=False):
                    for part in ("error", "damping", "passive"):
                        self.bind(f"{robot}.{side}.{part}")
            if robot != ROBOTS[0]:
                self._second.append(folder)

    def _add_push(self) -> None:
        for part in ("hand", "force", "seconds"):
            self.bind(f"push.{part}")
        for label, direction in DIRECTIONS.items():
            self._button(f"Push {label}", lambda d=direction: self._push(d))
        with self._gui.add_folder("Held load, axes of the robot's heading"):
            for side in self._sides:
                for axis in AXES:
                    self.bind(f"held.{side}.{axis}")
        self._gui.add_markdown(
            "Drag an orange ball with the mouse: a spring pulls that hand after it. Untick *policy moves arms* to feel "
            "the law alone."
        )

    def _push(self, direction: tuple[float, float, float]) -> Push:
        x, y, z = (self._good["push.force"] * d for d in direction)
        return Push(self._good["push.hand"], (x, y, z), self._good["push.seconds"])

    def _add_domain(self) -> None:
        for robot in ROBOTS:
            with self._gui.add_folder(f"Robot {robot.upper()}") as folder:
                for part in ("checkpoint", "friction", "mass_scale", "load_kg"):
                    self.bind(f"{robot}.{part}")
            if robot != ROBOTS[0]:
                self._second.append(folder)

    def _show_second(self, on: bool) -> None:
        for folder in self._second:
            folder.visible = on
