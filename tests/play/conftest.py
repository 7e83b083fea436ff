"""One session for all tests of a module; each begins with the robots on their feet and the defaults in force."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from cotap.evaluation.policy import shipped_checkpoint
from cotap.play.session import Session


@pytest.fixture(scope="module")
def shared_session() -> Session:
    return Session({"base": shipped_checkpoint("base"), "missing": Path("nowhere.pt")})


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
