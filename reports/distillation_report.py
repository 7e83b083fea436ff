"""What distillation did: does the CoTaP policy walk as well as the base at every stiffness, does one policy obey the
stiffness that it is asked for, and does it keep its feet while that changes. Writes docs/distillation.md."""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reports.kept_evaluations import kept_or_run

STIFFNESS = (100, 300, 500, 800)
ALPHA = (0.0, 0.3, 0.7, 1.0)
WALKING = {
    "e_lin_gait": "velocity error [m/s]",
    "e_yaw": "yaw-rate error [rad/s]",
    "e_yaw_gait": "the same, gait-averaged [rad/s]",
    "e_height": "height error [m]",
    "foot_slip": "foot slip [m/s]",
}


@dataclass
class Runs:
    """Evaluations, kept by name."""

    folder: Path
    checkpoint: str
    base: str
    threads: int
    reuse: bool

    def __call__(self, name: str, *args: str, checkpoint: str = "") -> dict[str, Any]:
        """The result of an evaluation of the distilled policy, or of another."""
        path = self.folder / f"{name}.json"
        return kept_or_run(path, list(args), checkpoint or self.checkpoint, self.threads, self.reuse)


def number(m: dict[str, Any], digits: int = 3) -> str:
    """Mean and 95 % interval."""
    if m["mean"] is None or m["ci95"] is None:
        return str(m.get("reason", "-"))
    return f"{m['mean']:.{digits}f} ({m['ci95'][0]:.{digits}f} to {m['ci95'][1]:.{digits}f})"


def no_worse(mine: dict[str, Any], base: dict[str, Any]) -> bool:
    """Within 10 % of the base's mean, or not beyond its 95 % interval."""
    return mine["mean"] <= max(1.1 * base["mean"], base["ci95"][1])


def walking(runs: Runs, envs: int, seconds: float) -> list[str]:
    """The walk under every stiffness and blend, beside the base's in the same simulation and in an easier one."""
    task = ["velocity-tracking", "--num-envs", str(envs), "--episode-seconds", str(seconds)]
    base = runs("walking-base", *task, "--collision", "full", checkpoint=runs.base)
    easier = runs("walking-base-feet", *task, "--collision", "feet", checkpoint=runs.base)
    lines = [
        "## Walking", "",
        f"Random commands, clips on the arms, randomisation on, {envs} envs, {seconds:g} s, legs, arms and torso "
        "that collide, but for the base's second row, in which feet pass through each other. In bold: "
        "worse than the base in the same simulation by more than 10 % and beyond its 95 % interval.", "",
        "| K_ee [N/m] | alpha | " + " | ".join(WALKING.values()) + " | fell |",
        "|---" * (3 + len(WALKING)) + "|",
    ]  # fmt: skip
    for name, result in (("base, PD", base), ("base, PD, feet and floor alone collide", easier)):
        cells = [number(result["metrics"][key]) for key in WALKING]
        lines.append(f"| {name} | | " + " | ".join(cells) + f" | {result['num_falls']} of {envs} |")
    kept = kept_easier = total = 0
    for stiffness in STIFFNESS:
        for alpha in ALPHA:
            law = ["--method", "cotap", "--stiffness", str(stiffness), "--alpha", str(alpha)]
            result = runs(f"walking-{stiffness}-{alpha}", *task, "--collision", "full", *law)
            cells = []
            for key in (*WALKING, "fall_fraction"):
                mine = result["metrics"][key]
                good = no_worse(mine, base["metrics"][key])
                kept, total = kept + good, total + 1
                kept_easier += no_worse(mine, easier["metrics"][key])
                text = f"{mine['mean']:.3f}" if key in WALKING else f"{result['num_falls']} of {envs}"
                cells.append(text if good else f"**{text}**")
            lines.append(f"| {stiffness} | {alpha:g} | " + " | ".join(cells) + " |")
    return [
        *lines, "",
        f"{kept} of {total} figures are no worse than the base's in the same simulation, {kept_easier} no worse "
        "than where its feet pass through each other.", "",
    ]  # fmt: skip


