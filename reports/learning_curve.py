"""What samples and hours buy: checkpoints of trainings evaluated one by one, as a table, JSON and a plot.

python -m reports.learning_curve runs/quick-0 runs/quick-1 --every-samples 5e6

Policies act deterministically and without the assisting wrench. The first checkpoint that reaches the goal is named.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from cotap.agents.checkpoint import load_checkpoint, require_parts, write_json
from cotap.agents.runner import CHECKPOINT_PATTERN, checkpoints_of
from cotap.checks import require_one_of, require_positive_int, require_range, require_seed, shortened
from cotap.evaluate import evaluate
from cotap.evaluation.report import pyplot, save_figure
from cotap.files import write_atomically

Row = dict[str, Any]


@dataclass
class Options:
    """Which checkpoints are evaluated, and how."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Run directories."""
    every_samples: float = 5e6
    """Samples between the checkpoints that are evaluated. The first and the last one always are."""
    protocols: tuple[str, ...] = ("velocity-tracking",)
    """velocity-tracking, which tells slopes and falls; push, which tells falls of standing robots whose base is pushed
    by 25 N s in random directions; and tour, which tells survival."""
    num_envs: int = 256
    """Envs of each evaluation."""
    seed: int = 0
    """Of the evaluations."""
    threads: int = 0
    """CPU threads; 0 takes every CPU."""
    slope: float = 0.85
    """The goal: at least this slope of measured against commanded velocity along x ..."""
    falls: float = 0.02
    """... and at most this share of envs that fall within 20 s."""
    reuse: bool = False
    """Keep what the JSON in the output folder has already."""
    output: str = "runs/learning_curve"
    """Folder for learning_curve.json, learning_curve.md and learning_curve.png."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_positive_int("number of runs", len(self.runs))
        require_range("every_samples", self.every_samples, 1.0, 1e12)
        require_positive_int("number of protocols", len(self.protocols))
        for protocol in self.protocols:
            require_one_of("protocols", protocol, MEASURES)
        require_positive_int("num_envs", self.num_envs)
        require_seed("seed", self.seed)
        require_range("threads", self.threads, 0, 4096)
        require_range("slope", self.slope, 0.0, 2.0)
        require_range("falls", self.falls, 0.0, 1.0)


def _tracking(result: dict[str, Any]) -> dict[str, float | None]:
    return result["slopes"] | {"falls": result["num_falls"] / result["num_envs"]}


def _push(result: dict[str, Any]) -> dict[str, float | None]:
    return {"falls_pushed": result["num_falls"] / result["num_envs"]}


def _tour(result: dict[str, Any]) -> dict[str, float | None]:
    return {name: result["metrics"][name]["mean"] for name in ("survival_s", "completed_fraction")}


MEASURES: dict[str, Callable[[dict[str, Any]], dict[str, float | None]]] = {
    "velocity-tracking": _tracking,
    "push": _push,
    "tour": _tour,
}
"""What is taken from an evaluation by each protocol."""
COMMANDS: dict[str, list[str]] = {"push": ["impact", "--place=base", "--force", "500", "0", "0", "--random-direction"]}
"""How `cotap evaluate` is asked for those that are no protocol by that name."""
COLUMNS = {
    "slope_x": "slope x",
    "slope_y": "slope y",
    "slope_yaw": "slope yaw",
    "slope_height": "slope height",
    "falls": "share that fell",
    "falls_pushed": "share that fell when pushed",
    "survival_s": "survival in the tour [s]",
    "completed_fraction": "share that completed the tour",
}
PLOTTED = ("slope_x", "falls", "falls_pushed", "survival_s")


def checkpoints(run: str) -> list[Row]:
    """A run's checkpoints, oldest first: file, samples and seconds of training.

    Raises:
        ValueError: there is none, or one cannot be read.
    """
    rows = []
    for path in checkpoints_of(Path(run)):
        content = load_checkpoint(path)
        require_parts(path, content, ("samples", "wall_seconds"))
        rows.append({"run": run, "checkpoint": path.name} | {k: content[k] for k in ("samples", "wall_seconds")})
    if not rows:
        raise ValueError(f"run directory {run!r} has no {CHECKPOINT_PATTERN}")
    return rows


def every(rows: list[Row], samples: float) -> list[Row]:
    """The first row, the first one at or beyond each multiple of `samples`, and the last one."""
    chosen, due = [], 0.0
    for row in rows:
        if row["samples"] >= due or row is rows[-1]:
            chosen.append(row)
            due = (row["samples"] // samples + 1) * samples
    return chosen


def measure(row: Row, options: Options, kept: list[Row]) -> Row:
    """A checkpoint's row with its measures; those that a kept row has of the same evaluations are taken from there."""
    row |= {"num_envs": options.num_envs, "seed": options.seed, "measures": {}}
    same = (old for old in kept if all(old.get(name) == row[name] for name in row.keys() - {"measures"}))
    known = next(same, row)["measures"]
    row["measures"] = {name: known[name] for name in options.protocols if name in known}
    for protocol in options.protocols:
        if protocol not in row["measures"]:
            path = Path(row["run"]) / row["checkpoint"]
            print(f"  {path}, {protocol}", file=sys.stderr)
            arguments = {"checkpoint": path, "num-envs": options.num_envs, "seed": options.seed}
            arguments["threads"] = options.threads
            with contextlib.redirect_stdout(io.StringIO()):
                result = evaluate(
                    [*COMMANDS.get(protocol, [protocol]), *(f"--{name}={value}" for name, value in arguments.items())]
                )
            row["measures"][protocol] = MEASURES[protocol](result)
    return row


