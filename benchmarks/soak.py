"""Trains for a given time and samples memory and throughput: what grows, and what slows down. Stops by itself.

A machine's own speed comes and goes with what else runs on it. So the training is stopped now and then while the same
work is timed each time, and what is judged is the training's throughput over that of this reference.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cotap.agents.checkpoint import write_json
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluation.report import pyplot, save_figure
from cotap.files import require_output

FOREVER = 10**9
RATE = "throughput/steps_per_s"
MOST_GROWTH, MOST_SLOWDOWN = 0.01, 0.03
REFERENCE_WORLDS, REFERENCE_STEPS = 256, 100


def resident_mib(pid: int) -> float:
    """Memory of a process that lies in RAM [MiB]."""
    if sys.platform == "linux":
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    kib = subprocess.run(["ps", "-o", "rss=", "-p", str(pid)], capture_output=True, text=True, check=True).stdout
    return int(kib) / 2**10


class Reference:
    """The same work every time: control steps of a small environment from one state, in this process."""

    def __init__(self, threads: int) -> None:
        if threads:
            torch.set_num_threads(threads)
        self._env = HumanoidEnv(HumanoidEnvConfig(num_envs=REFERENCE_WORLDS, num_threads=threads))
        self._env.reset()
        self._begin = self._env.state_dict()
        self._rest = torch.zeros(REFERENCE_WORLDS, len(self._env.spec.joints))

    @torch.inference_mode()
    def rate(self) -> float:
        """Environment steps per second [1/s]."""
        self._env.load_state_dict(self._begin)
        begin = time.perf_counter()
        for _ in range(REFERENCE_STEPS):
            self._env.step(self._rest)
        return REFERENCE_WORLDS * REFERENCE_STEPS / (time.perf_counter() - begin)


@dataclass
class Soaked:
    """What a soak saw; times from its beginning [s]."""

    memory: np.ndarray
    """(S, 2) time, resident memory [MiB]."""
    pauses: np.ndarray
    """(P, 3) begin, end, rate of the reference in between [steps/s]; P may be 0."""
    rates: np.ndarray
    """(I, 2) end of each iteration, steps/s of what it collected and learned."""

    def speeds(self) -> np.ndarray:
        """(J, 2) time, iterations per second of wall time, whatever they were spent on.

        With references: from each pause to the next, over the reference's rate in the first of them, and without the
        iterations that a pause was in. So no two of them share a reading.
        """
        begins, ends = self.rates[:-1, 0], self.rates[1:, 0]
        if not len(self.pauses):
            return np.stack([ends, 1.0 / (ends - begins)], 1)
        out = []
        for (_, free, reference), stop in zip(self.pauses, [*self.pauses[1:, 0], np.inf], strict=True):
            inside = (begins >= free) & (ends <= stop)
            if inside.any():
                speed = inside.sum() / (ends - begins)[inside].sum()
                out.append((float(ends[inside].mean()), float(speed / reference)))
        return np.array(out).reshape(-1, 2)


def soak(
    folder: Path, log_file: Path, stage: str, seconds: float, options: list[str], interval: float, threads: int,
    reference_every: float,
) -> Soaked:  # fmt: skip
    """Train for `seconds`; every `reference_every` seconds (0: never) the training waits for the reference."""
    command = [sys.executable, "-m", "cotap.train", stage, "--iterations", str(FOREVER), "--run-dir", str(folder)]
    command += ["--threads", str(threads)]
    reference = Reference(threads) if reference_every else None
    with log_file.open("w") as log:
        process = subprocess.Popen([*command, *options], stdout=log, stderr=subprocess.STDOUT)
        start, at, memory, pauses = time.monotonic(), time.time(), [], []
        due = reference_every
        try:
            while (now := time.monotonic() - start) < seconds and process.poll() is None:
                memory.append((now, resident_mib(process.pid)))
                if reference and now >= due:
                    process.send_signal(signal.SIGSTOP)
                    rate = reference.rate()
                    process.send_signal(signal.SIGCONT)
                    pauses.append((now, time.monotonic() - start, rate))
                    due = pauses[-1][1] + reference_every
                time.sleep(interval)
            early = process.poll() is not None
        finally:
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGTERM)
            status = process.wait()
    if status or early:
        raise SystemExit(f"the training ended by itself, with status {status}:\n{log_file.read_text()}")
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    known = RATE in events.Tags()["scalars"]
    rates = [(e.wall_time - at, e.value) for e in (events.Scalars(RATE) if known else []) if e.wall_time >= at]
    return Soaked(np.array(memory), np.array(pauses).reshape(-1, 3), np.array(rates).reshape(-1, 2))


def change(values: np.ndarray) -> float:
    """Relative change between the medians of the second and the last fifth: the first fifth is starting up."""
    if len(values) < 10:
        raise SystemExit(f"only {len(values)} samples; soak for longer")
    fifths = np.array_split(values, 5)
    return float(np.median(fifths[4]) / np.median(fifths[1]) - 1.0)


def trend(values: np.ndarray, seed: int = 0) -> tuple[float, list[float]]:
    """`change`, and its 95 % interval by a bootstrap within the fifths."""
    fifths, rng = np.array_split(values, 5), np.random.default_rng(seed)
    medians = [np.median(rng.choice(fifths[i], (2000, len(fifths[i]))), axis=1) for i in (1, 4)]
    return change(values), np.percentile(medians[1] / medians[0] - 1.0, [2.5, 97.5]).tolist()


def plot(path: Path, soaked: Soaked) -> None:
    """Memory and throughput over time, and throughput over that of the reference."""
    plt = pyplot()

    rows = 3 if len(soaked.pauses) else 2
    figure, axes = plt.subplots(rows, 1, figsize=(9, 2.4 * rows), constrained_layout=True, sharex=True)
    axes[0].plot(soaked.memory[:, 0] / 60.0, soaked.memory[:, 1], color="#2171b5")
    axes[0].set_ylabel("resident memory [MiB]")
    axes[1].plot(soaked.rates[:, 0] / 60.0, soaked.rates[:, 1], color="#2171b5", linewidth=0.7, label="training")
    axes[1].set_ylabel("[steps/s]")
    if len(soaked.pauses):
        axes[1].plot(soaked.pauses[:, 0] / 60.0, soaked.pauses[:, 2], ".", color="#e6550d", label="fixed reference")
        axes[1].legend(loc="lower right")
        times, speeds = soaked.speeds().T
        axes[2].plot(times / 60.0, speeds / np.median(speeds), ".", color="#2171b5")
        axes[2].set_ylabel("training / reference")
    axes[-1].set_xlabel("time [min]")
    for axis in axes:
        axis.set_ylim(bottom=0.0)
        axis.grid(alpha=0.3)
    save_figure(figure, path)


def main() -> int:
    """Returns the exit status: 0 if memory and throughput stay within their bounds, else 1."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--stage", choices=("base", "distill"), default="base")
    parser.add_argument("--run-dir", type=Path, help="keep the run here; by default it is deleted")
    parser.add_argument("--interval", type=float, default=5.0, help="seconds between samples of memory")
    parser.add_argument("--threads", type=int, default=0, help="of the training and the reference; 0: all")
    parser.add_argument(
        "--reference-every", type=float, default=45.0, help="seconds between looks at the machine's own speed; 0: never"
    )
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--plot", type=Path, help="write the plot here (PNG)")
    parser.add_argument("options", nargs="*", help="options of the training, after --")
    options = parser.parse_args()
    try:
        require_output("--json", options.json or "")
        require_output("--plot", options.plot or "", (".png",))
    except (ValueError, OSError) as error:
        parser.error(str(error))
    with tempfile.TemporaryDirectory(prefix="cotap-soak-") as work:
        soaked = soak(
            options.run_dir or Path(work) / "run", Path(work) / "log", options.stage, 60.0 * options.minutes,
            options.options, options.interval, options.threads, options.reference_every,
        )  # fmt: skip
    slower, interval = trend(soaked.speeds()[:, 1])
    result: dict[str, Any] = {
        "minutes": soaked.memory[-1, 0] / 60.0,
        "iterations": len(soaked.rates),
        "memory_mib": float(np.median(soaked.memory[:, 1])),
        "memory_growth": change(soaked.memory[:, 1]),
        "steps_per_s": float(np.median(soaked.rates[:, 1])),
        "throughput_change_as_the_clock_has_it": change(soaked.rates[:, 1]),
        "references": len(soaked.pauses),
        "throughput_change": slower,
        "throughput_change_ci95": interval,
    }
    print(json.dumps(result, indent=2))
    if options.json:
        series = {name: getattr(soaked, name).tolist() for name in ("memory", "pauses", "rates")}
        write_json(options.json, result | {"series": series})
    if options.plot:
        plot(options.plot, soaked)
    return int(result["memory_growth"] > MOST_GROWTH or slower < -MOST_SLOWDOWN)


if __name__ == "__main__":
    sys.exit(main())
