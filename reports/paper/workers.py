"""Trials shared among processes. What comes out does not depend on how many there are."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from cotap.checks import require_range
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.trial import Trial
from cotap.deployment.trials import run_trials

_GROUP = 2
"""Trials that are run one after the other in one engine: the same for every number of processes."""
_policy: OnnxPolicy | None = None


class Workers:
    """Runs trials of one policy in `jobs` processes, each on one CPU thread; with one job in this process.

    Args:
        path: The policy.
        jobs: How many.
    """

    def __init__(self, path: Path, jobs: int) -> None:
        require_range("jobs", jobs, 1, 1024)
        self._pool: Executor | None = None
        if jobs > 1:
            # Spawned, not forked: torch's threads do not survive a fork.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(jobs, context, _begin, (path,))
        else:
            _begin(path)

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def trials(self, options: tuple[Any, ...], count: int, seed: int) -> list[Trial]:
        """`count` trials, with seeds from `seed` on; `options` as `run_trials` takes them, up to the scenario."""
        starts = range(0, count, _GROUP)
        tasks = [(options, min(_GROUP, count - start), seed + start) for start in starts]
        found = self._pool.map(_run, tasks) if self._pool is not None else map(_run, tasks)
        groups = tqdm(found, total=len(tasks), desc="trials", unit="pair", leave=False)
        return [_unpacked(trial) for group in groups for trial in group]


def _begin(path: Path) -> None:
    global _policy
    torch.set_num_threads(1)
    _policy = OnnxPolicy(path)


def _run(task: tuple[tuple[Any, ...], int, int]) -> list[tuple[Trial, dict[str, np.ndarray]]]:
    (laws, engine, wrong, safety, scenario), count, seed = task
    assert _policy is not None
    trials = run_trials(_policy, laws, engine, wrong, safety, scenario, count, seed, progress=False)
    return [_packed(trial) for trial in trials]


def _packed(trial: Trial) -> tuple[Trial, dict[str, np.ndarray]]:
    """A trial, and its rows as one array per column: thousands of small tensors are slow to send."""
    names = trial.rows[0] if trial.rows else {}
    columns = {name: torch.stack([row[name] for row in trial.rows]).numpy() for name in names}
    return replace(trial, rows=[]), columns


def _unpacked(packed: tuple[Trial, dict[str, np.ndarray]]) -> Trial:
    trial, columns = packed
    tensors = {name: torch.from_numpy(values) for name, values in columns.items()}
    trial.rows = [{name: values[i] for name, values in tensors.items()} for i in range(len(trial.qpos))]
    return trial
