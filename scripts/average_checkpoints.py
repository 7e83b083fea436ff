"""Average the weights of policies of one layout that have an ancestor in common: what each learned on its way from it
adds, and what is noise of its last updates cancels (Wortsman et al. 2022, "Model soups"). Shares below zero go on along
the way from one to another: `NEW=2 OLD=-1` goes as far again. The result is a checkpoint without optimiser state,
beside it a JSON that says what it was made of."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

import torch

from cotap.agents.checkpoint import (
    PARTS,
    load_checkpoint,
    require_layout,
    require_parts,
    save_checkpoint,
    sha256,
    write_json,
)
from cotap.train import provenance

EMPTY = {"learner": {}, "env": {}, "others": []}
"""What an average has none of: optimisers' moments and simulations belong to one run."""
LARGEST = 5.0
"""A share beyond this is a slip."""


def average(states: list[dict[str, torch.Tensor]], shares: list[float]) -> dict[str, torch.Tensor]:
    """Weighted sum of states, tensor by tensor; counts are the first's.

    Raises:
        ValueError: states differ in names or shapes, or shares below zero leave a deviation below zero.
    """
    if any(state.keys() != states[0].keys() for state in states):
        names = [set(state) for state in states]
        odd = sorted(set.union(*names) - set.intersection(*names))
        raise ValueError(f"the networks of the checkpoints have not the same parts: {', '.join(odd)}")
    weights = torch.tensor(shares, dtype=torch.float64)
    mean = {}
    for name, first in states[0].items():
        tensors = [state[name] for state in states]
        if any(tensor.shape != first.shape for tensor in tensors):
            raise ValueError(f"{name} has not one shape in all checkpoints: {[tuple(t.shape) for t in tensors]}")
        stacked = torch.stack([tensor.double() for tensor in tensors], dim=-1)
        mean[name] = (stacked @ weights).to(first.dtype) if first.is_floating_point() else first
        if name.endswith(("._std", "._var")) and (mean[name] < 0.0).any():
            raise ValueError(f"with shares of {', '.join(f'{share:g}' for share in shares)} {name} is negative")
    return mean


def parse(text: str) -> tuple[Path, float]:
    """PATH=SHARE.

    Raises:
        ValueError: no share, or one that is zero or beyond `LARGEST`.
    """
    path, _, share = text.rpartition("=")
    if not path or not 0.0 < abs(float(share)) <= LARGEST:
        raise ValueError(
            f"{text!r} is not CHECKPOINT=SHARE with a share that is not 0 and within -{LARGEST:g} to {LARGEST:g}"
        )
    return Path(path), float(share)


def origin(path: Path, share: float, content: dict[str, Any]) -> dict[str, Any]:
    """What is remembered of a checkpoint that went into an average."""
    config = content["config"]
    kept = {key: config[key] for key in ("averaged", "merged") if key in config}
    return {
        "checkpoint": str(path),
        "sha256": sha256(path),
        "share": share,
        "command": config["command"],
        "commit": config["commit"],
        "iteration": content["iteration"],
        "samples": content["samples"],
        **kept,
    }


def run(parts: list[str], output: Path, command: str) -> None:
    """Average and save.

    Raises:
        ValueError: shares do not add up to 1, a file is no checkpoint, or the checkpoints do not fit each other.
        OSError: the result cannot be written.
    """
    paths, shares = zip(*(parse(text) for text in parts), strict=True)
    if abs(sum(shares) - 1.0) > 1e-9:
        raise ValueError(f"shares add up to {sum(shares):g}, not to 1")
    contents = [load_checkpoint(path) for path in paths]
    for path, content in zip(paths, contents, strict=True):
        require_parts(path, content, PARTS)
        require_layout(path, content["layout"], contents[0]["layout"])
    first = contents[0]
    origins = [origin(*entry) for entry in zip(paths, shares, contents, strict=True)]
    made = provenance(command, "mjbatch") | {"averaged": origins}
    made.pop("simulation")  # nothing was simulated
    config = first["config"] | made
    config.pop("merged", None)  # told of the first, among its origins
    model = average([content["model"] for content in contents], list(shares))
    save_checkpoint(output, first | EMPTY | {"model": model, "config": config})
    described = {key: config[key] for key in ("command", "commit", "averaged")}
    write_json(output.with_suffix(".json"), described)


def main() -> int:
    """Parse and average."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "parts", nargs="+", metavar="CHECKPOINT=SHARE",
        help="what is averaged; config, stage and counts are those of the first",
    )  # fmt: skip
    parser.add_argument("--output", type=Path, required=True, help="checkpoint to write; FILE.json goes beside it")
    options = parser.parse_args()
    command = shlex.join(["python", "scripts/average_checkpoints.py", *sys.argv[1:]])
    try:
        run(options.parts, options.output, command)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
