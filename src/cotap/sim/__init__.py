"""Batched physics: stepping, per-world model fields, wrenches, snapshots; knows nothing of control laws."""

from cotap.sim.actuation import DelayedTargets
from cotap.sim.simulation import Simulation, Snapshot

__all__ = ["DelayedTargets", "Simulation", "Snapshot"]
