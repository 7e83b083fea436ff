"""The page in a real browser: it loads, its controls act on the running simulation, and nothing in it complains."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import http.server
import math
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from viser import transforms as tf
from viser._messages import GuiUpdateMessage

from cotap.play import ROBOTS
from cotap.play.__main__ import PlayOptions, _live, restart
from cotap.play.app import App
from cotap.play.rules import VELOCITIES
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
        box = self.box(label, nth)
        box.fill(str(value))
        box.press("Enter")

    def box(self, label: str, nth: int = 0) -> Any:
        """That number box."""
        row = self.page.get_by_text(label, exact=True).nth(nth)
        return row.locator("xpath=ancestor::*[.//input][1]").locator("input").last

    def pixel(self, point: np.ndarray) -> tuple[float, float]:
        """Where the viewer sees a point of the scene."""
        camera = next(iter(self.app.server.get_clients().values())).camera
        right, down, ahead = tf.SO3(camera.wxyz).inverse() @ (np.asarray(point, np.float64) - camera.position)
        box = self.page.locator("canvas").first.bounding_box()
        focal = 0.5 * box["height"] / math.tan(0.5 * camera.fov)
        return (
            box["x"] + 0.5 * box["width"] + focal * right / ahead,
            box["y"] + 0.5 * box["height"] + focal * down / ahead,
        )

    def second_viewer(self) -> Any:
        """The same page once more in the browser."""
        other = self.page.context.new_page()
        other.goto(self.page.url)
        other.get_by_text("control steps/s").wait_for(timeout=1000.0 * PATIENCE_S)
        self.until("two viewers", lambda: len(self.app.server.get_clients()) == 2)
        return other

    def send(self, handle: Any, value: float) -> None:
        """What a message of the newest viewer does, with a value that no box lets through; all others get it."""
        server = self.app.server
        message = GuiUpdateMessage(handle._impl.uuid, {"value": value})
        handled = server.gui._handle_gui_updates(max(server.get_clients()), message)
        asyncio.run_coroutine_threadsafe(handled, server.get_event_loop()).result(PATIENCE_S)

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


class Tunnel:
    """A port that leads to another, as `ssh -L` makes one: bytes pass unchanged."""

    def __init__(self, target: int) -> None:
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._target))
                for source, sink in ((near, far), (far, near)):
                    threading.Thread(target=self._pass, args=(source, sink), daemon=True).start()

    @staticmethod
    def _pass(source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError), source, sink:
            while data := source.recv(1 << 16):
                sink.sendall(data)

    def close(self) -> None:
        self._listener.close()


@pytest.fixture
def page(free_port: int, tmp_path: Path, checkpoint: Path) -> Iterator[Page]:
    server = open_server("127.0.0.1", free_port)
    session = Session({"base": checkpoint})
    app = App(server, Scene(server, session.env.spec, len(ROBOTS)), session, tmp_path)
    thread = threading.Thread(target=app.run, daemon=True)
    thread.start()
    with opened(app) as page:
        yield page
    app.stop()
    thread.join(10.0)
    server.stop()
    assert not thread.is_alive()


@contextlib.contextmanager
def opened(app: App) -> Iterator[Page]:
    """The page of an app that runs, in a browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=ARGUMENTS)
        page = browser.new_context(viewport={"width": 1280, "height": 1000}).new_page()
        complaints: list[str] = []
        page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: complaints.append(str(e)))
        page.goto(f"http://127.0.0.1:{app.server.get_port()}")
        page.get_by_text("control steps/s").wait_for(timeout=1000.0 * PATIENCE_S)
        yield Page(app, page, complaints)
        browser.close()


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
    page.page.get_by_label("paused").click()
    page.until("it stands still", lambda: session.values["paused"])
    sim = session.env.sim
    assert not np.allclose(sim.qpos[0], sim.qpos[1], atol=1e-3)  # their left arms are under different laws
    page.button("Reset")
    page.until("both in one state", lambda: bool((sim.qpos[0] == sim.qpos[1]).all()))
    assert int(session.env.episode_length_buf[0]) == 0
    page.page.get_by_label("paused").click()
    page.tab("Record")
    page.button("Start recording")
    page.until("it is recording", lambda: page.app._recorder is not None and page.app._recorder.seconds > 1.0)
    page.button("Stop and save")
    page.until("it is written", lambda: page.app.archive.path is not None)
    assert page.app.archive.newest.trajectory.fell.shape[1] == 2
    page.page.screenshot(path=tmp_path / "side_by_side.png", timeout=1000.0 * PATIENCE_S)
    assert (tmp_path / "side_by_side.png").stat().st_size > 20_000
    assert page.complaints == []


