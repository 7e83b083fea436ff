"""Energy that is drawn by leading a hand around closed paths at constant commanded stiffness, law by law.

python -m reports.closed_paths --output docs/laws

Writes closed_paths.md and closed_paths.json there. Needs no policy and no physics: the pelvis is fixed, gravity is
compensated, and the hand is led so slowly that only the spring of the law counts.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from cotap.agents.checkpoint import write_json
from cotap.checks import require_one_of, require_positive_int, require_range, require_seed
from cotap.compliance.laws import LawConfig
from cotap.configs import to_plain
from cotap.evaluation.metrics import summarize
from cotap.evaluation.stability import random_poses
from cotap.files import write_atomically
from cotap.robots import ROBOTS
from cotap.robots.chains import arm_model
from reports.cells import cell
from reports.led_hands import circles, lead, spring_of


def _cotap(stiffness: float, **fields: Any) -> LawConfig:
    return LawConfig("cotap", (stiffness, stiffness, stiffness), **fields)


ROWS: dict[str, LawConfig] = {
    "PD": LawConfig("pd"),
    **{f"CoTaP, joint error, {k} N/m": _cotap(k) for k in (100, 300, 1000)},
    "CoTaP, joint error, 300 N/m, alpha 0.7": _cotap(300, alpha=0.7),
    **{f"CoTaP, task error, {k} N/m": _cotap(k, error="task") for k in (100, 300, 1000)},
    "CoTaP, task error, 300 N/m, alpha 0.7": _cotap(300, error="task", alpha=0.7),
    "CoTaP, task error, 300 N/m, never back to PD": _cotap(300, error="task", condition_threshold=1e9),
    "HMC, 300 N/m, alpha 0.5": LawConfig("hmc", alpha=0.5),
}


@dataclass
class Options:
    """How hands are led."""

    robot: str = "h1"
    """Whose arms."""
    poses: int = 64
    """Poses that are sent, of both arms."""
    radius: float = 0.05
    """Of the circles [m]."""
    offset: float = 0.05
    """Distance of their centres from where the hand is sent [m]."""
    points: int = 48
    """Points of a circle."""
    seed: int = 0
    """Of poses and circles."""
    output: str = "runs/laws"
    """Folder of what is written."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_one_of("robot", self.robot, ROBOTS.keys())
        require_positive_int("poses", self.poses)
        require_range("radius", self.radius, 1e-4, 0.5)
        require_range("offset", self.offset, 0.0, 0.5)
        require_range("points", self.points, 8, 10_000)
        require_seed("seed", self.seed)


def measure(options: Options) -> dict[str, Any]:
    """Every row: energy drawn per turn, in the direction in which it is drawn [J], and what it is a share of."""
    spec, rng = ROBOTS[options.robot](), torch.Generator().manual_seed(options.seed)
    arms = arm_model(spec).to(torch.float64)
    default = torch.tensor([spec.joint(name).default_rad for name in spec.upper_joints], dtype=torch.float64)
    default = default.reshape(1, len(spec.arms), -1)
    target = torch.lerp(default, random_poses(spec, options.poses, rng).double(), 0.5)
    path = circles(arms.chains.pose(target).tip, options.radius, options.offset, options.points, rng)
    rows = {}
    for name, law in ROWS.items():
        loop = lead(spring_of(law, arms, target), arms, target, path)
        if not loop.found.any():
            raise ValueError(f"{name}: no arm comes to rest all along its path; take smaller circles, or more poses")
        drawn, stored = (torch.where(loop.found, x, torch.nan) for x in (loop.work().abs(), loop.stored()))
        rows[name] = {
            "drawn": summarize(drawn.flatten(), options.seed),
            "largest": float(drawn[loop.found].max()),
            "stored": summarize(stored.flatten(), options.seed),
            "asymmetry": summarize(loop.asymmetry.mean(0)[loop.found], options.seed),
        }
        print(f"  {name}", file=sys.stderr)
    return {"settings": to_plain(options), "rows": rows}


def table(result: dict[str, Any]) -> str:
    """As Markdown."""
    lines = [
        "| law, at constant parameters | paths | drawn per turn [J] | largest [J] "
        "| stored and given back on the way [J] | antisymmetric part of the hand's stiffness |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in result["rows"].items():
        lines.append(
            f"| {name} | {row['drawn']['n']} | {cell(row['drawn'])} | {row['largest']:.2f} "
            f"| {row['stored']['mean']:.2f} | {row['asymmetry']['mean']:.1%} |"
        )
    o = result["settings"]
    about = (
        f"Circles of {100 * o['radius']:g} cm in random planes, their centres {100 * o['offset']:g} cm from where the "
        f"hand is sent; of {2 * o['poses']} paths, those along which the arm comes to rest everywhere, and in the end "
        "where it began. Mean (95 % interval) over paths."
    )
    return "\n".join([*lines, "", about])


def main(argv: list[str] | None = None) -> int:
    """Parse, measure, report. Returns the exit status: 0, or 2 for bad input."""
    options = tyro.cli(Options, args=argv, description=__doc__)
    try:
        options.check()
        output = Path(options.output)
        output.mkdir(parents=True, exist_ok=True)
        result = measure(options)
        write_json(output / "closed_paths.json", result)
        text = table(result) + "\n"
        write_atomically(output / "closed_paths.md", lambda p: p.write_text(text, encoding="utf-8"))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
