"""Make a run's checkpoint a policy that the package ships: its weights, where they come from, and its evaluations.

python -m release.publish runs/base/checkpoint_006104.pt h1-base

Writes NAME.pt, NAME.json and one NAME.EVALUATION.json for each of `EVALUATIONS`. No number of the policy changes. With
what ships in the checkpoint's place (`release.publish h1-base h1-base`), it is evaluated again. Afterwards,
`python -m release.card` sums up all that ships.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from cotap.agents.checkpoint import load_checkpoint, require_parts, save_checkpoint, sha256, write_json
from cotap.checks import require_positive_int
from cotap.evaluate import main as evaluate
from cotap.evaluation.policy import CHECKPOINTS, checkpoint_path, find_checkpoint
from cotap.motions.reference import ClipConfig
from cotap.train import runs_of
from release.recipe import require_default

TRACKING, ENVS = "velocity-tracking", "ENVS"
PUSHES = {"base-25": ("base", "500"), "base-50": ("base", "1000"), "hand-25": ("hand", "500")}
"""Where a push of 50 ms acts, and its force [N], by place and impulse [N s]."""


def pushed(place: str, force: str, mode: str) -> list[str]:
    """A push in any horizontal direction on robots that stand or walk, arms moving."""
    push = ["--place", place, "--force", force, "0", "0", "--random-direction"]
    return ["impact", "--num-envs", ENVS, "--mode", mode, *push]


EVALUATIONS: dict[str, list[str]] = {
    TRACKING: [TRACKING, "--num-envs", ENVS],
    f"{TRACKING}.hand-loads": [TRACKING, "--num-envs", ENVS, "--hand-loads"],
    f"{TRACKING}.held-out": [TRACKING, "--num-envs", ENVS, "--motion", *ClipConfig.held_out],
    f"{TRACKING}.reference-arms": [TRACKING, "--num-envs", ENVS, "--upper-actions", "reference"],
    **{f"impact.{name}.{mode}": pushed(*push, mode) for name, push in PUSHES.items() for mode in ("stance", "walking")},
    **{
        f"fall-curve.{mode}": ["fall-curve", "--num-envs", ENVS, "--place", "base", "--mode", mode]
        for mode in ("stance", "walking")
    },
    f"{TRACKING}.small": [TRACKING, "--num-envs", "64", "--episode-seconds", "10", "--threads", "1"],
}
"""By name; a test repeats the small one. ENVS stands for `--envs`."""
KEPT = ("kind", "layout", "agents", "config", "model", "iteration", "samples", "wall_seconds")
"""Parts of the run's checkpoint that are shipped."""
EMPTY: dict[str, Any] = {"learner": {}, "env": {}, "others": []}
HEADLINE = ("num_envs", "num_falls", "e_lin", "e_yaw", "slopes")


def strip(source: Path, target: Path) -> dict[str, Any]:
    """Save what is shipped of a checkpoint. Returns its content."""
    content = load_checkpoint(source)
    require_parts(source, content, KEPT)
    kept = {name: content[name] for name in KEPT}
    kept["config"] = without_folder(kept["config"], f"{Path.cwd()}/")
    save_checkpoint(target, kept | EMPTY)
    return kept


def without_folder(value: Any, folder: str) -> Any:
    """Plain data without the folder in its paths, which no other machine has."""
    return json.loads(json.dumps(value).replace(json.dumps(folder)[1:-1], ""))


def description(target: Path, content: dict[str, Any], headlines: dict[str, Any]) -> dict[str, Any]:
    """What NAME.json says."""
    config = content["config"]
    return {
        "sha256": sha256(target),
        "robot": content["layout"]["robot"],
        "stage": content["kind"],
        "runs": runs_of(content),
        **({"base": config["base"]} if "base" in config else {}),
        "command": config["command"],
        "commit": config["commit"],
        "seed": config["training"]["seed"],
        "iterations": content["iteration"],
        "samples": content["samples"],
        "hours": round(content["wall_seconds"] / 3600.0, 2),
        "machine": config["machine"],
        "evaluations": headlines,
    }


def publish(source: Path, name: str, envs: int, threads: int = 0) -> int:
    """Write everything, once all is there. Returns the exit status: 0, or that of the evaluation that failed.

    Args:
        source: The run's checkpoint.
        name: What it is published as.
        envs: Of the large evaluations.
        threads: Of theirs; 0 takes every CPU.

    Raises:
        ValueError: the checkpoint is of another robot or stage than its name, or new and not of the recipe `default`.
    """
    target = checkpoint_path(name)
    target.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        staged = Path(folder) / target.name
        if target.is_file() and sha256(source) == sha256(target):  # what ships was of the recipe of its day
            shutil.copyfile(source, staged)
            content = load_checkpoint(staged)
        else:
            content = strip(source, staged)
            require_name(name, content)
            require_default(content)
        headlines: dict[str, Any] = {}
        for evaluation, options in EVALUATIONS.items():
            out = staged.with_name(f"{name}.{evaluation}.json")
            args = [str(envs) if option == ENVS else option for option in options]
            args += [] if "--threads" in args else ["--threads", str(threads)]
            if status := evaluate([*args, "--checkpoint", str(staged), "--json", str(out)]):
                return status
            result = json.loads(out.read_text())
            headlines[evaluation] = {key: result[key] for key in HEADLINE if key in result}
        write_json(staged.with_suffix(".json"), description(staged, content, headlines))
        for path in sorted(Path(folder).iterdir()):
            path.replace(target.with_name(path.name))
    return 0


def require_name(name: str, content: dict[str, Any]) -> None:
    """Raise ValueError unless a checkpoint is of the robot and the stage that `name`, ROBOT-STAGE, says."""
    robot, stage = content["layout"]["robot"], {"distill": "cotap"}.get(content["kind"], content["kind"])
    if name != f"{robot}-{stage}":
        raise ValueError(f"the checkpoint is of {robot}-{stage}, it cannot be published as {name}")


def main(argv: list[str] | None = None) -> int:
    """Parse and publish. Returns the exit status: 0, or 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=find_checkpoint)
    parser.add_argument("name", choices=CHECKPOINTS)
    parser.add_argument("--envs", type=int, default=1024, help="of the large evaluations")
    parser.add_argument("--threads", type=int, default=0, help="of the large evaluations; 0 takes every CPU")
    options = parser.parse_args(argv)
    try:
        envs = require_positive_int("envs", options.envs)
        return publish(options.checkpoint, options.name, envs, options.threads)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
