"""What comes from the page: cleaned, bounded, and the newest counts."""

from __future__ import annotations

import math
import threading

import pytest

from cotap.play.controls import Choice, Flag, Number, Point, Refused
from cotap.play.forces import Push
from cotap.play.mailbox import QUEUE, Mailbox, Reset, Step

CONTROLS = {
    "k": Number("K_ee x [N/m]", 50.0, 1500.0, 300.0, 10.0),
    "law": Choice("law", ("pd", "cotap"), "cotap"),
    "stand": Flag("stand", True),
    "drag": Point("drag", 10.0),
}


@pytest.mark.parametrize(("sent", "used"), [(200, 200.0), (-3.0, 50.0), (1e300, 1500.0)])
def test_numbers_are_brought_into_their_range_and_a_notice_says_so(sent, used):
    mailbox = Mailbox(CONTROLS)
    value, notice = mailbox.set("k", sent)
    assert value == used
    assert isinstance(value, float)
    assert (notice is None) == (sent == used)
    assert mailbox.take()[0] == {"k": used}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("k", math.nan), ("k", math.inf), ("k", "300"), ("k", None), ("k", True), ("k", [300.0]), ("law", "PD"),
        ("law", 3), ("stand", 1), ("stand", "yes"), ("drag", (0.0, 1.0)), ("drag", (0.0, math.nan, 0.0)),
        ("drag", "xyz"), ("qpos", 1.0), ("x" * 10_000, 1.0),
    ],
)  # fmt: skip
def test_what_is_no_value_is_refused_by_name_and_leaves_nothing(name, value):
    mailbox = Mailbox(CONTROLS)
    with pytest.raises(Refused) as refusal:
        mailbox.set(name, value)
    assert len(str(refusal.value)) < 300
    assert mailbox.take() == ({}, [])


def test_a_flood_takes_no_room_and_the_newest_value_counts():
    mailbox = Mailbox(CONTROLS)

    def send(offset: int) -> None:
        for i in range(2000):
            mailbox.set("k", 100.0 + offset + i % 7)

    threads = [threading.Thread(target=send, args=(100 * t,)) for t in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    mailbox.set("k", 77.0)
    assert mailbox.take() == ({"k": 77.0}, [])
    assert mailbox.take() == ({}, [])


def test_requests_wait_in_order_and_too_many_are_refused():
    mailbox = Mailbox(CONTROLS)
    for i in range(QUEUE):
        mailbox.ask(Step() if i % 2 else Reset())
    with pytest.raises(Refused, match=str(QUEUE)):
        mailbox.ask(Step())
    requests = mailbox.take()[1]
    assert [type(r) for r in requests] == [Reset, Step] * (QUEUE // 2)
    mailbox.ask(Step())


@pytest.mark.parametrize(
    "push",
    [Push("left", (math.nan, 0.0, 0.0), 0.1), Push("left", (500.0, 500.0, 0.0), 0.1), Push("left", (1.0, 0, 0), 0.0),
     Push("left", (1.0, 0.0, 0.0), math.inf)],
)  # fmt: skip
def test_pushes_that_cannot_be_are_refused(push):
    mailbox = Mailbox(CONTROLS)
    with pytest.raises(Refused, match="push"):
        mailbox.ask(push)
    assert mailbox.take()[1] == []


def test_a_point_out_of_reach_is_moved_and_a_notice_says_so():
    mailbox = Mailbox(CONTROLS)
    assert mailbox.set("drag", (1.0, -2.0, 3.0)) == ((1.0, -2.0, 3.0), None)
    point, notice = mailbox.set("drag", (1.0, 2.0, -1e9))
    assert point == (1.0, 2.0, -10.0)
    assert "drag -1e+09 is outside [-10, 10]" in notice
