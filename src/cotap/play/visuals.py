"""What a robot looks like: its own primitive shapes, or MuJoCo Menagerie's meshes where they are at hand."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
from pathlib import Path

import mujoco
import numpy as np

from cotap.robots import RobotSpec
from cotap.robots.mjcf import build_mjspec, build_model


class RobotPose:
    """From configurations to body poses and contacts of all shapes, one robot at a time."""

    def __init__(self, spec: RobotSpec, visual: mujoco.MjModel) -> None:
        self._model = build_model(spec, "full")
        self._data = mujoco.MjData(self._model)
        bodies = [visual.body(i).name for i in range(visual.nbody)]
        own = {self._model.body(i).name: i for i in range(self._model.nbody)}
        # A body that only the visual model has stays with the world; it has no shape that matters.
        self._ids = np.array([own.get(name, 0) for name in bodies])

    def of(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (bodies, 3) [m] and rotations (bodies, 3, 3) of the visual model's bodies, contacts (C, 3) [m]."""
        m, d = self._model, self._data
        d.qpos[:] = qpos
        mujoco.mj_fwdPosition(m, d)
        contacts = d.contact.pos[d.contact.dist < 1e-3].copy()
        return d.xpos[self._ids].copy(), d.xmat[self._ids].reshape(-1, 3, 3).copy(), contacts.reshape(-1, 3)


def visual_model(spec: RobotSpec) -> tuple[mujoco.MjModel, str]:
    """A model whose shapes are to be shown, without a floor, and where they come from."""
    meshes = menagerie_file(spec)
    if meshes is not None:
        return mujoco.MjModel.from_xml_path(str(meshes)), "MuJoCo Menagerie"
    mj = build_mjspec(spec)
    mj.delete(mj.geom("floor"))
    return mj.compile(), "cotap"


def menagerie_file(spec: RobotSpec) -> Path | None:
    """The robot's XML in the cache of the `mujoco-menagerie` package; None where that is not there. Loads nothing."""
    if not spec.menagerie:
        return None
    try:
        import mujoco_menagerie
    except ImportError:
        return None
    cache = mujoco_menagerie.Cache()
    try:
        robot = mujoco_menagerie.get(spec.menagerie)
        if cache.root is None and not cache.is_cached(robot):
            return None
        file = robot.xml(robot.default_model, cache)
    except (mujoco_menagerie.MenagerieError, OSError):
        return None
    return file if file.is_file() else None
