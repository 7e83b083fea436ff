"""Envs on a GPU: MuJoCo Warp, float32, what it computes as graphs. Needs the extra `warp`."""

from __future__ import annotations

# Warp's arrays and MuJoCo's enumerations have no type stubs.
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false
import copy
from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp

from cotap.sim.simulation import DERIVED, MASSES, Simulation, state_size

_CONTACTS_PER_GEOM, _ON_BUMPS = 4, 16
"""Contacts for which there is room, per geom that may touch anything: on a plane, and on a height field."""
_INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)


class WarpSimulation(Simulation):
    """`Simulation` on MuJoCo Warp. States are float32 views of Warp's arrays; nothing travels through the host.

    The physics is MuJoCo's: the same integrator (implicitfast), solver (Newton) and friction cone (pyramidal), in
    float32, its tolerance no less than 1e-6. Warp has no automatic reset of envs that diverge, so none is switched
    off.

    Args:
        model: Compiled model; copied.
        num_envs: Number of envs.
        substeps: Physics steps per control step.
        device: Where they are: "cpu" (to develop and test), or "cuda" with or without the number of a GPU.
        fields: Names of `mjModel` fields that are to differ between envs.

    Raises:
        ValueError: Warp knows no such device.
    """

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, substeps: int, device: str = "cpu", fields: tuple[str, ...] = ()
    ) -> None:
        super().__init__(model, num_envs, substeps)
        self._place = _warp_device(device)
        self.device = wp.device_to_torch(self._place)
        derived = DERIVED if set(MASSES) & set(fields) else ()
        with wp.ScopedDevice(self._place):
            self._model = mjw.put_model(_supported(model), dict.fromkeys((*fields, *derived), num_envs))
            if derived:
                self._model.stat.meaninertia = wp.full(num_envs, float(model.stat.meaninertia), dtype=float)
            contacts = _room_for_contacts(model)
            rows = 4 * contacts + int(model.jnt_limited.sum()) + 6 * model.neq  # condim 3, pyramidal
            self._data = mjw.make_data(model, nworld=num_envs, nconmax=contacts, njmax=rows)
            mjw.reset_data(self._model, self._data)
        self.qpos, self.qvel, self.ctrl, self.xfrc, self.sensors, self._warm_start = (
            wp.to_torch(getattr(self._data, name))
            for name in ("qpos", "qvel", "ctrl", "xfrc_applied", "sensordata", "qacc_warmstart")
        )
        self._fields = {name: wp.to_torch(getattr(self._model, name)) for name in fields}
        self._graphs = {work: self._capture(work) for work in (mjw.step, mjw.forward)}

    def update_constants(self) -> None:
        """Recompute what MuJoCo derives from masses and inertias, per env. Call after writing such fields."""
        with wp.ScopedDevice(self._place):
            mjw.set_const(self._model, self._data)

    def _capture(self, work: Callable[[mjw.Model, mjw.Data], None]) -> wp.Graph | None:
        """`work` as a CUDA graph, launched with one call instead of hundreds; none on the CPU."""
        # What it allocates on the way must come from a memory pool to be part of a graph.
        if not (self._place.is_cuda and wp.is_mempool_enabled(self._place)):
            return None
        with wp.ScopedDevice(self._place):
            work(self._model, self._data)  # compiles, which a capture must not
            with wp.ScopedCapture() as capture:
                work(self._model, self._data)
            mjw.reset_data(self._model, self._data)
        return capture.graph

    def _run(self, work: Callable[[mjw.Model, mjw.Data], None]) -> None:
        # Warp's stream waits for torch's default one, and that for Warp's, as CUDA's blocking streams do.
        with wp.ScopedDevice(self._place):
            if graph := self._graphs[work]:
                wp.capture_launch(graph)
            else:
                work(self._model, self._data)

    def _advance(self) -> None:
        self._run(mjw.step)

    def _clear(self, mask: torch.Tensor) -> None:
        with wp.ScopedDevice(self._place):
            mjw.reset_data(self._model, self._data, wp.from_torch(mask))

    def _forward(self, mask: torch.Tensor) -> None:
        # Warp moves all envs forward; what others had of the step before is put back.
        kept = [(tensor, tensor.clone()) for tensor in (self.sensors, self._warm_start)]
        self._run(mjw.forward)
        for tensor, before in kept:
            tensor.copy_(torch.where(mask.unsqueeze(1), tensor, before))

    def _read_state(self) -> torch.Tensor:
        state = torch.zeros(self.num_envs, state_size(self.model), device=self.device)
        with wp.ScopedDevice(self._place):
            mjw.get_state(self._model, self._data, wp.from_torch(state), _INTEGRATION)
        return state

    def _write_state(self, state: torch.Tensor) -> None:
        state = state.to(self.device, torch.float32).contiguous()
        with wp.ScopedDevice(self._place):
            mjw.set_state(self._model, self._data, wp.from_torch(state), _INTEGRATION)


def _warp_device(device: str) -> wp.Device:
    """Warp's name for torch's `device`; "cuda" is torch's present GPU."""
    place = torch.device(device)
    index = torch.cuda.current_device() if place.type == "cuda" and place.index is None else place.index
    try:
        return wp.get_device("cpu" if place.type == "cpu" else f"{place.type}:{index}")
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"device {device!r} is none of Warp's: {', '.join(map(str, wp.get_devices()))}") from error


def _supported(model: mujoco.MjModel) -> mujoco.MjModel:
    """`model` less the flag that Warp does not know because it never restarts envs by itself."""
    model = copy.copy(model)
    model.opt.disableflags &= ~mujoco.mjtDisableBit.mjDSBL_AUTORESET.value
    return model


def _room_for_contacts(model: mujoco.MjModel) -> int:
    """Contacts per env for which memory is set aside."""
    touching = int(((model.geom_contype | model.geom_conaffinity) != 0).sum())
    return (_ON_BUMPS if model.nhfield else _CONTACTS_PER_GEOM) * touching
