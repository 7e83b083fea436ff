"""Cells of tables."""

from __future__ import annotations

from typing import Any

from cotap.evaluation.report import interval


def cell(m: dict[str, Any], digits: int = 3) -> str:
    """A summary's mean, with its 95 % interval in brackets; a dash where nothing was measured."""
    if m["mean"] is None:
        return "-"
    return f"{m['mean']:.{digits}f} ({interval(m, digits)})"
