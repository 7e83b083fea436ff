"""Physics engines that one robot can be deployed in, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from cotap.checks import require_one_of, require_range
from cotap.deployment.joint_law import JointLaw
from cotap.robots import RobotSpec
from cotap.robots.mjcf import COLLISIONS
from cotap.robots.spec import Vec3

CONES = ("elliptic", "pyramidal")


@dataclass
class EngineConfig:
    """How finely an engine simulates, and what it is wrong about."""

    engine: str = "mujoco"
    """Physics engine: mujoco or pybullet."""
    timestep: float = 0.001
    """Physics step [s]."""
    collision: str = "full"
    """What collides: full (all shapes) or feet (with the floor). feet in mujoco alone."""
    cone: str = "elliptic"
    """Friction cones: elliptic or pyramidal. In mujoco alone."""
    friction: float = 1.0
    """Sliding friction between feet and floor."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_one_of("engine", self.engine, ENGINES.keys())
        require_range("timestep", self.timestep, 1e-5, 0.02)
        require_one_of("collision", self.collision, COLLISIONS)
        require_one_of("cone", self.cone, CONES)
        require_range("friction", self.friction, 1e-3, 10.0)
        require_range("torque_limit_scale", self.torque_limit_scale, 1e-3, 1e3)
        if self.engine == "pybullet" and (self.collision, self.cone) != ("full", "elliptic"):
            raise ValueError("pybullet has full collision and friction cones of its own; leave collision and cone out")


@dataclass(frozen=True)
class PointForce:
    """A force on a body."""

    body: str
    point: Vec3
    """Where it acts, in the body's frame [m]."""
    force_w: np.ndarray
    """(3,) world frame [N]."""


class Engine(Protocol):
    """One robot. `qpos` (7 + J,) and `qvel` (6 + J,) are live and laid out as MuJoCo's; `sensor` arrays are live."""

    qpos: np.ndarray
    qvel: np.ndarray

    def sensor(self, name: str) -> np.ndarray:
        """Live (dim,) values of a foot sensor, named as in the MuJoCo model."""
        ...

    def reset(self, qpos: np.ndarray, qvel: np.ndarray, mass_scale: float) -> None:
        """Restart from a state, with all masses and inertias times a factor."""
        ...

    def hold(self, held: bool) -> None:
        """Hold the base where it is now, or let it go."""
        ...

    def advance(self, law: JointLaw, steps: int, forces: Sequence[PointForce]) -> None:
        """Take physics steps, with the law evaluated at each and clipped to the torque limits.

        Args:
            law: What the motors do.
            steps: How many.
            forces: What else acts on the robot in all of them.
        """
        ...

    def touching(self) -> set[tuple[str, str]]:
        """Pairs of the robot's own links that touch each other, in the alphabet's order."""
        ...

    def close(self) -> None:
        """Give back what the engine holds."""
        ...


class EngineState:
    """An engine as a batch of one, for `StateReader`."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    @property
    def qpos(self) -> torch.Tensor:
        return torch.from_numpy(self._engine.qpos).unsqueeze(0)

    @property
    def qvel(self) -> torch.Tensor:
        return torch.from_numpy(self._engine.qvel).unsqueeze(0)

    def sensor(self, name: str) -> torch.Tensor:
        return torch.from_numpy(self._engine.sensor(name)).unsqueeze(0)


def make_engine(cfg: EngineConfig, spec: RobotSpec) -> Engine:
    """Build an engine.

    Raises:
        ValueError: a field of the config is out of its range.
        ModuleNotFoundError: the engine is not installed; the message says how to install it.
    """
    cfg.check()
    return ENGINES[cfg.engine](cfg, spec)


def _mujoco(cfg: EngineConfig, spec: RobotSpec) -> Engine:
    from cotap.deployment.mujoco_engine import MujocoEngine

    return MujocoEngine(cfg, spec)


def _pybullet(cfg: EngineConfig, spec: RobotSpec) -> Engine:
    from cotap.deployment.pybullet_engine import PybulletEngine

    return PybulletEngine(cfg, spec)


ENGINES: dict[str, Callable[[EngineConfig, RobotSpec], Engine]] = {"mujoco": _mujoco, "pybullet": _pybullet}
"""Every engine, by name; imported only when it is asked for."""
