"""All that steps envs on the CPU, by name."""

from __future__ import annotations

import mujoco
import pytest

from cotap.sim import batch_of, resolve_backend
from cotap.sim.batch_simulation import MakeBatch
from cotap.sim.loop_batch import LoopBatch

BATCHES = ("mjbatch", "mujoco.batch", "LoopBatch")


def batch_named(name: str) -> MakeBatch:
    """One of `BATCHES`; skips the test where it cannot be had with the installed MuJoCo."""
    if name == "LoopBatch":
        return LoopBatch
    if name == "mujoco.batch":
        if batch_of("mujoco") is LoopBatch:
            pytest.skip(f"MuJoCo {mujoco.__version__} has no mujoco.batch")
        return batch_of("mujoco")
    try:
        return batch_of(resolve_backend(name))
    except ValueError as error:
        pytest.skip(str(error))
