"""Where episodes begin: on the feet, nearly at rest, default legs with noise, arms on their reference."""

from __future__ import annotations

import math

import torch

from cotap.envs.config import HumanoidEnvConfig
from cotap.persistence import uniform
from cotap.robots import RobotSpec
from cotap.robots.ground import HALF_EXTENT_M
from cotap.robots.mjcf import FIXED_BASE_LIFT_M
from cotap.rotations import quat_about_z


def start_state(
    cfg: HumanoidEnvConfig, spec: RobotSpec, arms: torch.Tensor, rng: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """`qpos` (n, 7 + J) and `qvel` (n, 6 + J) of n episodes whose arms begin at `arms` (n, U) [rad]."""
    n, joints = len(arms), len(spec.joints)
    legs = torch.tensor([j.default_rad for j in spec.joints[: joints - arms.shape[1]]], device=rng.device)
    legs = legs + uniform(rng, -0.05, 0.05, n, len(legs))
    position = torch.zeros(n, 3, device=rng.device)
    position[:, 2] = spec.base_height_m + (FIXED_BASE_LIFT_M if cfg.fixed_base else 0.01)
    if cfg.unevenness_m > 0.0 and not cfg.fixed_base:
        position[:, :2] = uniform(rng, -0.5 * HALF_EXTENT_M, 0.5 * HALF_EXTENT_M, n, 2)
        position[:, 2] += 0.5 * cfg.unevenness_m
    yaw = uniform(rng, -math.pi, math.pi, n) * (not cfg.fixed_base)
    qpos = torch.cat((position, quat_about_z(yaw), legs, arms), 1)
    qvel = torch.cat((uniform(rng, -0.05, 0.05, n, 6), torch.zeros(n, joints, device=rng.device)), 1)
    return qpos, qvel
