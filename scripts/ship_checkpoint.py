"""Make a training checkpoint the one that the package ships: weights only, with its provenance and its evaluations."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256, write_json
from cotap.evaluate import main as evaluate
from cotap.evaluation.policy import CHECKPOINTS, checkpoint_path

EVALUATIONS = {
    "velocity-tracking": ["velocity-tracking", "--num-envs", "1024"],
    "velocity-tracking.hand-forces": ["velocity-tracking", "--num-envs", "1024", "--hand-force", "40"],
    "velocity-tracking.held-out": [
        "velocity-tracking",
        "--num-envs",
        "512",
        "--motion",
        "dance_b",
        "dance_b_mirrored",
        "kick",
        "kick_mirrored",
    ],
    "velocity-tracking.small": ["velocity-tracking", "--num-envs", "64", "--episode-seconds", "10", "--threads", "1"],
}


def ship(source: Path, name: str) -> int:
    """Strip, save, describe, evaluate. Returns the exit status."""
    content = load_checkpoint(source)
    target = checkpoint_path(name)
    target.parent.mkdir(exist_ok=True)
    save_checkpoint(target, content | {"learner": {}, "env": {}})
    config = content["config"]
    write_json(
        target.with_suffix(".json"),
        {
            "stage": content["kind"],
            "sha256": sha256(target),
            "commit": config["commit"],
            "command": config["command"],
            "seed": config["training"]["seed"],
            "iterations": content["iteration"],
            "samples": content["samples"],
            "wall_seconds": round(content["wall_seconds"], 1),
            "machine": config["machine"],
            "config": config["training"],
        },
    )
    for evaluation, options in EVALUATIONS.items():
        out = target.with_name(f"{target.stem}.{evaluation}.json")
        if evaluate([*options, "--checkpoint", str(target), "--json", str(out)]) != 0:
            return 2
    return 0


def main() -> int:
    """Parse and ship."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--name", default="base", choices=CHECKPOINTS)
    options = parser.parse_args()
    return ship(options.checkpoint, options.name)


if __name__ == "__main__":
    sys.exit(main())
