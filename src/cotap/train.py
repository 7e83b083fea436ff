"""`cotap train`: train policies from the command line; without a stage, both, one after the other."""

from __future__ import annotations

import cotap.uncompiled  # noqa: F401 - before what would load the compiler

# isort: split

import contextlib
import os
import platform
import subprocess
import sys
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import mujoco
import tyro

from cotap import __version__
from cotap.agents.checkpoint import STAGES
from cotap.checks import quoted, reason_of, require_one_of, shortened
from cotap.configs import (
    BASE_RECIPES,
    DISTILL_RECIPES,
    BaseTraining,
    DistillTraining,
    from_plain,
    to_plain,
)
from cotap.pipeline import PipelineOptions, Stopped, next_commands, train_both
from cotap.sim import resolve_backend

SHORTCUTS = {
    "--robot": "--env.robot",
    "--num-envs": "--env.num-envs",
    "--iterations": "--runner.iterations",
    "--backend": "--env.backend",
    "--modulation": "--env.upper-body.modulation.kind",
}


@dataclass
class BaseOptions:
    """Stage 1: a base policy. Legs follow velocity, yaw rate, height and stand commands; arms follow a reference.

    `--robot`, `--num-envs`, `--iterations` and `--backend` are short for `--env.robot`, `--env.num-envs`,
    `--runner.iterations` and `--env.backend`.
    """

    run_dir: str = ""
    """Folder of the run. By default that of the run that is resumed, or else runs/base-DATE-TIME."""
    resume: str = ""
    """Checkpoint to go on from, or auto. auto takes the newest in --run-dir, if there is one. The configuration of the
    run is the default for every option."""
    recipe: str = "default"
    """default, quick, paper or facet. default is the full training, quick walks in the shortest time, paper has the
    paper's values, facet tracks FACET's reward."""
    command: tyro.conf.Suppress[str] = ""
    training: Annotated[BaseTraining, tyro.conf.arg(name="")] = field(default_factory=BASE_RECIPES["default"])


@dataclass
class DistillOptions:
    """Stage 2: arms under compliance, a policy that begins as the base and is guided by it while it learns.

    `--robot` names the robot whose shipped base policy is taken; any other base brings its robot. `--num-envs`,
    `--iterations` and `--backend` are short for `--env.num-envs`, `--runner.iterations` and `--env.backend`;
    `--modulation` for `--env.upper-body.modulation.kind`.
    """

    run_dir: str = ""
    """Folder of the run. By default that of the run that is resumed, or else runs/distill-DATE-TIME."""
    resume: str = ""
    """Checkpoint to go on from, or auto. auto takes the newest in --run-dir, if there is one. The configuration of the
    run is the default for every option."""
    base_checkpoint: str = ""
    """Policy to start from, a base or a distilled one: a file, or a shipped policy's name. It guides the new policy as
    well. By default the base that ships of --robot."""
    recipe: str = "default"
    """default, quick, paper, facet, modulated, no-ratio, torque-critic or goals. default: 80 to 1200 N/m. quick: the
    same, 15 M samples. paper: 150 to 450 N/m. facet: arms under PD, FACET's tracking reward. modulated: the policy sets
    alpha and stiffness, no arm targets. The others are ablations of quick. Where networks see or do something else than
    the base's, those are refitted."""
    command: tyro.conf.Suppress[str] = ""
    training: Annotated[DistillTraining, tyro.conf.arg(name="")] = field(default_factory=DistillTraining)


def main(argv: list[str] | None = None) -> int:
    """Parse, train, report. Returns the exit status: 0, 2 for bad input, 1 for a training that failed, 130 for both
    stages stopped before their end, or one before its checkpoint was saved."""
    args = list(sys.argv[1:] if argv is None else argv)
    stage = args.pop(0) if args and not args[0].startswith("-") else ""
    try:
        if not stage:
            train_both(tyro.cli(PipelineOptions, args=args, prog="cotap train"), run_stage)
            return 0
        require_one_of("stage", stage, STAGES)
        print(next_commands(run_stage(stage, args)), end="")
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except RuntimeError as error:  # an iteration failed, or the frozen base was found changed
        traceback.print_exception(error.__cause__ or error)
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 1
    except Stopped as stop:
        print(stop, file=sys.stderr)
        return 130
    except KeyboardInterrupt:  # asked to stop twice
        print("interrupted before the checkpoint was saved; the last one is whole", file=sys.stderr)
        return 130
    return 0


