"""Checkpoint files: plain tensors and numbers, written whole or not at all, loaded without running code."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import re
import warnings
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch

from cotap.checks import legible, quoted
from cotap.files import write_atomically
from cotap.inputs import InputError, read_bytes

FORMAT = "cotap-checkpoint"
VERSION = 1
PARTS: dict[str, Any] = {
    "kind": str, "layout": dict, "agents": dict, "config": dict, "model": dict, "learner": dict, "env": dict,
    "iteration": int, "samples": int, "wall_seconds": (int, float), "rng": torch.Tensor, "device_rng": torch.Tensor,
    "curriculum": dict,
}  # fmt: skip
"""What a checkpoint of a run holds; the parts of a shipped one may be empty."""
STAGES = ("base", "distill")
"""Of training; what the part `kind` may be."""
OPTIONAL_PARTS = {"device_rng", "curriculum"}
"""What some checkpoints lack: random numbers of a GPU, if networks were on none; an environment's curriculum."""
MALFORMED = (RuntimeError, ValueError, TypeError, LookupError, AttributeError, OverflowError)
"""What code that takes over a state raises where the state is not what it should be."""

_LARGEST = 16 << 30
"""Bytes of a file that are read."""


class CheckpointError(ValueError):
    """A file that cannot be used as a checkpoint; the message names it and says why."""


def remove_leftovers(folder: Path) -> int:
    """Delete the temporary files that processes killed while saving have left in a run's folder. Returns how many."""
    leftovers = [*folder.glob(".checkpoint_*.pt"), *folder.glob(".config.*.json")]
    for path in leftovers:
        with contextlib.suppress(OSError):
            path.unlink()
    return len(leftovers)


def write_json(path: Path, value: Any) -> None:
    """Write `value` as strict JSON (non-finite numbers are refused), atomically."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda p: p.write_text(text, encoding="utf-8"))


def save_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Save `content`, which holds nothing but tensors, numbers, strings, lists and dicts.

    Raises:
        OSError: it cannot be written; an older file of that name is untouched.
    """
    payload = {"format": FORMAT, "version": VERSION, **content}

    def write(temporary: Path) -> None:
        try:
            with temporary.open("wb") as file:  # given a path, torch would write the temporary name into the file
                torch.save(payload, file)
        except RuntimeError as error:  # torch reports a full disk this way
            raise OSError(f"cannot write checkpoint {path}: {error}") from error

    write_atomically(path, write)


