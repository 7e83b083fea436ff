"""TensorBoard records and messages of a run: each is written at once, and a write that fails does not end the run."""

from __future__ import annotations

# TensorBoard's protocol buffers have no type stubs.
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
import contextlib
import io
import os
import sys
import time
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter
from tqdm import tqdm
from tqdm.utils import ObjectWrapper

_PREFIX = "events.out.tfevents."


class RunLog:
    """Writes one record an iteration and hands it to the system at once, so that a killed process loses none.

    TensorBoard reads a folder's files in the order of the times in their names. A file's name here is later than those
    there are, even if the clock has been set back since. `lost` counts records that could not be written.

    Args:
        run_dir: Folder of the run.
        samples: Samples so far; what older files hold beyond is void.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, run_dir: Path, samples: int) -> None:
        stamp = max([int(time.time()), *(_stamp(p) + 1 for p in run_dir.glob(_PREFIX + "*"))])
        self.path = run_dir / f"{_PREFIX}{stamp:010d}.cotap.{os.getpid()}"
        self.lost = 0
        self._file = self.path.open("ab", buffering=0)
        self._size = 0
        start = SessionLog(status=SessionLog.START)
        self._append(
            Event(wall_time=time.time(), file_version="brain.Event:2"),
            Event(wall_time=time.time(), step=samples + 1, session_log=start),
        )

    def write(self, scalars: dict[str, float], samples: int) -> OSError | None:
        """Append `scalars` at `samples`. A record that cannot be written whole is left out, and the reason returned."""
        values = [Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()]
        try:
            self._append(Event(wall_time=time.time(), step=samples, summary=Summary(value=values)))
        except OSError as error:
            self.lost += 1
            return error
        return None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _append(self, *events: Event) -> None:
        buffer = io.BytesIO()
        writer = RecordWriter(buffer)
        for event in events:
            writer.write(event.SerializeToString())
        left = memoryview(buffer.getvalue())
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError:
            self._file.truncate(self._size)  # a reader would go no further than a torn record
            raise
        self._size = self._file.tell()


class Unfailing(ObjectWrapper):
    """A stream whose failures end nothing: a run that is logged to a full disk goes on unseen."""

    def write(self, text: str) -> int:
        """Write what can be written."""
        with contextlib.suppress(OSError):
            self._wrapped.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush if that can be done."""
        with contextlib.suppress(OSError):
            self._wrapped.flush()

    def __eq__(self, other: object) -> bool:  # tqdm asks whether a message goes where its bar is
        return self._wrapped == getattr(other, "_wrapped", other)

    __hash__ = None  # pyright: ignore[reportAssignmentType]


def say(text: str) -> None:
    """Print a line above the progress bar."""
    tqdm.write(text, file=Unfailing(sys.stdout))


def _stamp(path: Path) -> int:
    text = path.name.removeprefix(_PREFIX).partition(".")[0]
    return int(text) if text.isdecimal() else 0
