"""Links that hold settings: what comes back is what was there, and nothing else gets in."""

from __future__ import annotations

import re

import pytest
from test_rules import controls

from cotap.play.controls import Refused
from cotap.play.guard import _SETTINGS
from cotap.play.link import from_text, to_text

NAMES = {
    "checkpoints": ("shipped h1-base", "runs/a~b%20&websocket=ws:,x.pt", "c\u00e4"),
    "motions": ("rest", "a,b:c"),
}


def defaults(of):
    return {name: control.default for name, control in of.items()}


def test_settings_come_back_as_they_were():
    of = controls(**NAMES)
    changed = {
        "stand": False, "velocity_x": -0.35, "yaw_rate": 1.0, "a.left.stiffness_x": 870.0, "b.right.law": "pd",
        "a.checkpoint": NAMES["checkpoints"][1], "b.checkpoint": NAMES["checkpoints"][2], "motion": "a,b:c",
        "held.left.z": -12.5, "side_by_side": True, "speed": 0.1, "push.hand": "right", "a.left.alpha": 0.33,
    }  # fmt: skip
    values = defaults(of) | changed
    text = to_text("h1", of, values | {"paused": True, "a.left.drag": (1.0, 2.0, 3.0)})
    assert _SETTINGS.fullmatch(f"set={text}")
    read = from_text(text, "h1", of)
    assert read == {n: v for n, v in values.items() if n != "paused" and not n.endswith(".drag")}
    assert {n: v for n, v in read.items() if v != of[n].default} == changed


def test_of_the_defaults_only_the_robot_is_said():
    of = controls()
    assert to_text("h1", of, defaults(of)) == "robot:h1"
    assert from_text("robot:h1", "h1", of)["stand"] is True


def test_a_velocity_by_hand_ends_standing_as_on_the_page():
    assert from_text("robot:h1,velocity_x:0.5", "h1", controls())["stand"] is False


@pytest.mark.parametrize(
    ("text", "reason"),
    [("robot:h1,a.left.stiffness_x:1501", "K_ee x [N/m] 1501 is outside [50, 1500]"),
     ("robot:h1,velocity_x:-1e400", "must be a finite number"), ("robot:h1,velocity_x:nan", "must be a finite number"),
     ("robot:h1,velocity_x:", "must be a finite number, got ''"),
     ("robot:h1,stand:yes", "must be on or off, got 'yes'"),
     ("robot:h1,a.left.law:lqr", "law 'lqr' is unknown; known: cotap, pd"), ("robot:g1", "of another robot than h1"),
     ("velocity_x:0.5", "of another robot than h1"), ("robot:h1,speed:1,speed:2", "'speed' in the link is there twice"),
     ("robot:h1,qpos:1", "'qpos' in the link is no setting"),
     ("robot:h1,paused:1", "'paused' in the link is no setting"),
     ("robot:h1,a.left.drag:1", "'a.left.drag' in the link is no setting"), ("", "'' in the link is no setting"),
     ("robot:h1,a.checkpoint:~2Fetc~2Fpasswd", "policy '/etc/passwd' is unknown"), (None, "no setting"),
     ("x" * 4000, "no setting"), ("robot:h1,a.left.law:~FF~", "is unknown")],
)  # fmt: skip
def test_what_is_no_setting_or_out_of_its_range_is_refused(text, reason):
    with pytest.raises(Refused, match=re.escape(reason)) as refusal:
        from_text(text, "h1", controls())
    assert "is used" not in str(refusal.value)
    assert len(str(refusal.value)) < 300


@pytest.mark.parametrize(
    "query", ["set=", "set=a&websocket=ws://evil.example", "set=a%26websocket=x", "set=a;b", "set=a=b", "set=a#b",
              "set=a+b", "set=<b>", "Set=a", "xset=a", "set=" + "a" * 4001],
)  # fmt: skip
def test_what_could_mean_more_than_settings_is_no_link(query):
    assert not _SETTINGS.fullmatch(query)
