"""One session for all tests of a module; each begins with the robots on their feet and the defaults in force."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from random_policy import save_random_policy
from viser import ViserServer

from cotap.evaluation.recording import Recording
from cotap.play.forces import Push
from cotap.play.recorder import Recorder
from cotap.play.server import open_server
from cotap.play.session import Session


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of the H1 that leaves its joints where they are: it stands for a second and a half."""
    return save_random_policy(tmp_path_factory.mktemp("policy") / "base.pt")


@pytest.fixture(scope="module")
def shared_session(checkpoint: Path) -> Session:
    return Session({"base": checkpoint, "missing": Path("nowhere.pt")})


@pytest.fixture
def session(shared_session: Session) -> Iterator[Session]:
    yield shared_session
    defaults = {name: c.default for name, c in shared_session.controls.items()}
    shared_session.set({n: v for n, v in defaults.items() if v != shared_session.values[n]})
    shared_session.reset()


@pytest.fixture
def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def server(free_port: int) -> Iterator[ViserServer]:
    server = open_server("127.0.0.1", free_port)
    yield server
    server.stop()


@pytest.fixture
def two_shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Policies of two robots, as if they were shipped; those that are shipped are not there."""
    names = {f"{robot}-base": save_random_policy(tmp_path / f"{robot}.pt", robot=robot) for robot in ("h1", "g1")}
    monkeypatch.setattr("cotap.evaluation.policy.shipped_names", lambda: list(names))
    monkeypatch.setattr("cotap.evaluation.policy.shipped_checkpoint", names.get)


@pytest.fixture
def record(session: Session) -> Callable[..., Recording]:
    """Records some steps of the first robots, both of them with the left hand pushed, robot b under PD."""

    def make(steps: int, count: int) -> Recording:
        recorder = Recorder(session.dt, count, session.describe())
        session.set({"b.left.law": "pd"})
        session.push(Push("left", (40.0, 0.0, 0.0), 1.0))
        for _ in range(steps):
            recorder.append(session.step(), {})
        return recorder.finish()

    return make
