"""The task of learned modulation: a policy that sets alpha and stiffness beside the best constant setting.

python -m reports.modulation_grid --checkpoint runs/modulated/checkpoint_002441.pt

Writes modulation_grid.md and modulation_grid.json. The best constant setting is that of the grid with the largest
return; it is then run again beside the policy, with another seed, so that luck in the grid does not count.
"""

from __future__ import annotations

import contextlib
import io
import sys
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import tyro

from cotap.agents.checkpoint import write_json
from cotap.checks import require_positive_int, require_range, require_seed, shortened
from cotap.compare import difference
from cotap.configs import to_plain
from cotap.evaluate import evaluate
from cotap.files import write_atomically

SHOWN = ("return", "free_hand_error", "loaded_hand_error", "push_resistance", "alpha", "stiffness", "fall_fraction")
"""Columns of the table."""


@dataclass
class Options:
    """What is compared."""

    checkpoint: str
    """The policy that sets the laws."""
    constant_checkpoint: str = ""
    """The policy that runs with constant settings; empty for the same one."""
    alphas: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)
    """Of the grid."""
    stiffnesses: tuple[float, ...] = (80.0, 160.0, 300.0, 600.0, 1200.0)
    """Of the grid, alike along all axes [N/m]; at alpha 0 it does nothing, and the first one is run alone."""
    num_envs: int = 512
    """Envs of each evaluation."""
    episode_seconds: float = 20.0
    """Length of each evaluation [s]."""
    seed: int = 0
    """Of the grid; the comparison has the next one."""
    threads: int = 0
    """CPU threads; 0 takes every CPU."""
    output: str = "runs/modulation_grid"
    """Folder of what is written."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name, low, high in (("alphas", 0.0, 1.0), ("stiffnesses", 1.0, 1e5)):
            require_positive_int(f"number of {name}", len(getattr(self, name)))
            for i, value in enumerate(getattr(self, name)):
                require_range(f"{name}[{i}]", value, low, high)
        require_positive_int("num_envs", self.num_envs)
        require_seed("seed", self.seed)
        require_range("episode_seconds", self.episode_seconds, 0.1, 3600.0)

    def settings(self) -> list[tuple[float, float]]:
        """Alpha and stiffness of every constant setting."""
        pairs = product(self.alphas, self.stiffnesses)
        return [(alpha, k) for alpha, k in pairs if alpha > 0.0 or k == self.stiffnesses[0]]


def measure(options: Options) -> dict[str, Any]:
    """The grid, and the policy beside its best setting."""
    grid = []
    for alpha, stiffness in options.settings():
        grid.append({"alpha": alpha, "stiffness": stiffness, **_task(options, options.seed, (alpha, stiffness))})
        print(f"  alpha {alpha:g}, {stiffness:g} N/m", file=sys.stderr)
    best = max(grid, key=lambda row: row["metrics"]["return"]["mean"])
    setting = best["alpha"], best["stiffness"]
    constant, learned = (_task(options, options.seed + 1, given) for given in (setting, None))
    gained = {
        name: difference(constant["metrics"][name], learned["metrics"][name])
        for name in learned["metrics"] if name.startswith("return")
    }  # fmt: skip
    return {"grid": grid, "best": {"alpha": setting[0], "stiffness": setting[1], **constant}, "learned": learned,
            "learned_less_best": gained}  # fmt: skip


def _task(options: Options, seed: int, constant: tuple[float, float] | None) -> dict[str, Any]:
    """Measures of the task at a constant alpha and stiffness, or as the policy sets them."""
    path = options.checkpoint if constant is None else options.constant_checkpoint or options.checkpoint
    args = ["task", "--checkpoint", path, "--num-envs", str(options.num_envs), "--seed", str(seed)]
    args += ["--episode-seconds", str(options.episode_seconds), "--threads", str(options.threads)]
    if constant is not None:
        args += ["--alpha", str(constant[0]), "--stiffness", str(constant[1])]
    with contextlib.redirect_stdout(io.StringIO()):  # its own table
        result = evaluate(args)
    digest = result["settings"]["checkpoint_sha256"]
    return {"metrics": result["metrics"], "num_falls": result["num_falls"], "checkpoint_sha256": digest}


def table(result: dict[str, Any]) -> str:
    """As Markdown."""
    lines = [f"| setting | {' | '.join(SHOWN)} |", "|---" * (1 + len(SHOWN)) + "|"]
    for row in result["grid"]:
        lines.append(_row(f"alpha {row['alpha']:g}, {row['stiffness']:g} N/m", row))
    best = result["best"]
    lines.append(_row(f"best again, alpha {best['alpha']:g}, {best['stiffness']:g} N/m", best))
    lines.append(_row("set by the policy", result["learned"]))
    lines += ["", "| part | policy less best constant |", "|---|---|"]
    for name, d in result["learned_less_best"].items():
        if d["difference"] is None:
            lines.append(f"| {name} | - |")
            continue
        low, high = d["ci95"]
        lines.append(f"| {name} | {d['difference']:+.3f} ({low:+.3f} to {high:+.3f}) |")
    about = "Mean (95 % interval) over envs; returns per second, errors in m, resistance in N, stiffness in N/m."
    return "\n".join([*lines, "", about])


def _row(label: str, row: dict[str, Any]) -> str:
    return f"| {label} | {' | '.join(_cell(row['metrics'][name]) for name in SHOWN)} |"


def _cell(m: dict[str, Any]) -> str:
    if m["mean"] is None:
        return "-"
    low, high = m["ci95"]
    return f"{m['mean']:.3f} ({low:.3f} to {high:.3f})"


def main(argv: list[str] | None = None) -> int:
    """Parse, measure, report. Returns the exit status: 0, or 2 for bad input."""
    options = tyro.cli(Options, args=argv, description=__doc__, prog="python -m reports.modulation_grid")
    try:
        options.check()
        output = Path(options.output)
        output.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        result = measure(options)
        result |= {"settings": to_plain(options), "seconds": time.perf_counter() - start}
        write_json(output / "modulation_grid.json", result)
        text = table(result) + "\n"
        write_atomically(output / "modulation_grid.md", lambda p: p.write_text(text, encoding="utf-8"))
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
