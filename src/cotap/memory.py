"""Checks of free memory before much of it is taken: a system that runs out kills a process without a message."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

_SYSTEM = Path("/proc/meminfo")
_CONTAINER = Path("/sys/fs/cgroup/memory.max")


def free_bytes(device: str = "cpu") -> int | None:
    """Memory that could be taken now on a CPU or a GPU; None where that cannot be told."""
    if device.startswith("cuda"):
        import torch

        return torch.cuda.mem_get_info(device)[0]
    known = [_available(), _limit()]
    if known[0] is None:
        with suppress(AttributeError, ValueError, OSError):  # not on Windows
            known[0] = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min((bound for bound in known if bound is not None), default=None)


def require_memory(what: str, needed: int, device: str = "cpu") -> None:
    """Raise ValueError if `what` is to take more bytes than there are; without a word where that cannot be told."""
    free = free_bytes(device)
    if free is not None and needed > free:
        wanted = min(needed, 1 << 80) / 2**30
        raise ValueError(f"{what} would take {wanted:,.1f} GiB of memory; {free / 2**30:,.1f} GiB are free")


def _available() -> int | None:
    """What Linux says that it can give without swapping."""
    with suppress(OSError):
        for line in _SYSTEM.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) << 10
    return None


def _limit() -> int | None:
    """What the container that this runs in may take in all."""
    with suppress(OSError, ValueError):  # there is none, or it says "max"
        return int(_CONTAINER.read_text())
    return None
