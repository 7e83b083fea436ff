"""Trains for a given time and samples memory and throughput: what grows, and what slows down. Stops by itself."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

FOREVER = 10**9
MOST_GROWTH, MOST_SLOWDOWN = 0.01, 0.03


def resident_mib(pid: int) -> float:
    """Memory of a process that lies in RAM [MiB]."""
    if sys.platform == "linux":
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    kib = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=True).stdout
    return int(kib) / 2**10


def soak(
    folder: Path, log_file: Path, stage: str, seconds: float, options: list[str], interval: float
) -> tuple[np.ndarray, np.ndarray]:
    """Train for `seconds`. Returns samples (S, 2) of time [s] and memory [MiB], and the throughput (I,) [steps/s]."""
    command = [sys.executable, "-m", "cotap.train", stage, "--iterations", str(FOREVER), "--run-dir", str(folder)]
    with log_file.open("w") as log:
        process = subprocess.Popen([*command, *options], stdout=log, stderr=subprocess.STDOUT)
        start, samples = time.monotonic(), []
        try:
            while (now := time.monotonic() - start) < seconds and process.poll() is None:
                samples.append((now, resident_mib(process.pid)))
                time.sleep(interval)
        finally:
            process.send_signal(signal.SIGTERM)
            status = process.wait()
    if status:
        raise SystemExit(log_file.read_text())
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return np.array(samples), np.array([e.value for e in events.Scalars("throughput/steps_per_s")])


def change(values: np.ndarray) -> float:
    """Relative change between the medians of the second and the last fifth: the first fifth is starting up."""
    if len(values) < 10:
        raise SystemExit(f"only {len(values)} samples; soak for longer")
    fifths = np.array_split(values, 5)
    return float(np.median(fifths[4]) / np.median(fifths[1]) - 1.0)


def plot(path: Path, samples: np.ndarray, rate: np.ndarray) -> None:
    """Memory and throughput over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 1, figsize=(9, 5), constrained_layout=True, sharex=True)
    minutes = samples[:, 0] / 60.0
    axes[0].plot(minutes, samples[:, 1], color="#2171b5")
    axes[0].set_ylabel("resident memory [MiB]")
    axes[1].plot(np.linspace(minutes[0], minutes[-1], len(rate)), rate, color="#2171b5", linewidth=0.7)
    axes[1].set_ylabel("training [steps/s]")
    axes[1].set_xlabel("time [min]")
    for axis in axes:
        axis.set_ylim(bottom=0.0)
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def main() -> int:
    """Returns the exit status: 0 if memory and throughput stay within their bounds, else 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--stage", choices=("base", "distill"), default="base")
    parser.add_argument("--run-dir", type=Path, help="keep the run here; by default it is thrown away")
    parser.add_argument("--interval", type=float, default=5.0, help="seconds between samples of memory")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--plot", type=Path, help="write the plot here (PNG)")
    parser.add_argument("options", nargs="*", help="options of the training, after --")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="cotap-soak-") as work:
        samples, rate = soak(
            options.run_dir or Path(work) / "run", Path(work) / "log", options.stage, 60.0 * options.minutes,
            options.options, options.interval,
        )  # fmt: skip
    result: dict[str, Any] = {
        "minutes": samples[-1, 0] / 60.0,
        "iterations": len(rate),
        "memory_mib": float(np.median(samples[:, 1])),
        "memory_growth": change(samples[:, 1]),
        "steps_per_s": float(np.median(rate)),
        "throughput_change": change(rate),
    }
    print(json.dumps(result, indent=2))
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")
    if options.plot:
        plot(options.plot, samples, rate)
    return int(result["memory_growth"] > MOST_GROWTH or result["throughput_change"] < -MOST_SLOWDOWN)


if __name__ == "__main__":
    sys.exit(main())
