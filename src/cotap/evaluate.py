"""`python -m cotap.evaluate PROTOCOL`: batched evaluation from the command line."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from cotap.checks import require_one_of
from cotap.configs import from_plain, to_plain
from cotap.evaluation.disturbance import ConstantLoad, Impact
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.protocols import VelocityTracking
from cotap.evaluation.recording import RecordingProtocol
from cotap.evaluation.static import StaticStiffness

if TYPE_CHECKING:
    from cotap.envs import H1Env, H1EnvConfig
    from cotap.evaluation.policy import Policy


@dataclass
class CommonOptions:
    """What every evaluation takes."""

    checkpoint: str = ""
    """Checkpoint to evaluate; by default the shipped base policy."""
    threads: int = 0
    """Processor threads; 0 takes every processor. Results are reproducible for one number."""
    json: str = ""
    """Write the result here."""
    plot: str = ""
    """Write a plot here (PNG)."""
    laws: tyro.conf.OmitArgPrefixes[LawOptions] = field(default_factory=LawOptions)


@dataclass
class VelocityTrackingOptions(CommonOptions):
    """Commanded against measured velocity: errors, slopes, falls, gait quality."""

    video: str = ""
    """Write a video of one robot on a tour of commands here (MP4); a contact sheet (PNG) goes beside it."""
    protocol: tyro.conf.OmitArgPrefixes[VelocityTracking] = field(default_factory=VelocityTracking)


@dataclass
class StaticStiffnessOptions(CommonOptions):
    """Commanded against effective stiffness of a hand under a load."""

    protocol: tyro.conf.OmitArgPrefixes[StaticStiffness] = field(default_factory=StaticStiffness)


@dataclass
class ImpactOptions(CommonOptions):
    """A blow on a hand: errors of hand, arm and torso, torques, falls."""

    protocol: tyro.conf.OmitArgPrefixes[Impact] = field(default_factory=Impact)


@dataclass
class ConstantLoadOptions(CommonOptions):
    """A load on a hand, held: errors of hand, arm and torso, torques, falls."""

    protocol: tyro.conf.OmitArgPrefixes[ConstantLoad] = field(default_factory=ConstantLoad)


@dataclass
class RecordingOptions:
    """A recording of `cotap.play`: the same measures, robot by robot."""

    json: str = ""
    """Write the result here."""
    protocol: tyro.conf.OmitArgPrefixes[RecordingProtocol] = field(default_factory=RecordingProtocol)


def main(argv: list[str] | None = None) -> int:
    """Parse, evaluate, report. Returns the exit status: 0, or 2 for bad input."""
    args = list(sys.argv[1:] if argv is None else argv)
    try:
        if not args or args[0] in ("-h", "--help"):
            print(f"usage: python -m cotap.evaluate PROTOCOL [options]; protocols: {', '.join(PROTOCOLS)}")
            return 0 if args else 2
        require_one_of("protocol", args[0], PROTOCOLS.keys())
        kind, run = PROTOCOLS[args[0]]
        run(tyro.cli(kind, args=args[1:], prog=f"python -m cotap.evaluate {args[0]}"))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _prepare(options: CommonOptions, protocol: Any, outputs: tuple[str, ...]) -> tuple[H1Env, Policy, str]:
    """The policy, and the environment that the protocol makes of the one it was trained in."""
    import torch

    from cotap.agents.checkpoint import require_layout, sha256
    from cotap.envs import H1Env, H1EnvConfig
    from cotap.evaluation.policy import load_policy, shipped_checkpoint

    protocol.check()
    upper_body = options.laws.configure()
    for name in outputs:
        _require_folder(name, getattr(options, name))
    if options.threads:
        torch.set_num_threads(options.threads)
    path = options.checkpoint or shipped_checkpoint("base")
    policy = load_policy(path)
    torch.manual_seed(protocol.seed)
    cfg: H1EnvConfig = protocol.configure(from_plain(H1EnvConfig, policy.config["training"]["env"]))
    cfg.upper_body, cfg.num_threads = upper_body, options.threads
    env = H1Env(cfg)
    require_layout(path, policy.layout, json.loads(json.dumps(env.layout())))
    return env, policy, sha256(path)


def _result(name: str, options: CommonOptions, protocol: Any, env: H1Env, checkpoint: str) -> dict[str, Any]:
    """The head of an evaluation's JSON."""
    settings = to_plain(protocol) | to_plain(options.laws)
    return {
        "protocol": name,
        "method": options.laws.method,
        "settings": {**settings, "checkpoint_sha256": checkpoint, "env": to_plain(env.cfg)},
        "num_envs": protocol.num_envs,
        "num_diverged": env.num_diverged,
    }