def obedience(runs: Runs, envs: int) -> list[str]:
    """One policy, no retraining: torque under an impact and displacement under a load, against stiffness."""
    lines = [
        "## One policy, every stiffness", "",
        f"Left hand, stance, arms' default pose, {envs} envs, alpha 1. Impact: 500 N x 0.05 s along x. "
        "Load: -15 N in z, displacement of the hand relative to its reference.", "",
        "| K_ee [N/m] | J_upper under the impact [Nm] | fell | displacement under the load [m] | F / K [m] | fell |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    torques, drops = [], []
    for stiffness in STIFFNESS:
        law = ["--method", "cotap", "--stiffness", str(stiffness), "--num-envs", str(envs)]
        push = runs(f"impact-{stiffness}", "impact", "--motion", "none", *law)
        load = runs(f"load-{stiffness}", "constant-load", "--force", "0", "0", "-15", *law)
        torque, drop = push["metrics"]["j_upper"], load["metrics"]["displacement_z"]
        torques.append(torque)
        drops.append(drop)
        lines.append(
            f"| {stiffness} | {number(torque, 1)} | {push['num_falls']} of {envs} | {number(drop, 4)} "
            f"| {-15.0 / stiffness:.4f} | {load['num_falls']} of {envs} |"
        )
    rising = all(a["ci95"][1] < b["ci95"][0] for a, b in itertools.pairwise(torques))
    falling = all(a["ci95"][1] < b["ci95"][0] for a, b in itertools.pairwise(drops))
    return [
        *lines, "",
        f"Torque rises with K_ee beyond the intervals: **{'yes' if rising else 'no'}**. "
        f"Displacement falls with it beyond the intervals: **{'yes' if falling else 'no'}**.", "",
    ]  # fmt: skip


def against_pd(runs: Runs, envs: int) -> list[str]:
    """The same policy under an impact, arms under PD and under CoTaP."""
    from cotap.compare import measure_difference

    lines = [
        "## Against PD", "",
        f"Impact of 500 N x 0.05 s on the left hand, the same policy and {envs} envs, arms' default pose.", "",
        "| mode | arms | e_torso [m/s] | e_ee [m] | J_upper [Nm] | fell |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    rows = {"PD": ["--method", "pd"]} | {
        f"K {k}, alpha {a:g}": ["--method", "cotap", "--stiffness", str(k), "--alpha", str(a)]
        for k, a in ((100, 1.0), (300, 1.0), (500, 1.0), (800, 1.0), (100, 0.3), (100, 0.7), (200, 0.5), (300, 0.5),
                     (500, 0.7))
    }  # fmt: skip
    rows["soft PD"] = ["--method", "soft-pd"]
    rows["K 300, alpha 0.5, PD's damping"] = [*rows["K 300, alpha 0.5"], "--damping", "pd"]
    wins = []
    for mode, where in {"stance": [], "walking": ["--mode", "walking", "--random-direction"]}.items():
        pd = None
        for name, law in rows.items():
            size = ["--num-envs", str(envs), "--per-env"]
            result = runs(f"pd-{mode}-{name.replace(' ', '')}", "impact", "--motion", "none", *size, *where, *law)
            pd, m = pd or result, result["metrics_without_falls"]
            names = ("e_torso", "e_ee", "j_upper")
            figures = [m[key] for key in names]
            gains = [measure_difference(pd, result, key, without_falls=True)["ci95"] for key in names]
            if all(gain and gain[1] < 0.0 for gain in gains):
                wins.append(f"{mode}, {name}")
            cells = [number(f, d) for f, d in zip(figures, (3, 3, 1), strict=True)]
            lines.append(f"| {mode} | {name} | " + " | ".join(cells) + f" | {result['num_falls']} of {envs} |")
    return [
        *lines,
        "",
        "Better than PD in all three, the 95 % intervals of the differences, env by env, below zero: "
        f"{'; '.join(wins) or 'none'}.",
        "",
    ]


def changing(runs: Runs, envs: int) -> list[str]:
    """Stiffness and blend changed over their whole range."""
    lines = [
        "## Stiffness that changes", "",
        f"Stiffness and alpha stepped and ramped over their whole range, {envs} envs.", "",
        "| case | fell | peak arm torque [Nm] | energy [J] |", "|---|---|---|---|",
    ]  # fmt: skip
    loads = {"": [], ", 15 N down on the left hand": ["--force", "0", "0", "-15"]}
    cases = {
        f"{mode}{label}": ["--mode", mode, *load] for label, load in loads.items() for mode in ("walking", "stance")
    }
    for case, options in cases.items():
        result = runs(
            f"changing-{case.replace(' ', '-').replace(',', '')}", "modulation", "--num-envs", str(envs), *options
        )
        m = result["metrics"]
        lines.append(
            f"| {case} | {result['num_falls']} of {envs} | {number(m['peak_torque'], 1)} | {number(m['energy'], 0)} |"
        )
    return [*lines, ""]


def main() -> int:
    """Measure and write. Exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--checkpoint", default="h1-cotap", help="the distilled policy")
    parser.add_argument("--base", default="h1-base", help="the base that it is compared with")
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--obedience-envs", type=int, default=4096)
    parser.add_argument("--walking-envs", type=int, default=1024)
    parser.add_argument("--walking-seconds", type=float, default=20.0)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--reuse", action="store_true", help="keep evaluations that are there")
    parser.add_argument("--evaluations", type=Path, default=Path("runs/distillation"))
    parser.add_argument("--output", type=Path, default=Path("docs/distillation.md"))
    options = parser.parse_args()
    options.evaluations.mkdir(parents=True, exist_ok=True)
    runs = Runs(options.evaluations, options.checkpoint, options.base, options.threads, options.reuse)
    from cotap.files import write_atomically

    lines = [
        "# What distillation did",
        "",
        f"Written by `python -m reports.distillation_report`; policy `{options.checkpoint}`, base `{options.base}`.",
        "",
    ]
    lines += walking(runs, options.walking_envs, options.walking_seconds)
    lines += obedience(runs, options.obedience_envs)
    lines += against_pd(runs, options.num_envs)
    lines += changing(runs, options.num_envs)
    write_atomically(options.output, lambda p: p.write_text("\n".join(lines)))
    print(options.output.read_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
