"""`cotap evaluate PROTOCOL`: batched evaluation from the command line."""

from __future__ import annotations

import cotap.uncompiled  # noqa: F401 - before what would load the compiler

# isort: split

import inspect
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import tyro

from cotap.checks import require_one_of, require_range, shortened
from cotap.configs import to_plain
from cotap.evaluation.disturbance import ConstantLoad, Impact
from cotap.evaluation.fall_curve import FallCurve
from cotap.evaluation.fidelity import Fidelity
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.modulation import Modulation
from cotap.evaluation.passivity import Passivity
from cotap.evaluation.periodic import PeriodicLoad
from cotap.evaluation.protocol import Protocol, RolloutProtocol
from cotap.evaluation.recording import RecordingProtocol
from cotap.evaluation.report import require_outputs, sheet_path
from cotap.evaluation.stability import Stability
from cotap.evaluation.static import StaticStiffness
from cotap.evaluation.task import Task
from cotap.evaluation.tour.protocol import Tour
from cotap.evaluation.velocity_tracking import VelocityTracking
from cotap.files import require_output

if TYPE_CHECKING:
    import numpy as np

    from cotap.envs import HumanoidEnv
    from cotap.envs.upper_body import UpperBodyConfig
    from cotap.evaluation.policy import Policy

P = TypeVar("P", bound=Protocol)
PROTOCOLS: dict[str, type[Protocol]] = {
    "velocity-tracking": VelocityTracking,
    "static-stiffness": StaticStiffness,
    "stability": Stability,
    "passivity": Passivity,
    "fidelity": Fidelity,
    "impact": Impact,
    "constant-load": ConstantLoad,
    "periodic-load": PeriodicLoad,
    "tour": Tour,
    "fall-curve": FallCurve,
    "modulation": Modulation,
    "task": Task,
}
RECORDING = "recording"
"""The protocol that simulates nothing: it measures a recording of `cotap play`."""


@dataclass
class Options(Generic[P]):
    """What every evaluation takes."""

    protocol: tyro.conf.OmitArgPrefixes[P]
    laws: tyro.conf.OmitArgPrefixes[LawOptions]
    checkpoint: str = ""
    """Policy to evaluate: a file, or a shipped policy's name. By default what ships of --robot."""
    robot: str = ""
    """Robot whose shipped policy to take. Under compliance, if there is one; by default h1."""
    backend: str = "auto"
    """What simulates: mujoco, mjbatch (both on the CPU), warp (a GPU) or auto. auto takes warp if there is a GPU and
    the extra `warp` is installed, else mjbatch if that is installed, else mujoco. Results are reproducible on one
    machine, on GPUs up to rounding."""
    threads: int = 0
    """CPU threads, 0 for every core. Results are reproducible for one number of threads."""
    json: str = ""
    """Write the result here (JSON)."""
    plot: str = ""
    """Write a plot here (PNG)."""
    video: str = ""
    """Write a video of the first env here (MP4). A contact sheet (NAME_frames.png) goes beside it."""


@dataclass
class RecordingOptions:
    """A recording of `cotap play`, measured robot by robot; nothing is simulated."""

    protocol: tyro.conf.OmitArgPrefixes[RecordingProtocol]
    json: str = ""
    """Write the result here (JSON)."""


def main(argv: list[str] | None = None) -> int:
    """Parse, evaluate, report. Returns the exit status: 0, 2 for bad input, or 130 for one that was interrupted."""
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        print(usage())
        return 0 if args else 2
    try:
        evaluate(args)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: no result", file=sys.stderr)
        return 130
    return 0


def usage() -> str:
    """How the command is called, and what every protocol is for."""
    lines = []
    for name, kind in {**PROTOCOLS, RECORDING: RecordingProtocol}.items():
        purpose, *_ = (inspect.getdoc(kind) or "").split("\n\n")
        lines.append(f"  {name:18s}{' '.join(purpose.split())}")
    call = "cotap evaluate PROTOCOL"
    return "\n".join([f"usage: {call} [options]", "", "protocols:", *lines, "", f"Options: {call} --help"])


def evaluate(args: list[str]) -> dict[str, Any]:
    """As `cotap evaluate`, for callers who want the result.

    Raises:
        ValueError: bad input; the message names it.
        OSError: an output cannot be written.
    """
    if args[0] == RECORDING:
        return recording(tyro.cli(RecordingOptions, args=args[1:], default=RecordingOptions(RecordingProtocol())))
    return run(args[0], parse(args))


def parse(args: list[str]) -> Options[Protocol]:
    """The options that a command line means. Raises ValueError for an unknown protocol."""
    kind = PROTOCOLS[require_one_of("protocol", args[0], (*PROTOCOLS, RECORDING))]
    default, prog = Options(kind(), LawOptions()), f"cotap evaluate {args[0]}"
    options: Any = Options
    return tyro.cli(options[kind], args=args[1:], default=default, prog=prog, description=kind.__doc__)


