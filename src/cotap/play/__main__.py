"""`cotap play`: a policy in the browser, to push, to lead, and to turn the stiffness of."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from cotap.checks import require_one_of, shortened
from cotap.files import require_folder
from cotap.play import ROBOTS
from cotap.play.startup import uncollected

if TYPE_CHECKING:
    from viser import ViserServer

    from cotap.play.app import App
    from cotap.play.replay import Replay


@dataclass
class PlayOptions:
    """Open a page on which to push a robot and change the stiffness of its hands."""

    host: str = "127.0.0.1"
    """Address to listen at. 127.0.0.1 is this machine only; 0.0.0.0 lets others in, and the URL then has a token."""
    port: int = 8080
    """Port to listen at."""
    checkpoint: tuple[str, ...] = ()
    """Policies to choose from: files, or shipped policies' names. They are all of one robot; the first of them runs at
    first, and the robot's shipped policies can be chosen as well."""
    robot: str = ""
    """Robot whose shipped policies run. By default h1. Checkpoints and recordings name their own."""
    library: str = ""
    """Motion library (.npz) to choose clips from. By default that of the first policy."""
    replay: str = ""
    """Show this recording (.npz) instead of simulating."""
    output: str = "runs/play"
    """Folder for recordings and films."""
    seed: int = 0
    """Seed of the robots' starts."""


def main(argv: list[str] | None = None) -> int:
    """Open the page and run it. Returns the exit status: 0, or 2 for bad input."""
    options = tyro.cli(PlayOptions, args=argv, prog="cotap play")
    try:
        return _run(options)
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped")
        return 0


def _run(options: PlayOptions) -> int:
    begin = time.perf_counter()
    if options.replay and (options.robot or options.checkpoint):
        raise ValueError("a recording has its own robot and policies: leave out --robot and --checkpoint with --replay")
    for name in ("library", "output", "seed"):
        if options.replay and getattr(options, name) != getattr(PlayOptions, name):
            raise ValueError(f"--{name} does nothing with --replay")
    if options.checkpoint and options.robot:
        raise ValueError("a checkpoint has its own robot: leave out --robot with --checkpoint")
    try:
        with uncollected():
            from cotap.play.guard import new_token, page_url
            from cotap.play.server import open_server
    except ImportError as error:
        raise ValueError(
            f"the page needs viser and mjviser ({error}): in cotap's folder, pip install -e '.[play]'"
        ) from error
    with uncollected():
        fill = _replay(options) if options.replay else _live(options)
    token = new_token(options.host)
    server = open_server(options.host, options.port, token)
    try:
        loading = server.gui.add_markdown("Loading the simulation ...")
        given = bool(options.replay or options.checkpoint or options.robot or options.library)
        if not given:  # the page answers while torch, the policy and the model are still being loaded
            print(f"open {page_url(options.host, options.port, token)}", flush=True)
        with uncollected():
            app = fill(server)
        if given:  # what was given can be shown
            print(f"open {page_url(options.host, options.port, token)}", flush=True)
        loading.remove()
        print(f"ready after {time.perf_counter() - begin:.1f} s; Ctrl-C ends it", flush=True)
        while robot := app.run():
            app = restart(server, options, robot)
    finally:
        server.stop()
    return 0


def restart(server: ViserServer, options: PlayOptions, robot: str) -> App:
    """Begin anew on a page with another robot. What was given for the first robot is not this one's."""
    from cotap.play.script import reload
    from cotap.play.server import empty

    first = _first_robot(options)
    empty(server)
    loading = server.gui.add_markdown(f"Loading the simulation of {robot} ...")
    given = options if robot == first else replace(options, checkpoint=(), robot=robot, library="")
    app = _live(given, first)(server)
    loading.remove()
    reload(server)
    return app


def _first_robot(options: PlayOptions) -> str:
    return _robot_of(options.checkpoint) if options.checkpoint else options.robot or "h1"


def _live(options: PlayOptions, first: str = "") -> Callable[[ViserServer], App]:
    """Read what was given: no page is opened for what cannot be shown. Returns what fills the page.

    `first` can be chosen again where it is not the robot of the options.
    """
    from cotap.robots import ROBOTS as KNOWN_ROBOTS

    require_folder("output", options.output)
    robot = _first_robot(options)
    require_one_of("robot", robot, KNOWN_ROBOTS)
    spec = KNOWN_ROBOTS[robot]()
    if options.robot:
        _policies(options, robot)
    if options.library:
        from cotap.motions.library import MotionLibrary

        MotionLibrary.load(options.library, spec)

    def fill(server: ViserServer) -> App:
        from cotap.play.scene import Scene

        scene = Scene(server, spec, len(ROBOTS))
        server.flush()  # browsers prepare it while the rest is loaded

        import torch

        import cotap.uncompiled  # noqa: F401
        from cotap.play.app import App
        from cotap.play.session import Session

        torch.set_num_threads(1)  # two robots: more would only wait for each other
        session = Session(_policies(options, robot), options.seed, options.library)
        shipped = (name for name in KNOWN_ROBOTS if _shipped_policies(name))
        robots = tuple(dict.fromkeys((first or robot, robot, *shipped)))
        return App(server, scene, session, Path(options.output), robots)

    return fill


def _policies(options: PlayOptions, robot: str) -> dict[str, Path]:
    """What can be chosen, by the names that are shown; the first runs at first. Raises ValueError if there is none."""
    import cotap.uncompiled  # noqa: F401
    from cotap.evaluation.policy import find_checkpoint

    policies = {name: find_checkpoint(name) for name in options.checkpoint} | _shipped_policies(robot)
    if not policies:
        raise ValueError(f"no policy of robot {robot!r} is shipped; train one, and give it with --checkpoint")
    return policies


def _robot_of(checkpoints: tuple[str, ...]) -> str:
    """The robot of all these. Raises ValueError if one cannot be used, or is of another robot."""
    import cotap.uncompiled  # noqa: F401
    from cotap.evaluation.policy import find_checkpoint, load_policy

    robots = {name: load_policy(find_checkpoint(name)).env_config.robot for name in checkpoints}
    first = robots[checkpoints[0]]
    for name, robot in robots.items():
        if robot != first:
            raise ValueError(f"checkpoint {name!r} is of robot {robot!r}, the first one of {first!r}")
    return first


def _shipped_policies(robot: str) -> dict[str, Path]:
    """Those of a robot, by the names that are shown; the first is what the page begins with."""
    from cotap.evaluation.policy import shipped_checkpoint, shipped_names

    names = [name for name in (f"{robot}-cotap", f"{robot}-base") if name in shipped_names()]
    return {f"shipped {name}": shipped_checkpoint(name) for name in names}


def _replay(options: PlayOptions) -> Callable[[ViserServer], Replay]:
    """Read the recording. Returns what fills the page."""
    import cotap.uncompiled  # noqa: F401
    from cotap.evaluation.recording import load_recording

    recording = load_recording(options.replay)

    def fill(server: ViserServer) -> Replay:
        from cotap.play.replay import Replay

        return Replay(server, recording, Path(options.replay))

    return fill


if __name__ == "__main__":
    sys.exit(main())
