"""How fast each backend is on the CPU, as ratios within one run: physics alone, and the environment.

Physics alone is cotap's `Simulation` on the control steps of `benchmark.py`. There, masses differ between envs, and
torques are asked for before every physics step. Rates are control steps (20 ms) per second, medians over rounds. Ratios
are medians of the ratios within rounds, to the first row of their kind. With MuJoCo 3.14, `LoopBatch` is compared with
mjbatch; from 3.17 on, with `mujoco.batch`.
"""

from __future__ import annotations

import cotap  # noqa: F401 - before torch, which reads when it is loaded for how long its threads may spin

# isort: split
import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.training import (
    SUBSTEPS,
    WARM_UP_STEPS,
    EnvStepping,
    Recording,
    actor,
    full_env,
    machine,
    ratio,
    record,
    reference_model,
    rounds,
    sizes,
)
from cotap.agents.checkpoint import write_json
from cotap.checks import require_positive_int, require_range
from cotap.envs.randomization import Randomizer
from cotap.sim import BatchSimulation, batch_of, resolve_backend
from cotap.sim.batch_simulation import MakeBatch
from cotap.sim.loop_batch import LoopBatch


class SimulationStepping:
    """`Simulation.step` on a recording, every env with masses of its own; only the stepping is timed.

    With one thread, its time is the CPU's, which other programs hardly change.
    """

    def __init__(self, recording: Recording, seconds: float, threads: int, make_batch: MakeBatch) -> None:
        self.recording, self.seconds = recording, seconds
        self.clock = time.process_time if threads == 1 else time.perf_counter
        n = recording.qpos.shape[1]
        self.sim = sim = BatchSimulation(make_batch, reference_model(), n, SUBSTEPS, threads, Randomizer.FIELDS)
        scale = torch.linspace(0.9, 1.2, n, dtype=torch.float64).unsqueeze(1)
        sim.field("body_mass").mul_(scale)
        sim.field("body_inertia").mul_(scale.unsqueeze(-1))
        sim.update_constants()

    def run(self) -> float:
        r, spent, steps = self.recording, 0.0, 0
        while spent < self.seconds:
            for qpos, qvel, torque in zip(r.qpos, r.qvel, torch.from_numpy(r.torque).unbind(), strict=True):
                self.sim.qpos.numpy()[:], self.sim.qvel.numpy()[:] = qpos, qvel
                start = self.clock()
                self.sim.step(lambda _, torque=torque: torque)
                spent += self.clock() - start
                steps += 1
        return steps * r.qpos.shape[1] / spent


def installed() -> list[str]:
    """Backends on the CPU that can be had with the installed MuJoCo, the fastest first."""
    try:
        return [resolve_backend("mjbatch"), "mujoco"]
    except ValueError:
        return ["mujoco"]


def measure(num_envs: int, options: argparse.Namespace) -> dict[str, Any]:
    """Rates and ratios at a number of envs."""
    seconds, threads = options.seconds, options.threads
    name, policy = actor(options.checkpoint)
    envs = {backend: full_env(num_envs, threads, backend) for backend in installed()}
    recording = record(envs["mujoco"], policy, WARM_UP_STEPS, options.steps)
    batches = {make.__module__: make for make in (*map(batch_of, envs), LoopBatch)}
    parts: dict[str, Callable[[], float]] = {
        f"physics, {module}": SimulationStepping(recording, seconds, threads, make).run
        for module, make in batches.items()
    }
    parts |= {f"environment, {backend}": EnvStepping(env, policy, seconds).run for backend, env in envs.items()}
    results = rounds(parts, options.repeats)
    firsts = {part: next(other for other in parts if other.split(",")[0] == part.split(",")[0]) for part in parts}
    return {
        "policy": name,
        "steps_per_s": {part: statistics.median(rates) for part, rates in results.items()},
        "over_first": {part: ratio(results, part, first) for part, first in firsts.items()},
        "rounds": results,
    }


def table(results: dict[str, dict[str, Any]]) -> str:
    """What `measure` returned at each number of envs, as a Markdown table."""
    rows = [
        f"| {num_envs} | {part} | {rate:,.0f} | {result['over_first'][part]:.2f} |"
        for num_envs, result in results.items()
        for part, rate in result["steps_per_s"].items()
    ]
    return "\n".join(["| envs | what | control steps/s | over the first |", "|---|---|---|---|", *rows])


def main() -> int:
    """Parse, measure, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=sizes, default=[512, 4096], help="numbers of envs, comma-separated")
    parser.add_argument("--seconds", type=float, default=3.0, help="least time per measurement")
    parser.add_argument("--repeats", type=int, default=3, help="rounds, after one of warming up")
    parser.add_argument("--steps", type=int, default=10, help="control steps recorded for physics alone")
    parser.add_argument("--threads", type=int, default=1, help="threads of physics and torch; 0 takes every core")
    parser.add_argument("--checkpoint", default="", help="policy to record and drive with; by default the shipped base")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    try:
        for name in ("repeats", "steps"):
            require_positive_int(name, getattr(options, name))
        require_range("seconds", options.seconds, 1e-3, 1e6)
        require_range("threads", options.threads, 0, 4096)
        if options.threads:
            torch.set_num_threads(options.threads)
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
        results = {str(n): measure(n, options) for n in options.sizes}
        if options.json:
            write_json(options.json, {"sizes": results, "threads": options.threads, "machine": machine()})
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
