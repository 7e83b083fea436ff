"""The page of `cotap play` in a headless browser: how fast it is, and the recording in the README.

python -m benchmarks.page speed --viewers 2
python -m benchmarks.page film --output docs/play.webp --picture docs/play.png

Needs playwright (extra `dev`) and a Chromium.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from cotap.checks import require_one_of, require_range
from cotap.files import require_output, write_atomically

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGUMENTS = [
    "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
]  # fmt: skip
STATUS = "control steps/s"
"""What the head of the page says once everything runs."""
SHOWN_TIMES = """seconds => new Promise(resolve => {
    const seen = [], end = performance.now() + 1e3 * seconds;
    let last = null;
    const timer = setInterval(() => {
        const head = [...document.querySelectorAll("p")].find(p => p.textContent.includes("control steps/s"));
        const shown = head ? parseFloat(head.textContent) : NaN;
        if (last !== null && shown > last) seen.push([1e-3 * performance.now(), shown]);
        if (shown >= 0) last = shown;
        if (performance.now() > end) { clearInterval(timer); resolve(seen); }
    }, 20);
})"""
"""Wall time and simulated time [s] whenever the page's head changes."""
PATIENCE_S = 180.0
DRAWN_MS = 150.0
"""How long a step takes to be seen in the browser [ms]."""


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A browser that draws without a screen. Raises ValueError where there is none."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise ValueError(f"no browser: install Chromium; looked for {', '.join(BROWSERS)}")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise ValueError("playwright is not installed: pip install 'cotap[dev]'") from error
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def processor_s(process: int) -> float:
    """Processor time that a process has used [s]; NaN where the system has no /proc."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return math.nan
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def fill(page: Any, label: str, value: float, nth: int = 0) -> None:
    """Write a number into the box beside the slider called `label`."""
    box = page.get_by_text(label, exact=True).nth(nth).locator("xpath=ancestor::*[.//input][1]").locator("input").last
    box.fill(str(value))
    box.press("Enter")


@dataclass
class Speed:
    """Seconds from the command to a usable page, and control steps per second with several viewers."""

    viewers: int = 2
    """Browsers' pages that look on."""
    seconds: float = 20.0
    """How long steps are counted [s]."""
    width: int = 1280
    """Of each page [pixels]."""
    height: int = 800
    """Of each page [pixels]."""

    def run(self) -> str:
        """Measure. Returns lines to print."""
        require_range("viewers", self.viewers, 1, 16)
        require_range("seconds", self.seconds, 2.0, 3600.0)
        port = free_port()
        # The browser is up before the clock runs, as a reader's is.
        with chromium() as browser, tempfile.TemporaryDirectory() as folder:
            pages = [
                browser.new_context(viewport={"width": self.width, "height": self.height}).new_page()
                for _ in range(self.viewers)
            ]
            begin = time.perf_counter()
            play = subprocess.Popen(
                [sys.executable, "-m", "cotap.play", "--port", str(port), "--output", folder],
                stdout=subprocess.DEVNULL,
            )
            try:
                answers = self._open(pages[0], port, play, begin)
                pages[0].get_by_text(STATUS).wait_for(timeout=1000.0 * PATIENCE_S)
                usable, busy = time.perf_counter() - begin, processor_s(play.pid)
                for page in pages[1:]:
                    page.goto(f"http://127.0.0.1:{port}")
                    page.get_by_text(STATUS).wait_for(timeout=1000.0 * PATIENCE_S)
                at_pace, at_pace_ms = self._rate(pages[0], play.pid)
                fill(pages[0], "speed", 4.0)
                at_most, at_most_ms = self._rate(pages[0], play.pid)
            finally:
                play.terminate()
                play.wait(30.0)
        return (
            f"page answers after {answers:.1f} s, can be used after {usable:.1f} s ({busy:.1f} s of CPU time)\n"
            f"{self.viewers} viewers: {at_pace:.1f} control steps/s at speed 1 ({at_pace_ms:.1f} ms of CPU time "
            f"each), {at_most:.1f} at speed 4 ({at_most_ms:.1f} ms)"
        )

    def _open(self, page: Any, port: int, play: subprocess.Popen[bytes], begin: float) -> float:
        """Load the page as soon as somebody listens. Returns the seconds since `begin`."""
        while time.perf_counter() - begin < PATIENCE_S:
            if play.poll() is not None:
                raise ValueError(f"cotap play ended with exit status {play.returncode}")
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.2):
                answers = time.perf_counter() - begin
                page.goto(f"http://127.0.0.1:{port}")
                return answers
            time.sleep(0.02)
        raise ValueError(f"cotap play did not listen at port {port} within {PATIENCE_S:g} s")

    def _rate(self, page: Any, process: int) -> tuple[float, float]:
        """Control steps per second of wall time, and the program's processor time per step [ms]."""
        page.wait_for_timeout(2000)
        idle, begin = processor_s(process), time.perf_counter()
        shown = page.evaluate(SHOWN_TIMES, self.seconds)
        busy, seconds = processor_s(process) - idle, time.perf_counter() - begin
        rate = 50.0 * slope(shown)
        return rate, 1e3 * busy / (rate * seconds)


def slope(points: list[list[float]]) -> float:
    """Slope of the straight line nearest to points (x, y): single times are late by what a browser takes to draw.

    Raises ValueError for less than three points."""
    if len(points) < 3:
        raise ValueError(f"the page's head changed {len(points)} times only")
    return float(np.polyfit(*np.array(points).T, 1)[0])


def _until(page: Any, happened: Callable[[], bool]) -> None:
    """Wait for the simulation to have taken what the page sent. Raises ValueError if it never does."""
    deadline = time.monotonic() + PATIENCE_S
    while not happened():
        if time.monotonic() > deadline:
            raise ValueError("the simulation does not take what the page sends")
        page.wait_for_timeout(20)


