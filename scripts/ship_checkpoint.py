"""Make a training checkpoint the one that the package ships: weights only, with its provenance and its evaluations."""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from pathlib import Path
from typing import Any

from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256, write_json
from cotap.checks import require_one_of
from cotap.configs import BaseTraining, DistillTraining, from_plain, to_plain
from cotap.evaluate import main as evaluate
from cotap.evaluation.policy import checkpoint_path, find_checkpoint

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
        "velocity-tracking.hand-forces-any-direction": [*VELOCITY, "--hand-force-size", "40"],
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


def shipped_description(source: Path) -> dict[str, Any]:
    """What stands beside a policy that is shipped already; empty for any other checkpoint, an average say, which has a
    description without evaluations, and so without a checksum, beside it.

    Raises:
        ValueError: the description is another checkpoint's.
    """
    path = source.with_suffix(".json")
    if not path.is_file():
        return {}
    description = json.loads(path.read_text())
    if "sha256" not in description:
        return {}
    if description["sha256"] != sha256(source):
        raise ValueError(f"{path} describes another checkpoint than {source}")
    return description


def changed(training: dict[str, Any], stage: str, changes: dict[str, float | bool]) -> dict[str, Any]:
    """A run's config with other numbers and switches in it.

    Raises:
        ValueError: a key is not that of a number or switch in the config, or a value is out of its range.
    """
    config = from_plain(DistillTraining if stage == "distill" else BaseTraining, training)
    for key, value in changes.items():
        *path, field = key.split(".")
        owner: Any = config
        for part in path:
            owner = getattr(owner, part, None)
        if type(getattr(owner, field, None)) is not type(value):
            raise ValueError(f"{key!r} is no {'switch' if isinstance(value, bool) else 'number'} of the config")
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


COMMANDS = {"forward": ("command_velocity", 0), "sideways": ("command_velocity", 1), "turning": ("command_yaw_rate", 0)}
"""Which number of which term of an observation a command is."""


def told_more(content: dict[str, Any], gains: dict[str, float]) -> dict[str, Any]:
    """A checkpoint whose networks see commands times a gain: a policy that follows a command by 0.9 of it follows, told
    1.1 of it, more closely.

    Raises:
        ValueError: a key is not in `COMMANDS`, or a gain is not within 0.5 to 2.
    """
    model = dict(content["model"])
    for key, gain in gains.items():
        require_one_of("command", key, COMMANDS)
        if not 0.5 <= gain <= 2.0:
            raise ValueError(f"command {key!r} can be told 0.5 to 2 times, got {gain}")
        # Of a number g x, normalised by mean m and deviation s, (g x - m) / s is what x gives by m / g and s / g.
        for part, power in (("_mean", 1), ("_std", 1), ("_var", 2)):
            name = f"normalizers.policy.{part}"
            model[name] = model[name].clone()
            model[name][:, columns_of(content["layout"], *COMMANDS[key])] /= gain**power
    return content | {"model": model}


def columns_of(layout: dict[str, Any], term: str, place: int) -> list[int]:
    """Where an observation has number `place` of a term, once for every step of its history."""
    start, steps = 0, layout["history"]
    for name, width, _ in layout["terms"]:
        if name == term:
            return [start + place + width * step for step in range(steps)]
        start += width * steps
    raise ValueError(f"policies that do not see {term!r} cannot be told more of it")


def without_folder(value: Any) -> Any:
    """Plain data with paths from the repository's folder on: where the machine keeps it is nobody's business."""
    if isinstance(value, dict):
        return {key: without_folder(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [without_folder(entry) for entry in value]
    return value.replace(f"{Path.cwd()}/", "") if isinstance(value, str) else value


def ship(
    source: Path,
    name: str,
    before: list[Path],
    changes: dict[str, float | bool],
    factors: dict[str, float],
    gains: dict[str, float],
) -> int:
    """Strip, save, describe, evaluate. Returns the exit status.

    A policy that is shipped already keeps its provenance: what is changed now comes on top of what was before.
    """
    known = shipped_description(source)
    earlier = known.get("earlier_runs", []) + earlier_runs(before)
    content = told_more(scaled(load_checkpoint(source), factors), gains)
    target = checkpoint_path(name)
    target.parent.mkdir(exist_ok=True)
    config = without_folder(content["config"])
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
            "merged": config.get("merged", {}),
            "earlier_runs": earlier,
            "changed_after_training": known.get("changed_after_training", {}) | changes,
            "outputs_scaled_after_training": combined(known.get("outputs_scaled_after_training", {}), factors),
            "commands_scaled_after_training": combined(known.get("commands_scaled_after_training", {}), gains),
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


def combined(before: dict[str, float], now: dict[str, float]) -> dict[str, float]:
    """Factors applied one after the other.

    Raises:
        ValueError: a joint is named now that was scaled before under a name of which this is a part, or the other way
            round, so that the product is no single factor.
    """
    for key, other in itertools.product(now, before):
        if key != other and (key in other or other in key):
            raise ValueError(f"{key!r} meets {other!r}, by which outputs were scaled before: name the joints as then")
    return {key: before.get(key, 1.0) * now.get(key, 1.0) for key in before | now}


def numbers(pairs: list[str]) -> dict[str, float]:
    """Of KEY=VALUE; ValueError where a value is no number."""
    return {key: float(value) for key, _, value in (text.partition("=") for text in pairs)}


def settings(pairs: list[str]) -> dict[str, float | bool]:
    """Of KEY=VALUE with a number, yes or no; ValueError where a value is none of these."""
    switches = {text: text.endswith("=yes") for text in pairs if text.endswith(("=yes", "=no"))}
    return numbers([text for text in pairs if text not in switches]) | {
        text.partition("=")[0]: on for text, on in switches.items()
    }


def main() -> int:
    """Parse and ship."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "checkpoint", type=find_checkpoint, help="a file, or the name of a policy that is shipped already"
    )
    parser.add_argument("--name", default="base", choices=EVALUATIONS)
    parser.add_argument(
        "--before", type=Path, nargs="*", default=[], metavar="RUN",
        help="runs that this one went on from, oldest first: folders, or a shipped policy's JSON for all of its own",
    )  # fmt: skip
    parser.add_argument(
        "--change", nargs="*", default=[], metavar="KEY=VALUE",
        help="numbers and switches (yes, no) of the config that the policy is shipped with instead of those it was "
        "trained with",
    )  # fmt: skip
    parser.add_argument(
        "--scale", nargs="*", default=[], metavar="JOINT=FACTOR",
        help="what the networks send to joints of which this is a part of the name, times a factor",
    )  # fmt: skip
    parser.add_argument(
        "--tell", nargs="*", default=[], metavar="COMMAND=GAIN",
        help=f"what the networks see of a command ({', '.join(COMMANDS)}), times a gain",
    )  # fmt: skip
    options = parser.parse_args()
    try:
        changes, factors, gains = settings(options.change), numbers(options.scale), numbers(options.tell)
        return ship(options.checkpoint, options.name, options.before, changes, factors, gains)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