def value(row: Row, name: str) -> float | None:
    """A measure of a row, whichever protocol tells it; None where it was not measured."""
    return next((m[name] for m in row["measures"].values() if name in m), None)


def first_at_goal(rows: list[Row], slope: float, falls: float) -> Row | None:
    """The first row whose slope along x is at least `slope` while at most `falls` of the envs fell."""
    for row in rows:
        x, fell = value(row, "slope_x"), value(row, "falls")
        if x is not None and fell is not None and x >= slope and fell <= falls:
            return row
    return None


def by_run(rows: list[Row]) -> dict[str, list[Row]]:
    """Rows of each run, in order."""
    return {run: [row for row in rows if row["run"] == run] for run in dict.fromkeys(row["run"] for row in rows)}


def table(rows: list[Row], options: Options) -> str:
    """As Markdown."""
    shown = {name: title for name, title in COLUMNS.items() if any(value(row, name) is not None for row in rows)}
    lines = [f"| run | samples [M] | hours | {' | '.join(shown.values())} |", "|---" * (3 + len(shown)) + "|"]
    for row in rows:
        cells = ("-" if (x := value(row, name)) is None else f"{x:.3f}" for name in shown)
        lines.append(f"| {row['run']} | {_cost(row)} | {' | '.join(cells)} |")
    if "velocity-tracking" in options.protocols:
        goal = f"Slope x at least {options.slope:g} and at most {options.falls:.1%} falls in 20 s"
        lines += ["", f"{goal}, the first checkpoint:", "", "| run | samples [M] | hours |", "|---|---|---|"]
        for run, own in by_run(rows).items():
            first = first_at_goal(own, options.slope, options.falls)
            lines.append(f"| {run} | {_cost(first) if first else 'not reached | -'} |")
    about = f"{options.num_envs} envs each, deterministic actions, no assisting wrench; hours are those of training."
    return "\n".join([*lines, "", about])


def _cost(row: Row) -> str:
    return f"{row['samples'] / 1e6:.1f} | {row['wall_seconds'] / 3600:.2f}"


def plot(path: Path, rows: list[Row], options: Options) -> None:
    """Each measure over samples and over hours, a line a run, with the goal dashed."""
    measures = [name for name in PLOTTED if any(value(row, name) is not None for row in rows)]
    figure, axes = pyplot().subplots(
        len(measures), 2, figsize=(10.0, 2.8 * len(measures)), squeeze=False, sharey="row", constrained_layout=True
    )
    for name, pair in zip(measures, axes, strict=True):
        for axis, key, unit, title in zip(
            pair, ("samples", "wall_seconds"), (1e6, 3600.0), ("samples [M]", "hours"), strict=True
        ):
            for run, own in by_run(rows).items():
                points = [(row[key] / unit, y) for row in own if (y := value(row, name)) is not None]
                axis.plot([x for x, _ in points], [y for _, y in points], "o-", ms=3, label=run)
            if name in ("slope_x", "falls"):
                axis.axhline(options.slope if name == "slope_x" else options.falls, color="0.4", ls="--", lw=1)
            axis.set(xlabel=title, ylabel=COLUMNS[name])
            axis.grid(alpha=0.2)
    axes[0, 0].legend(frameon=False, fontsize=8)
    save_figure(figure, path)


def kept_rows(path: Path) -> list[Row]:
    """Rows of an earlier report; none where there is no such file. Raises ValueError for one that is none."""
    if not path.is_file():
        return []
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
        if all(isinstance(row["measures"], dict) for row in rows):
            return rows
    except (ValueError, TypeError, LookupError):
        pass
    raise ValueError(f"{str(path)!r} is no report of learning curves; remove it, or leave out --reuse")


def main(argv: list[str] | None = None) -> int:
    """Parse, evaluate, report. Returns the exit status: 0, or 2 for bad input."""
    options = tyro.cli(Options, args=argv, description=__doc__, prog="python -m reports.learning_curve")
    try:
        options.check()
        output = Path(options.output)
        output.mkdir(parents=True, exist_ok=True)
        file = output / "learning_curve.json"
        kept = kept_rows(file) if options.reuse else []
        asked = [row for run in options.runs for row in every(checkpoints(run), options.every_samples)]
        rows: list[Row] = []
        for row in asked:
            rows.append(measure(row, options, kept))
            write_json(file, {"rows": rows + kept})  # hours of evaluations must outlive an interruption
        write_json(file, {"rows": rows})
        text = table(rows, options) + "\n"
        write_atomically(output / "learning_curve.md", lambda p: p.write_text(text, encoding="utf-8"))
        plot(output / "learning_curve.png", rows, options)
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: what was evaluated is kept, and --reuse goes on with it", file=sys.stderr)
        return 130
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
