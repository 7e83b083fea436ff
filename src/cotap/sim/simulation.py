"""A batch of simulated robots (envs) as torch tensors on the simulator's memory: what every backend has in common."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import torch

from cotap.checks import require_positive_int, require_shape

DriveFunction = Callable[[int], torch.Tensor]
"""Called before every physics step with its number within the control step; returns `ctrl`, (num_envs, nu)."""
MASSES = ("body_mass", "body_inertia")
DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")
"""Model fields that MuJoCo derives from `MASSES`. So is the mean inertia of the model's statistics."""


@dataclass(frozen=True)
class Snapshot:
    """Everything that the envs' future depends on: integration states, sensors, expanded model fields.

    States are in the order of MuJoCo's mjSTATE_INTEGRATION whatever the backend, so that one may go on from another's.
    """

    state: torch.Tensor
    sensors: torch.Tensor
    fields: dict[str, torch.Tensor]


class Simulation(ABC):
    """N envs of one model.

    State tensors (`qpos`, `qvel`, `ctrl`, `xfrc`) are views into the simulator's own memory, in its own precision:
    write to them and the next step starts from there. So are the tensors of `field`. `sensors` (float32) is to be read.

    Staleness: after `step`, `qpos` and `qvel` are current, `sensors` are one physics step behind (as with `mj_step`).
    After `reset`, all are current.

    Args:
        model: Compiled model; kept as `model`, and not to be changed afterwards.
        num_envs: Number of envs.
        substeps: Physics steps per control step.
    """

    device: str
    """Where all tensors are."""
    qpos: torch.Tensor
    """(num_envs, nq)."""
    qvel: torch.Tensor
    """(num_envs, nv)."""
    ctrl: torch.Tensor
    """(num_envs, nu)."""
    xfrc: torch.Tensor
    """(num_envs, nbody, 6) force [N] and torque [Nm] on every body, at its centre of mass, world frame."""
    sensors: torch.Tensor
    """(num_envs, nsensordata)."""
    _fields: dict[str, torch.Tensor]

    def __init__(self, model: mujoco.MjModel, num_envs: int, substeps: int) -> None:
        self.num_envs = require_positive_int("num_envs", num_envs)
        self.substeps = require_positive_int("substeps", substeps)
        self.model = model
        self.dt = float(model.opt.timestep) * substeps

    def field(self, name: str) -> torch.Tensor:
        """Per-env values of an `mjModel` field named at construction, (num_envs, ...), to write in place.

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

    @abstractmethod
    def update_constants(self) -> None:
        """Recompute what MuJoCo derives from masses and inertias, per env. Call after writing such fields."""

    def step(self, drive: DriveFunction) -> None:
        """Advance every env by one control step, asking `drive` for `ctrl` before every physics step."""
        for k in range(self.substeps):
            self.ctrl.copy_(drive(k))
            self._advance()

    def reset(self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        """Restart the envs in `mask` (num_envs,) bool from `qpos` (n, nq) and `qvel` (n, nv), n = mask.sum().

        Forces and controls are cleared; sensors are current afterwards.
        """
        require_shape("mask", mask, (self.num_envs,))
        ids = mask.nonzero().squeeze(1)
        if ids.numel() == 0:
            return
        self._clear(mask)
        self.qpos[ids], self.qvel[ids] = qpos.to(self.qpos), qvel.to(self.qvel)
        self._forward(mask)

    def snapshot(self) -> Snapshot:
        """Copy of everything that the future depends on."""
        return Snapshot(
            self._read_state(), self.sensors.clone(), {name: value.clone() for name, value in self._fields.items()}
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Go on from a snapshot of a simulation with the same model, size and fields, of whatever backend and device.

        Raises:
            ValueError: sizes or fields differ.
        """
        require_shape("snapshot.state", snapshot.state, (self.num_envs, state_size(self.model)))
        if snapshot.fields.keys() != self._fields.keys():
            raise ValueError(f"snapshot has fields {sorted(snapshot.fields)}, not {sorted(self._fields)}")
        constants_change = False
        for name, value in snapshot.fields.items():
            field = self._fields[name]
            require_shape(f"snapshot.fields[{name}]", value, tuple(field.shape))
            constants_change |= name in MASSES and not torch.equal(field, value.to(field))
            field.copy_(value)
        if constants_change:  # which takes longer than all else
            self.update_constants()
        self._write_state(snapshot.state)
        self.sensors.copy_(snapshot.sensors)

    @abstractmethod
    def _advance(self) -> None:
        """One physics step of every env."""

    @abstractmethod
    def _clear(self, mask: torch.Tensor) -> None:
        """Put the envs of `mask` (num_envs,) back to the model's initial state, without forces and controls."""

    @abstractmethod
    def _forward(self, mask: torch.Tensor) -> None:
        """Make everything that follows from the state current in the envs of `mask` (num_envs,), and in no other."""

    @abstractmethod
    def _read_state(self) -> torch.Tensor:
        """Copy of the integration states (num_envs, state_size)."""

    @abstractmethod
    def _write_state(self, state: torch.Tensor) -> None:
        """Take over integration states (num_envs, state_size)."""


def state_size(model: mujoco.MjModel) -> int:
    """Numbers in an env's integration state."""
    return mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION)
