"""A look at everything in a few minutes: distil the shipped base, push a hand, plot, and film. Writes runs/demo/."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

OUT = Path("runs/demo")
ITERATIONS = 6
IMPACT = ["impact", "--num-envs", "256", "--force", "500", "0", "0"]
METHODS = {"pd": ["--method", "pd"], "cotap": ["--method", "cotap", "--stiffness", "200", "--alpha", "0.5"]}
MEASURES = {
    "e_torso": "torso velocity error [m/s]",
    "e_ee_hit": "error of the hand that is pushed [m]",
    "j_upper": "arm torque, 2-norm [Nm]",
    "fall_fraction": "envs that fell",
}


def main(argv: list[str] | None = None) -> int:
    """Distil for a few iterations from the shipped base, then evaluate the shipped policy. Exit status."""
    argparse.ArgumentParser(description=__doc__).parse_args(argv)
    from cotap.evaluate import main as evaluate
    from cotap.evaluation.policy import shipped_checkpoint
    from cotap.train import main as train

    try:
        base, policy = shipped_checkpoint("h1-base"), shipped_checkpoint("h1-cotap")
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    print("1. The shipped base is distilled under compliance for a few iterations")
    training = OUT / "training"
    distil = ["distill", "--base-checkpoint", str(base), "--run-dir", str(training), "--runner.no-save-envs"]
    if status := train([*distil, "--iterations", str(ITERATIONS), "--num-envs", "1024"]):
        return status
    if not (training / f"checkpoint_{ITERATIONS:06d}.pt").is_file():
        return 130  # it was asked to stop
    print("2. A push of 500 N for 50 ms on the left hand, 256 envs, under PD and under CoTaP (200 N/m, alpha 0.5)")
    for name, options in METHODS.items():
        files = ["--json", str(OUT / f"impact_{name}.json"), "--plot", str(OUT / f"impact_{name}.png")]
        if status := evaluate([*IMPACT, *options, *files, "--checkpoint", str(policy)]):
            return status
    table = comparison({name: json.loads((OUT / f"impact_{name}.json").read_text()) for name in METHODS})
    (OUT / "impact.md").write_text(table)
    print(table)
    print("3. One robot that is pushed while it walks and punches, arms under CoTaP, filmed")
    film = ["impact", *METHODS["cotap"], "--mode", "walking", "--motion", "punch", "--num-envs", "8"]
    if status := evaluate([*film, "--checkpoint", str(policy), "--video", str(OUT / "impact.mp4")]):
        return status
    print(f"look at {OUT}: " + ", ".join(sorted(p.name for p in OUT.iterdir())))
    print("and push the robot yourself: .venv/bin/cotap play, then open http://localhost:8080")
    return 0


def comparison(results: dict[str, dict[str, object]]) -> str:
    """A Markdown table of what was measured, means with their 95 % intervals."""
    lines = ["| measure | " + " | ".join(results) + " |", "|---" * (1 + len(results)) + "|"]
    for key, label in MEASURES.items():
        cells = []
        for result in results.values():
            value = result["metrics"][key]  # pyright: ignore[reportIndexIssue]
            cells.append(f"{value['mean']:.3f} ({value['ci95'][0]:.3f} to {value['ci95'][1]:.3f})")
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
