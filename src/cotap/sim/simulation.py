"""A batch of MuJoCo worlds on mjbatch, seen as torch tensors that share its memory."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import torch
from mjbatch import Batch

from cotap.checks import require_positive_int, require_shape

DriveFunction = Callable[[int], torch.Tensor]
"""Called before every physics step with its number within the control step; returns `ctrl`, (num_envs, nu)."""


@dataclass(frozen=True)
class Snapshot:
    """Everything that the worlds' future depends on: integration states, sensors, expanded model fields."""

    state: torch.Tensor
    sensors: torch.Tensor
    fields: dict[str, torch.Tensor]


class Simulation:
    """N worlds of one model.

    State tensors (`qpos`, `qvel`, `ctrl`, `xfrc`) are float64 views into the simulator's own memory: write to them and
    the next step starts from there. `sensors` is a float32 copy-out.

    Staleness: after `step`, `qpos` and `qvel` are current, `sensors` are one physics step behind (as with `mj_step`).
    After `reset`, all are current.

    Args:
        model: Compiled model; copied.
        num_envs: Number of worlds.
        substeps: Physics steps per control step.
        num_threads: Worker threads; 0 takes every processor.
        fields: Names of `mjModel` fields that are to differ between worlds.
    """

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, substeps: int, num_threads: int = 0, fields: tuple[str, ...] = ()
    ) -> None:
        self.num_envs = require_positive_int("num_envs", num_envs)
        self.substeps = require_positive_int("substeps", substeps)
        self.model = model
        self.dt = float(model.opt.timestep) * substeps
        self._batch = Batch(model, num_envs, num_threads)
        self._state = torch.from_numpy(self._batch.bind("state"))
        self.qpos, self.qvel, self.ctrl, self.xfrc = (
            torch.from_numpy(self._batch.bind(name)) for name in ("qpos", "qvel", "ctrl", "xfrc_applied")
        )
        self.sensors = torch.from_numpy(self._batch.bind("sensordata", "float32"))
        self._fields = {name: torch.from_numpy(self._batch.expand(name)) for name in fields}

    def field(self, name: str) -> torch.Tensor:
        """Per-world values of an `mjModel` field named at construction, (num_envs, ...), to write in place.

        Raises:
            ValueError: the field was not declared.
        """
        if name not in self._fields:
            raise ValueError(f"model field {name!r} was not declared; declared: {', '.join(self._fields) or 'none'}")
        return self._fields[name]

    def sensor(self, name: str) -> torch.Tensor:
        """Live (num_envs, dim) view of a named sensor."""
        sensor = self.model.sensor(name)
        return self.sensors[:, sensor.adr[0] : sensor.adr[0] + sensor.dim[0]]

    def update_constants(self) -> None:
        """Recompute what MuJoCo derives from masses and inertias, per world. Call after writing such fields."""
        self._batch.set_const()

    def step(self, drive: DriveFunction) -> None:
        """Advance every world by one control step, asking `drive` for `ctrl` before every physics step."""
        for k in range(self.substeps):
            self.ctrl.copy_(drive(k))
            self._batch.step()

    def reset(self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        """Restart the worlds in `mask` (num_envs,) bool from `qpos` (n, nq) and `qvel` (n, nv), n = mask.sum().

        Forces and controls are cleared; sensors are current afterwards.
        """
        require_shape("mask", mask, (self.num_envs,))
        ids = mask.nonzero().squeeze(1)
        if ids.numel() == 0:
            return
        self._batch.reset(mask.numpy())
        self.qpos[ids] = qpos.double()
        self.qvel[ids] = qvel.double()
        self._batch.forward(mask.numpy())

    def apply_force(self, body: int, force_w: torch.Tensor, lever_w: torch.Tensor) -> None:
        """Apply `force_w` (num_envs, 3) [N] to body number `body` at `lever_w` from its centre of mass, world frame.

        MuJoCo takes a wrench at the centre of mass, so the force's moment is added here. Replaces the body's wrench.
        """
        self.xfrc[:, body, :3] = force_w
        self.xfrc[:, body, 3:] = torch.linalg.cross(lever_w, force_w)

    def snapshot(self) -> Snapshot:
        """Copy of everything that the future depends on."""
        return Snapshot(
            self._state.clone(), self.sensors.clone(), {name: value.clone() for name, value in self._fields.items()}
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Go on from a snapshot of a simulation with the same model, size and fields.

        Raises:
            ValueError: sizes or fields differ.
        """
        require_shape("snapshot.state", snapshot.state, tuple(self._state.shape))
        if snapshot.fields.keys() != self._fields.keys():
            raise ValueError(f"snapshot has fields {sorted(snapshot.fields)}, not {sorted(self._fields)}")
        for name, value in snapshot.fields.items():
            self._fields[name].copy_(require_shape(f"snapshot.fields[{name}]", value, tuple(self._fields[name].shape)))
        if {"body_mass", "body_inertia"} & self._fields.keys():
            self.update_constants()
        self._state.copy_(snapshot.state)
        self.sensors.copy_(snapshot.sensors)
