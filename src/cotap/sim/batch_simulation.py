"""Envs on the CPU, in float64, on as many threads as one likes: MuJoCo alone, or mjbatch."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import mujoco
import numpy as np
import torch

from cotap.sim.loop_batch import LoopBatch
from cotap.sim.simulation import Simulation

MakeBatch = Callable[[mujoco.MjModel, int, int], Any]
"""A batch of simulations of a model, so many, on so many threads (0: every core)."""


def batch_of(backend: str) -> MakeBatch:
    """What steps the envs of backend `mjbatch` or `mujoco`, all with one interface: mjbatch, or MuJoCo's own
    `mujoco.batch`, or before MuJoCo 3.17, where there is none, `LoopBatch`."""
    if backend == "mjbatch":
        from mjbatch import Batch  # an optional extra

        return Batch
    if find_spec("mujoco.batch"):
        from mujoco.batch import Batch  # pyright: ignore[reportMissingImports]

        return Batch
    return LoopBatch


class BatchSimulation(Simulation):
    """`Simulation` on a batch of `batch_of`. States are float64 views; `sensors` is a float32 copy.

    Args:
        make_batch: What steps the envs.
        model: Compiled model; copied.
        num_envs: Number of envs.
        substeps: Physics steps per control step.
        num_threads: Worker threads; 0 takes every core.
        fields: Names of `mjModel` fields that are to differ between envs.
    """

    def __init__(
        self, make_batch: MakeBatch, model: mujoco.MjModel, num_envs: int, substeps: int, num_threads: int = 0,
        fields: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        super().__init__(model, num_envs, substeps)
        self.device = "cpu"
        self._batch = batch = make_batch(model, num_envs, num_threads)
        self._state = torch.from_numpy(batch.state if hasattr(batch, "state") else batch.bind("state"))
        self._applied = [batch.bind(name) for name in ("ctrl", "xfrc_applied")]
        self.ctrl, self.xfrc = (torch.from_numpy(values) for values in self._applied)
        self.qpos, self.qvel = (torch.from_numpy(batch.bind(name)) for name in ("qpos", "qvel"))
        self._sensordata = batch.bind("sensordata")
        self._sensors = np.zeros(self._sensordata.shape, np.float32)
        self.sensors = torch.from_numpy(self._sensors)
        self._fields = {name: torch.from_numpy(batch.expand(name)) for name in fields}

    def update_constants(self) -> None:
        """Recompute what MuJoCo derives from masses and inertias, per env. Call after writing such fields."""
        self._batch.set_const()

    def _advance(self) -> None:
        self._batch.step()
        self._sensors[:] = self._sensordata

    def _clear(self, mask: torch.Tensor) -> None:
        here = mask.numpy()
        self._batch.reset(here)
        for values in self._applied:
            values[here] = 0.0  # mjbatch leaves what was written since the last step

    def _forward(self, mask: torch.Tensor) -> None:
        here = mask.numpy()
        self._batch.forward(here)
        self._sensors[here] = self._sensordata[here]

    def _read_state(self) -> torch.Tensor:
        return self._state.clone()

    def _write_state(self, state: torch.Tensor) -> None:
        self._state.copy_(state)
