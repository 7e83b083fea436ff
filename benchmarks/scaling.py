"""Several processes against one: throughput, learning, and what they tell each other. On a machine with nothing else
running: `python -m benchmarks.scaling measure` and `python -m benchmarks.scaling count`."""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cotap.agents.checkpoint import write_json
from cotap.agents.ranks import Ranks
from cotap.agents.runner import DualRunner
from cotap.configs import BASE_RECIPES, to_plain
from cotap.envs import HumanoidEnv
from cotap.files import require_output

LEARNING = ("command/error_velocity", "episode/falls_per_s", "command/e_upper", "curriculum/assist")
RATE = "throughput/steps_per_s"


def train(folder: Path, processes: int, threads: int, envs: int, iterations: int, seed: int) -> dict[str, list[float]]:
    """Train in `processes` of `threads` each, `envs` in all. Returns the curves, by name."""
    options = ["base", "--num-envs", envs // processes, "--threads", threads, "--iterations", iterations,
               "--seed", seed, "--run-dir", folder]  # fmt: skip
    launch = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"] if processes > 1 else []
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    command = [sys.executable, *launch, "-m", "cotap.train", *map(str, options)]
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [e.value for e in events.Scalars(tag)] for tag in (RATE, *LEARNING)}


def measure(layouts: list[tuple[int, int]], envs: int, iterations: int, seeds: int) -> list[dict[str, Any]]:
    """Every layout of processes x threads, for every seed in turn, so that a slow spell of the machine meets all."""
    runs: dict[tuple[int, int], list[dict[str, list[float]]]] = {layout: [] for layout in layouts}
    with tempfile.TemporaryDirectory(prefix="cotap-scaling-") as work:
        for seed in range(seeds):
            for processes, threads in layouts:
                folder = Path(work) / f"{processes}x{threads}-{seed}"
                runs[processes, threads].append(train(folder, processes, threads, envs, iterations, seed))
    tail = max(1, iterations // 5)
    out = []
    for (processes, threads), curves in runs.items():
        rates = [statistics.median(c[RATE][1:] or c[RATE]) for c in curves]
        ends = {tag: [statistics.fmean(c[tag][-tail:]) for c in curves] for tag in LEARNING}
        out.append({"processes": processes, "threads": threads, "steps_per_s": statistics.median(rates), "ends": ends})
    return out


def table(rows: list[dict[str, Any]]) -> str:
    """As Markdown: throughput against the first row, and the end of the curves, mean and deviation over seeds."""
    lines = [
        "| processes x threads | env steps/s | of the first | " + " | ".join(LEARNING) + " |",
        "|---|---|---|" + "---|" * len(LEARNING),
    ]
    for r in rows:
        share = r["steps_per_s"] / rows[0]["steps_per_s"]
        ends = [_mean_and_spread(v) for v in r["ends"].values()]
        lines.append(
            f"| {r['processes']} x {r['threads']} | {r['steps_per_s']:,.0f} | {share:.3f} | {' | '.join(ends)} |"
        )
    return "\n".join(lines)


def _mean_and_spread(values: list[float]) -> str:
    spread = f" +- {statistics.stdev(values):.4f}" if len(values) > 1 else " (one seed)"
    return f"{statistics.fmean(values):.4f}{spread}"


def count() -> dict[str, Any]:
    """Messages and bytes that each process sends in one iteration of the default recipe, by kind."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory(prefix="cotap-scaling-") as work:
        mp.spawn(_count_in, args=(2, port, work), nprocs=2)
        return json.loads((Path(work) / "counts.json").read_text())


def _count_in(rank: int, size: int, port: int, work: str) -> None:
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
    torch.set_num_threads(1)
    training = BASE_RECIPES["default"]()
    training.env.num_envs, training.env.num_threads, training.runner.iterations = 8, 1, 2
    ranks = Ranks(rank, size, rank, size)
    messages: Counter[str] = Counter()
    total: Counter[str] = Counter()
    all_reduce = dist.all_reduce

    def counted(tensor: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        kind = "gradients" if tensor.numel() > 10_000 else "normalisers" if ranks_in_act else "scalars"
        messages[kind] += 1
        total[kind] += tensor.numel() * tensor.element_size()
        return all_reduce(tensor, *args, **kwargs)

    ranks_in_act = False
    with ranks.joined("cpu"):
        runner = DualRunner(
            HumanoidEnv(training.env, size), training.runner, training.ppo, Path(work), to_plain(training), ranks=ranks
        )
        act, iterate = runner.alg.act, runner._iterate
        begins: list[tuple[Counter[str], Counter[str]]] = []

        def watched(observations: Any) -> torch.Tensor:
            nonlocal ranks_in_act
            ranks_in_act = True
            actions = act(observations)
            ranks_in_act = False
            return actions

        def begun(observations: Any) -> Any:
            begins.append((messages.copy(), total.copy()))
            return iterate(observations)

        runner.alg.act, runner._iterate = watched, begun
        dist.all_reduce = counted
        runner.learn()  # from the beginning of the first to that of the second is one iteration, whole
        dist.all_reduce = all_reduce
    if rank == 0:
        weights = {
            n: sum(p.numel() for p in (*m.actors[n].parameters(), m.log_std[n], *m.critics[n].parameters()))
            for m in [runner.alg.model]
            for n in runner.alg.names
        }
        sent = [dict(after - before) for before, after in zip(*begins, strict=True)]
        result = {"messages": sent[0], "bytes": sent[1], "weights": weights}
        (Path(work) / "counts.json").write_text(json.dumps(result))


def layout(text: str) -> tuple[int, int]:
    """Processes and threads of each, of `PROCESSESxTHREADS`."""
    processes, _, threads = text.partition("x")
    if not (processes.isdecimal() and threads.isdecimal() and int(processes) and int(threads)):
        raise argparse.ArgumentTypeError(f"must be PROCESSESxTHREADS, got {text!r}")
    return int(processes), int(threads)


def main() -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("count", help="messages and bytes per iteration")
    measuring = commands.add_parser("measure", help="throughput and learning of processes x threads")
    measuring.add_argument(
        "--layouts", nargs="+", type=layout, default=[(1, 2), (2, 1), (1, 1)], help="PROCESSESxTHREADS each"
    )
    measuring.add_argument("--envs", type=int, default=1024, help="in all")
    measuring.add_argument("--iterations", type=int, default=60)
    measuring.add_argument("--seeds", type=int, default=3)
    measuring.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    if options.command == "count":
        print(json.dumps(count(), indent=2))
        return 0
    try:
        require_output("--json", options.json or "")
    except (ValueError, OSError) as error:
        parser.error(str(error))
    rows = measure(options.layouts, options.envs, options.iterations, options.seeds)
    print(f"{options.envs} envs, {options.iterations} iterations, {options.seeds} seeds\n\n{table(rows)}")
    if options.json:
        write_json(options.json, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
