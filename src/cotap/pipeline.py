"""Both stages of training, one after the other: what `cotap train` does without a stage."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

from cotap.agents.checkpoint import STAGES, write_json
from cotap.checks import reason_of, require_one_of, require_range
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES, BaseTraining, DistillTraining, from_plain, to_plain

RunStage = Callable[[str, list[str]], Path]
"""Trains one stage, given its name and its arguments as if typed, and returns its directory."""
BEGUN_WITH = "pipeline.json"
"""The file beside both runs that has the options which they began with."""
MAY_CHANGE = ("run_dir", "resume", "base_iterations", "distill_iterations", "threads", "backend", "device")
"""Options that may differ where a pipeline goes on."""


@dataclass
class PipelineOptions:
    """Both stages: a base policy, then its distillation under compliance. For more options:
    `cotap train base --help`, `cotap train distill --help`."""

    run_dir: str = ""
    """Folder of both runs, by default runs/cotap-DATE-TIME. It gets the folders `base` and `distill`."""
    robot: str = "h1"
    """Name of the robot."""
    quick: bool = False
    """A small version of both stages. Walking is trained without loads and pushes, compliance only begun."""
    recipe: str = ""
    """Recipe of both stages: default, quick, paper or facet. Without it, default, or quick with --quick."""
    resume: bool = False
    """Go on with the runs in --run-dir, with the options that they began with. A stage that is finished is not run
    again."""
    num_envs: int = 0
    """Number of envs; 0 for the recipe's. Samples stay the same."""
    base_iterations: int = 0
    """Iterations of stage 1; 0 for as many as the recipe's samples take."""
    distill_iterations: int = 0
    """Iterations of stage 2; 0 for as many as the recipe's samples take."""
    seed: int = 0
    """Seed of both stages."""
    threads: int = 0
    """CPU threads, 0 for every core."""
    backend: str = "auto"
    """What simulates: mujoco, mjbatch (both on the CPU), warp (a GPU) or auto. auto takes warp if there is
    a GPU and the extra `warp` is installed, else mjbatch if that is installed, else mujoco."""
    device: str = "cpu"
    """Where the networks live, such as cpu or cuda."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("num_envs", self.num_envs, 0, 1e9)
        for name in ("base_iterations", "distill_iterations"):
            require_range(name, getattr(self, name), 0, 1e9)
        if self.recipe:
            require_one_of("recipe", self.recipe, BASE_RECIPES.keys() & DISTILL_RECIPES.keys())
            if self.quick:
                raise ValueError(f"--quick is a recipe, so --recipe {self.recipe!r} is not allowed")
        for training in self._trainings():
            training.check()
        if self.resume and not self.run_dir:
            raise ValueError("--resume goes on with the runs in --run-dir, which is not given")

    @property
    def chosen(self) -> str:
        """Name of the recipe."""
        return self.recipe or ("quick" if self.quick else "default")

    def iterations(self) -> tuple[int, int]:
        """Of both stages."""
        base, distill = self._trainings()
        return base.runner.iterations, distill.runner.iterations

    def _trainings(self) -> tuple[BaseTraining, DistillTraining]:
        """Both configurations."""
        base = BASE_RECIPES[self.chosen](self.robot)
        samples = base.samples
        base.seed, base.threads, base.device = self.seed, self.threads, self.device
        base.env.backend, base.env.num_threads = self.backend, self.threads
        base.env.num_envs = self.num_envs or base.env.num_envs
        base.train_for(samples)
        distill = DISTILL_RECIPES[self.chosen](base)
        distill.threads, distill.device = self.threads, self.device
        base.runner.iterations = self.base_iterations or base.runner.iterations
        distill.runner.iterations = self.distill_iterations or distill.runner.iterations
        return base, distill


class Stopped(Exception):
    """A stage was asked to stop before its end; the message says how to go on."""


def train_both(options: PipelineOptions, run_stage: RunStage) -> Path:
    """Run stage 1, then stage 2 from its result, and sum both up. Returns the directory of both.

    Args:
        options: Of both stages.
        run_stage: Trains one of them.

    Raises:
        ValueError: an option is out of its range, or this is one of several processes.
        Stopped: a stage was asked to stop.
    """
    from cotap.agents.ranks import Ranks
    from cotap.agents.runner import sole_writer

    options.check()
    if Ranks.from_environment().size > 1:
        raise ValueError("several processes train stage by stage: cotap train base, then distill")
    run_dir = Path(options.run_dir or time.strftime("runs/cotap-%Y%m%d-%H%M%S"))
    if options.resume:
        options = _resumed_options(options, run_dir)
    else:
        _require_unused(run_dir, "go on with --resume, or choose another --run-dir")
        print(expected(options), flush=True)
    base_steps, distill_steps = options.iterations()
    recipe = ["--recipe", options.chosen]
    run_dir.mkdir(parents=True, exist_ok=True)
    with sole_writer(run_dir):
        write_json(run_dir / BEGUN_WITH, to_plain(options))
        base = _part(options, run_dir / "base", base_steps, [*recipe, "--robot", options.robot], run_stage)
        _part(options, run_dir / "distill", distill_steps, [*recipe, "--base-checkpoint", str(base)], run_stage)
    print(_summary(run_dir), end="")
    return run_dir


def _require_unused(run_dir: Path, advice: str) -> None:
    from cotap.agents.runner import newest_checkpoint

    if found := next(filter(None, (newest_checkpoint(run_dir / stage) for stage in STAGES)), None):
        raise ValueError(f"run directory {str(run_dir)!r} already holds {str(found.relative_to(run_dir))!r}: {advice}")


def _resumed_options(options: PipelineOptions, run_dir: Path) -> PipelineOptions:
    """The options that the pipeline in a folder began with, but for those of `MAY_CHANGE` that are given now; these
    options where nothing began there yet.

    Raises:
        ValueError: the folder has runs but not their options, those cannot be used, or another option differs.
    """
    path = run_dir / BEGUN_WITH
    if not path.is_file():
        advice = f"it has no {BEGUN_WITH}, so that its stages go on one by one: cotap train base --resume auto"
        _require_unused(run_dir, advice)
        return options
    try:
        begun = from_plain(PipelineOptions, json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, RecursionError) as error:  # the last of values nested without end
        raise ValueError(f"{str(path)!r} has no usable options: {reason_of(error)}") from error
    default = PipelineOptions()
    for name in (field.name for field in fields(options)):
        given, before = getattr(options, name), getattr(begun, name)
        if given == getattr(default, name):
            continue  # not given
        if given != before and name not in MAY_CHANGE:
            raise ValueError(
                f"--{name.replace('_', '-')} {given!r}: the runs in {str(run_dir)!r} began with {before!r}"
            )
        setattr(begun, name, given)
    begun.check()
    return begun


def expected(options: PipelineOptions) -> str:
    """What both stages will take on this machine, by one iteration of each, as a Markdown table."""
    import torch

    from cotap.agents.distillation import Guide
    from cotap.agents.timing import TimedTraining
    from cotap.envs import HumanoidEnv

    if options.threads:
        torch.set_num_threads(options.threads)
    lines = ["| stage | samples | samples/s here | hours |", "|---|---|---|---|"]
    base, distill = options._trainings()
    walking = TimedTraining(HumanoidEnv(base.env), base.ppo, options.device)
    guide = Guide(walking.alg.model, distill.distillation)
    complying = TimedTraining(HumanoidEnv(distill.env), distill.ppo, options.device, guide)
    for stage, training, timed in zip(STAGES, (base, distill), (walking, complying), strict=True):
        timed.run()  # warm up
        rate = timed.run()
        hours = training.samples / rate / 3600.0
        lines.append(f"| {stage} | {training.samples:,} | {rate:,.0f} | {hours:.1f} |")
    return "\n".join(lines)


def _part(options: PipelineOptions, run_dir: Path, iterations: int, begin: list[str], run_stage: RunStage) -> Path:
    """Run one part of the pipeline, up to so many iterations; with `begin` unless it goes on.

    Returns its newest checkpoint. Raises Stopped if that is not its last.
    """
    from cotap.agents.checkpoint import load_checkpoint
    from cotap.agents.runner import newest_checkpoint

    newest = newest_checkpoint(run_dir) if options.resume else None
    envs = ["--num-envs", str(options.num_envs)] if options.num_envs else []
    run_stage(run_dir.name, [
        *envs, "--seed", str(options.seed), "--threads", str(options.threads),
        "--backend", options.backend, "--device", options.device, "--iterations", str(iterations),
        "--run-dir", str(run_dir), *(["--resume", str(newest)] if newest else begin),
    ])  # fmt: skip
    newest = newest_checkpoint(run_dir)
    assert newest, f"{run_dir} holds no checkpoint of a stage that ended"
    reached = load_checkpoint(newest)["iteration"]
    if reached < iterations:
        raise Stopped(
            f"stopped at iteration {reached} of {iterations} of {run_dir}; the same command with "
            f"--run-dir {run_dir.parent} --resume goes on"
        )
    return newest


def _summary(run_dir: Path) -> str:
    """What each stage took, as a Markdown table, and what to type next."""
    from cotap.agents.checkpoint import load_checkpoint
    from cotap.agents.runner import newest_checkpoint

    lines = ["| run | iterations | samples | seconds | checkpoint |", "|---|---|---|---|---|"]
    for part in STAGES:
        path = newest_checkpoint(run_dir / part)
        assert path, f"{run_dir / part} holds no checkpoint"
        content = load_checkpoint(path)
        lines.append(
            f"| {part} | {content['iteration']} | {content['samples']:,} | {content['wall_seconds']:.0f} | {path} |"
        )
    return "\n".join(lines) + "\n" + next_commands(run_dir / STAGES[-1])


def next_commands(run_dir: Path) -> str:
    """What a user may want to type after a training; nothing where it saved no checkpoint."""
    from cotap.agents.runner import newest_checkpoint

    newest = newest_checkpoint(run_dir)
    if newest is None:
        return ""
    commands = (
        f"tensorboard --logdir {run_dir}",
        f"cotap play --checkpoint {newest}",
        f"cotap evaluate velocity-tracking --checkpoint {newest}",
    )
    return "\nNext:\n" + "".join(f"  {command}\n" for command in commands)
