"""Reading joblib files without running anything in them.

A joblib file is a pickle whose numpy arrays are wrapper objects, each followed by its raw bytes. The reader here admits
those wrappers, plain containers and numbers, and nothing else; joblib itself is not used.
"""

from __future__ import annotations

# The standard library's unpickler in Python has no type stubs.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false
import bz2
import gzip
import io
import lzma
import pickle
import zlib
from collections import OrderedDict
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from cotap.motions.library import MotionError

_LARGEST = 16 * 2**30
"""Bytes beyond which a file is refused, unpacked."""


class _ArrayWrapper:
    """Stands in for joblib's own wrapper class; holds the same fields and has no behaviour."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.shape = tuple(int(n) for n in state["shape"])
        self.order, self.dtype = str(state["order"]), state["dtype"]
        self.padded = state.get("numpy_array_alignment_bytes") is not None


_ARRAY_TYPE = object()
"""Stands in for numpy.ndarray, which a file may name but not call."""


def _plain_dtype(text: Any, *_: Any) -> np.dtype:
    """A dtype of numbers; objects and records, which could be made to point anywhere, are refused."""
    dtype = np.dtype(str(text))
    if dtype.kind not in "biufSU":
        raise MotionError(f"holds numbers of type {text!r}, which no motion needs")
    return dtype


def _new_array(kind: Any, *_: Any) -> np.ndarray:
    if kind is not _ARRAY_TYPE:
        raise MotionError(f"makes an array of {kind!r}, which no motion needs")
    return np.zeros(0, np.int8)


def _scalar(dtype: Any, data: Any) -> Any:
    if not isinstance(dtype, np.dtype) or not isinstance(data, bytes):
        raise MotionError("holds a number that is none")
    return np.frombuffer(data, dtype, 1)[0]


_ADMITTED: dict[tuple[str, str], Any] = {
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): _ArrayWrapper,
    ("numpy", "ndarray"): _ARRAY_TYPE,
    ("numpy", "dtype"): _plain_dtype,
    ("collections", "OrderedDict"): OrderedDict,
    # How Python writes bytes where pickles know only text.
    ("_codecs", "encode"): lambda text, _encoding="latin1": str(text).encode("latin1"),
}
for _core in ("numpy.core.multiarray", "numpy._core.multiarray"):
    _ADMITTED[(_core, "_reconstruct")] = _new_array
    _ADMITTED[(_core, "scalar")] = _scalar


class _Unpickler(pickle._Unpickler):
    """Python's own unpickler, in Python, because the arrays' bytes lie between its opcodes."""

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        self.file = file

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ADMITTED:
            raise MotionError(f"asks for {module}.{name}, which no motion needs; nothing was run")
        return _ADMITTED[(module, name)]

    def load_build(self) -> None:
        """Give an object its state: only those few kinds that are known here have any."""
        state = self.stack.pop()
        made = self.stack[-1]
        if isinstance(made, _ArrayWrapper):
            made.__setstate__(state)
            self.stack[-1] = _read_array(made, self.file)
        elif isinstance(made, np.dtype):
            if state[1] not in ("<", "|", "="):
                raise MotionError(f"holds numbers in byte order {state[1]!r}; '<' is supported")
        elif isinstance(made, np.ndarray):
            _, shape, dtype, fortran, data = state
            if not isinstance(dtype, np.dtype) or not isinstance(data, bytes):
                raise MotionError("holds an array that is none of numbers")
            made.__setstate__((1, shape, dtype, fortran, data))
        else:
            raise MotionError(f"sets the state of a {type(made).__name__}, which no motion needs")

    dispatch[pickle.BUILD[0]] = load_build


def _read_array(wrapper: _ArrayWrapper, file: BinaryIO) -> np.ndarray:
    dtype = wrapper.dtype
    if not isinstance(dtype, np.dtype) or min(wrapper.shape, default=0) < 0:
        raise MotionError(f"holds an array of {dtype!r} and shape {wrapper.shape}, which is no motion")
    if wrapper.padded:
        file.read(int.from_bytes(file.read(1), "little"))
    count = int(np.prod(wrapper.shape, dtype=object)) if wrapper.shape else 1
    data = file.read(count * dtype.itemsize) if count * dtype.itemsize <= _LARGEST else b""
    if len(data) != count * dtype.itemsize:
        raise MotionError(f"ends within an array of shape {wrapper.shape}: the file is truncated")
    array = np.frombuffer(data, dtype=dtype, count=count)
    if wrapper.order == "F":  # stored column by column
        return array.reshape(wrapper.shape[::-1]).transpose()
    return array.reshape(wrapper.shape)


def _unpacked(path: Path) -> BinaryIO:
    """The file's content, whatever it was compressed with."""
    raw = path.read_bytes()
    for magic, unpack in (
        (b"\x1f\x8b", gzip.open), (b"BZ", bz2.open), (b"\xfd7zXZ", lzma.open), (b"\x5d\x00", lzma.open),
    ):  # fmt: skip
        if raw.startswith(magic):
            data = unpack(io.BytesIO(raw)).read(_LARGEST + 1)
            break
    else:
        data = zlib.decompressobj().decompress(raw, _LARGEST + 1) if raw[:1] == b"\x78" else raw
    if len(data) > _LARGEST:
        raise MotionError(f"is larger than {_LARGEST} bytes when unpacked")
    return io.BytesIO(data)


def load_joblib(path: Path) -> Any:
    """The content of a joblib file or plain pickle of containers, numbers and numpy arrays.

    Raises:
        MotionError: the file is missing, truncated, or asks for anything else. Nothing in it is ever run.
    """
    try:
        return _Unpickler(_unpacked(path)).load()
    except MotionError as error:
        raise MotionError(f"{str(path)!r} {error}") from error
    except FileNotFoundError as error:
        raise MotionError(f"motion file {str(path)!r} does not exist") from error
    except PermissionError as error:
        raise MotionError(f"motion file {str(path)!r} cannot be read: {error}") from error
    except (
        Exception
    ) as error:  # opcodes of a hostile file run into whatever their operands lack; one bad file is reported
        raise MotionError(f"{str(path)!r} is damaged or no joblib file: {type(error).__name__}: {error}") from error
