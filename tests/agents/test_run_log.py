"""A run's curves: whole after a kill, in order after a clock that was set back, and never a reason to end a run."""

from __future__ import annotations

import errno
import os
import sys
import time
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tqdm import tqdm

from cotap.agents.run_log import RunLog, Unfailing, say


def curve(folder: Path) -> list[tuple[int, float]]:
    events = EventAccumulator(str(folder))
    events.Reload()
    return [(e.step, e.value) for e in events.Scalars("a/b")]


def test_every_record_is_there_without_closing(tmp_path: Path):
    log = RunLog(tmp_path, 0)
    for step in (10, 20):
        assert log.write({"a/b": step / 4.0, "c": 1.0}, step) is None
    assert curve(tmp_path) == [(10, 2.5), (20, 5.0)]


def test_what_a_run_goes_on_from_voids_what_was_beyond(tmp_path: Path):
    first = RunLog(tmp_path, 0)
    for step in (10, 20, 30):
        first.write({"a/b": 1.0}, step)
    second = RunLog(tmp_path, 20)
    second.write({"a/b": 2.0}, 30)
    assert curve(tmp_path) == [(10, 1.0), (20, 1.0), (30, 2.0)]


@pytest.mark.parametrize("jump", [-86400.0, -3e8, 0.0, 86400.0])
def test_files_are_read_in_the_order_written_whatever_the_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jump: float
):
    now = time.time()
    RunLog(tmp_path, 0).write({"a/b": 1.0}, 10)
    monkeypatch.setattr(time, "time", lambda: now + jump)
    RunLog(tmp_path, 10).write({"a/b": 2.0}, 20)
    RunLog(tmp_path, 20).write({"a/b": 3.0}, 30)
    assert curve(tmp_path) == [(10, 1.0), (20, 2.0), (30, 3.0)]
    assert len(list(tmp_path.iterdir())) == 3


def test_a_record_that_does_not_fit_is_left_out_whole_and_counted(tmp_path: Path):
    import resource

    log = RunLog(tmp_path, 0)
    log.write({"a/b": 1.0}, 10)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (log.path.stat().st_size + 5, hard))
    try:
        reason = log.write({"a/b": 2.0}, 20)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert isinstance(reason, OSError)
    assert log.lost == 1
    log.write({"a/b": 3.0}, 30)
    assert curve(tmp_path) == [(10, 1.0), (30, 3.0)]


def test_a_folder_that_is_none_is_an_os_error(tmp_path: Path):
    with pytest.raises(OSError, match="No such file"):
        RunLog(tmp_path / "missing", 0)


class FullStream:
    """Output that is redirected to a full disk."""

    encoding = "utf-8"

    def write(self, _text: str) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def flush(self) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_under_the_output_ends_nothing(monkeypatch: pytest.MonkeyPatch):
    full = FullStream()
    with pytest.raises(OSError, match="No space left"):
        tqdm.write("lost", file=full)
    monkeypatch.setattr(sys, "stdout", full)
    say("lost")
    monkeypatch.undo()
    bar = tqdm(total=3, file=Unfailing(full), mininterval=0.0)
    assert [bar.update() for _ in range(3)] == [True] * 3


def test_what_is_said_goes_to_the_present_output(capsys: pytest.CaptureFixture[str]):
    say("heard")
    assert capsys.readouterr().out == "heard\n"