def velocity_tracking(options: VelocityTrackingOptions) -> dict[str, Any]:
    """Evaluate, print the table, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.envs import H1EnvConfig
    from cotap.evaluation.metrics import summarize, tracking_measures, tracking_slopes
    from cotap.evaluation.report import plot_tracking, table
    from cotap.evaluation.rollout import record_rollout

    protocol = options.protocol
    env, policy, checkpoint = _prepare(options, protocol, ("json", "plot", "video"))
    if not protocol.arm_motion:
        env.motions.hold(env.motions.default)
    start = time.perf_counter()
    trajectory = record_rollout(env, policy, round(protocol.episode_seconds / env.dt))
    seconds = time.perf_counter() - start
    gait = env.cfg.commands.gait_period_s
    measures = tracking_measures(trajectory, gait, protocol.settle_seconds)
    stood = ~trajectory.fell.any(0)
    metrics = {name: summarize(value, protocol.seed) for name, value in measures.items()}
    slopes = tracking_slopes(trajectory, gait, protocol.settle_seconds)
    result = _result("velocity-tracking", options, protocol, env, checkpoint) | {
        "num_falls": int(trajectory.fell.any(0).sum()),
        "seconds": seconds,
        "e_lin": metrics["e_lin"]["mean"],
        "e_yaw": metrics["e_yaw"]["mean"],
        "episode_length_fraction": metrics["episode_length_fraction"]["mean"],
        "slopes": {name: None if math.isnan(value) else value for name, value in slopes.items()},
        "metrics": metrics,
        "metrics_without_falls": {name: summarize(value[stood], protocol.seed) for name, value in measures.items()},
        "window": {"start": 0.0, "end": protocol.episode_seconds},
    }
    print(table(result))
    if options.json:
        write_json(Path(options.json), result)
    if options.plot:
        plot_tracking(Path(options.plot), trajectory, gait, protocol.settle_seconds)
    if options.video:
        from cotap.evaluation.render import tour_video

        video = Path(options.video)
        tour_video(video, from_plain(H1EnvConfig, policy.config["training"]["env"]), policy, video.with_suffix(".png"))
    return result


def static_stiffness(options: StaticStiffnessOptions) -> dict[str, Any]:
    """Measure, print the table, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.evaluation.static import measure, plot, summary, table

    protocol = options.protocol
    env, policy, checkpoint = _prepare(options, protocol, ("json", "plot"))
    law = env.cfg.upper_body.of(protocol.hand)
    commanded = law.stiffness if law.name == "cotap" else None
    start = time.perf_counter()
    measured = measure(env, protocol, policy)
    result = _result("static-stiffness", options, protocol, env, checkpoint) | {
        "num_falls": measured.num_falls,
        "seconds": time.perf_counter() - start,
        **summary(measured, commanded),
        "window": {"start": 2.0 * protocol.settle_seconds - 1.0, "end": 2.0 * protocol.settle_seconds},
    }
    print(table(result))
    if options.json:
        write_json(Path(options.json), result)
    if options.plot:
        plot(Path(options.plot), measured, commanded, protocol.force)
    return result


def disturbance(name: str, options: ImpactOptions | ConstantLoadOptions) -> dict[str, Any]:
    """Measure, print the table, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.evaluation.disturbance import curve, disturbance_measures, plot
    from cotap.evaluation.metrics import summarize
    from cotap.evaluation.report import table
    from cotap.evaluation.rollout import record_rollout

    protocol = options.protocol
    env, policy, checkpoint = _prepare(options, protocol, ("json", "plot"))
    protocol.command(env)
    start = time.perf_counter()
    steps = round(protocol.seconds / env.dt)
    trajectory = record_rollout(env, policy, steps, arm_actions=protocol.arm_actions)
    seconds = time.perf_counter() - start
    sides = tuple(arm.side for arm in env.spec.arms)
    measures = disturbance_measures(trajectory, protocol, sides)
    stood = ~trajectory.fell.any(0)
    curves = curve(trajectory, protocol, sides)
    result = _result(name, options, protocol, env, checkpoint) | {
        "num_falls": int((~stood).sum()),
        "seconds": seconds,
        "metrics": {key: summarize(value, protocol.seed) for key, value in measures.items()},
        "metrics_without_falls": {key: summarize(value[stood], protocol.seed) for key, value in measures.items()},
        "window": {"start": protocol.onset + protocol.window[0], "end": protocol.onset + protocol.window[1]},
        "curve": curves,
    }
    print(table(result))
    if options.json:
        write_json(Path(options.json), result)
    if options.plot:
        plot(Path(options.plot), curves, f"{name}, {protocol.mode}, {options.laws.method}")
    return result


def recording(options: RecordingOptions) -> dict[str, Any]:
    """Measure a recording, print the table, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.evaluation.recording import load_recording, measure
    from cotap.evaluation.report import table

    options.protocol.check()
    _require_folder("json", options.json)
    start = time.perf_counter()
    loaded = load_recording(options.protocol.file)
    result = {"protocol": "recording", "method": "as recorded", "settings": to_plain(options.protocol)}
    result["settings"]["recorded"] = loaded.settings
    result |= measure(loaded, options.protocol)
    result["seconds"] = time.perf_counter() - start
    print(table(result))
    if options.json:
        write_json(Path(options.json), result)
    return result


PROTOCOLS: dict[str, tuple[type[Any], Callable[[Any], dict[str, Any]]]] = {
    "velocity-tracking": (VelocityTrackingOptions, velocity_tracking),
    "static-stiffness": (StaticStiffnessOptions, static_stiffness),
    "impact": (ImpactOptions, partial(disturbance, "impact")),
    "constant-load": (ConstantLoadOptions, partial(disturbance, "constant-load")),
    "recording": (RecordingOptions, recording),
}
"""Every protocol's options and what runs it."""


def _require_folder(name: str, path: str) -> None:
    """Fail before the work rather than after it."""
    if path and not Path(path).resolve().parent.is_dir():
        raise ValueError(f"--{name} {path!r}: its folder does not exist")


if __name__ == "__main__":
    sys.exit(main())
