"""`cotap deploy`: one robot, its policy in onnxruntime, in a physics engine of choice."""

from __future__ import annotations

import cotap.uncompiled  # noqa: F401 - before what would load the compiler

# isort: split

import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from cotap.checks import require_positive_int, require_seed, shortened
from cotap.deployment.engines import EngineConfig
from cotap.deployment.robot import Perturbations
from cotap.deployment.safety import SafetyConfig
from cotap.deployment.scenario import Scenario, TimedCommand, load_scenario
from cotap.evaluation.law_options import make_passive, parse_law
from cotap.files import require_output
from cotap.motions.reference import HELD

_KEYBOARD_S = 600.0


@dataclass
class DeployOptions:
    """Run an exported policy on one robot, as on hardware: readings of joints and IMU in, torques out.

    Commands come from a scenario, from the keyboard, or are drawn at random as the velocity-tracking evaluation does.
    """

    policy: str
    """ONNX file that `cotap export` wrote."""
    scenario: str = ""
    """File (TOML) of commands, forces, motion and laws."""
    keyboard: bool = False
    """Steer from this terminal, in real time. The keys are printed at the start."""
    trials: int = 1
    """Number of trials, each with another seed."""
    episode_seconds: float | None = None
    """Length of a trial [s]. By default 20, and 600 with --keyboard; a scenario has its own."""
    motion: str = HELD
    """Clip for the arms, `mixture` or `none`. mixture: clips and generated motion, as recipes have them. none:
    hold the default pose. A scenario has its own."""
    library: str = ""
    """Motion library (.npz) of the clip. By default the shipped one."""
    left: str = ""
    """Law of the left arm, such as cotap:alpha=0.7,stiffness=500. By default the scenario's, or the training's. A
    policy that sets alpha and stiffness itself no longer does."""
    right: str = ""
    """Law of the right arm."""
    passive: bool = False
    """Give each arm under cotap an energy store. Changes of stiffness that would give away more than it has are held
    back. By default as in the training, or as --left and --right say."""
    seed: int = 0
    """Seed of commands, motions and perturbations."""
    json: str = ""
    """Write the result here (JSON)."""
    video: str = ""
    """Write a video of the first trial here (MP4)."""
    engine: tyro.conf.OmitArgPrefixes[EngineConfig] = field(default_factory=EngineConfig)
    perturbations: tyro.conf.OmitArgPrefixes[Perturbations] = field(default_factory=Perturbations)
    safety: tyro.conf.OmitArgPrefixes[SafetyConfig] = field(default_factory=SafetyConfig)


def main(argv: list[str] | None = None) -> int:
    """Parse, run, report. Returns the exit status: 0, or 2 for bad input."""
    options = tyro.cli(DeployOptions, args=argv, prog="cotap deploy")
    try:
        deploy(options)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def deploy(options: DeployOptions) -> dict[str, Any]:
    """Run, print the table, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.deployment.controller import command_config, law_config, robot_of
    from cotap.deployment.keyboard import HELP, KeyboardPilot, raw_terminal
    from cotap.deployment.policy import OnnxPolicy
    from cotap.deployment.trials import report, run_trials
    from cotap.evaluation.render import STRIDE, render_frames, write_film

    require_positive_int("trials", options.trials)
    require_seed("seed", options.seed)
    for part in (options.engine, options.perturbations, options.safety):
        part.check()
    require_output("--json", options.json)
    require_output("--video", options.video, (".mp4",))
    if options.keyboard and (options.scenario or options.trials > 1):
        raise ValueError("--keyboard goes with neither --scenario nor --trials")
    if options.scenario and (options.episode_seconds is not None or options.motion != HELD or options.library):
        raise ValueError("--episode-seconds, --motion and --library do nothing with --scenario: it says so itself")
    if options.library and options.motion == HELD:
        raise ValueError(f"--library {options.library!r} does nothing without --motion, which names a clip")
    policy = OnnxPolicy(options.policy)
    spec = robot_of(policy.metadata)
    scenario = load_scenario(options.scenario, spec) if options.scenario else Scenario()
    if not options.scenario:
        if options.episode_seconds is not None:
            scenario.seconds = options.episode_seconds
        scenario.arms.clip, scenario.arms.library = "" if options.motion == HELD else options.motion, options.library
        scenario.check(spec)
    laws = law_config(policy.metadata)
    for side in ("left", "right"):
        text = getattr(options, side) or getattr(scenario, side)
        if text:
            setattr(laws, side, parse_law(side, text, laws.of(side)))
            laws.modulation.hold()
    for command in scenario.command:
        for note in command.untrained(command_config(policy.metadata)):
            print(f"note: {note}", file=sys.stderr)
    if options.passive:
        make_passive(laws)
    laws.check()
    pilot = KeyboardPilot(spec.nominal_height_m, command_config(policy.metadata)) if options.keyboard else None
    if pilot:
        scenario.command = (TimedCommand(stand=True),)
        scenario.seconds = options.episode_seconds or _KEYBOARD_S
    started = time.perf_counter()
    with raw_terminal() if options.keyboard else nullcontext():
        if options.keyboard:
            print(f"{HELP}; it ends after {scenario.seconds:g} s")
        trials = run_trials(
            policy, laws, options.engine, options.perturbations, options.safety, scenario, options.trials, options.seed,
            pilot,
        )  # fmt: skip
    result = report(
        trials, options.policy, policy, laws, options.engine, options.perturbations, options.safety, scenario,
        options.seed, started,
    )  # fmt: skip
    print(summary(result))
    if options.json:
        write_json(Path(options.json), result)
    if options.video and not trials[0].qpos:
        print(f"{options.video} is not written: the first trial diverged in its first step", file=sys.stderr)
    elif options.video:
        import numpy as np
        import torch

        part = torch.from_numpy(np.stack(trials[0].qpos[::STRIDE]))
        write_film(Path(options.video), render_frames(spec, part), len(part), trials[0].dt)
    return result


def summary(result: dict[str, Any]) -> str:
    """The result as Markdown."""
    from cotap.evaluation.report import interval, unit

    lines = ["| measure | mean | 95 % interval | unit |", "|---|---|---|---|"]
    for name, m in result["metrics"].items():
        if m["mean"] is not None:
            lines.append(f"| {name} | {m['mean']:.4f} | {interval(m)} | {unit(name)} |")
    stops = "; ".join(f"stopped, {reason}: {count}" for reason, count in result["stops"].items())
    falls = f"{result['engine']}: {result['num_falls']} of {result['num_trials']} trials fell"
    return "\n".join([*lines, "", falls + (f" ({stops})" if stops else "") + f", {result['seconds']:.1f} s"])


if __name__ == "__main__":
    sys.exit(main())
