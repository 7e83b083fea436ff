"""What the page's script says of keys and sticks, and who has fallen silent."""

from __future__ import annotations

import pytest

from cotap.play import drive
from cotap.play.controls import Number, Refused
from cotap.play.drive import SILENCE_S, Drive
from cotap.play.rules import VELOCITIES

RANGES = {"velocity_x": (-0.5, 1.0), "velocity_y": (-0.4, 0.4), "yaw_rate": (-1.0, 2.0)}
STILL = dict.fromkeys(VELOCITIES, 0.0)


@pytest.fixture
def driver(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(drive.time, "monotonic", lambda: now[0])
    made = Drive({name: Number(name, low, high, 0.0, 0.05) for name, (low, high) in RANGES.items()})
    made.wait = lambda seconds: now.__setitem__(0, now[0] + seconds)
    return made


@pytest.mark.parametrize(
    ("text", "velocities"),
    [("1 0 0 0 5", (1.0, 0.0, 0.0)), ("-1 0.5 -0.25 0 5", (-0.5, 0.2, -0.25)), ("0.5 -1 1 0 6", (0.5, -0.4, 2.0)),
     ("0.000 0.000 0.000 0 7", (0.0, 0.0, 0.0))],
)  # fmt: skip
def test_shares_are_of_each_directions_own_range(driver, text, velocities):
    assert driver.read(text) == dict(zip(VELOCITIES, velocities, strict=True))


def test_space_is_to_stand(driver):
    assert driver.read("0 0 0 1 8") == {"stand": True}


@pytest.mark.parametrize(
    "text", ["", "1", "1 0 0 0", "1 0 0 0 5 6", "1.001 0 0 0 5", "nan 0 0 0 5", "-inf 0 0 0 5", "w 0 0 0 5",
             "0 0 0 2 5", "0 0 0 0.5 5", None, 3.0, True, "1 " * 2000],
)  # fmt: skip
def test_what_no_script_says_is_refused_and_drives_nothing(driver, text):
    with pytest.raises(Refused, match="three shares from -1 to 1") as refusal:
        driver.read(text)
    assert len(str(refusal.value)) < 300
    driver.wait(10.0)
    assert driver.let_go() == {}


def test_who_falls_silent_lets_go_once(driver):
    driver.read("1 0 0 0 5")
    driver.wait(0.9 * SILENCE_S)
    assert driver.let_go() == {}
    driver.read("1 0 0 0 6")
    driver.wait(0.9 * SILENCE_S)
    assert driver.let_go() == {}
    driver.wait(0.2 * SILENCE_S)
    assert driver.let_go() == STILL
    assert driver.let_go() == {}


def test_who_has_let_go_leaves_the_sliders_to_others(driver):
    for last in ("0 0 0 0 6", "0 0 0 1 6"):
        driver.read("1 0 0 0 5")
        driver.read(last)
        driver.wait(10.0)
        assert driver.let_go() == {}
