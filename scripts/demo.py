"""A look at everything in a few minutes: resume training, evaluate, plot, and film. Writes runs/demo/."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

OUT = Path("runs/demo")


def main() -> int:
    """Resume the shipped base for a few iterations, then evaluate the shipped policy."""
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "osmesa" if not Path("/dev/dri").exists() else "egl")
    from cotap.evaluate import main as evaluate
    from cotap.evaluation.policy import shipped_checkpoint
    from cotap.train import main as train

    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    base = str(shipped_checkpoint("base"))
    print("1. Training goes on from the shipped base policy for a few iterations")
    status = train(
        ["base", "--resume", base, "--run-dir", str(OUT / "training"), "--num-envs", "1024", "--iterations", "8"]
    )
    if status:
        return status
    print("2. The shipped policy follows random commands in 256 randomised worlds")
    evaluation = ["velocity-tracking", "--num-envs", "256", "--json", str(OUT / "velocity_tracking.json")]
    status = evaluate([*evaluation, "--plot", str(OUT / "velocity_tracking.png")])
    if status:
        return status
    print("3. One robot on a tour of commands, filmed")
    film = ["velocity-tracking", "--num-envs", "1", "--video", str(OUT / "tour.mp4")]
    if evaluate(film):
        print("no video on this machine; everything else is there")
    print(f"look at {OUT}: " + ", ".join(sorted(p.name for p in OUT.iterdir())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
