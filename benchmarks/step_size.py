"""What the physics step costs in accuracy and buys in speed: joint PD of H1 under random targets, against 0.5 ms.

Prints a Markdown table. `explicit` computes the torque before every physics step; `implicit` lets MuJoCo's actuators
add the damping inside its implicit integrator, as the environment does.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time

import numpy as np
from mjbatch import Batch

from cotap.robots import h1
from cotap.robots.mjcf import build_model

CONTROL_DT = 0.02
VARIANTS = ((0.005, False), (0.005, True), (0.01, False), (0.01, True))
"""Physics step [s], and whether damping is implicit."""
KP, KD, DEFAULT = (np.array([getattr(j, name) for j in h1().joints]) for name in ("kp", "kd", "default_rad"))


def simulate(timestep_s: float, implicit: bool, targets: np.ndarray) -> tuple[np.ndarray, float]:
    """Joint angles (T, N, J) after every control step under `targets` (T, N, J), and seconds spent stepping."""
    steps, envs, _ = targets.shape
    model = build_model(h1(), "feet", timestep_s)
    if not implicit:
        model.actuator_biasprm[:] = 0.0
    batch = Batch(model, envs)
    qpos, qvel, ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
    qpos[:, 2], qpos[:, 7:] = h1().base_height_m, DEFAULT
    out = np.empty_like(targets)
    spent = 0.0
    for t in range(steps):
        for _ in range(round(CONTROL_DT / timestep_s)):
            damping = 0.0 if implicit else KP * qpos[:, 7:] + KD * qvel[:, 6:]
            ctrl[:] = KP * targets[t] - damping
            start = time.perf_counter()
            batch.step()
            spent += time.perf_counter() - start
        out[t] = qpos[:, 7:]
    return out, spent


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--envs", type=int, default=256)
    parser.add_argument("--seconds", type=float, default=0.5)
    parser.add_argument(
        "--spread", type=float, default=0.15, help="standard deviation of targets about the default [rad]"
    )
    parser.add_argument("--repeats", type=int, default=7, help="rounds of timing")
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    steps = round(options.seconds / CONTROL_DT)
    # Targets hold for five control steps, so that joints have time to go somewhere.
    draws = rng.normal(size=(-(-steps // 5), options.envs, len(DEFAULT))) * options.spread
    targets = DEFAULT + np.repeat(draws, 5, axis=0)[:steps]
    reference, _ = simulate(0.0005, True, targets)
    rms: dict[tuple[float, bool], np.ndarray] = {}
    spent: dict[tuple[float, bool], list[float]] = {variant: [] for variant in VARIANTS}
    for _ in range(options.repeats):  # in turn, so that all meet the same machine
        for variant in VARIANTS:
            angles, seconds = simulate(*variant, targets)
            rms[variant] = np.sqrt(np.mean((angles - reference) ** 2, axis=(0, 1)))
            spent[variant].append(seconds)
    print("| step | torque | rms error, mean over joints [rad] | worst joint [rad] | control steps/s, relative |")
    print("|---|---|---|---|---|")
    for timestep_s, implicit in VARIANTS:
        variant = (timestep_s, implicit)
        speed = statistics.median(a / b for a, b in zip(spent[VARIANTS[0]], spent[variant], strict=True))
        kind = "implicit" if implicit else "explicit"
        error = rms[variant]
        print(f"| {1e3 * timestep_s:g} ms | {kind} | {error.mean():.4f} | {error.max():.4f} | {speed:.2f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
