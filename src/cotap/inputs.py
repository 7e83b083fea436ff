"""Files that a user may have received: regular ones only, no more of them than is needed, and nothing in them run."""

from __future__ import annotations

import math
import stat
import zipfile
from collections.abc import Collection
from pathlib import Path

import numpy as np

from cotap.checks import quoted, reason_of
from cotap.memory import free_bytes

LARGEST_TEXT = 1 << 28
"""Bytes of text that are read; as numbers it takes ten times as much memory."""
_LFS_POINTER = b"version https://git-lfs.github.com/spec/"


class InputError(ValueError):
    """Why a file cannot be used. The message goes on where the file's name ends, as in `is no regular file`."""


def require_regular(path: Path | str) -> int:
    """The size of a file [bytes].

    Raises:
        InputError: it does not exist, cannot be opened, is a folder or device, or a Git LFS pointer in its place.
    """
    try:
        status = Path(path).stat()
        if not stat.S_ISREG(status.st_mode):  # a device may have no end, a pipe no beginning
            raise InputError(f"is no file but a {'folder' if stat.S_ISDIR(status.st_mode) else 'device or pipe'}")
        with Path(path).open("rb") as file:
            pointer = file.read(len(_LFS_POINTER)) == _LFS_POINTER
    except FileNotFoundError as error:
        raise InputError("does not exist") from error
    except InputError:
        raise
    except (OSError, ValueError) as error:  # the latter for a name that no file can have
        raise InputError(f"cannot be opened or read from disk: {reason_of(error)}") from error
    if pointer:
        raise InputError("is a Git LFS pointer, which stands for the file itself; git lfs pull fetches it")
    return status.st_size


def read_bytes(path: Path | str, largest: int) -> bytes:
    """A file of at most `largest` bytes. Raises InputError for a larger one, and as `require_regular` does."""
    size = require_regular(path)
    if size > largest:
        raise InputError(f"has {size} bytes; at most {largest} are read")
    _require_room("has", size)
    try:
        with Path(path).open("rb") as file:
            return file.read(size)  # no more than it had: memory is taken for all that is asked for
    except OSError as error:
        raise InputError(f"cannot be opened or read from disk: {reason_of(error)}") from error


def read_text(path: Path | str, largest: int = LARGEST_TEXT) -> str:
    """A text of at most `largest` bytes in UTF-8. Raises InputError for another, and as `read_bytes` does."""
    try:
        return read_bytes(path, largest).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"is no text in UTF-8: {error.reason} at byte {error.start}") from error


def array_names(path: Path | str) -> list[str]:
    """Names of the arrays in an npz file; none of them is read. Raises InputError as `read_arrays` does."""
    with _open(path) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def read_arrays(path: Path | str, names: Collection[str], largest: int) -> dict[str, np.ndarray]:
    """Those arrays of an npz file that are called one of `names` and are there; all else in it is passed over.

    Raises:
        InputError: it is no npz file, is damaged, one of these arrays is of Python objects, or they claim to take more
            than `largest` bytes, which is found out before any of them is read.
    """
    with _open(path) as archive:
        entries = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        found = {name: entries[name] for name in names if name in entries}
        size = sum(info.file_size for info in found.values())
        if size > largest:
            raise InputError(f"holds {', '.join(found)} of {size} bytes when unpacked; at most {largest} are read")
        _require_room("unpacks to", size)
        try:
            return {name: _read_array(archive, name, info) for name, info in found.items()}
        except InputError:
            raise
        except OSError as error:
            raise InputError(f"cannot be opened or read from disk: {reason_of(error)}") from error
        except Exception as error:  # zip, zlib and numpy each fail in ways of their own on rubbish
            raise InputError(f"is damaged: {reason_of(error)}") from error


def _require_room(does: str, size: int) -> None:
    free = free_bytes()
    if free is not None and size > free:
        raise InputError(f"{does} {size} bytes; there is memory for {free}")


def _open(path: Path | str) -> zipfile.ZipFile:
    require_regular(path)
    try:
        return zipfile.ZipFile(path)
    except Exception as error:  # as above
        raise InputError(f"is damaged or no npz file: {reason_of(error)}") from error


def _read_array(archive: zipfile.ZipFile, name: str, info: zipfile.ZipInfo) -> np.ndarray:
    """One array, once its header claims no objects and no more than there is."""
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise InputError(f"has {name} in version {version} of numpy's format; 1 and 2 are read")
        headers = (np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0)
        shape, _, dtype = headers[version[0] - 1](file)
        if dtype.hasobject:
            raise InputError(f"has {name} as Python objects, which could run code; numbers and text are read")
        claimed, there = math.prod(shape) * dtype.itemsize, info.file_size - file.tell()
        if claimed != there:
            raise InputError(f"has {name} of shape {quoted(shape)} in {there} bytes instead of {claimed}")
    with archive.open(info) as file:
        return np.lib.format.read_array(file, allow_pickle=False)
