"""The tour: what it sets can be set, what it says is so, and every click goes on."""

from __future__ import annotations

import asyncio
import re
from types import SimpleNamespace

import pytest

from cotap.play.forces import Push
from cotap.play.mailbox import Reset
from cotap.play.readout import Readout
from cotap.play.rules import consistent
from cotap.play.tour import add_tour, make_stops


def moved(session, stop, steps=35):
    """How far each hand has moved along the force on it after a stop's click [cm], robot by robot."""
    assert session.set(consistent(stop.settings(session.controls))) == []
    readout = Readout(session.sides)
    for request in stop.requests():
        if isinstance(request, Push):
            session.push(request)
        else:
            session.reset()
    for _ in range(steps):
        readout.take(session.step())
    cells = [line.strip("|").split("|") for line in readout.table(2).splitlines()[2:]]
    return {row[0].strip(): float(row[2]) for row in cells if row[2].strip() != "-"}


def test_every_stop_can_be_set_as_it_is_and_says_two_sentences(session):
    stops = make_stops(session.sides)
    assert len(stops) == 5
    for stop in stops:
        values = stop.settings(session.controls)
        for name, value in values.items():
            assert session.controls[name].clean(value) == (value, None)
        assert consistent(values) == values
        assert isinstance(stop.requests()[0], Reset)
        for push in stop.requests()[1:]:
            push.check()
        assert len(re.findall(r"[A-Za-z)]\.( |$)", stop.text)) == 2


def test_what_the_tour_says_of_stiffness_is_so(session):
    soft_and_stiff, directions, law, share, _ = make_stops(session.sides)
    for stop in (soft_and_stiff, directions):
        hands = moved(session, stop)
        assert hands["A left"] > 2.5 * hands["A right"] > 0.0
    hands = moved(session, law)
    assert hands["A left"] > 1.2 * hands["B left"]
    assert hands["A right"] > 1.2 * hands["B right"]
    hands = moved(session, share)
    assert 0.4 < hands["B left"] / hands["A left"] < 0.8


@pytest.fixture
def click(server, session):
    """Clicks a button of the tour; returns its text, and what was asked for."""
    asked = []
    add_tour(server.gui, session.controls, session.sides, lambda values, requests, _: asked.append((values, requests)))
    handles = list(server.gui._container_handle_from_uuid["root"]._children.values())
    text, buttons = handles[0], {button.label: button for button in handles[1:]}

    def press(label):
        asyncio.run(buttons[label]._impl.update_cb[0](SimpleNamespace(target=buttons[label], client=None)))
        return text.content, asked[-1]

    press.buttons = buttons
    return press


def test_next_goes_on_and_round_and_once_more_does_the_same_again(click, session):
    assert click.buttons["Once more"].disabled
    stops = make_stops(session.sides)
    for number, stop in (*enumerate(stops, 1), (1, stops[0])):
        for label in ("Next", "Once more"):
            text, asked = click(label)
            assert text == f"**{number} of 5: {stop.title}.** {stop.text}"
            assert asked == (stop.settings(session.controls), stop.requests())
        assert not click.buttons["Once more"].disabled
