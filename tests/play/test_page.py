"""The page in a real browser: it loads, its controls act on the running simulation, and nothing in it complains."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cotap.evaluation.policy import shipped_checkpoint
from cotap.play import ROBOTS
from cotap.play.app import App
from cotap.play.scene import Scene
from cotap.play.server import open_server
from cotap.play.session import Session

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
ARGUMENTS = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
]  # fmt: skip
PATIENCE_S = 120.0

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason=f"no browser to test the page in; looked for {', '.join(BROWSERS)}"),
]


class Page:
    """A page open in a browser on a running simulation, and what the browser complained about."""

    def __init__(self, app: App, page: Any, complaints: list[str]) -> None:
        self.app, self.page, self.complaints = app, page, complaints

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def button(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click()

    def number(self, label: str, value: float | str, nth: int = 0) -> None:
        """Type a value into the number box beside the slider of this label, the nth one on the page."""
        row = self.page.get_by_text(label, exact=True).nth(nth)
        box = row.locator("xpath=ancestor::*[.//input][1]").locator("input").last
        box.fill(str(value))
        box.press("Enter")

    def until(self, what: str, happened: Callable[[], bool]) -> None:
        """Wait for the simulation to have something; the test fails if it never does."""
        deadline = time.monotonic() + PATIENCE_S
        while not happened():
            assert time.monotonic() < deadline, f"never happened: {what}"
            self.page.wait_for_timeout(50)

    def hand_x(self, robot: int = 0, hand: int = 0) -> float:
        """Where the hand is ahead of its reference [m]."""
        sample = self.app._latest[1]
        return float((sample["hand_w"] - sample["hand_reference_w"])[robot, hand, 0])


@pytest.fixture
def page(free_port: int, tmp_path: Path) -> Iterator[Page]:
    from playwright.sync_api import sync_playwright

    server = open_server("127.0.0.1", free_port)
    session = Session({"base": shipped_checkpoint("base")})
    app = App(server, Scene(server, session.env.spec, len(ROBOTS)), session, tmp_path)
    thread = threading.Thread(target=app.run, daemon=True)
    thread.start()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=ARGUMENTS)
        page = browser.new_context(viewport={"width": 1280, "height": 1000}).new_page()
        complaints: list[str] = []
        page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: complaints.append(str(e)))
        page.goto(f"http://127.0.0.1:{free_port}")
        page.get_by_text("control steps/s").wait_for(timeout=1000.0 * PATIENCE_S)
        yield Page(app, page, complaints)
        browser.close()
    app.stop()
    thread.join(10.0)
    server.stop()
    assert not thread.is_alive()


def test_a_walk_through_the_page(page: Page, tmp_path: Path):
    session = page.app.session
    parameters = session.env.upper_body.parameters

    page.tab("Arms")
    page.number("K_ee x [N/m]", 800)
    page.until("stiffness of the left arm", lambda: float(parameters.stiffness[0, 0, 0]) == 800.0)
    assert float(parameters.stiffness[0, 1, 0]) == 300.0
    assert float(parameters.stiffness[1, 0, 0]) == 300.0

    page.number("K_ee z [N/m]", 99999, nth=1)  # the page's box clamps it, or the mailbox does
    page.until("stiffness of the right arm", lambda: float(parameters.stiffness[0, 1, 2]) == 1500.0)

    page.page.get_by_role("combobox", name="law").first.click()
    page.page.get_by_role("option", name="pd", exact=True).click()
    page.until("law of the left arm", lambda: session.values["a.left.law"] == "pd")
    assert session.values["a.right.law"] == "cotap"

    page.tab("Push")
    page.number("force [N]", 80)
    page.number("for [s]", 1)
    before = page.hand_x()
    page.button("Push forward")
    # The push rises and fades within its second, and a loaded machine may look at it late: one moment shows both.
    page.until(
        "a push of tens of newtons moves the hand ahead by 3 cm",
        lambda: page.hand_x() > before + 0.03 and page.app._latest[1]["hand_force_w"][0, 0, 0] > 20.0,
    )

    page.page.get_by_label("side by side").click()
    page.until("two robots", lambda: page.app.scene.shown == 2)
    page.button("Reset")
    page.until("both in one state", lambda: int(session.env.episode_length_buf[0]) < 50)
    page.tab("Record")
    page.button("Start recording")
    page.until("it is recording", lambda: page.app._recorder is not None and page.app._recorder.seconds > 1.0)
    page.button("Stop and save")
    page.until("it is written", lambda: page.app.archive.path is not None)
    assert page.app.archive.newest.trajectory.fell.shape[1] == 2
    page.page.screenshot(path=tmp_path / "side_by_side.png")
    assert (tmp_path / "side_by_side.png").stat().st_size > 20_000
    assert page.complaints == []


def test_several_viewers_and_one_that_leaves_do_not_stop_it(page: Page):
    other = page.page.context.new_page()
    other.goto(page.page.url)
    other.get_by_text("control steps/s").wait_for(timeout=1000.0 * PATIENCE_S)
    page.until("two viewers", lambda: len(page.app.server.get_clients()) == 2)
    other.close()
    page.until("one viewer", lambda: len(page.app.server.get_clients()) == 1)
    steps = page.app.session.num_steps
    page.until("it goes on", lambda: page.app.session.num_steps > steps + 10)
    assert page.complaints == []


def test_a_flood_of_settings_is_survived_and_never_leaves_its_range(page: Page):
    page.tab("Walk")
    for value in [*range(-50, 50, 5), "1e400", "-"]:
        page.number("forward [m/s]", value)
    steps = page.app.session.num_steps
    page.until("it goes on", lambda: page.app.session.num_steps > steps + 10)
    low, high = (getattr(page.app.session.controls["velocity_x"], end) for end in ("low", "high"))
    assert low <= page.app.session.values["velocity_x"] <= high
    assert np.isfinite(page.app._latest[1]["qpos"]).all()