def run_stage(stage: str, args: list[str]) -> Path:
    """Train one stage, of arguments as they were typed. Returns the run directory."""
    options = _parse_base(args) if stage == "base" else _parse_distill(args)
    options.command = " ".join(["cotap train", stage, *args])
    return train_base(options) if isinstance(options, BaseOptions) else train_distill(options)


def _expand(args: list[str]) -> list[str]:
    """Arguments with names as the options have them, shortcuts written out, and the files that checkpoints' names and
    auto mean."""
    from cotap.agents.runner import newest_checkpoint
    from cotap.evaluation.policy import find_checkpoint

    args = [_named(key) + sep + value for key, sep, value in (a.partition("=") for a in args)]
    for option in ("--resume", "--base-checkpoint"):
        if (given := _peek(args, option)) not in ("", "auto"):
            args = [*args, f"{option}={find_checkpoint(given)}"]  # the last one counts
    if _peek(args, "--resume") != "auto":
        return args
    run_dir = _peek(args, "--run-dir")
    if not run_dir:
        raise ValueError("--resume auto looks for checkpoints in --run-dir, which is not given")
    return [*args, f"--resume={newest_checkpoint(Path(run_dir)) or ''}"]


def _resumes_newest(args: list[str]) -> bool:
    """Whether `--resume auto` is asked for, of arguments as they were typed."""
    return _peek([_named(arg) for arg in args], "--resume") == "auto"


def _named(key: str) -> str:
    """An option's name as `_peek` looks for it; the parser takes underscores for hyphens."""
    key = key.replace("_", "-") if key.startswith("--") else key
    return SHORTCUTS.get(key, key)


def _parse_base(args: list[str]) -> BaseOptions:
    """Options on top of the resumed checkpoint's config, or else of the recipe's."""
    goes_on = _resumes_newest(args)  # with whatever the run began with
    args = _expand(args)
    recipe, resumed = _peek(args, "--recipe"), _peek(args, "--resume")
    require_one_of("recipe", recipe or "default", BASE_RECIPES.keys())
    if resumed:
        training = _resumed_config(resumed, "" if goes_on else recipe, "base", BaseTraining)
    else:
        training = BASE_RECIPES[recipe or "default"](_peek(args, SHORTCUTS["--robot"]) or BaseTraining().env.robot)
    _unpin_library(args, training)
    samples = training.samples
    default = BaseOptions(recipe=recipe or "default", training=training)
    options = tyro.cli(BaseOptions, args=args, default=default, prog="cotap train base")
    _train_as_long(args, options, samples)
    return options


def _parse_distill(args: list[str]) -> DistillOptions:
    """Options on top of the resumed checkpoint's config, or else of what the recipe makes of the base's."""
    from cotap.evaluation.policy import require_robot, shipped_policy

    goes_on = _resumes_newest(args)  # with whatever the run began with
    args = _expand(args)
    given, resumed, base = (_peek(args, option) for option in ("--recipe", "--resume", "--base-checkpoint"))
    robot = _peek(args, SHORTCUTS["--robot"])
    recipe = require_one_of("recipe", given or "default", DISTILL_RECIPES.keys())
    if resumed:
        training = _resumed_config(resumed, "" if goes_on else given, "distill", DistillTraining)
        if base and not goes_on:
            raise ValueError(f"--base-checkpoint {base!r}: checkpoint {resumed!r} brings the base that guides it")
        base = ""
    else:
        base = base or str(shipped_policy(robot or BaseTraining().env.robot, ("base",)))
        training = DISTILL_RECIPES[recipe](_base_config(base))
    if robot:
        require_robot(resumed or base, training.env.robot, robot)
    _unpin_library(args, training)
    samples = training.samples
    default = DistillOptions(recipe=recipe, base_checkpoint=base, training=training)
    options = tyro.cli(DistillOptions, args=args, default=default, prog="cotap train distill")
    if resumed:
        options.base_checkpoint = ""  # the resumed checkpoint brings its base, whose file may be gone
    _train_as_long(args, options, samples)
    return options


def _train_as_long(args: list[str], options: BaseOptions | DistillOptions, samples: int) -> None:
    """Unless iterations are given, or those of a run that goes on, as many as take so many `samples`."""
    if not options.resume and not _peek(args, "--runner.iterations"):
        options.training.train_for(samples)


