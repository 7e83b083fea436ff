"""What a browser may say to the page: these messages, with these fields. Nothing else is heard."""

from __future__ import annotations

import io
from typing import Annotated, Literal

import msgspec
from PIL import Image

MAX_BYTES = 2 * 2**20
"""Largest message, which is a picture for a film; all others are below 10 kB."""
MAX_PIXELS = 2**22
"""Of a picture for a film; it takes four bytes of memory each."""

Text = Annotated[str, msgspec.Meta(max_length=256)]
Value = bool | int | float | Annotated[str, msgspec.Meta(max_length=4096)]
"""Of a control. A choice may be the path of a checkpoint."""
Vector = tuple[float, float, float]


class _Message(msgspec.Struct, tag=True, tag_field="type"):
    """One of viser's messages; it and its fields have viser's names."""


class ViewerCameraMessage(_Message):
    """Where a viewer looks from."""

    wxyz: tuple[float, float, float, float]
    position: Vector
    fov: float
    near: float
    far: float
    image_height: int
    image_width: int
    look_at: Vector
    up_direction: Vector


class Updates(msgspec.Struct):
    """Of a control, its value only: viser would set any attribute of its own, the list of its callbacks among them."""

    value: Value


class GuiUpdateMessage(_Message):
    """A control was set, or a button pressed."""

    uuid: Text
    updates: Updates


class SceneNodeDragMessage(_Message):
    """Something in the scene was taken hold of, dragged, or let go."""

    phase: Literal["start", "update", "end"]
    name: Text
    instance_index: int | None
    start_position: Vector
    start_screen_pos: tuple[float, float]
    end_position: Vector
    end_screen_pos: tuple[float, float]
    button: Literal["left", "middle", "right"]
    modifier: Text | None
    owner: Text = ""


class GetRenderResponseMessage(_Message):
    """A picture for a film (JPEG), or nothing where the browser could not draw it."""

    payload: bytes
    render_uuid: Text


class _AnyMessage(msgspec.Struct):
    """What every message has."""

    type: str


Message = ViewerCameraMessage | GuiUpdateMessage | SceneNodeDragMessage | GetRenderResponseMessage
_decoder = msgspec.msgpack.Decoder(Message)
_any_decoder = msgspec.msgpack.Decoder(_AnyMessage)


def parse(data: bytes) -> Message | None:
    """What a browser said; None for what it may not say.

    Raises:
        ValueError: it is no message at all.
    """
    try:
        _any_decoder.decode(data)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(str(error)) from error
    try:
        message = _decoder.decode(data)
    except msgspec.ValidationError:
        return None
    if isinstance(message, GetRenderResponseMessage) and message.payload and not _is_picture(message.payload):
        return None
    return message


def _is_picture(payload: bytes) -> bool:
    """Whether it is a JPEG of a bearable size, by its header. viser decodes whatever Pillow can, of any size."""
    try:
        with Image.open(io.BytesIO(payload), formats=["JPEG"]) as picture:
            return picture.width * picture.height <= MAX_PIXELS
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return False
