"""Train what the paper's ablation compares: CoTaP with three seeds, and each ablation, one after another.

python -m reports.train_ablations --run-dir runs/ablations --base-checkpoint h1-base

All else is an option of `cotap train distill` and holds for all of them, such as --iterations, but that each has its
recipe, and each seed its seed. The same command goes on where it stopped, and says at the end how the paper's tables
are made of them.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from cotap.agents.checkpoint import load_checkpoint
from cotap.agents.runner import newest_checkpoint
from cotap.checks import require_one_of, shortened
from cotap.pipeline import Stopped
from cotap.train import run_stage

TRAININGS: dict[str, list[str]] = {
    **{f"seed-{seed}": ["--recipe", "quick", "--seed", str(seed)] for seed in range(3)},
    **{name: ["--recipe", name] for name in ("no-ratio", "torque-critic", "goals", "facet")},
}
"""By the policy's name in `reports.reproduce_paper`."""


def train_all(names: list[str], run_dir: Path, options: list[str]) -> dict[str, Path]:
    """Train those of `names`, one after another. Returns the last checkpoint of each.

    Raises:
        Stopped: it was asked to stop before.
        ValueError: an option of `cotap train distill` is not valid, or two began from different bases.
    """
    last: dict[str, Path] = {}
    bases: set[str] = set()
    for name in names:
        last[name] = train(name, run_dir, options)
        bases.add(load_checkpoint(last[name])["config"]["base"]["sha256"])
        if len(bases) > 1:
            raise ValueError(f"{run_dir / name} began from another base than {run_dir / names[0]}")
    return last


def train(name: str, run_dir: Path, options: list[str]) -> Path:
    """Train one of them to its end, from its newest checkpoint if there is one. Returns its last.

    Raises:
        Stopped: it was asked to stop before.
        ValueError: an option of `cotap train distill` is not valid.
    """
    folder = run_dir / name
    run_stage("distill", [*options, *TRAININGS[name], "--run-dir", str(folder), "--resume", "auto"])  # the last counts
    newest = newest_checkpoint(folder)
    assert newest, f"{folder} holds no checkpoint of a training that ended"
    content = load_checkpoint(newest)
    asked = content["config"]["training"]["runner"]["iterations"]
    if content["iteration"] < asked:
        raise Stopped(f"stopped at iteration {content['iteration']} of {asked} of {folder}; the same command goes on")
    return newest


def main(argv: list[str] | None = None) -> int:
    """Parse and train. Returns the exit status: 0, 2 for bad input, 130 where it was stopped."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--run-dir", type=Path, default=Path("runs/ablations"), help="gets a folder for each of them")
    parser.add_argument("--only", nargs="+", default=list(TRAININGS), metavar="NAME", help=", ".join(TRAININGS))
    parser.add_argument("--base-checkpoint", default="", help="what all begin from; by default the shipped base")
    own, options = parser.parse_known_args(argv)
    base = own.base_checkpoint
    options += ["--base-checkpoint", base] if base else []
    try:
        for name in own.only:
            require_one_of("--only", name, TRAININGS.keys())
        last = train_all(own.only, own.run_dir, options)
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except Stopped as stop:
        print(stop, file=sys.stderr)
        return 130
    robot = load_checkpoint(next(iter(last.values())))["layout"]["robot"]
    named = ({"base": base} if base else {}) | last
    policies = [f"{name}={path}" for name, path in named.items()]
    tables = ["python", "-m", "reports.reproduce_paper", "--robot", robot, "--policies", *policies]
    print("\nNext:\n  " + shlex.join(tables))
    return 0


if __name__ == "__main__":
    sys.exit(main())