def _unpin_library(args: list[str], training: BaseTraining | DistillTraining) -> None:
    """If a motion library is given, drop the digest that the resumed or base config has: the file is taken as it is."""
    if _peek(args, "--env.motions.clips.library"):
        training.env.motions.clips.library_sha256 = ""


def _resumed_config(checkpoint: str, recipe: str, stage: str, kind: type[Any]) -> Any:
    """The config of a run that goes on. Raises ValueError for one that cannot, or would become another run."""
    from cotap.agents.checkpoint import load_checkpoint

    content = load_checkpoint(checkpoint)
    if content.get("kind", stage) != stage:
        raise ValueError(f"--resume {checkpoint!r}: a checkpoint of stage {quoted(content['kind'])}, not {stage!r}")
    if not content.get("learner"):
        raise ValueError(
            f"--resume {checkpoint!r}: a shipped policy has no optimiser and cannot go on; train from nothing, or "
            "distill with --base-checkpoint"
        )
    if recipe:
        raise ValueError(f"--recipe {recipe!r}: the run of --resume goes on with its own config")
    return _config_of(checkpoint, content, kind)


def _base_config(checkpoint: str) -> BaseTraining:
    """The config of a policy to begin from, but for rewards that are not known here and how it was distilled. Raises
    CheckpointError for one that cannot be used."""
    from cotap.agents.checkpoint import load_checkpoint, require_parts
    from cotap.agents.run_log import say
    from cotap.configs.saved import without_unknown_terms

    content = load_checkpoint(checkpoint)
    require_parts(checkpoint, content, ("kind", "layout", "model", "config"))
    plain = content["config"].get("training")
    unknown: list[str] = []
    if isinstance(plain, dict) and "env" in plain:
        plain["env"], unknown = without_unknown_terms(plain["env"])
        plain.pop("distillation", None)
    if unknown:
        say(f"{checkpoint}: trained with rewards that are not known here and are left out: {', '.join(unknown)}")
    return _config_of(checkpoint, content, BaseTraining)


def _config_of(checkpoint: str, content: dict[str, Any], kind: type[Any]) -> Any:
    from cotap.agents.checkpoint import MALFORMED, CheckpointError

    try:
        return from_plain(kind, content["config"]["training"])
    except MALFORMED as error:
        raise CheckpointError(f"checkpoint {checkpoint!r} has no usable config: {reason_of(error)}") from error


def _peek(args: list[str], option: str) -> str:
    """The value that the parser will find: of an option given twice, the last. Empty if it is not given."""
    found = ""
    for i, arg in enumerate(args):
        if arg.startswith(option + "="):
            found = arg.partition("=")[2]
        if arg == option and i + 1 < len(args):
            found = args[i + 1]
    return found


def train_base(options: BaseOptions) -> Path:
    """Run stage 1. Returns the run directory."""
    return _train("base", options, None)


def train_distill(options: DistillOptions) -> Path:
    """Run stage 2. Returns the run directory.

    Raises:
        CheckpointError: the base checkpoint cannot be used, or has other networks.
    """
    from cotap.agents.checkpoint import load_checkpoint

    return _train("distill", options, load_checkpoint(options.base_checkpoint) if options.base_checkpoint else None)


