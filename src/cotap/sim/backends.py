"""What simulates: mjbatch on the processor, or MuJoCo Warp on a graphics card, by name."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
from importlib.util import find_spec

import mujoco
import torch

from cotap.checks import require_one_of
from cotap.sim.batch_simulation import BatchSimulation
from cotap.sim.simulation import Simulation

BACKENDS = ("auto", "mjbatch", "warp")


def resolve_backend(name: str) -> str:
    """`mjbatch` or `warp`: the backend that `name` means on this machine.

    `auto` is warp where there are a graphics card (CUDA) and the extra `warp`, else mjbatch.

    Raises:
        ValueError: `name` is unknown, or the extra it needs is not installed.
    """
    require_one_of("backend", name, BACKENDS)
    if name == "mjbatch" or (name == "auto" and not torch.cuda.is_available()):
        return "mjbatch"
    missing = [package for package in ("mujoco_warp", "warp") if find_spec(package) is None]
    if name == "warp" and missing:
        raise ValueError(f"backend 'warp' needs {missing[0]}, which is not installed: pip install cotap[warp]")
    return "mjbatch" if missing else "warp"


def simulated_on(backend: str) -> str:
    """The device, cpu or cuda, that a backend keeps its envs on. Raises ValueError as `resolve_backend` does."""
    return "cuda" if resolve_backend(backend) == "warp" and torch.cuda.is_available() else "cpu"


def make_simulation(
    backend: str, model: mujoco.MjModel, num_envs: int, substeps: int, num_threads: int = 0,
    fields: tuple[str, ...] = (),
) -> Simulation:  # fmt: skip
    """N envs of `model` on a backend. Warp takes torch's present graphics card, or without one the processor.

    Raises:
        ValueError: the backend is unknown or not installed, or a number is out of its range.
    """
    if resolve_backend(backend) == "mjbatch":
        return BatchSimulation(model, num_envs, substeps, num_threads, fields)
    from cotap.sim.warp_simulation import WarpSimulation  # an optional extra

    return WarpSimulation(model, num_envs, substeps, simulated_on(backend), fields)
