"""Cells of tables."""

from __future__ import annotations

from typing import Any


def cell(m: dict[str, Any], digits: int = 3) -> str:
    """A summary's mean, with its 95 % interval in brackets; a dash where nothing was measured."""
    if m["mean"] is None:
        return "-"
    low, high = m["ci95"]
    return f"{m['mean']:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"
