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
import struct
import zlib
from collections import OrderedDict
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np

from cotap.checks import legible, quoted
from cotap.inputs import InputError, read_bytes
from cotap.motions.library import MotionError

_LARGEST = 4 << 30
"""Bytes that are read of a file, and that it may unpack to."""
_LARGEST_SMALL = 1 << 26
_LARGEST_RATIO = 100
"""How many times its own size a packed file may unpack to, if that is more than `_LARGEST_SMALL` bytes."""


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
        raise MotionError(f"holds numbers of type {quoted(text)}, which no motion needs")
    return dtype


def _new_array(kind: Any, *_: Any) -> np.ndarray:
    if kind is not _ARRAY_TYPE:
        raise MotionError(f"makes an array of {quoted(kind)}, which no motion needs")
    return np.zeros(0, np.int8)


def _array_of_bytes(data: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> np.ndarray:
    """What numpy.core.numeric._frombuffer makes, which arrays are pickled by since protocol 5."""
    if not isinstance(dtype, np.dtype) or not isinstance(data, (bytes, bytearray)):
        raise MotionError("holds an array that is none of numbers")
    array = np.frombuffer(data, dtype)
    return array.reshape(shape).transpose(axes) if order == "K" else array.reshape(shape, order=order)


def _scalar(dtype: Any, data: Any) -> Any:
    if not isinstance(dtype, np.dtype) or not isinstance(data, bytes):
        raise MotionError("holds a number that is none")
    return np.frombuffer(data, dtype, 1)[0]


_ADMITTED: dict[tuple[str, str], Any] = {
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): _ArrayWrapper,
    ("numpy", "ndarray"): _ARRAY_TYPE,
    ("numpy", "dtype"): _plain_dtype,
    ("collections", "OrderedDict"): lambda pairs=(): OrderedDict((_key(k), v) for k, v in pairs),
    # How Python writes bytes where pickles know only text.
    ("_codecs", "encode"): lambda text, _encoding="latin1": str(text).encode("latin1"),
}
for _core in ("numpy.core.multiarray", "numpy._core.multiarray"):
    _ADMITTED[(_core, "_reconstruct")] = _new_array
    _ADMITTED[(_core, "scalar")] = _scalar
for _core in ("numpy.core.numeric", "numpy._core.numeric"):
    _ADMITTED[(_core, "_frombuffer")] = _array_of_bytes


def _key(value: Any) -> Any:
    """A key of a dict; nested tuples could take forever to be hashed."""
    if not isinstance(value, (str, int, float)):
        raise MotionError(f"has a {type(value).__name__} as the key of a dict; keys may be text or numbers")
    return value


class _Unpickler(pickle._Unpickler):
    """Python's own unpickler, in Python, because the arrays' bytes lie between its opcodes."""

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)
    for _code in (pickle.EMPTY_SET, pickle.ADDITEMS, pickle.FROZENSET):
        del dispatch[_code[0]]  # hashed as keys are, and in no motion

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        self.file = file

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ADMITTED:
            raise MotionError(f"asks for {legible(f'{module}.{name}')}, which no motion needs; nothing was run")
        return _ADMITTED[(module, name)]

    def load_bytearray8(self) -> None:
        """Bytes that can be changed; as many as there are, whatever the file says."""
        self.append(bytearray(self.read(struct.unpack("<Q", self.read(8))[0])))

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8

    def load_setitems(self) -> None:
        """Entries of a dict."""
        items = self.pop_mark()
        self.stack[-1].update((_key(k), v) for k, v in zip(items[::2], items[1::2], strict=True))

    dispatch[pickle.SETITEMS[0]] = load_setitems

    def load_setitem(self) -> None:
        """One entry of a dict."""
        value, key = self.stack.pop(), self.stack.pop()
        self.stack[-1][_key(key)] = value

    dispatch[pickle.SETITEM[0]] = load_setitem

    def load_dict(self) -> None:
        """A dict with its entries."""
        items = self.pop_mark()
        self.append({_key(k): v for k, v in zip(items[::2], items[1::2], strict=True)})

    dispatch[pickle.DICT[0]] = load_dict

    def load_build(self) -> None:
        """Give an object its state: only those few kinds that are known here have any."""
        state = self.stack.pop()
        made = self.stack[-1]
        if isinstance(made, _ArrayWrapper):
            made.__setstate__(state)
            self.stack[-1] = _read_array(made, self.file)
        elif isinstance(made, np.dtype):
            if state[1] not in ("<", "|", "="):
                raise MotionError(f"holds numbers in byte order {quoted(state[1])}; '<' is supported")
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
        raise MotionError(f"holds an array of {quoted(dtype)} and shape {quoted(wrapper.shape)}, which is no motion")
    if wrapper.padded:
        file.read(int.from_bytes(file.read(1), "little"))
    count = int(np.prod(wrapper.shape, dtype=object)) if wrapper.shape else 1
    data = file.read(count * dtype.itemsize) if count * dtype.itemsize <= _LARGEST else b""
    if len(data) != count * dtype.itemsize:
        raise MotionError(f"ends within an array of shape {quoted(wrapper.shape)}: the file is truncated")
    array = np.frombuffer(data, dtype=dtype, count=count)
    if wrapper.order == "F":  # stored column by column
        return array.reshape(wrapper.shape[::-1]).transpose()
    return array.reshape(wrapper.shape)


def _read(file: BinaryIO, most: int) -> bytes:
    """So many bytes, or all there are; memory is taken only for those."""
    data = bytearray()
    while len(data) < most and (part := file.read(min(most - len(data), 1 << 24))):
        data += part
    return bytes(data)


def _unpacked(path: Path) -> BinaryIO:
    """The file's content, whatever it was compressed with."""
    raw = read_bytes(path, _LARGEST)
    most = min(_LARGEST, max(_LARGEST_SMALL, _LARGEST_RATIO * len(raw)))
    for magic, unpack in (
        (b"\x1f\x8b", gzip.open), (b"BZ", bz2.open), (b"\xfd7zXZ", lzma.open), (b"\x5d\x00", lzma.open),
    ):  # fmt: skip
        if raw.startswith(magic):
            data = _read(unpack(io.BytesIO(raw)), most + 1)
            break
    else:
        data = zlib.decompressobj().decompress(raw, most + 1) if raw[:1] == b"\x78" else raw
    if len(data) > max(most, len(raw)):
        raise MotionError(f"unpacks from {len(raw)} to more than the {most} bytes that are read")
    return io.BytesIO(data)


def load_joblib(path: Path) -> Any:
    """The content of a joblib file or plain pickle of containers, numbers and numpy arrays.

    Raises:
        MotionError: the file is missing, truncated, or asks for anything else. Nothing in it is ever run.
    """
    try:
        return _Unpickler(_unpacked(path)).load()
    except (MotionError, InputError) as error:
        raise MotionError(f"motion file {str(path)!r} {error}") from error
    except (
        Exception
    ) as error:  # opcodes of a hostile file run into whatever their operands lack; one bad file is reported
        raise MotionError(f"motion file {str(path)!r} is damaged or no joblib file") from error
