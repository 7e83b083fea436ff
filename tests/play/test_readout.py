"""The readout against springs: what is shown is what a spring of known stiffness gives."""

from __future__ import annotations

import numpy as np
import pytest

from cotap.play.readout import Readout

SIDES = ("left", "right")
STIFFNESS = np.array([[[300.0, 600.0, 900.0], [50.0, 50.0, 50.0]], [[np.nan] * 3, [200.0, 200.0, 200.0]]])
SAG = np.array([0.02, -0.01, -0.03])


def sample(force_h, yaw=0.0, stiffness=STIFFNESS):
    """Two robots whose hands are springs, off their references by SAG without a force; the same force on all hands."""
    c, s = np.cos(yaw), np.sin(yaw)
    heading = np.tile(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), (2, 1, 1))
    force = np.broadcast_to(force_h, (2, 2, 3)) @ heading[0].T
    give = np.broadcast_to(force_h, (2, 2, 3)) / np.nan_to_num(stiffness, nan=1000.0) + SAG
    reference = np.array([[[0.3, 0.2, 1.0], [0.3, -0.2, 1.0]]] * 2)
    return {
        "heading_w": heading, "hand_force_w": force, "hand_reference_w": reference,
        "hand_w": reference + give @ heading[0].T, "commanded_stiffness": stiffness,
    }  # fmt: skip


def rows(readout, count=2):
    table = readout.table(count).splitlines()[2:]
    return {cells[0]: cells[1:] for cells in ([c.strip() for c in line.strip("|").split("|")] for line in table)}


@pytest.mark.parametrize("yaw", [0.0, 2.0])
@pytest.mark.parametrize(
    ("force", "row"),
    [((30.0, 0.0, 0.0), ["30.0", "10.0", "300", "300"]), ((0.0, -30.0, 0.0), ["30.0", "5.0", "600", "600"]),
     ((0.0, 0.0, 45.0), ["45.0", "5.0", "900", "900"]), ((24.0, 0.0, -18.0), ["30.0", "7.6", "395", "395"])],
)  # fmt: skip
def test_a_spring_feels_as_stiff_as_it_was_asked_to_be(force, row, yaw):
    readout = Readout(SIDES)
    readout.take(sample((0.0, 0.0, 0.0), yaw))
    readout.take(sample(force, yaw))
    shown = rows(readout)
    assert shown["A left"] == row
    assert shown["B left"][2:] == ["1000", "-"]  # a law that commands no stiffness
    assert list(shown) == ["A left", "A right", "B left", "B right"]
    assert list(rows(readout, 1)) == ["left", "right"]


def test_another_stiffness_than_asked_is_felt_and_what_has_hardly_moved_is_none():
    readout = Readout(SIDES)
    readout.take(sample((0.0, 0.0, 0.0)))
    readout.take(sample((30.0, 0.0, 0.0)) | {"commanded_stiffness": 2.0 * STIFFNESS})
    assert rows(readout)["A left"] == ["30.0", "10.0", "300", "600"]
    readout.take(sample((0.0, 0.0, 2.2)))
    assert rows(readout)["A left"] == ["2.2", "0.2", "-", "900"]
    back = sample((30.0, 0.0, 0.0))
    back["hand_w"] = back["hand_reference_w"] + SAG - np.array([0.05, 0.0, 0.0])
    readout.take(back)
    assert rows(readout)["A left"] == ["30.0", "-5.0", "-", "300"]


def test_what_the_last_force_did_stays_in_brackets():
    readout = Readout(SIDES)
    assert rows(readout) == {}
    readout.take(sample((0.0, 0.0, 0.0)))
    assert rows(readout)["A left"] == ["-"] * 4
    readout.take(sample((30.0, 0.0, 0.0)))
    readout.take(sample((0.0, 0.0, 0.0)))
    assert rows(readout)["A left"] == ["(30.0)", "(10.0)", "(300)", "(300)"]


def test_hands_that_were_put_elsewhere_start_from_there():
    readout = Readout(SIDES)
    readout.take(sample((0.0, 0.0, 0.0)))
    readout.take(sample((30.0, 0.0, 0.0)))
    readout.clear()
    assert rows(readout) == {}
    readout.take(sample((3.0, 0.0, 0.0)))
    readout.take(sample((33.0, 0.0, 0.0)))
    assert rows(readout)["A left"][:2] == ["33.0", "10.0"]