def test_a_hand_is_dragged_by_the_mouse_and_the_page_says_how_stiff_it_feels(page: Page):
    page.app.mailbox.set("arm_actions", False)
    page.app.mailbox.set("paused", True)
    page.until("it stands still", lambda: page.app.session.values["paused"])
    page.button("Reset")  # an untrained robot stands for a second and a half
    page.page.wait_for_timeout(1000)
    x, y = page.pixel(page.app.scene.hands.batched_positions[0])
    mouse = page.page.mouse
    mouse.move(x, y)
    page.page.wait_for_timeout(1000)
    mouse.down()
    mouse.move(x + 40, y + 20, steps=4)
    page.until("the hand is held", lambda: page.app.session.values["a.left.drag"] is not None)
    page.app.mailbox.set("speed", 0.2)
    page.app.mailbox.set("paused", False)
    row = page.page.get_by_role("row").filter(has_text="left").first
    page.until("it is felt", lambda: float(row.get_by_role("cell").nth(1).inner_text().strip("()-") or 0.0) > 3.0)
    page.until("it gives way", lambda: float(row.get_by_role("cell").nth(2).inner_text().strip("()-") or 0.0) > 0.5)
    asked = row.get_by_role("cell").nth(4)
    page.until("as asked for", lambda: asked.inner_text().strip("()") == "300")
    mouse.up()
    page.until("it is let go", lambda: page.app.session.values["a.left.drag"] is None)


def test_keys_and_a_gamepad_drive_and_what_is_let_go_stops(page: Page):
    values = page.app.session.values
    high = {name: page.app.session.controls[name].high for name in VELOCITIES}

    def drives(what: str, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, stand: bool = False) -> None:
        shares = dict(zip(VELOCITIES, (x, y, yaw), strict=True))
        page.until(
            what,
            lambda: (
                values["stand"] is stand
                and all(math.isclose(values[n], shares[n] * high[n], abs_tol=1e-3) for n in VELOCITIES)
            ),
        )

    keyboard = page.page.keyboard
    camera = next(iter(page.app.server.get_clients().values())).camera
    page.tab("Walk")
    before = camera.position
    for key, axes in (("w", {"x": 0.5}), ("s", {"x": -0.5}), ("a", {"y": 0.5}), ("d", {"y": -0.5}), ("q", {"yaw": 0.5}),
                      ("e", {"yaw": -0.5})):  # fmt: skip
        keyboard.down(key)
        drives(f"{key} is held", **axes)
        keyboard.up(key)
        drives(f"{key} is let go")
    assert camera.position == pytest.approx(before)  # viser's keys for the camera are the same
    keyboard.down("Shift")
    keyboard.down("W")
    keyboard.down("Q")
    drives("fast, in a curve", x=1.0, yaw=1.0)
    ahead = page.box("forward [m/s]")
    page.until("sliders show it", lambda: float(ahead.input_value()) == pytest.approx(high["velocity_x"]))
    page.page.wait_for_timeout(1500)
    drives("still held", x=1.0, yaw=1.0)
    page.page.evaluate("window.dispatchEvent(new Event('blur'))")
    drives("another window is in front")
    for key in ("W", "Q", "Shift"):
        keyboard.up(key)
    page.page.get_by_label("stand").click()
    page.page.get_by_label("stand").click()
    keyboard.press("Space")  # not a second click of what was clicked last
    drives("to stand", stand=True)

    ahead.focus()
    keyboard.type("wasd ")
    page.page.wait_for_timeout(300)
    drives("nobody drives by typing", stand=True)
    ahead.blur()

    page.page.evaluate("""() => {
        window.pad = {connected: true, axes: [-1, 0.1, 0, 0], buttons: [{pressed: false}]};
        navigator.getGamepads = () => [null, window.pad]}""")
    drives("the stick to the left", y=1.0)
    page.page.evaluate("window.pad.axes = [0, -0.6, 0.5, 0]")
    drives("ahead and a turn to the right", x=0.6, yaw=-0.5)
    page.page.evaluate("window.pad.axes = [0.1, 0.1, -0.1, 0]")
    drives("the sticks at rest")
    page.page.evaluate("window.pad.buttons[0].pressed = true")
    drives("its first button", stand=True)
    page.page.evaluate("window.pad.buttons[0].pressed = false; window.pad.axes = [0, -1, 0, 0]")
    drives("ahead", x=1.0)
    page.page.evaluate("() => { navigator.getGamepads = () => { throw new Error('gone') } }")  # as a page that hangs
    drives("a browser that falls silent")
    page.complaints[:] = [text for text in page.complaints if "gone" not in text]
    assert page.complaints == []


