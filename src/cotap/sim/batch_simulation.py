"""Worlds on the processor: mjbatch, float64, on as many threads as one likes."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco
import torch
from mjbatch import Batch

from cotap.sim.simulation import Simulation


class BatchSimulation(Simulation):
    """`Simulation` on mjbatch. States are float64 views; `sensors` is a float32 copy-out.

    Args:
        model: Compiled model; copied.
        num_envs: Number of envs.
        substeps: Physics steps per control step.
        num_threads: Worker threads; 0 takes every processor.
        fields: Names of `mjModel` fields that are to differ between envs.
    """

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, substeps: int, num_threads: int = 0, fields: tuple[str, ...] = ()
    ) -> None:
        super().__init__(model, num_envs, substeps)
        self.device = "cpu"
        self._batch = Batch(model, num_envs, num_threads)
        self._state = torch.from_numpy(self._batch.bind("state"))
        self.qpos, self.qvel, self.ctrl, self.xfrc = (
            torch.from_numpy(self._batch.bind(name)) for name in ("qpos", "qvel", "ctrl", "xfrc_applied")
        )
        self.sensors = torch.from_numpy(self._batch.bind("sensordata", "float32"))
        self._fields = {name: torch.from_numpy(self._batch.expand(name)) for name in fields}

    def update_constants(self) -> None:
        """Recompute what MuJoCo derives from masses and inertias, per env. Call after writing such fields."""
        self._batch.set_const()

    def _advance(self) -> None:
        self._batch.step()

    def _clear(self, mask: torch.Tensor) -> None:
        self._batch.reset(mask.numpy())

    def _forward(self, mask: torch.Tensor) -> None:
        self._batch.forward(mask.numpy())

    def _read_state(self) -> torch.Tensor:
        return self._state.clone()

    def _write_state(self, state: torch.Tensor) -> None:
        self._state.copy_(state)
