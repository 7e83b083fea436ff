"""Evaluations that reports are made of: run, or kept from an earlier time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def kept_or_run(path: Path, arguments: list[str], checkpoint: str, threads: int, reuse: bool) -> dict[str, Any]:
    """The result of `cotap evaluate ARGUMENTS --checkpoint CHECKPOINT`, written to `path`.

    With `reuse` what `path` has is taken if it is of the same checkpoint and arguments.
    """
    from cotap.agents.checkpoint import sha256, write_json
    from cotap.evaluate import evaluate
    from cotap.evaluation.policy import find_checkpoint

    asked = [arguments[0], "--checkpoint", checkpoint, *arguments[1:]]
    result = json.loads(path.read_text()) if reuse and path.is_file() else {}
    if result.get("arguments") == asked and result["settings"]["checkpoint_sha256"] == sha256(
        find_checkpoint(checkpoint)
    ):
        return result
    print(f"\n{path.stem}", flush=True)
    result = evaluate([*asked, "--threads", str(threads)]) | {"arguments": asked}
    write_json(path, result)
    return result
