"""Where arms meet the rest of the robot."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import math

import mujoco
import numpy as np
import torch

from cotap.robots import RobotSpec
from cotap.robots.mjcf import FIXED_BASE_LIFT_M, build_model

STEP_RAD = 0.02
TOUCHING_M = 0.002
"""Shapes that meet no deeper than this do not count: they are rounder than the robot."""


def clear_range(spec: RobotSpec, low: torch.Tensor, high: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """`low` and `high` (U,) [rad], brought in to where an arm meets the robot as one joint leaves the default pose.

    Shapes that meet in the default pose already may overlap as far as they do there. Several joints together may still
    bring an arm to the body, though far less often.
    """
    model = build_model(spec, "full", fixed_base=True)
    data = mujoco.MjData(model)
    address = [model.jnt_qposadr[model.joint(j.name).id] for j in spec.joints]
    default = data.qpos.copy()
    default[:7] = 0.0, 0.0, spec.base_height_m + FIXED_BASE_LIFT_M, 1.0, 0.0, 0.0, 0.0  # no foot is to meet the floor
    default[address] = [j.default_rad for j in spec.joints]
    met_m = min(_nearest(model, data, default), 0.0) - TOUCHING_M
    bounds = []
    for limits in (low, high):
        reached = []
        for joint, limit in zip(spec.indices(spec.upper_joints), limits.tolist(), strict=True):
            start, pose = spec.joints[joint].default_rad, default.copy()
            free = start
            for angle in np.linspace(start, limit, 1 + math.ceil(abs(limit - start) / STEP_RAD))[1:]:
                pose[address[joint]] = angle
                if _nearest(model, data, pose) < met_m:
                    break
                free = float(angle)
            reached.append(free)
        bounds.append(torch.tensor(reached, dtype=low.dtype, device=low.device))
    return bounds[0], bounds[1]


def touching(model: mujoco.MjModel, spec: RobotSpec, side: int, qpos: torch.Tensor) -> torch.Tensor:
    """Whether (N,) an arm, by its place `side` among `spec.arms`, touches anything at configurations `qpos` (N, nq).

    Shapes meet as `model` lets them: in one of `build_model(spec, "feet")` no arm touches anything.
    """
    of_arm = np.zeros(model.nbody, dtype=bool)
    of_arm[[model.joint(name).bodyid[0] for name in spec.arms[side].joints]] = True
    data, touched = mujoco.MjData(model), []
    for configuration in qpos.double().cpu().numpy():
        _collide(model, data, configuration)
        ends = of_arm[model.geom_bodyid[data.contact.geom]]
        touched.append(bool(((ends[:, 0] != ends[:, 1]) & (data.contact.dist < 0.0)).any()))
    return torch.tensor(touched, dtype=torch.bool)


def _nearest(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> float:
    """Smallest distance [m] of shapes that may meet, negative where they overlap; infinite where none are near."""
    _collide(model, data, qpos)
    return float(data.contact.dist.min(initial=np.inf))


def _collide(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> None:
    """Find the contacts at a configuration."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
