"""`python -m cotap.train`: train policies from the command line."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from cotap import __version__
from cotap.checks import require_one_of
from cotap.configs import BASE_RECIPES, BaseTraining, from_plain, to_plain

SHORTCUTS = {"--num-envs": "--env.num-envs", "--iterations": "--runner.iterations"}


@dataclass
class BaseOptions:
    """Stage 1: a base policy. Legs follow velocity, yaw rate, height and stand commands; arms follow a reference.

    `--num-envs` and `--iterations` are short for `--env.num-envs` and `--runner.iterations`.
    """

    run_dir: str = ""
    """Where the run goes; by default runs/base-DATE-TIME, or the resumed checkpoint's folder."""
    resume: str = ""
    """Checkpoint to go on from; its config is the default for every option."""
    recipe: str = "default"
    """default, or paper (the paper's networks)."""
    command: tyro.conf.Suppress[str] = ""
    training: Annotated[BaseTraining, tyro.conf.arg(name="")] = field(default_factory=BASE_RECIPES["default"])


def main(argv: list[str] | None = None) -> int:
    """Parse, train, report. Returns the exit status: 0, or 2 for bad input."""
    args = list(sys.argv[1:] if argv is None else argv)
    stage = args.pop(0) if args and not args[0].startswith("-") else "base"
    try:
        require_one_of("stage", stage, ("base",))
        options = _parse(args)
        options.command = " ".join(["python -m cotap.train", stage, *args])
        train_base(options)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _parse(args: list[str]) -> BaseOptions:
    """Options on top of the resumed checkpoint's config, or else of the recipe's."""
    from cotap.agents.checkpoint import CheckpointError, load_checkpoint

    args = [SHORTCUTS.get(key, key) + sep + value for key, sep, value in (a.partition("=") for a in args)]
    first: Any = _peek(args, "--resume")
    recipe = require_one_of("recipe", _peek(args, "--recipe") or "default", BASE_RECIPES.keys())
    training = BASE_RECIPES[recipe]()
    if first:
        content = load_checkpoint(first)
        try:
            training = from_plain(BaseTraining, content["config"]["training"])
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(f"checkpoint {first!r} has no usable config: {error}") from error
    default = BaseOptions(recipe=recipe, training=training)
    return tyro.cli(BaseOptions, args=args, default=default, prog="python -m cotap.train base")


def _peek(args: list[str], option: str) -> str:
    for i, arg in enumerate(args):
        if arg.startswith(option + "="):
            return arg.partition("=")[2]
        if arg == option and i + 1 < len(args):
            return args[i + 1]
    return ""


def train_base(options: BaseOptions) -> Path:
    """Run stage 1. Returns the run directory."""
    import torch

    from cotap.agents.runner import DualRunner, check_run_dir
    from cotap.envs import H1Env

    training = options.training
    resumed_dir = Path(options.resume).parent if options.resume else None
    run_dir = Path(options.run_dir) if options.run_dir else resumed_dir or _new_run_dir("base")
    training.env.seed, training.env.num_threads = training.seed, training.threads
    training.check()
    if training.threads:
        torch.set_num_threads(training.threads)
    torch.manual_seed(training.seed)
    config = {"stage": "base", "training": to_plain(training), **_provenance(options.command)}
    runner = DualRunner(H1Env(training.env), training.runner, training.ppo, run_dir, config, training.device)
    if options.resume:
        runner.load(options.resume)
    # Last, so that nothing is left behind when any of the above refuses.
    check_run_dir(run_dir, resuming=resumed_dir is not None and run_dir.resolve() == resumed_dir.resolve())
    runner.learn(init_at_random_ep_len=True)
    print(f"{runner.current_learning_iteration} iterations, {runner.wall_seconds:.0f} s: {run_dir}")
    return run_dir


def _provenance(command: str) -> dict[str, str]:
    """What else a run should remember: the code it ran, the command, the machine."""
    try:
        git = ["git", "-C", str(Path(__file__).parent)]
        commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        dirty = subprocess.run([*git, "status", "--porcelain", "."], capture_output=True, text=True, check=True).stdout
        commit += " with local changes" if dirty.strip() else ""
    except (OSError, subprocess.CalledProcessError):
        commit = f"cotap {__version__}"
    machine = f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}"
    return {"commit": commit, "command": command, "machine": machine}


def _new_run_dir(stage: str) -> Path:
    return Path("runs") / time.strftime(f"{stage}-%Y%m%d-%H%M%S")


if __name__ == "__main__":
    sys.exit(main())
