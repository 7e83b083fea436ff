"""Five clicks that show what compliance is: each sets stiffness and law, and pushes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import viser

from cotap.play import ROBOTS
from cotap.play.controls import AXES, Control
from cotap.play.forces import Push
from cotap.play.link import defaults
from cotap.play.mailbox import Request, Reset

PUSH_S = 3.0
"""Long enough for a soft hand to come to rest [s]."""
Act = Callable[[dict[str, Any], list[Request], viser.ClientHandle | None], None]


@dataclass(frozen=True)
class Stop:
    """What one click does. All else is as the page begins, but that the policy leaves the arms to their laws."""

    title: str
    text: str
    """What to see, in two sentences."""
    pushes: tuple[tuple[str, tuple[float, float, float]], ...]
    """Hands, with the forces on them in the heading frame [N]."""
    values: dict[str, Any] = field(default_factory=dict)

    def settings(self, controls: Mapping[str, Control]) -> dict[str, Any]:
        """All settings of this stop."""
        return {**defaults(controls), "paused": False, "arm_actions": False, **self.values}

    def requests(self) -> list[Request]:
        """What is asked for once they are in force."""
        return [Reset(), *(Push(side, force, PUSH_S) for side, force in self.pushes)]


def make_stops(sides: tuple[str, ...]) -> tuple[Stop, ...]:
    """The tour of a robot with these arms, of which it uses the first and the last."""
    one, other = sides[0], sides[-1]
    ahead = ((one, (30.0, 0.0, 0.0)), (other, (30.0, 0.0, 0.0)))
    apart = ((one, (0.0, 30.0, 0.0)), (other, (0.0, -30.0, 0.0)))
    return (
        Stop(
            "Soft and stiff",
            f"Both hands are pushed ahead with 30 N: the {one} one is asked for 200 N/m, the {other} one for 1000 N/m. "
            "The soft one gives way by 15 cm, the stiff one by 3 cm: the table below says so.",
            ahead,
            _stiffness("a", one, 200.0, 200.0, 200.0) | _stiffness("a", other, 1000.0, 1000.0, 1000.0),
        ),
        Stop(
            "Each direction by itself",
            f"The same push, but the {one} hand is soft ahead and stiff across, and the {other} one is the opposite. "
            "The blue wires are long where much stiffness is asked for, and the hands give way where they are short.",
            ahead,
            _stiffness("a", one, 200.0, 1000.0, 1000.0) | _stiffness("a", other, 1000.0, 200.0, 200.0),
        ),
        Stop(
            "Asked for, or left to the pose",
            "Robot A is asked for 300 N/m; robot B, to its right, has PD control, which holds the angles of joints. "
            "Pushed outwards, A feels as it was asked to, and B as its gains and its pose happen to make it.",
            apart,
            {"side_by_side": True} | {f"b.{side}.law": "pd" for side in (one, other)},
        ),
        Stop(
            "As much of it as you want",
            "Both robots are asked for 200 N/m, but B is only half compliant: its alpha is 0.5 (0 would be PD). "
            "Pushed up, its hands give way about half as far; the orange ellipsoid is the stiffness in force.",
            tuple((side, (0.0, 0.0, 30.0)) for side in (one, other)),
            {"side_by_side": True, **{f"b.{side}.alpha": 0.5 for side in (one, other)}}
            | {f"{robot}.{side}.stiffness_{axis}": 200.0 for robot in ROBOTS for side in (one, other) for axis in AXES},
        ),
        Stop(
            "While it walks",
            "The robot walks, and its soft hand is pushed to the side: the arm gives way, and the legs walk on. "
            "Drag an orange ball with the mouse to feel it yourself.",
            apart[:1],
            {"stand": False, "velocity_x": 0.4} | _stiffness("a", one, 200.0, 200.0, 200.0),
        ),
    )


def add_tour(gui: viser.GuiApi, controls: Mapping[str, Control], sides: tuple[str, ...], act: Act) -> None:
    """The tour in the present container; `act` gets settings, what is asked for then, and who clicked."""
    stops = make_stops(sides)
    text = gui.add_markdown(f"{len(stops)} clicks show what compliance is. Each sets all that can be set anew.")
    at = -1

    async def go(event: viser.GuiEvent[Any]) -> None:
        nonlocal at
        at = (at + (event.target is onward or at < 0)) % len(stops)
        stop = stops[at]
        text.content = f"**{at + 1} of {len(stops)}: {stop.title}.** {stop.text}"
        again.disabled = False
        act(stop.settings(controls), stop.requests(), event.client)

    onward, again = gui.add_button("Next"), gui.add_button("Once more", disabled=True)
    for button in (onward, again):
        button.on_click(go)


def _stiffness(robot: str, side: str, *along: float) -> dict[str, Any]:
    return {f"{robot}.{side}.stiffness_{axis}": value for axis, value in zip(AXES, along, strict=True)}
