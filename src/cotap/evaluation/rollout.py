"""Running a policy in many worlds and recording what happens."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from tqdm import tqdm

from cotap.agents.actors import as_dict
from cotap.envs import H1Env

PolicyFunction = Callable[[dict[str, torch.Tensor]], torch.Tensor]


@dataclass(frozen=True)
class Trajectory:
    """Recorded tensors, T steps of N worlds; a world's record is meaningful up to its fall, that step included."""

    dt: float
    velocity: torch.Tensor
    """(T, N, 3) torso velocity x, y in the heading frame [m/s] and yaw rate [rad/s]."""
    command: torch.Tensor
    """(T, N, 3) what they were asked to be."""
    stand: torch.Tensor
    """(T, N) bool: standing, not stepping."""
    told_to_stand: torch.Tensor
    """(T, N) bool: to stand is what was asked, whether or not it steps at first or for its balance."""
    height: torch.Tensor
    """(T, N) [m]."""
    height_command: torch.Tensor
    """(T, N) [m]."""
    position: torch.Tensor
    """(T, N, 2) horizontal position of the torso in the world [m]."""
    arm_error: torch.Tensor
    """(T, N, U) arm joint angles minus reference [rad]."""
    arm_velocity: torch.Tensor
    """(T, N, U) arm joint rates [rad/s]."""
    arm_torque: torch.Tensor
    """(T, N, U) [Nm]."""
    arm_at_limit: torch.Tensor
    """(T, N) bool: an arm joint is at its torque limit."""
    hand_position: torch.Tensor
    """(T, N, H, 3) hands relative to the torso, heading frame [m]."""
    hand_error: torch.Tensor
    """(T, N, H) distance of the hands from their reference in the torso frame [m]."""
    foot_contact: torch.Tensor
    """(T, N, F) bool."""
    foot_speed: torch.Tensor
    """(T, N, F) horizontal [m/s]."""
    foot_height: torch.Tensor
    """(T, N, F) of the soles' centres [m]."""
    path_error: torch.Tensor
    """(T, N) horizontal distance of the torso from where its path has it [m]; NaN in worlds that follow none."""
    fell: torch.Tensor
    """(T, N) bool: the world fell in that step."""

    def alive(self) -> torch.Tensor:
        """(T, N) bool: the world has not fallen up to and including this step."""
        return self.fell.cumsum(0) == 0


def record_rollout(
    env: H1Env, policy: PolicyFunction, steps: int, progress: bool = True, arm_actions: bool = True
) -> Trajectory:
    """Run `policy` for `steps` control steps from a fresh start of every world, with or without its arm actions."""
    obs = env.reset()
    rows: dict[str, list[torch.Tensor]] = {f.name: [] for f in fields(Trajectory) if f.name != "dt"}
    for _ in tqdm(range(steps), desc="rollout", unit="step", disable=not progress, leave=False):
        action = policy(as_dict(obs))
        if not arm_actions:
            action = action.clone()
            action[:, env.action_slices["upper"]] = 0.0
        obs, _, _, extras = env.step(action)
        for name, value in trajectory_row(env, extras["falls"]).items():
            rows[name].append(value)
    return Trajectory(dt=env.dt, **{name: torch.stack(values) for name, values in rows.items()})


def trajectory_row(env: H1Env, fell: torch.Tensor) -> dict[str, torch.Tensor]:
    """One step's row (N, ...) of a `Trajectory`, just after `env.step`; `fell` (N,) from its extras."""
    r, upper = env.record, env.action_slices["upper"]
    s, hands = r.state, len(env.spec.arms)
    return {
        "velocity": torch.cat((s.torso_linear_velocity_h[:, :2], s.yaw_rate.unsqueeze(1)), 1),
        "command": torch.cat((r.command.velocity_h, r.command.yaw_rate.unsqueeze(1)), 1),
        "stand": r.command.stand > 0.5,
        "told_to_stand": env.commands.told_to_stand,
        "height": s.height,
        "height_command": r.command.height,
        "position": s.torso_pos_w[:, :2],
        "arm_error": s.joint_pos[:, upper] - r.reference.position,
        "arm_velocity": s.joint_vel[:, upper],
        "arm_torque": r.torque[:, upper],
        "arm_at_limit": (r.torque[:, upper].abs() > 0.999 * env.arm_limits.flatten()).any(1),
        "hand_position": s.arms.tip @ (s.heading_w.transpose(1, 2) @ s.torso_rotation_w).transpose(1, 2),
        "hand_error": (r.key_points_t - r.key_points_reference_t)[:, :hands].norm(dim=2),
        "foot_contact": s.foot_contact,
        "foot_speed": s.foot_velocity_w[:, :, :2].norm(dim=2),
        "foot_height": s.foot_pos_w[:, :, 2],
        "path_error": torch.where(
            env.path.active, (s.torso_pos_w[:, :2] - env.path.target_w).norm(dim=1), torch.full_like(s.height, math.nan)
        ),
        "fell": fell,
    }
