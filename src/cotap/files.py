"""Files written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it: readers see the old file or the new, whole.

    Raises:
        OSError: the disk is full or the folder not writable; the error names `path`, nothing is left behind, and an old
            file is untouched.
    """
    try:
        _write_beside(path, write)
    except OSError as error:
        if error.errno is None:  # raised by our own code, which says what it was about
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
    _sync_folder(path.parent)


def _write_beside(path: Path, write: Callable[[Path], object]) -> None:
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    os.umask(mask := os.umask(0))  # the only way to read it
    os.chmod(name, 0o666 & ~mask)  # a temporary file is private; the file that it becomes is like any other
    temporary = Path(name)
    try:
        write(temporary)
        with temporary.open("rb") as f:
            os.fsync(f.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a compressed npz without objects, whole or not at all. Raises OSError as `write_atomically` does."""

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:  # numpy would add .npz to a name
            np.savez_compressed(file, allow_pickle=False, **arrays)

    write_atomically(path, write)


def require_output(option: str, path: Path | str, suffixes: tuple[str, ...] = ()) -> None:
    """Find out before the work, rather than after it, that a file could not be written; an empty path is none.

    Raises:
        ValueError: its folder does not exist, it is a folder itself, or it ends in none of `suffixes` (if any).
        OSError: its folder cannot be written to.
    """
    target = Path(path)
    if not str(path):
        return
    if not target.resolve().parent.is_dir():
        raise ValueError(f"{option} {str(path)!r}: its folder does not exist")
    if target.is_dir():
        raise ValueError(f"{option} {str(path)!r} is a folder, not a file")
    if suffixes and target.suffix.lower() not in suffixes:
        raise ValueError(f"{option} must end in {' or '.join(suffixes)}, got {str(path)!r}")
    try:
        handle, name = tempfile.mkstemp(prefix=".writable.", dir=target.resolve().parent)
    except OSError as error:
        raise OSError(error.errno, f"{option}: {error.strerror}", str(path)) from error
    os.close(handle)
    os.unlink(name)


def require_folder(option: str, path: Path | str) -> None:
    """Raise ValueError if `path` is no folder and cannot become one, since a file is in its way."""
    first = next(place for place in (Path(path).absolute(), *Path(path).absolute().parents) if place.exists())
    if not first.is_dir():
        raise ValueError(f"{option} {str(path)!r} cannot be a folder: {str(first)!r} is a file")


def _sync_folder(folder: Path) -> None:
    """Make a rename last through a power cut, where the system can."""
    with contextlib.suppress(OSError):  # Windows opens no folders, and some file systems sync none
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