def _train(stage: str, options: BaseOptions | DistillOptions, base: dict[str, Any] | None) -> Path:
    """What both stages share. `base` is the checkpoint that a distillation begins from."""
    import torch

    from cotap.agents.ranks import Ranks
    from cotap.agents.run_log import say
    from cotap.agents.runner import CHECKPOINT_PATTERN, DualRunner, check_run_dir, sole_writer
    from cotap.envs import HumanoidEnv
    from cotap.motions.reference import pin_library

    training, ranks = options.training, Ranks.from_environment()
    resumed = Path(options.resume) if options.resume else None
    # A checkpoint that was copied out of its run goes on elsewhere.
    resumed_dir = resumed.parent if resumed and resumed.match(CHECKPOINT_PATTERN) else None
    if ranks.size > 1 and not (options.run_dir or resumed_dir):
        raise ValueError("several processes need one --run-dir, got none")
    run_dir = Path(options.run_dir) if options.run_dir else resumed_dir or _new_run_dir(stage)
    training.env.seed, training.env.num_threads = training.seed, training.threads
    training.check()
    pin_library(training.env.motions.clips)
    config = {"stage": stage, "training": to_plain(training), **provenance(options.command, training.env.backend)}
    config |= _origin(options)
    training.env.seed, training.env.num_threads = ranks.seed(training.seed), ranks.threads(training.threads)
    training.device = ranks.device(training.device)
    if training.env.num_threads:
        torch.set_num_threads(training.env.num_threads)
    torch.manual_seed(training.seed)  # networks begin alike everywhere
    with ranks.joined(training.device):
        env = HumanoidEnv(training.env, ranks.size)
        guide = _guide(env, options, base) if isinstance(options, DistillOptions) else None
        runner = DualRunner(env, training.runner, training.ppo, run_dir, config, training.device, guide, ranks)
        if guide and not options.resume:
            guide.start(runner.alg.model)
            runner.alg.begin_anew()
        if ranks.size > 1:
            torch.manual_seed(training.env.seed)
        if options.resume:
            runner.load(options.resume)
        # Last, so that nothing is left behind when any of the above refuses.
        if ranks.leads:
            check_run_dir(run_dir, resumed if resumed_dir else None)
        with sole_writer(run_dir) if ranks.leads else contextlib.nullcontext():
            runner.learn()
    if ranks.leads:
        say(f"{runner.current_learning_iteration} iterations, {runner.wall_seconds:.0f} s: {run_dir}")
    return run_dir


def _origin(options: BaseOptions | DistillOptions) -> dict[str, Any]:
    """What a run's config says of where it comes from: the runs before it, and the base of a distillation, which may
    have a base itself."""
    from cotap.agents.checkpoint import load_checkpoint, sha256

    begun_from = options.base_checkpoint if isinstance(options, DistillOptions) else ""
    if not (before := options.resume or begun_from):
        return {}
    content = load_checkpoint(before)
    older = {"base": content["config"]["base"]} if "base" in content["config"] else {}
    if options.resume:
        return {"earlier_runs": runs_of(content), **older}
    return {"base": {"sha256": sha256(before), "runs": runs_of(content), **older}}


def runs_of(content: dict[str, Any]) -> list[dict[str, Any]]:
    """Command, commit and last sample of every run that a checkpoint comes from, the first one first."""
    config = content["config"]
    last = {name: config.get(name, "") for name in ("command", "commit")} | {"samples": content.get("samples", 0)}
    return [*config.get("earlier_runs", []), last]


def _guide(env: Any, options: DistillOptions, base: dict[str, Any] | None) -> Any:
    """The frozen base; of a resumed run, one whose weights the checkpoint brings."""
    from cotap.agents.actors import DualActorCritic
    from cotap.agents.distillation import Guide
    from cotap.agents.refit import REFITTED, spread, take_over
    from cotap.agents.run_log import say
    from cotap.agents.runner import layout_of

    training = options.training
    layout = layout_of(env, training.ppo.symmetric)
    model = DualActorCritic(layout, training.ppo.hidden, training.distillation.new_std)
    if base is not None:
        if take_over(options.base_checkpoint, base, model, env, REFITTED):
            say("the networks see or do something else than the base's, which were refitted to that")
        model.load_state_dict(spread(model.state_dict()))
    return Guide(model.to(training.device), training.distillation)


def provenance(command: str, backend: str) -> dict[str, str]:
    """What else a run should remember: the code it ran, the command, the machine, what simulated."""
    try:
        git = ["git", "-C", str(Path(__file__).parent)]
        # Fails where the package lies in another project's repository, whose commit says nothing of it.
        subprocess.run([*git, "ls-files", "--error-unmatch", Path(__file__).name], capture_output=True, check=True)
        commit = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        dirty = subprocess.run([*git, "status", "--porcelain", "."], capture_output=True, text=True, check=True).stdout
        commit += " with local changes" if dirty.strip() else ""
    except (OSError, subprocess.CalledProcessError):
        commit = f"cotap {__version__}"
    simulation = f"{resolve_backend(backend)}, MuJoCo {mujoco.__version__}"
    machine = f"{platform.machine()}, {os.cpu_count()} CPUs, Python {platform.python_version()}"
    return {"commit": commit, "command": command, "machine": machine, "simulation": simulation}


def _new_run_dir(stage: str) -> Path:
    return Path("runs") / time.strftime(f"{stage}-%Y%m%d-%H%M%S")


if __name__ == "__main__":
    sys.exit(main())
