"""What simulates, by name: MuJoCo itself or mjbatch on the CPU, or MuJoCo Warp on a GPU."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
from importlib.metadata import PackageNotFoundError, requires
from importlib.util import find_spec

import mujoco
import torch

from cotap.checks import require_one_of
from cotap.sim.batch_simulation import BatchSimulation, batch_of
from cotap.sim.simulation import Simulation

BACKENDS = ("auto", "mujoco", "mjbatch", "warp")


def resolve_backend(name: str) -> str:
    """`mujoco`, `mjbatch` or `warp`: the backend that `name` means on this machine.

    `auto` is warp where there are a GPU (CUDA) and the extra `warp`, else mjbatch where it is installed, else mujoco.

    Raises:
        ValueError: `name` is unknown, or what it needs is not installed.
    """
    require_one_of("backend", name, BACKENDS)
    missing = {"mjbatch": _lack_of_mjbatch(), "warp": _lack_of_warp()}
    if name != "auto":
        if reason := missing.get(name):
            raise ValueError(f"backend {name!r} needs {reason}: in cotap's folder, pip install -e '.[{name}]'")
        return name
    if torch.cuda.is_available() and not missing["warp"]:
        return "warp"
    return "mujoco" if missing["mjbatch"] else "mjbatch"


def simulated_on(backend: str) -> str:
    """The device, cpu or cuda, that a backend keeps its envs on. Raises ValueError as `resolve_backend` does."""
    return "cuda" if resolve_backend(backend) == "warp" and torch.cuda.is_available() else "cpu"


def make_simulation(
    backend: str, model: mujoco.MjModel, num_envs: int, substeps: int, num_threads: int = 0,
    fields: tuple[str, ...] = (),
) -> Simulation:  # fmt: skip
    """N envs of `model` on a backend. Warp takes torch's present GPU, or without one the CPU.

    Raises:
        ValueError: the backend is unknown or not installed, or a number is out of its range.
    """
    backend = resolve_backend(backend)
    if backend != "warp":
        return BatchSimulation(batch_of(backend), model, num_envs, substeps, num_threads, fields)
    from cotap.sim.warp_simulation import WarpSimulation  # an optional extra

    return WarpSimulation(model, num_envs, substeps, simulated_on(backend), fields)


def _lack_of_mjbatch() -> str:
    """What is missing for mjbatch; empty if nothing is. Beside another MuJoCo than its own it would crash."""
    try:
        pins = [need for need in requires("mjbatch") or () if need.startswith("mujoco==")]
    except PackageNotFoundError:
        return "mjbatch, which is not installed"
    installed = f"mujoco=={mujoco.__version__}"
    return f"{pins[0]}, and {installed} is installed" if pins and installed not in pins else ""


def _lack_of_warp() -> str:
    """What is missing for warp; empty if nothing is."""
    missing = [package for package in ("mujoco_warp", "warp") if find_spec(package) is None]
    return f"{missing[0]}, which is not installed" if missing else ""