def test_a_link_reproduces_settings_and_what_is_out_of_range_is_refused(page: Page):
    values, url = page.app.session.values, page.page.url
    page.page.goto(url + "?set=robot:h1,a.left.stiffness_x:870,velocity_x:0.35,stand:0,b.right.law:pd")
    page.until("the link's settings", lambda: values["a.left.stiffness_x"] == 870.0 and values["b.right.law"] == "pd")
    page.until("a walk", lambda: values["velocity_x"] == 0.35 and not values["stand"])
    page.tab("Arms")
    page.until("the page shows them", lambda: page.box("K_ee x [N/m]").input_value() == "870")
    page.number("K_ee z [N/m]", 450)
    page.tab("Record")
    link = page.page.get_by_role("link", name="link to these settings")
    page.until("all are linked", lambda: "a.left.stiffness_z:450" in (link.get_attribute("href") or ""))
    link.click()
    page.until("it is in the address bar", lambda: "a.left.stiffness_z:450" in page.page.url)
    made = page.page.url
    page.page.goto(url + "?set=robot:h1")
    page.until("the defaults", lambda: values["a.left.stiffness_x"] == 300.0 and values["b.right.law"] == "cotap")
    page.page.goto(made)
    page.until("all that was copied", lambda: values["a.left.stiffness_z"] == 450.0 and values["velocity_x"] == 0.35)
    assert values["a.left.stiffness_x"] == 870.0
    before = dict(values)
    page.page.goto(url + "?set=robot:h1,a.left.stiffness_x:9999")
    page.page.get_by_text("K_ee x [N/m] 9999 is outside [50, 1500]; nothing was changed").first.wait_for()
    assert values == before
    assert page.complaints == []


def test_the_tour_sets_pushes_and_says_what_to_see(page: Page):
    values = page.app.session.values
    page.tab("Tour")
    page.button("Next")
    page.until("a soft and a stiff hand", lambda: values["a.right.stiffness_x"] == 5.0 * values["a.left.stiffness_x"])
    page.page.get_by_text("1 of 5: Soft and stiff.").wait_for()
    page.until("both are pushed", lambda: bool((page.app._latest[1]["hand_force_w"][0, :, 0] > 20.0).all()))
    for _ in range(2):
        page.button("Next")
    page.page.get_by_text("3 of 5: Asked for, or left to the pose.").wait_for()
    page.until("B is under PD", lambda: values["side_by_side"] and values["b.left.law"] == "pd")
    page.page.get_by_role("row").filter(has_text="B left").first.wait_for()
    assert page.complaints == []


@pytest.mark.usefixtures("two_shipped")
def test_another_robot_comes_onto_the_same_page(free_port: int, tmp_path: Path):
    server, options = open_server("127.0.0.1", free_port), PlayOptions(output=str(tmp_path))
    apps = [_live(options)(server)]

    def run() -> None:
        while robot := apps[-1].run():
            apps.append(restart(server, options, robot))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    viewers = server.get_clients
    with opened(apps[0]) as page:
        for number, robot in ((1, "g1"), (2, "h1")):
            before = max(viewers())
            page.tab("Robot")
            page.page.get_by_role("combobox", name="robot").click()
            page.page.get_by_role("option", name=robot, exact=True).click()
            page.until("another app", lambda number=number: len(apps) > number)
            app = apps[number]
            assert app.session.env.spec.name == robot
            page.until("it runs", lambda app=app: app.session.num_steps > 20)
            page.until("the page was opened anew", lambda before=before: max(viewers(), default=before) > before)
            page.page.get_by_text("control steps/s").wait_for()
            page.page.keyboard.down("w")
            page.until("keys drive it", lambda app=app: app.session.values["velocity_x"] > 0.0)
            page.page.keyboard.up("w")
        assert page.page.get_by_role("tab", name="Robot").count() == 1
        # Between the two robots, a slow browser may have updates to come of plots that went.
        assert [text for text in page.complaints if "non-existent component" not in text] == []
    apps[-1].stop()
    thread.join(10.0)
    server.stop()
    assert not thread.is_alive()