def prepare(options: Options[Protocol]) -> tuple[HumanoidEnv, Policy, str]:
    """The environment that the protocol makes of the policy's own, ready to run, the policy, and its file's digest."""
    import torch

    from cotap.agents.checkpoint import sha256
    from cotap.envs import HumanoidEnv
    from cotap.evaluation.policy import find_policy, load_policy, require_acting
    from cotap.sim import resolve_backend

    protocol = options.protocol
    protocol.check()
    options.laws.require_free(protocol.drives)
    require_range("threads", options.threads, 0, 4096)
    require_outputs(options.json, options.plot, options.video)
    if options.threads:
        torch.set_num_threads(options.threads)
    path = find_policy(options.checkpoint, options.robot)
    policy = load_policy(path)
    torch.manual_seed(protocol.seed)
    cfg = policy.env_config
    cfg.upper_body, cfg.num_threads = arms_of(options, policy), options.threads
    cfg.backend = resolve_backend(options.backend)
    cfg = protocol.configure(cfg)
    if protocol.drives or cfg.fixed_base:  # another sets the laws, or there is no policy that could
        cfg.upper_body.modulation.hold()
    env = HumanoidEnv(cfg)
    require_acting(path, policy, env.layout())
    protocol.prepare(env)
    return env, policy.to(env.device), sha256(path)


def arms_of(options: Options[Protocol], policy: Policy) -> UpperBodyConfig:
    """The laws of the arms: those of the options, else those that the policy was trained with or the protocol's own.

    Raises:
        ValueError: an option of the laws is out of its range, or neither arm's law reads it.
    """
    trained = policy.env_config.upper_body
    under_pd = policy.stage == "base" and trained.left.name == trained.right.name == "pd"
    if options.laws.method is None and (under_pd or options.protocol.laws_for_all):
        trained = options.protocol.laws.configure(trained)
    return options.laws.configure(trained)


def run(name: str, options: Options[Protocol]) -> dict[str, Any]:
    """Evaluate, print the table, write what was asked for, and return the result."""
    protocol = options.protocol
    env, policy, digest = prepare(options)
    start = time.perf_counter()
    measured = _measured(options, env, policy)
    settings = to_plain(protocol) | to_plain(options.laws)
    result = {
        "protocol": name,
        "method": _method(env),
        "arms": protocol.arms,
        "settings": {**settings, "checkpoint_sha256": digest, "env": to_plain(env.cfg)},
        "num_envs": protocol.num_envs,
        "num_diverged": env.num_diverged,
        "seconds": time.perf_counter() - start,
        **measured,
    }
    _report(protocol.table(result), result, options.json)
    if options.plot:
        protocol.plot(Path(options.plot), result)
    if options.video:
        protocol.video(Path(options.video), sheet_path(options.video), env)
    return result


def _measured(options: Options[Protocol], env: HumanoidEnv, policy: Policy) -> dict[str, Any]:
    """What the protocol finds, in the engine that it names if it names one."""
    if isinstance(options.protocol, Tour) and options.protocol.engine != "mujoco":
        from cotap.deployment.tour import evaluate_in_engine
        from cotap.evaluation.policy import find_policy

        return evaluate_in_engine(options.protocol, find_policy(options.checkpoint, options.robot), env.cfg)
    return options.protocol.evaluate(env, policy)


def recording(options: RecordingOptions) -> dict[str, Any]:
    """Measure a recording, print the table, write what was asked for, and return the result."""
    from cotap.evaluation.recording import load_recording, measure
    from cotap.evaluation.report import table

    options.protocol.check()
    require_output("--json", options.json)
    start = time.perf_counter()
    loaded = load_recording(options.protocol.file)
    result = {
        "protocol": RECORDING,
        "method": "as recorded",
        "arms": "as recorded",
        "settings": to_plain(options.protocol) | {"recorded": loaded.settings},
        **measure(loaded, options.protocol),
        "seconds": time.perf_counter() - start,
    }
    _report(table(result), result, options.json)
    return result


def pictures(
    args: list[str], times: tuple[float, ...], width: int = 480, height: int = 480
) -> tuple[list[np.ndarray], float]:
    """Pictures (height, width, 3) of the first env of a protocol that can be filmed, at these times [s], and when it
    fell [s], infinite if it did not. A robot that has fallen begins anew, so that it is shown as it was just before.

    Args:
        args: As for `evaluate`.
        times: Within the evaluation [s].
        width: [pixels].
        height: [pixels].

    Raises:
        ValueError: bad input; the message names it.
    """
    from cotap.evaluation.render import film_frames

    options = parse(args)
    if not isinstance(options.protocol, RolloutProtocol):
        raise ValueError(f"{args[0]} cannot be filmed")
    env, policy, _ = prepare(options)
    trajectory = options.protocol.record(env, policy, max(times))
    film, fell = trajectory.film, trajectory.fell[:, 0].nonzero().flatten().tolist()
    last = fell[0] - 1 if fell else len(film) - 1
    rows = [max(min(round(time / env.dt) - 1, last), 0) for time in times]
    return list(film_frames(env, film[rows], width, height)), env.dt * (fell[0] + 1) if fell else math.inf


def _report(table: str, result: dict[str, Any], path: str) -> None:
    from cotap.agents.checkpoint import write_json

    print(table)
    if path:
        write_json(Path(path), result)


def _method(env: HumanoidEnv) -> str:
    """The arms' law; of two that differ, both."""
    laws = {arm.side: env.cfg.upper_body.of(arm.side).name for arm in env.spec.arms}
    same = len(set(laws.values())) == 1
    return next(iter(laws.values())) if same else ", ".join(f"{side} {law}" for side, law in laws.items())


if __name__ == "__main__":
    sys.exit(main())