def load_checkpoint(path: Path | str, device: str = "cpu") -> dict[str, Any]:
    """Load a checkpoint without running any code from the file.

    Raises:
        CheckpointError: the file is missing, truncated, foreign, or of another version, or has weights that are not
            finite.
    """
    path = Path(path)
    try:
        data = read_bytes(path, _LARGEST)
    except InputError as error:
        raise CheckpointError(f"checkpoint {str(path)!r} {error}") from error
    try:
        _refuse_compressed(data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch tells of pickles that it may not know
            content = torch.load(io.BytesIO(data), map_location=device, weights_only=True)
    except Exception as error:  # on rubbish, torch's restricted unpickler raises whatever its reading stumbles over
        reason = _reason(error)
        raise CheckpointError(f"checkpoint {str(path)!r} cannot be read (truncated or foreign): {reason}") from error
    if not isinstance(content, dict) or not same(content.get("format"), FORMAT):
        raise CheckpointError(f"{str(path)!r} is not a cotap checkpoint")
    if not same(content.get("version"), VERSION):
        raise CheckpointError(f"{str(path)!r} has version {quoted(content.get('version'))}; this cotap reads {VERSION}")
    _require_finite(path, content)
    return content


def _require_finite(path: Path, content: dict[str, Any]) -> None:
    """Raise CheckpointError naming a number of the networks or their optimisers that is not finite, or a tensor that
    claims more numbers than it holds."""
    left: list[tuple[str, Any]] = [(part, content.get(part)) for part in ("model", "learner")]
    seen: set[int] = set()  # a list may lie in itself, or in many places
    while left:
        where, value = left.pop()
        if isinstance(value, torch.Tensor):
            _require_finite_tensor(f"checkpoint {str(path)!r} has", where, value)
        elif isinstance(value, float) and not math.isfinite(value):
            raise CheckpointError(f"checkpoint {str(path)!r} has weights that are not finite: {where}")
        elif isinstance(value, (dict, list, tuple)) and id(value) not in seen:
            seen.add(id(value))
            items = value.items() if isinstance(value, dict) else enumerate(value)
            left += [(f"{where}.{legible(str(key))}", inner) for key, inner in items]


def _require_finite_tensor(who: str, where: str, value: torch.Tensor) -> None:
    try:
        held = value.untyped_storage().nbytes()
    except MALFORMED:  # sparse, and others that nobody trains
        held = -1
    if value.numel() * value.element_size() > held:
        raise CheckpointError(f"{who} no plain tensor of {tuple(value.shape)}: {where}")
    if value.is_floating_point() and not value.isfinite().all():
        raise CheckpointError(f"{who} weights that are not finite: {where}")


def _reason(error: Exception) -> str:
    """What is wrong with a file, in place of torch's advice to load it anyway."""
    asked = re.search(r"GLOBAL (\S+)", str(error))
    if asked:
        return f"it asks for {legible(asked[1])}, which no checkpoint needs; nothing was run"
    if isinstance(error, InputError):
        return str(error)
    return "it is no archive of plain tensors and numbers, and nothing else is read"


def _refuse_compressed(data: bytes) -> None:
    """Torch writes archives uncompressed; one that is compressed could unpack to more than any memory holds."""
    if zipfile.is_zipfile(io.BytesIO(data)):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > len(data):
                raise InputError("its entries unpack to more than the whole file holds")


def load_weights(model: torch.nn.Module, weights: dict[str, Any]) -> None:
    """Take over networks. Raises ValueError naming the first weight that is missing, is not theirs or does not fit."""
    present = model.state_dict()
    for name in dict.fromkeys((*present, *weights)):
        where = legible(str(name))
        if name not in weights:
            raise ValueError(f"weight {where} is missing")
        if name not in present:
            raise ValueError(f"weight {where} is of other networks")
        shape = getattr(weights[name], "shape", None)
        if shape != present[name].shape:
            raise ValueError(f"weight {where} must be of shape {tuple(present[name].shape)}, got {quoted(shape)}")
    model.load_state_dict(weights)


def require_parts(path: Path | str, content: dict[str, Any], parts: Collection[str]) -> None:
    """Raise CheckpointError naming the first of `parts` that is missing or not of the kind that `PARTS` says."""
    for part in parts:
        if part not in content:
            if part in OPTIONAL_PARTS:
                continue
            raise CheckpointError(f"checkpoint {str(path)!r} lacks its part {part!r}")
        value = content[part]
        if part == "kind" and not any(same(value, stage) for stage in STAGES):
            raise CheckpointError(f"checkpoint {str(path)!r} is of stage {quoted(value)}; known: {', '.join(STAGES)}")
        if not isinstance(value, PARTS[part]) or (isinstance(value, (int, float)) and not value >= 0):
            raise CheckpointError(f"checkpoint {str(path)!r} has no usable part {part!r}: {quoted(value)}")


def require_layout(path: Path | str, saved: dict[str, Any], present: dict[str, Any]) -> None:
    """Raise CheckpointError naming the first entry in which a checkpoint's layout differs from the environment's.

    What the environment does not name, in the layout or in a table in it, may be anything.
    """
    for key, value in present.items():
        kept = saved.get(key)
        if isinstance(kept, dict) and isinstance(value, dict):
            kept = {name: entry for name, entry in kept.items() if name in value}
        if not same(kept, value):
            raise CheckpointError(
                f"checkpoint {str(path)!r} was trained with another {key}: {quoted(saved.get(key))}, here {value!r}"
            )


def same(saved: Any, expected: Any) -> bool:
    """Whether plain data are equal; a file may hold tensors in their place, whose comparison is no truth value."""
    try:
        return type(saved) is type(expected) and bool(saved == expected)
    except (RuntimeError, ValueError):
        return False


def sha256(path: Path | str) -> str:
    """Hex digest of a file."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
