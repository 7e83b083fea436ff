"""All that steps envs on the CPU, by name."""

from __future__ import annotations

import mujoco
import pytest
import torch

from cotap.sim import Simulation, batch_of, resolve_backend
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


def require_that_one_diverges_alone(sims: list[Simulation], qpos: torch.Tensor, qvel: torch.Tensor) -> None:
    """Of two alike, one gets an env that is no number: its other envs go on as the other's, and it can be restarted."""
    n = len(qpos)
    for sim in sims:
        sim.reset(torch.ones(n, dtype=torch.bool), qpos, qvel)
    sims[0].qpos[2, 10] = float("nan")
    for sim in sims:
        for _ in range(5):
            sim.step(lambda _: torch.zeros_like(sims[0].ctrl))
    others = torch.arange(n) != 2
    assert not torch.isfinite(sims[0].qpos[2]).all()
    assert torch.equal(sims[0].qpos[others], sims[1].qpos[others])
    sims[0].reset(~others, qpos[2:3], qvel[2:3])
    sims[0].step(lambda _: torch.zeros_like(sims[0].ctrl))
    assert torch.isfinite(sims[0].qpos).all()
