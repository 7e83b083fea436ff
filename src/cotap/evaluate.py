"""`python -m cotap.evaluate PROTOCOL`: batched evaluation from the command line."""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from cotap.checks import require_one_of
from cotap.configs import from_plain, to_plain
from cotap.evaluation.protocols import PROTOCOLS, VelocityTracking


@dataclass
class VelocityTrackingOptions:
    """Commanded against measured velocity: errors, slopes, falls, gait quality."""

    checkpoint: str = ""
    """Checkpoint to evaluate; by default the shipped base policy."""
    method: str = "pd"
    """Upper-body law."""
    threads: int = 0
    """Processor threads; 0 takes every processor. Results are reproducible for one number."""
    json: str = ""
    """Write the result here."""
    plot: str = ""
    """Write a plot of commanded against measured velocity here (PNG)."""
    video: str = ""
    """Write a video of one robot on a tour of commands here (MP4); a contact sheet (PNG) goes beside it."""
    protocol: tyro.conf.OmitArgPrefixes[VelocityTracking] = field(default_factory=VelocityTracking)


def main(argv: list[str] | None = None) -> int:
    """Parse, evaluate, report. Returns the exit status: 0, or 2 for bad input."""
    args = list(sys.argv[1:] if argv is None else argv)
    try:
        if not args or args[0] in ("-h", "--help"):
            print(f"usage: python -m cotap.evaluate PROTOCOL [options]; protocols: {', '.join(PROTOCOLS)}")
            return 0 if args else 2
        require_one_of("protocol", args[0], PROTOCOLS.keys())
        options = tyro.cli(VelocityTrackingOptions, args=args[1:], prog=f"python -m cotap.evaluate {args[0]}")
        velocity_tracking(options)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def velocity_tracking(options: VelocityTrackingOptions) -> dict[str, Any]:
    """Evaluate, print the table, write what was asked for, and return the result."""
    import torch

    from cotap.agents.checkpoint import require_layout, sha256, write_json
    from cotap.envs import H1Env, H1EnvConfig
    from cotap.evaluation.metrics import summarize, tracking_measures, tracking_slopes
    from cotap.evaluation.policy import load_policy, shipped_checkpoint
    from cotap.evaluation.report import plot_tracking, table
    from cotap.evaluation.rollout import record_rollout

    protocol = options.protocol
    require_one_of("method", options.method, ("pd",))
    protocol.check()
    for name in ("json", "plot", "video"):
        _require_folder(name, getattr(options, name))
    if options.threads:
        torch.set_num_threads(options.threads)
    path = options.checkpoint or shipped_checkpoint("base")
    policy = load_policy(path)
    torch.manual_seed(protocol.seed)
    cfg = protocol.configure(from_plain(H1EnvConfig, policy.config["training"]["env"]))
    cfg.num_threads = options.threads
    env = H1Env(cfg)
    require_layout(path, policy.layout, json.loads(json.dumps(env.layout())))
    if not protocol.arm_motion:
        env.motions.hold(env.motions.default)
    start = time.perf_counter()
    trajectory = record_rollout(env, policy, round(protocol.episode_seconds / env.dt))
    seconds = time.perf_counter() - start
    gait = cfg.commands.gait_period_s
    measures = tracking_measures(trajectory, gait, protocol.settle_seconds)
    stood = ~trajectory.fell.any(0)
    metrics = {name: summarize(value, protocol.seed) for name, value in measures.items()}
    slopes = tracking_slopes(trajectory, gait, protocol.settle_seconds)
    result = {
        "protocol": "velocity-tracking",
        "method": options.method,
        "settings": {**to_plain(protocol), "checkpoint_sha256": sha256(path), "env": to_plain(cfg)},
        "num_envs": protocol.num_envs,
        "num_falls": int(trajectory.fell.any(0).sum()),
        "num_diverged": env.num_diverged,
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


def _require_folder(name: str, path: str) -> None:
    """Fail before the work rather than after it."""
    if path and not Path(path).resolve().parent.is_dir():
        raise ValueError(f"--{name} {path!r}: its folder does not exist")


if __name__ == "__main__":
    sys.exit(main())
