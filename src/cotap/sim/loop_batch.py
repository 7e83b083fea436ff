"""Many simulations of one model in Python threads, for MuJoCo before 3.17, which has no `mujoco.batch` yet."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import copy
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import mujoco
import numpy as np

from cotap.sim.simulation import DERIVED

_INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_DERIVED = (*DERIVED, "dof_M0", "tendon_invweight0")
_COMPONENTS = {
    "qpos": mujoco.mjtState.mjSTATE_QPOS,
    "qvel": mujoco.mjtState.mjSTATE_QVEL,
    "ctrl": mujoco.mjtState.mjSTATE_CTRL,
    "xfrc_applied": mujoco.mjtState.mjSTATE_XFRC_APPLIED,
}


class LoopBatch:
    """The part of `mujoco.batch.Batch` that cotap uses: the same names, and the same numbers bit for bit.

    Every thread has one model and one `MjData`, which serve its simulations in turn: what a simulation has of its own
    is written into them, and its state is read back. A model for each simulation would take 70 KB apiece without
    textures, and be read from memory anew at every step, which costs more than the writing.

    Args:
        model: Compiled model; copied.
        nsim: Number of simulations.
        nthread: Threads; 0 takes every core.
    """

    def __init__(self, model: mujoco.MjModel, nsim: int, nthread: int = 0) -> None:
        self._workers = [_Worker(model) for _ in range(min(nsim, nthread or os.cpu_count() or 1))]
        self._pool = ThreadPoolExecutor(len(self._workers)) if len(self._workers) > 1 else None
        self._model, self._data = self._workers[0].model, mujoco.MjData(model)
        self._initial = np.zeros(mujoco.mj_stateSize(model, _INTEGRATION))
        mujoco.mj_getState(model, self._data, self._initial, _INTEGRATION)
        self.state = np.tile(self._initial, (nsim, 1))
        """(nsim, nstate), in the order of MuJoCo's mjSTATE_INTEGRATION."""
        self._sensordata = np.zeros((nsim, model.nsensordata))
        self._mean_inertia = np.full(nsim, model.stat.meaninertia)
        self._fields: dict[str, np.ndarray] = {}

    def bind(self, name: str) -> np.ndarray:
        """Live (nsim, ...) view of a field of `MjData`: a part of the state, or `sensordata`."""
        if name == "sensordata":
            return self._sensordata
        part = int(_COMPONENTS[name])
        start = mujoco.mj_stateSize(self._model, part - 1)  # of all parts with lower bits, which come first
        view = self.state[:, start : start + mujoco.mj_stateSize(self._model, part)]
        return view.reshape(len(view), *getattr(self._data, name).shape)

    def expand(self, name: str) -> np.ndarray:
        """Values of a field of `MjModel` for each simulation, (nsim, ...), to write in place."""
        if name not in self._fields:
            self._fields[name] = np.repeat(getattr(self._model, name)[None], len(self.state), 0)
        return self._fields[name]

    def step(self) -> None:
        """`mj_step` of every simulation."""
        self._share(partial(self._run, mujoco.mj_step), range(len(self.state)))

    def forward(self, mask: np.ndarray) -> None:
        """`mj_forward` of the simulations in `mask` (nsim,) bool."""
        self._share(partial(self._run, mujoco.mj_forward), np.flatnonzero(mask).tolist())

    def reset(self, mask: np.ndarray) -> None:
        """`mj_resetData` and `mj_forward` of the simulations in `mask` (nsim,) bool."""
        self.state[mask] = self._initial
        self.forward(mask)

    def set_const(self) -> None:
        """`mj_setConst` of every simulation."""
        for name in _DERIVED:
            self.expand(name)
        self._share(self._derive, range(len(self.state)))

    def _share(self, work: Callable[[_Worker, Iterable[int]], None], ids: range | list[int]) -> None:
        """Have the workers do their shares of `ids`."""
        if self._pool is None:
            return work(self._workers[0], ids)
        size = -(-len(ids) // len(self._workers))
        shares = [ids[k * size : (k + 1) * size] for k in range(len(self._workers))]
        for _ in self._pool.map(work, self._workers, shares):  # raises what a worker raised
            pass

    def _run(self, function: Callable[[mujoco.MjModel, mujoco.MjData], None], worker: _Worker, ids: Iterable[int]):
        model, data, state, sensordata = worker.model, worker.data, self.state, self._sensordata
        fields, stat, mean_inertia = worker.pairs(self._fields), model.stat, self._mean_inertia
        for i in ids:
            for own, values in fields:
                own[...] = values[i]
            stat.meaninertia = mean_inertia[i]
            mujoco.mj_setState(model, data, state[i], _INTEGRATION)
            function(model, data)
            mujoco.mj_getState(model, data, state[i], _INTEGRATION)
            sensordata[i] = data.sensordata

    def _derive(self, worker: _Worker, ids: Iterable[int]) -> None:
        fields = worker.pairs(self._fields)
        for i in ids:
            for own, values in fields:
                own[...] = values[i]
            mujoco.mj_setConst(worker.model, worker.data)
            for name in _DERIVED:
                self._fields[name][i] = getattr(worker.model, name)
            self._mean_inertia[i] = worker.model.stat.meaninertia


class _Worker:
    """What a thread has of its own."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)

    def pairs(self, fields: dict[str, np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Fields of the model beside their values for each simulation."""
        return [(getattr(self.model, name), values) for name, values in fields.items() if values.size]
