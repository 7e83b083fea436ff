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

from cotap.checks import require_one_of, require_range, require_seed
from cotap.configs import to_plain
from cotap.evaluation.disturbance import ConstantLoad, Impact
from cotap.evaluation.fall_curve import FallCurve
from cotap.evaluation.fidelity import Fidelity
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.modulation import Modulation
from cotap.evaluation.periodic import PeriodicLoad
from cotap.evaluation.protocols import VelocityTracking
from cotap.evaluation.punches import PunchWalk
from cotap.evaluation.recording import RecordingProtocol
from cotap.evaluation.scenario import Scenario
from cotap.evaluation.stability import Stability
from cotap.evaluation.static import StaticStiffness
from cotap.files import require_output

if TYPE_CHECKING:
    import numpy as np

    from cotap.envs import H1Env, H1EnvConfig
    from cotap.evaluation.policy import Policy

LEANING = ("as-trained", "yes", "no")


@dataclass
class CommonOptions:
    """What every evaluation takes."""

    checkpoint: str = ""
    """Checkpoint to evaluate, a file or the name of a shipped one. By default the shipped base policy for
    velocity-tracking, and for all others the shipped policy that was distilled under compliance, if there is one."""
    backend: str = "auto"
    """What simulates: mjbatch (the processor), warp (a graphics card), or auto: warp where there is one and the extra
    `warp`. Results are reproducible on one machine, on graphics cards up to rounding."""
    threads: int = 0
    """Processor threads; 0 takes every processor. Results are reproducible for one number."""
    json: str = ""
    """Write the result here."""
    plot: str = ""
    """Write a plot here (PNG)."""
    lean_into_loads: str = "as-trained"
    """Whether robots sense what pulls at them and lean against it: yes, no, or as-trained."""
    brace_tilt_rad: float | None = None
    """Tilt that loads ask for from which robots that lean against them stop and stand [rad]; 0 for never; as trained
    unless given."""
    laws: tyro.conf.OmitArgPrefixes[LawOptions] = field(default_factory=LawOptions)


@dataclass
class VelocityTrackingOptions(CommonOptions):
    """Commanded against measured velocity: errors, slopes, falls, gait quality."""

    video: str = ""
    """Write a video of one robot on a tour of commands here (MP4); a contact sheet (NAME_frames.png) goes beside it."""
    protocol: tyro.conf.OmitArgPrefixes[VelocityTracking] = field(default_factory=VelocityTracking)


@dataclass
class StaticStiffnessOptions(CommonOptions):
    """Commanded against effective stiffness of a hand under a load."""

    protocol: tyro.conf.OmitArgPrefixes[StaticStiffness] = field(default_factory=StaticStiffness)


@dataclass
class FidelityOptions(CommonOptions):
    """Commanded against felt stiffness over many arm poses, axes and stiffnesses, by default while standing."""

    laws: tyro.conf.OmitArgPrefixes[LawOptions] = field(default_factory=lambda: LawOptions(method="cotap"))
    protocol: tyro.conf.OmitArgPrefixes[Fidelity] = field(default_factory=Fidelity)


@dataclass
class ScenarioOptions(CommonOptions):
    """What protocols take that disturb a robot that stands or walks."""

    video: str = ""
    """Write a video of the first world here (MP4); a contact sheet (NAME_frames.png) goes beside it."""
    protocol: tyro.conf.OmitArgPrefixes[Scenario] = field(kw_only=True)


@dataclass
class ImpactOptions(ScenarioOptions):
    """A blow on a hand: errors of hand, arm and torso, torques, recovery, falls."""

    protocol: tyro.conf.OmitArgPrefixes[Impact] = field(default_factory=Impact)


@dataclass
class ConstantLoadOptions(ScenarioOptions):
    """A load on a hand, held: errors of hand, arm and torso, torques, effective stiffness, falls."""

    protocol: tyro.conf.OmitArgPrefixes[ConstantLoad] = field(default_factory=ConstantLoad)


@dataclass
class PeriodicLoadOptions(ScenarioOptions):
    """A load on both hands that swings slowly: torques of each arm beside what statics asks for.

    By default the left arm is compliant and the right one under PD; `--left "" --right ""` gives both `--method`.
    """

    laws: tyro.conf.OmitArgPrefixes[LawOptions] = field(
        default_factory=lambda: LawOptions(left="cotap:alpha=0.7,stiffness=500", right="pd")
    )
    protocol: tyro.conf.OmitArgPrefixes[PeriodicLoad] = field(default_factory=PeriodicLoad)