def test_a_website_cannot_use_the_page_and_a_tunnel_can(page: Page, tmp_path: Path):
    """A page of another origin tries to connect as the page itself does; then the page itself through a tunnel."""
    port = int(page.page.url.rpartition(":")[2].strip("/"))
    (tmp_path / "index.html").write_text("<p>a website</p>")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path)
    website = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=website.serve_forever, daemon=True).start()
    connect = """url => new Promise(done => {
        const socket = new WebSocket(url);
        socket.onopen = () => { done("open"); socket.close() }; socket.onerror = () => done("refused")})"""
    assert page.page.evaluate(connect, f"ws://127.0.0.1:{port}") == "open"
    stranger = page.page.context.new_page()
    stranger.goto(f"http://127.0.0.1:{website.server_port}")
    for host in ("127.0.0.1", "localhost"):
        assert stranger.evaluate(connect, f"ws://{host}:{port}") == "refused"
    assert stranger.evaluate("url => fetch(url).then(() => 'read', () => 'refused')", f"http://127.0.0.1:{port}") == (
        "refused"
    )
    stranger.evaluate("url => { location = url }", f"http://127.0.0.1:{port}/?set=robot:h1,a.left.stiffness_x:870")
    stranger.get_by_text("a link with settings works from the address bar").wait_for()
    page.until("one viewer", lambda: len(page.app.server.get_clients()) == 1)
    stranger.close()
    website.shutdown()
    tunnel = Tunnel(port)
    through = page.page.context.new_page()
    through.goto(f"http://localhost:{tunnel.port}")
    through.get_by_text("control steps/s").wait_for(timeout=1000.0 * PATIENCE_S)
    page.until("a viewer through the tunnel", lambda: len(page.app.server.get_clients()) == 2)
    tunnel.close()


def test_on_a_small_screen_nothing_lies_upon_the_robots_and_plots_are_in_sight(page: Page):
    page.page.set_viewport_size({"width": 1000, "height": 800})
    page.page.get_by_label("side by side").click()
    page.until("two robots", lambda: page.app.scene.shown == 2)
    page.page.get_by_text("B right").first.wait_for()  # the plots' legend, once they are of two robots
    scene, head, plot = (
        part.bounding_box()
        for part in (page.page.locator("canvas").first, page.page.get_by_text("control steps/s"),
                     page.page.get_by_text(page.app.plots.TITLES[0], exact=True).last)
    )  # fmt: skip
    assert 500.0 < scene["x"] + scene["width"] <= head["x"]
    assert head["y"] < 200.0 < plot["y"] < 600.0
    assert page.complaints == []


def test_several_viewers_and_one_that_leaves_do_not_stop_it(page: Page):
    page.second_viewer().close()
    page.until("one viewer", lambda: len(page.app.server.get_clients()) == 1)
    steps = page.app.session.num_steps
    page.until("it goes on", lambda: page.app.session.num_steps > steps + 10)
    assert page.complaints == []


def test_a_flood_of_settings_is_survived_and_never_leaves_its_range(page: Page):
    page.tab("Walk")
    for value in [*range(-50, 50, 5), "1e400", "-"]:
        page.number("forward [m/s]", value)
    session, handle = page.app.session, page.app.panel._handles["velocity_x"]
    low, high = (getattr(session.controls["velocity_x"], end) for end in ("low", "high"))
    page.number("forward [m/s]", 0.2)
    page.until("the last of them counts", lambda: session.values["velocity_x"] == 0.2)
    other = page.second_viewer()
    for _ in range(50):
        for value in (math.inf, -math.inf, math.nan):
            page.send(handle, value)
            assert handle.value == 0.2
    refusal = other.get_by_text("forward [m/s] must be a finite number")

    def refused_again() -> bool:  # a notice is shown for some seconds, which a busy browser may miss
        page.send(handle, math.nan)
        return refusal.count() > 0

    page.until("the viewer reads why", refused_again)
    page.until("it is shown as it was", lambda: float(page.box("forward [m/s]").input_value()) == 0.2)
    page.send(handle, 1e300)
    page.until("it is moved to the end of its range", lambda: session.values["velocity_x"] == high)
    page.until("it is shown so", lambda: float(page.box("forward [m/s]").input_value()) == high)
    for value in (-1e300, 1e300) * 20:
        page.send(handle, value)
        assert low <= handle.value <= high
    steps = session.num_steps
    page.until("it goes on", lambda: session.num_steps > steps + 10)
    assert low <= session.values["velocity_x"] <= high
    assert np.isfinite(page.app._latest[1]["qpos"]).all()
    assert page.complaints == []
