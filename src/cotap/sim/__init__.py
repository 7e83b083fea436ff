"""Batched physics: stepping, per-env model fields, wrenches, snapshots; knows nothing of control laws."""

from cotap.sim.backends import BACKENDS, make_simulation, resolve_backend, simulated_on
from cotap.sim.batch_simulation import BatchSimulation, batch_of
from cotap.sim.simulation import Simulation, Snapshot

__all__ = [
    "BACKENDS",
    "BatchSimulation",
    "Simulation",
    "Snapshot",
    "batch_of",
    "make_simulation",
    "resolve_backend",
    "simulated_on",
]