@dataclass
class PunchesOptions(ScenarioOptions):
    """A walk over waypoints while the arms take punches: who arrives."""

    protocol: tyro.conf.OmitArgPrefixes[PunchWalk] = field(default_factory=PunchWalk)


@dataclass
class FallCurveOptions(ScenarioOptions):
    """Fall rate against impulse, and the impulse at which half of the worlds fall."""

    protocol: tyro.conf.OmitArgPrefixes[FallCurve] = field(default_factory=FallCurve)


@dataclass
class ModulationOptions(ScenarioOptions):
    """Stiffness and blend stepped and ramped over their whole range: falls, torque, energy."""

    laws: tyro.conf.OmitArgPrefixes[LawOptions] = field(default_factory=lambda: LawOptions(method="cotap"))
    protocol: tyro.conf.OmitArgPrefixes[Modulation] = field(default_factory=Modulation)


@dataclass
class StabilityOptions(CommonOptions):
    """Linearised closed loop of an arm's law over random poses, and the energy that can be drawn from it."""

    protocol: tyro.conf.OmitArgPrefixes[Stability] = field(default_factory=Stability)


@dataclass
class RecordingOptions:
    """A recording of `cotap.play`: the same measures, robot by robot."""

    json: str = ""
    """Write the result here."""
    protocol: tyro.conf.OmitArgPrefixes[RecordingProtocol] = field(default_factory=RecordingProtocol)


def main(argv: list[str] | None = None) -> int:
    """Parse, evaluate, report. Returns the exit status: 0, or 2 for bad input."""
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        print(f"usage: python -m cotap.evaluate PROTOCOL [options]; protocols: {', '.join(PROTOCOLS)}")
        return 0 if args else 2
    try:
        evaluate(args)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def evaluate(args: list[str]) -> dict[str, Any]:
    """As `python -m cotap.evaluate`, for callers who want the result.

    Raises:
        ValueError: bad input; the message names it.
        OSError: an output cannot be written.
    """
    require_one_of("protocol", args[0], PROTOCOLS.keys())
    kind, run = PROTOCOLS[args[0]]
    return run(tyro.cli(kind, args=args[1:], prog=f"python -m cotap.evaluate {args[0]}"))


def _prepare(options: CommonOptions, protocol: Any) -> tuple[H1Env, Policy, str]:
    """The policy, and the environment that the protocol makes of the one it was trained in."""
    import torch

    from cotap.agents.checkpoint import require_layout, sha256
    from cotap.envs import H1Env
    from cotap.evaluation.policy import load_policy
    from cotap.sim import resolve_backend

    protocol.check()
    require_seed("seed", protocol.seed)
    require_range("threads", options.threads, 0, 4096)
    upper_body = options.laws.configure()
    require_one_of("lean_into_loads", options.lean_into_loads, LEANING)
    _require_outputs(options)
    if options.threads:
        torch.set_num_threads(options.threads)
    path = _checkpoint(options)
    policy = load_policy(path)
    torch.manual_seed(protocol.seed)
    cfg = _leaning(options, protocol.configure(policy.env_config))
    cfg.upper_body, cfg.num_threads = upper_body, options.threads
    cfg.backend = resolve_backend(options.backend)
    env = H1Env(cfg)
    require_layout(path, policy.layout, json.loads(json.dumps(env.layout())))
    return env, policy.to(env.device), sha256(path)


def _leaning(options: CommonOptions, env: H1EnvConfig) -> H1EnvConfig:
    """`env` with loads sensed and braced against or not. Changes and returns `env`."""
    commands = env.commands
    if options.lean_into_loads != "as-trained":
        commands.lean_into_loads = options.lean_into_loads == "yes"
    if options.brace_tilt_rad is not None:
        commands.brace_tilt_rad = options.brace_tilt_rad
    elif not commands.lean_into_loads:
        commands.brace_tilt_rad = 0.0  # what is not sensed is not braced against
    return env


def _checkpoint(options: CommonOptions) -> Path:
    """The file that the options mean."""
    from cotap.evaluation.policy import default_checkpoint, find_checkpoint, shipped_checkpoint

    if options.checkpoint:
        return find_checkpoint(options.checkpoint)
    return shipped_checkpoint("base") if isinstance(options, VelocityTrackingOptions) else default_checkpoint()


