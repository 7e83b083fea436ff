"""What must hold of an ONNX file before anything runs it: weights in the file itself and finite, nodes in one row.

Needs neither torch nor onnx: it goes through the file's fields (protocol buffers) itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

# Messages, and by the number of their field, the messages in them that hold weights or nodes.
_PARTS: dict[str, dict[int, str]] = {
    "model": {7: "graph", 25: "function"},
    "graph": {1: "node", 5: "weight", 15: "sparse weight"},
    "node": {5: "attribute"},
    "attribute": {5: "weight", 6: "branch", 10: "weight", 11: "branch", 22: "sparse weight", 23: "sparse weight"},
    "sparse weight": {1: "weight", 2: "weight"},
}
# A field that a message has only once, and that is there twice, is the sum of both.
_ONCE = {
    ("model", 7),
    ("attribute", 5),
    ("attribute", 6),
    ("attribute", 22),
    ("sparse weight", 1),
    ("sparse weight", 2),
}
_ATTRIBUTE_NUMBERS = (2, 7)
_TYPE, _FLOATS, _NAME, _RAW, _DOUBLES = 2, 4, 8, 9, 10
_FLOAT_TYPES = {1: np.float32, 11: np.float64}
_WHOLE_TYPES = {2, 3, 4, 5, 6, 7, 8, 9, 12, 13}
"""Integers, texts and truth values."""
# A weight that lies in another file names it under this key of eight letters, wherever in the file the weight is.
_EXTERNAL = re.compile(rb"[\x08\x00]location")


def require_plain_graph(data: bytes) -> None:
    """Raise ValueError if an ONNX file is none, or has weights that are elsewhere, not finite or of other kinds than
    float32, float64 and integers, or has loops, branches or functions, whose run or unfolding may have no end."""
    if _EXTERNAL.search(data):
        raise ValueError("its weights lie in another file, which is not read; export them into one")
    if not any(kind == "graph" for kind, _ in _parts("model", data)):
        raise ValueError("it is damaged or no ONNX file")
    left = [("model", data)]
    while left:
        kind, message = left.pop()
        if kind in ("branch", "function"):
            raise ValueError(f"its graph has a {'loop or a ' * (kind == 'branch')}{kind}, which no policy needs")
        if kind == "weight":
            _require_finite_weight(message)
            continue
        if kind == "attribute":
            _require_finite_numbers(message)
        left += _parts(kind, message)


def _parts(kind: str, message: bytes) -> list[tuple[str, bytes]]:
    """The messages in a message that hold weights or nodes."""
    known, once, out = _PARTS[kind], {}, []
    for field, value in _fields(message):
        if field not in known or not isinstance(value, bytes):
            continue
        if (kind, field) in _ONCE:
            once[field] = once.get(field, b"") + value
        else:
            out.append((known[field], value))
    return out + [(known[field], value) for field, value in once.items()]


def _require_finite_weight(weight: bytes) -> None:
    kind, name, numbers = 0, b"", []
    for field, value in _fields(weight):
        if field == _TYPE:
            kind = value
        elif field == _NAME and isinstance(value, bytes):
            name = value
        elif field in (_FLOATS, _RAW, _DOUBLES) and isinstance(value, bytes):
            numbers.append(value)
    shown = repr(name[:100].decode(errors="replace"))
    if kind in _WHOLE_TYPES:
        return
    if kind not in _FLOAT_TYPES:
        raise ValueError(f"its weight {shown} is of a kind that is not read; export float32")
    if not np.isfinite(np.frombuffer(b"".join(numbers), _FLOAT_TYPES[kind])).all():
        raise ValueError(f"its weight {shown} is not finite")


def _require_finite_numbers(attribute: bytes) -> None:
    """Of a node: single ones, and lists of them."""
    numbers = [v for field, v in _fields(attribute) if field in _ATTRIBUTE_NUMBERS and isinstance(v, bytes)]
    if not np.isfinite(np.frombuffer(b"".join(numbers), np.float32)).all():
        raise ValueError("an attribute of its graph is not finite")


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