@dataclass
class Film:
    """A recording of the page: the same push on a soft and on a stiff hand."""

    output: str = "docs/play.webp"
    """Animated picture (WebP or GIF)."""
    picture: str = ""
    """Write a still of the push on the stiff hand here (PNG)."""
    soft: float = 150.0
    """Stiffness at first [N/m]."""
    stiff: float = 1200.0
    """Stiffness after the change [N/m]."""
    force: float = 60.0
    """Of the pushes [N]."""
    width: int = 1100
    """Of the page [pixels]."""
    height: int = 700
    """Of the page [pixels]."""
    scale: float = 0.65
    """Of the recording's size over the page's."""
    fps: float = 12.5
    """Pictures per second of simulated time; the page waits for each, so that no machine is too slow."""
    seed: int = 0
    """Seed of the robots' start."""

    def run(self) -> str:
        """Film. Returns lines to print."""
        require_range("scale", self.scale, 0.1, 1.0)
        require_range("fps", self.fps, 1.0, 50.0)
        require_range("force", self.force, 5.0, 300.0)
        require_output("--output", self.output, (".webp", ".gif"))
        require_output("--picture", self.picture, (".png",))
        from cotap.evaluation.policy import shipped_checkpoint
        from cotap.play import ROBOTS
        from cotap.play.app import App
        from cotap.play.scene import Scene
        from cotap.play.server import open_server
        from cotap.play.session import Session

        port = free_port()
        server = open_server("127.0.0.1", port)
        with tempfile.TemporaryDirectory() as folder:
            policy = shipped_checkpoint("h1-cotap")
            session = Session({policy.stem: policy}, self.seed)
            app = App(server, Scene(server, session.env.spec, len(ROBOTS)), session, Path(folder))
            server.initial_camera.position, server.initial_camera.look_at = (2.1, 1.4, 1.4), (0.0, 0.1, 0.85)
            thread = threading.Thread(target=app.run, daemon=True)
            thread.start()
            try:
                with chromium() as browser:
                    view = {"width": self.width, "height": self.height}
                    page = browser.new_context(viewport=view).new_page()
                    page.goto(f"http://127.0.0.1:{port}")
                    page.get_by_text(STATUS).wait_for(timeout=1000.0 * PATIENCE_S)
                    pictures = self._scenes(page, app)
            finally:
                app.stop()
                thread.join(10.0)
                server.stop()
        return self._write(pictures)

    def _scenes(self, page: Any, app: Any) -> list[bytes]:
        """Screenshots, `fps` for every second of simulated time."""
        from cotap.play.mailbox import Step

        pictures: list[bytes] = []
        stride = max(1, round(1.0 / (self.fps * app.session.dt)))

        def shoot(seconds: float) -> None:
            for _ in range(round(seconds * self.fps)):
                for _ in range(stride):
                    before = app.session.num_steps
                    app.mailbox.ask(Step())
                    while app.session.num_steps == before:
                        time.sleep(0.005)
                page.wait_for_timeout(DRAWN_MS)
                pictures.append(page.screenshot())

        def set_stiffness(value: float) -> None:
            page.get_by_role("tab", name="Arms").click()
            for axis in "xyz":
                fill(page, f"K_ee {axis} [N/m]", value)
                _until(page, lambda axis=axis: app.session.values[f"a.left.stiffness_{axis}"] == value)

        def push() -> None:
            page.get_by_role("tab", name="Push").click()
            fill(page, "force [N]", self.force)
            page.get_by_role("button", name="Push forward", exact=True).click()

        for notice in page.get_by_role("alert").all():  # of drawing without a GPU
            notice.get_by_role("button").click()
        page.get_by_label("policy moves arms").click()  # the law alone
        page.get_by_label("paused").click()
        _until(page, lambda: app.session.values["paused"])
        set_stiffness(self.soft)
        shoot(0.6)
        push()
        shoot(1.6)
        set_stiffness(self.stiff)
        shoot(0.8)
        push()
        shoot(0.4)
        if self.picture:
            write_atomically(Path(self.picture), lambda p: p.write_bytes(pictures[-1]))
        shoot(1.2)
        return pictures

    def _write(self, pictures: list[bytes]) -> str:
        from PIL import Image

        size = (round(self.width * self.scale), round(self.height * self.scale))
        images = [
            Image.open(io.BytesIO(data)).convert("RGB").resize(size, Image.Resampling.LANCZOS) for data in pictures
        ]
        kind = Path(self.output).suffix[1:]
        options: dict[str, Any] = {"quality": 55, "method": 4, "minimize_size": True} if kind == "webp" else {}

        def save(path: Path) -> None:
            images[0].save(
                path,
                format=kind,
                save_all=True,
                append_images=images[1:],
                duration=round(1000.0 / self.fps),
                loop=0,
                **options,
            )

        write_atomically(Path(self.output), save)
        size_mb = Path(self.output).stat().st_size / 1e6
        return f"{self.output}: {len(images)} pictures, {len(images) / self.fps:.1f} s, {size_mb:.2f} MB"


COMMANDS = {"speed": Speed, "film": Film}


def main(argv: list[str] | None = None) -> int:
    """Parse, run, report. Returns the exit status: 0, or 2 for bad input."""
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        print(f"usage: python -m benchmarks.page COMMAND [options]; commands: {', '.join(COMMANDS)}")
        return 0 if args else 2
    try:
        kind = COMMANDS[require_one_of("command", args[0], COMMANDS.keys())]
        print(tyro.cli(kind, args=args[1:], prog=f"python -m benchmarks.page {args[0]}").run())
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
