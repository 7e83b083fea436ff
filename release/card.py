"""What the shipped policies do beside what is asked of them, of the evaluations that ship with them.

python -m release.card

Writes `src/cotap/checkpoints/README.md`; a test says when that is to be done again.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cotap.evaluation.policy import checkpoint_path, shipped_names
from cotap.files import write_atomically

TRACKING = "velocity-tracking"
HEAD = """# The policies that ship

Written by `python -m release.card`, of the files beside it. 1024 robots unless a file says otherwise, arms moving on
real and generated motion; friction, masses, gains and delay are randomised. Measures are means (95 % interval), over
all robots, against what was asked. *H1*, *G1*: what is asked of the robot's policies; **bold** is missed. Policies
under CoTaP run at 300 N/m.
"""


@dataclass(frozen=True)
class Measure:
    """A row: what it is called, which evaluation has it, and how it is read."""

    label: str
    evaluation: str
    read: Callable[[dict[str, Any]], dict[str, Any]]
    bounds: tuple[float, float] = (-math.inf, math.inf)
    """Asked of H1: at least, at most."""
    g1: tuple[float, float] | None = None
    """Asked of G1, if that is something else."""
    digits: int = 3

    def asked(self, robot: str) -> tuple[float, float]:
        """At least and at most what is asked of `robot`."""
        return self.g1 if robot == "g1" and self.g1 is not None else self.bounds


def metric(name: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """A measure of an evaluation."""
    return lambda result: result["metrics"][name]


def percent(result: dict[str, Any]) -> dict[str, Any]:
    """Share of the robots that fell [%]."""
    share = result["metrics"]["fall_fraction"]
    return {"mean": 100.0 * share["mean"], "ci95": [100.0 * bound for bound in share["ci95"]]}


def slope(axis: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Measured over commanded, of all robots together."""
    name = f"slope_{axis}"
    return lambda result: {"mean": result["slopes"][name], "ci95": result["slopes_ci95"][name]}


def most(value: float) -> tuple[float, float]:
    """Bounds of what should be small."""
    return -math.inf, value


MEASURES = (
    Measure("random commands, 20 s: falls [%]", TRACKING, percent, most(0.5), most(1.0), 1),
    Measure("velocity error, mean of a stride [m/s]", TRACKING, metric("e_lin_gait"), most(0.10), most(0.12)),
    Measure("yaw rate error [rad/s]", TRACKING, metric("e_yaw"), most(0.15)),
    Measure("the same, mean of a stride [rad/s]", TRACKING, metric("e_yaw_gait"), most(0.06)),
    *(Measure(f"slope {axis}", TRACKING, slope(axis), (0.93, 1.07), (0.9, 1.1), 2)
      for axis in ("x", "y", "yaw", "height")),
    Measure("height error [m]", TRACKING, metric("e_height"), most(0.03)),
    Measure("drift where it is to stand [m/s]", TRACKING, metric("stand_drift"), most(0.05)),
    Measure("share of that time that it is still", TRACKING, metric("still_share"), (0.9, 1.0), None, 2),
    Measure("slip of feet [m/s]", TRACKING, metric("foot_slip"), most(0.08)),
    Measure("height that feet swing to [m]", TRACKING, metric("swing_height"), (0.05, math.inf)),
    Measure("arms off their reference, norm [rad]", TRACKING, metric("e_upper")),
    Measure("the same without the policy's arm actions [rad]", f"{TRACKING}.reference-arms", metric("e_upper")),
    Measure("arm motion held out: falls [%]", f"{TRACKING}.held-out", percent, most(0.5), most(1.0), 1),
    Measure("loads on both hands: falls [%]", f"{TRACKING}.hand-loads", percent, most(3.0), None, 1),
    Measure("the same: velocity error [m/s]", f"{TRACKING}.hand-loads", metric("e_lin_gait"), most(0.20)),
    Measure("the same: slope x", f"{TRACKING}.hand-loads", slope("x"), (0.8, math.inf), None, 2),
    *(
        Measure(f"{name}, {mode}: falls [%]", f"impact.{file}.{mode}", percent, most(bound), None, 1)
        for name, file, bound in (
            ("25 N s on the base", "base-25", 1.0), ("50 N s on the base", "base-50", 5.0),
            ("500 N for 50 ms on the left hand", "hand-25", 2.0),
        )
        for mode in ("stance", "walking")
    ),
)  # fmt: skip


def card(names: list[str], folder: Path) -> str:
    """The page, of the policies `names` in `folder`."""
    about = {name: json.loads((folder / f"{name}.json").read_text()) for name in names}
    lines = [HEAD, f"| | H1 | G1 | {' | '.join(f'`{name}`' for name in names)} |", "|---" * (3 + len(names)) + "|"]
    trained = [f"{about[name]['samples'] / 1e6:.0f} M" for name in names]
    lines.append(f"| samples | 300 M, CoTaP 75 M | the same | {' | '.join(trained)} |")
    for measure in MEASURES:
        cells = []
        for name in names:
            result = json.loads((folder / f"{name}.{measure.evaluation}.json").read_text())
            cells.append(cell(measure, measure.read(result), about[name]["robot"]))
        goals = [goal(measure.asked(robot)) for robot in ("h1", "g1")]
        lines.append(f"| {' | '.join([measure.label, *goals, *cells])} |")
    return "\n".join(lines) + "\n"


def cell(measure: Measure, value: dict[str, Any], robot: str) -> str:
    """A figure with its interval, in bold where it misses what is asked of the `robot`."""
    if value["mean"] is None:
        return "-"
    low, high = measure.asked(robot)
    text = f"{value['mean']:.{measure.digits}f}"
    if value["ci95"]:
        text += " ({:.{d}f} to {:.{d}f})".format(*value["ci95"], d=measure.digits)
    return text if low <= value["mean"] <= high else f"**{text}**"


def goal(bounds: tuple[float, float]) -> str:
    """In words; nothing where nothing is asked."""
    low, high = bounds
    if math.isinf(low):
        return "" if math.isinf(high) else f"at most {high:g}"
    return f"at least {low:g}" if math.isinf(high) or high == 1.0 else f"{low:g} to {high:g}"


def write() -> Path:
    """Write the page of all that ships. Returns its path."""
    folder = checkpoint_path("h1-base").parent
    path, text = folder / "README.md", card(shipped_names(), folder)
    write_atomically(path, lambda p: p.write_text(text, encoding="utf-8"))
    return path


def main() -> int:
    """Write, and say where."""
    print(f"written: {write()}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
