"""Make a training checkpoint the one that the package ships: weights only, with its provenance and its evaluations."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256, write_json
from cotap.configs import BaseTraining, DistillTraining, from_plain, to_plain
from cotap.evaluate import main as evaluate
from cotap.evaluation.policy import checkpoint_path

VELOCITY = ["velocity-tracking", "--num-envs", "1024"]
SMALL = ["--num-envs", "64", "--threads", "1"]


def ablation(*options: str) -> dict[str, list[str]]:
    """What vouches for a policy that an ablation trained."""
    arms = ["--method", "cotap", *options]
    return {
        "velocity-tracking": [*VELOCITY, *arms],
        "velocity-tracking.small": ["velocity-tracking", "--episode-seconds", "10", *arms, *SMALL],
        "impact.stance": ["impact", "--num-envs", "1024", *arms],
    }


EVALUATIONS = {
    "base": {
        "velocity-tracking": VELOCITY,
        "velocity-tracking.hand-forces": [*VELOCITY, "--hand-force", "40"],
        "velocity-tracking.held-out": [
            "velocity-tracking", "--num-envs", "512",
            "--motion", "dance_b", "dance_b_mirrored", "kick", "kick_mirrored",
        ],
        "velocity-tracking.small": ["velocity-tracking", "--episode-seconds", "10", *SMALL],
    },
    "cotap": {
        "velocity-tracking": [*VELOCITY, "--method", "cotap"],
        "velocity-tracking.small": ["velocity-tracking", "--episode-seconds", "10", "--method", "cotap", *SMALL],
        "impact.stance": ["impact", "--num-envs", "1024", "--method", "cotap"],
        "impact.walking": ["impact", "--num-envs", "1024", "--method", "cotap", "--mode", "walking"],
        "impact.walking.random": [
            "impact", "--num-envs", "1024", "--method", "cotap", "--mode", "walking", "--random-direction",
        ],
    },
    "facet": {
        "velocity-tracking": [*VELOCITY, "--method", "facet"],
        "velocity-tracking.small": ["velocity-tracking", "--episode-seconds", "10", "--method", "facet", *SMALL],
        "impact.stance": ["impact", "--num-envs", "1024", "--method", "facet"],
    },
    "cotap-no-ratio": ablation("--no-singularity-ratio"),
    "cotap-torque-critic": ablation(),
    "cotap-goals": ablation(),
}  # fmt: skip
"""What vouches for each policy; the small one is repeated by the tests."""


def earlier_runs(before: list[Path]) -> list[dict[str, Any]]:
    """Command and commit of the runs that a policy went through before its own: of a folder, the run of its
    config.json; of a shipped policy's description, all of that policy's."""
    runs: list[dict[str, Any]] = []
    for path in before:
        run = json.loads((path / "config.json" if path.is_dir() else path).read_text())
        runs += [*run.get("earlier_runs", []), {key: run[key] for key in ("command", "commit")}]
    return runs


def changed(training: dict[str, Any], stage: str, changes: dict[str, float]) -> dict[str, Any]:
    """A run's config with other numbers in it.

    Raises:
        ValueError: a key is not that of a number in the config, or a value is out of its range.
    """
    config = from_plain(DistillTraining if stage == "distill" else BaseTraining, training)
    for key, value in changes.items():
        *path, field = key.split(".")
        owner: Any = config
        for part in path:
            owner = getattr(owner, part, None)
        if not isinstance(getattr(owner, field, None), float):
            raise ValueError(f"{key!r} is no number of the config")
        setattr(owner, field, value)
    config.check()
    return to_plain(config)


def scaled(content: dict[str, Any], factors: dict[str, float]) -> dict[str, Any]:
    """A checkpoint whose policy moves some joints less or more: what the networks send to every joint whose name
    contains a key of `factors`, times its value.

    Raises:
        ValueError: a key is in no learned joint's name, or a factor is not within 0.5 to 2.
    """
    model = dict(content["model"])
    for key, factor in factors.items():
        if not 0.5 <= factor <= 2.0:
            raise ValueError(f"{key!r} can be scaled by 0.5 to 2, got {factor}")
        hits = 0
        for agent, (begin, end) in content["agents"]["action_slices"].items():
            joints = content["layout"]["joints"][begin:end]
            rows = [i for i, joint in enumerate(joints) if key in joint]
            hits += len(rows)
            for part in ("output_weight", "output_bias"):
                name = f"actors.{agent}.{part}"
                model[name] = model[name].clone()
                model[name][rows] *= factor
        if hits == 0:
            raise ValueError(f"{key!r} is in no joint's name: {', '.join(content['layout']['joints'])}")
    return content | {"model": model}


def ship(source: Path, name: str, before: list[Path], changes: dict[str, float], factors: dict[str, float]) -> int:
    """Strip, save, describe, evaluate. Returns the exit status."""
    earlier = earlier_runs(before)
    content = scaled(load_checkpoint(source), factors)
    target = checkpoint_path(name)
    target.parent.mkdir(exist_ok=True)
    # Where the machine keeps the repository is nobody's business.
    config = content["config"] | {"command": content["config"]["command"].replace(f"{Path.cwd()}/", "")}
    config["training"] = changed(config["training"], content["kind"], changes)
    save_checkpoint(target, content | {"learner": {}, "env": {}, "others": [], "config": config})
    write_json(
        target.with_suffix(".json"),
        {
            "stage": content["kind"],
            "sha256": sha256(target),
            "commit": config["commit"],
            "command": config["command"],
            "averaged": config.get("averaged", []),
            "earlier_runs": earlier,
            "changed_after_training": changes,
            "outputs_scaled_after_training": factors,
            "seed": config["training"]["seed"],
            "iterations": content["iteration"],
            "samples": content["samples"],
            "wall_seconds": round(content["wall_seconds"], 1),
            "machine": config["machine"],
            "config": config["training"],
        },
    )
    for evaluation, options in EVALUATIONS[name].items():
        out = target.with_name(f"{target.stem}.{evaluation}.json")
        if evaluate([*options, "--checkpoint", str(target), "--json", str(out)]) != 0:
            return 2
    return 0


def numbers(pairs: list[str]) -> dict[str, float]:
    """Of KEY=VALUE; ValueError where a value is no number."""
    return {key: float(value) for key, _, value in (text.partition("=") for text in pairs)}


def main() -> int:
    """Parse and ship."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--name", default="base", choices=EVALUATIONS)
    parser.add_argument(
        "--before", type=Path, nargs="*", default=[], metavar="RUN",
        help="runs that this one went on from, oldest first: folders, or a shipped policy's JSON for all of its own",
    )  # fmt: skip
    parser.add_argument(
        "--change", nargs="*", default=[], metavar="KEY=VALUE",
        help="numbers of the config that the policy is shipped with instead of those it was trained with",
    )  # fmt: skip
    parser.add_argument(
        "--scale", nargs="*", default=[], metavar="JOINT=FACTOR",
        help="what the networks send to joints of which this is a part of the name, times a factor",
    )  # fmt: skip
    options = parser.parse_args()
    try:
        changes, factors = numbers(options.change), numbers(options.scale)
        return ship(options.checkpoint, options.name, options.before, changes, factors)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
