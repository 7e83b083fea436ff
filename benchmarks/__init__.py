"""Measurements of a machine: speed, scaling, memory, what survives faults. `python -m benchmarks` lists them."""

from __future__ import annotations

import ast
from pathlib import Path


def list_modules(package: str, folder: Path) -> str:
    """A line for each module of `folder` that is a command: how it is called, and what its first sentence says."""
    lines = []
    for file in sorted(folder.glob("*.py")):
        text = file.read_text(encoding="utf-8")
        if not file.stem.startswith("_") and '__name__ == "__main__"' in text:
            about = " ".join((ast.get_docstring(ast.parse(text)) or "").partition("\n\n")[0].split())
            lines.append(f"python -m {package}.{file.stem}\n    {about}")
    return "\n".join(lines)
