"""Which controls give way to others, and which do nothing."""

from __future__ import annotations

import pytest

from cotap.compliance.laws import READS
from cotap.play.controls import Ranges, make_controls
from cotap.play.rules import consistent, without_effect

STILL = {"velocity_x": 0.0, "velocity_y": 0.0, "yaw_rate": 0.0}
UPRIGHT = {"stand": False, "height_offset": 0.0}


def controls(**changes):
    span = (-1.0, 1.0)
    given = {"velocity_x": span, "velocity_y": span, "yaw_rate": span, "height_offset": (-0.2, 0.0),
             "sides": ("left", "right"), "laws": ("cotap", "pd"), "motions": ("rest", "wave"),
             "checkpoints": ("one", "two")}  # fmt: skip
    return make_controls(Ranges(**given | changes))


def idle(changes, **ranges):
    of = controls(**ranges)
    return without_effect(of, {name: control.default for name, control in of.items()} | changes)


@pytest.mark.parametrize(
    ("asked", "becomes"),
    [({"velocity_y": 0.1}, {"velocity_y": 0.1, **UPRIGHT}), ({"yaw_rate": 0.0}, {"yaw_rate": 0.0}),
     ({"stand": True, "velocity_x": 0.4}, {"stand": True, **STILL}), ({"stand": False}, UPRIGHT),
     ({"stand": True}, {"stand": True, **STILL}), ({"speed": 2.0}, {"speed": 2.0}), ({}, {}),
     ({"height_offset": -0.1}, {"height_offset": -0.1, "stand": True, **STILL}),
     ({"height_offset": 0.0}, {"height_offset": 0.0}),
     ({"height_offset": -0.1, "velocity_x": 0.4}, {"height_offset": -0.1, "stand": True, **STILL})],
)  # fmt: skip
def test_standing_and_walking_end_each_other(asked, becomes):
    assert consistent(asked) == becomes


def test_what_a_law_does_not_read_does_nothing():
    assert idle({}) == set()
    grey = idle({"b.right.law": "pd"})
    axes = {"stiffness_x": "stiffness", "stiffness_y": "stiffness", "stiffness_z": "stiffness"}
    parts = axes | {name: name for name in ("null_stiffness", "alpha", "error", "damping", "passive")}
    assert grey == {f"b.right.{part}" for part, field in parts.items() if field not in READS["pd"]}
    assert "b.right.alpha" in grey


def test_what_can_only_be_one_thing_does_nothing():
    assert idle({}, checkpoints=("one",), velocity_y=(0.0, 0.0)) == {"a.checkpoint", "b.checkpoint", "velocity_y"}


def test_the_speed_of_a_pause_does_nothing():
    assert idle({"paused": True}) == {"speed"}
