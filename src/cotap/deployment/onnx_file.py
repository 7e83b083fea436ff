"""What must hold of an ONNX file before anything runs it: weights in the file itself, all of them finite.

Needs neither torch nor onnx: it goes through the file's fields (protocol buffers) itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

_MODEL_GRAPH, _GRAPH_WEIGHTS = 7, 5
_TYPE, _FLOATS, _NAME, _RAW, _DOUBLES = 2, 4, 8, 9, 10
_FLOAT_TYPES = {1: np.float32, 10: np.float16, 11: np.float64}
# A weight that lies in another file names it under this key of eight letters, wherever in the file the weight is.
_EXTERNAL = re.compile(rb"[\x08\x00]location")


def require_plain_weights(data: bytes) -> None:
    """Raise ValueError if an ONNX file has weights that are elsewhere or not finite, or is none."""
    if _EXTERNAL.search(data):
        raise ValueError("its weights lie in another file, which is not read; export them into one")
    for field, graph in _fields(data):
        if field == _MODEL_GRAPH and isinstance(graph, bytes):
            for part, weight in _fields(graph):
                if part == _GRAPH_WEIGHTS and isinstance(weight, bytes):
                    _require_finite(weight)


def _require_finite(weight: bytes) -> None:
    kind, name, numbers = np.float32, b"", []
    for field, value in _fields(weight):
        if field == _TYPE:
            kind = _FLOAT_TYPES.get(value) if isinstance(value, int) else None
        elif field == _NAME and isinstance(value, bytes):
            name = value
        elif field in (_FLOATS, _RAW, _DOUBLES) and isinstance(value, bytes):
            numbers.append(value)
    if kind and not np.isfinite(np.frombuffer(b"".join(numbers), kind)).all():
        raise ValueError(f"its weight {name[:100].decode(errors='replace')!r} is not finite")


def _fields(message: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Number and value of every field of a message."""
    at = 0
    while at < len(message):
        tag, at = _varint(message, at)
        kind = tag & 7
        if kind == 0:
            value, at = _varint(message, at)
            yield tag >> 3, value
            continue
        size = {1: 8, 5: 4}.get(kind)
        if size is None:
            if kind != 2:
                raise ValueError("it is damaged or no ONNX file")
            size, at = _varint(message, at)
        if at + size > len(message):
            raise ValueError("it is damaged or no ONNX file")
        yield tag >> 3, message[at : at + size]
        at += size


def _varint(message: bytes, at: int) -> tuple[int, int]:
    """A number of variable length at a place in a message, and the place after it."""
    value = 0
    for i in range(10):
        if at + i >= len(message):
            break
        value |= (message[at + i] & 0x7F) << 7 * i
        if message[at + i] < 0x80:
            return value, at + i + 1
    raise ValueError("it is damaged or no ONNX file")
