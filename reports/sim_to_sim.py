"""One ONNX policy in several physics engines: Markdown, JSON and a picture."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from cotap.agents.checkpoint import write_json
from cotap.deployment.controller import robot_of
from cotap.deployment.engines import make_engine
from cotap.deployment.policy import OnnxPolicy
from cotap.files import write_atomically
from reports.paper.engines import Comparison, compare, figure, markdown


@dataclass
class Options:
    """Velocity tracking, impact, constant and periodic load, perturbations, in every engine."""

    policy: str
    """What `cotap export` wrote."""
    output: str = "runs/sim_to_sim"
    """Folder for report.md, report.json and report.png; parts/ keeps what is done, and is gone on with."""
    jobs: int = 0
    """Processes that share the trials; 0 takes one per CPU."""
    comparison: tyro.conf.OmitArgPrefixes[Comparison] = field(default_factory=Comparison)


def main(argv: list[str] | None = None) -> int:
    """Parse, run, write. Returns the exit status: 0, or 2 for bad input."""
    options = tyro.cli(Options, args=argv, prog="python -m reports.sim_to_sim")
    cfg = options.comparison
    try:
        policy = OnnxPolicy(options.policy)
        cfg.check()
        for name in cfg.engines:  # before hours are spent on the others
            make_engine(cfg.engine(name), robot_of(policy.metadata)).close()
        started = time.perf_counter()
        output = Path(options.output)
        (output / "parts").mkdir(parents=True, exist_ok=True)
        jobs = options.jobs or len(os.sched_getaffinity(0))
        result = compare(Path(options.policy), cfg, jobs, output / "parts")
        result["seconds"] = time.perf_counter() - started
        write_json(output / "report.json", result)
        write_atomically(output / "report.md", lambda p: p.write_text(markdown(result), encoding="utf-8"))
        figure(result, output / "report.png")
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(markdown(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