def _result(name: str, options: CommonOptions, protocol: Any, env: H1Env, checkpoint: str) -> dict[str, Any]:
    """The head of an evaluation's JSON."""
    settings = to_plain(protocol) | to_plain(options.laws)
    return {
        "protocol": name,
        "method": _method(env),
        "settings": {**settings, "checkpoint_sha256": checkpoint, "env": to_plain(env.cfg)},
        "num_envs": protocol.num_envs,
        "num_diverged": env.num_diverged,
    }


def _method(env: H1Env) -> str:
    """The arms' law; of two that differ, both."""
    laws = {arm.side: env.cfg.upper_body.of(arm.side).name for arm in env.spec.arms}
    return ", ".join(f"{side} {law}" for side, law in laws.items()) if len(set(laws.values())) > 1 else laws["left"]


def velocity_tracking(options: VelocityTrackingOptions) -> dict[str, Any]:
    """Evaluate, print the table, write what was asked for, and return the result."""
    import torch

    from cotap.agents.checkpoint import write_json
    from cotap.evaluation.metrics import summaries, tracking_measures, tracking_slopes
    from cotap.evaluation.report import plot_tracking, table
    from cotap.evaluation.rollout import record_rollout

    protocol = options.protocol
    env, policy, checkpoint = _prepare(options, protocol)
    if not protocol.arm_motion:
        env.motions.hold(env.motions.default)
    start = time.perf_counter()
    trajectory = record_rollout(env, policy, round(protocol.episode_seconds / env.dt))
    seconds = time.perf_counter() - start
    gait = env.cfg.commands.gait_period_s
    measures = tracking_measures(trajectory, gait, protocol.settle_seconds)
    stood = ~trajectory.fell.any(0)
    metrics = summaries(measures, torch.ones_like(stood), protocol.seed)
    slopes = tracking_slopes(trajectory, gait, protocol.settle_seconds)
    result = _result("velocity-tracking", options, protocol, env, checkpoint) | {
        "num_falls": int(trajectory.fell.any(0).sum()),
        "seconds": seconds,
        "e_lin": metrics["e_lin"]["mean"],
        "e_yaw": metrics["e_yaw"]["mean"],
        "episode_length_fraction": metrics["episode_length_fraction"]["mean"],
        "slopes": {name: None if math.isnan(value) else value for name, value in slopes.items()},
        "metrics": metrics,
        "metrics_without_falls": summaries(measures, stood, protocol.seed),
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
        filmed = _leaning(options, policy.env_config)
        filmed.upper_body = options.laws.configure()
        tour_video(video, filmed, policy.to("cpu"), _sheet(video))
    return result


def static_stiffness(options: StaticStiffnessOptions) -> dict[str, Any]:
    """Measure, print the table, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.compliance.laws import WITHOUT_STIFFNESS
    from cotap.evaluation.static import measure, plot, summary, table

    protocol = options.protocol
    env, policy, checkpoint = _prepare(options, protocol)
    law = env.cfg.upper_body.of(protocol.hand)
    commanded = None if law.name in WITHOUT_STIFFNESS else law.stiffness
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


def fidelity(options: FidelityOptions) -> dict[str, Any]:
    """Measure, print the table, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.compliance.laws import WITHOUT_STIFFNESS
    from cotap.evaluation.fidelity import measure, plot, summary, table

    protocol = options.protocol
    env, policy, checkpoint = _prepare(options, protocol)
    if env.cfg.upper_body.of(protocol.hand).name in WITHOUT_STIFFNESS:
        raise ValueError("fidelity needs a law with a stiffness at the hand, such as --method cotap")
    start = time.perf_counter()
    measured, coverage = measure(env, protocol, policy)
    result = _result("fidelity", options, protocol, env, checkpoint) | {
        "num_falls": int(measured.fell.sum()),
        "seconds": time.perf_counter() - start,
        **summary(measured, coverage, protocol),
        "window": {"start": 2.0 * protocol.settle_seconds - 1.0, "end": 2.0 * protocol.settle_seconds},
    }
    print(table(result))
    if options.json:
        write_json(Path(options.json), result)
    if options.plot:
        plot(Path(options.plot), result)
    return result


def pictures(args: list[str], times: tuple[float, ...], width: int = 480, height: int = 480) -> list[np.ndarray]:
    """Pictures (height, width, 3) of the first world of a protocol that disturbs it, at these times [s].

    Args:
        args: As for `evaluate`.
        times: Within the evaluation [s].
        width: [pixels].
        height: [pixels].

    Raises:
        ValueError: bad input; the message names it.
        RenderingUnavailable: there is no OpenGL to be had.
    """
    from cotap.evaluation.render import film_frames
    from cotap.evaluation.rollout import record_rollout

    kind, _ = PROTOCOLS[require_one_of("protocol", args[0], PROTOCOLS.keys())]
    options = tyro.cli(kind, args=args[1:])
    protocol = options.protocol
    env, policy, _ = _prepare(options, protocol)
    protocol.prepare(env)
    steps = round(max(times) / env.dt)
    trajectory = record_rollout(
        env, policy, steps, arm_actions=protocol.arm_actions, before_step=protocol.before_step, film=True
    )
    rows = [min(max(round(time / env.dt) - 1, 0), steps - 1) for time in times]
    return list(film_frames(env, trajectory.film[rows], width, height))


def scenario(name: str, options: ScenarioOptions) -> dict[str, Any]:
    """Run, print the table, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.evaluation.report import table
    from cotap.evaluation.rollout import idle, record_rollout

    protocol = options.protocol
    env, policy, checkpoint = _prepare(options, protocol)
    protocol.prepare(env)
    start = time.perf_counter()
    trajectory = record_rollout(
        env, idle(env) if env.cfg.fixed_base else policy, round(protocol.seconds / env.dt),
        arm_actions=protocol.arm_actions, before_step=protocol.before_step, film=bool(options.video),
    )  # fmt: skip
    measured = protocol.measure(trajectory, env)
    result = _result(name, options, protocol, env, checkpoint) | {
        "num_falls": int(trajectory.fell.any(0).sum()),
        "seconds": time.perf_counter() - start,
        **measured,
    }
    print(table(result))
    if options.json:
        write_json(Path(options.json), result)
    if options.plot:
        protocol.plot(Path(options.plot), result)
    if options.video:
        from cotap.evaluation.render import film_video

        film_video(Path(options.video), env, trajectory.film, _sheet(Path(options.video)))
    return result


def stability(options: StabilityOptions) -> dict[str, Any]:
    """Analyse and measure the left arm's law, print the tables, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.evaluation.stability import energy_summary, exchanged_energy, growth_rates, plot, table

    protocol = options.protocol
    env, _, checkpoint = _prepare(options, protocol)
    start = time.perf_counter()
    arms = env.cfg.upper_body
    rates = growth_rates(env.spec, arms.built(arms.left), protocol)
    energy = energy_summary(exchanged_energy(env, protocol))
    result = _result("stability", options, protocol, env, checkpoint) | {
        "num_poses": protocol.poses,
        "seconds": time.perf_counter() - start,
        "linearised": rates,
        "energy": energy,
    }
    print(table(result))
    if options.json:
        write_json(Path(options.json), result)
    if options.plot:
        plot(Path(options.plot), result)
    return result


def recording(options: RecordingOptions) -> dict[str, Any]:
    """Measure a recording, print the table, write what was asked for, and return the result."""
    from cotap.agents.checkpoint import write_json
    from cotap.evaluation.recording import load_recording, measure
    from cotap.evaluation.report import table

    options.protocol.check()
    require_output("--json", options.json)
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
    "stability": (StabilityOptions, stability),
    "fidelity": (FidelityOptions, fidelity),
    "impact": (ImpactOptions, partial(scenario, "impact")),
    "constant-load": (ConstantLoadOptions, partial(scenario, "constant-load")),
    "periodic-load": (PeriodicLoadOptions, partial(scenario, "periodic-load")),
    "punches": (PunchesOptions, partial(scenario, "punches")),
    "fall-curve": (FallCurveOptions, partial(scenario, "fall-curve")),
    "modulation": (ModulationOptions, partial(scenario, "modulation")),
    "recording": (RecordingOptions, recording),
}
"""Every protocol's options and what runs it."""


def _require_outputs(options: CommonOptions) -> None:
    """Fail before the work rather than after it: where results cannot be written, or would replace each other."""
    video: str = getattr(options, "video", "")
    require_output("--json", options.json)
    require_output("--plot", options.plot, (".png",))
    require_output("--video", video, (".mp4",))
    wanted = [("--json", options.json), ("--plot", options.plot), ("--video", video)]
    if video:
        wanted.append(("the contact sheet of --video", str(_sheet(Path(video)))))
    named: dict[Path, str] = {}
    for option, path in wanted:
        if path and (other := named.setdefault(Path(path).resolve(), option)) != option:
            raise ValueError(f"{option} and {other} are one file, {path!r}")


def _sheet(video: Path) -> Path:
    """Where a video's contact sheet goes."""
    return video.with_name(f"{video.stem}_frames.png")


if __name__ == "__main__":
    sys.exit(main())
