"""Batched physics: stepping, per-env model fields, wrenches, snapshots; knows nothing of control laws."""

from cotap.sim.backends import BACKENDS, make_simulation, resolve_backend, simulated_on
from cotap.sim.batch_simulation import BatchSimulation
from cotap.sim.simulation import Simulation, Snapshot

__all__ = [
    "BACKENDS",
    "BatchSimulation",
    "Simulation",
    "Snapshot",
    "make_simulation",
    "resolve_backend",
    "simulated_on",
]
