"""Running a policy in many envs and recording what happens."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields

import torch
from tqdm import tqdm

from cotap.agents.actors import as_dict
from cotap.checks import quoted, require_range
from cotap.compliance.dynamics import gravity_torque
from cotap.compliance.interface import Arms
from cotap.envs import HumanoidEnv
from cotap.envs.commands import CommandSource
from cotap.envs.state import RobotState
from cotap.memory import require_memory
from cotap.rotations import rotate_inverse

PolicyFunction = Callable[[dict[str, torch.Tensor]], torch.Tensor]
UPPER_ACTIONS = ("policy", "reference")


@dataclass(frozen=True)
class Trajectory:
    """Recorded tensors, T steps of N envs; an env's record is meaningful up to its fall."""

    dt: float
    velocity: torch.Tensor
    """(T, N, 3) torso velocity x, y in the heading frame [m/s] and yaw rate [rad/s]."""
    command: torch.Tensor
    """(T, N, 3) what they were asked to be, rates of change aside."""
    stand: torch.Tensor
    """(T, N) bool: to stand is what was asked, whether or not the robot still slows down."""
    height: torch.Tensor
    """(T, N) [m]."""
    height_command: torch.Tensor
    """(T, N) what it was asked to be, its rate of change aside [m]."""
    position: torch.Tensor
    """(T, N, 2) horizontal position of the torso in the world [m]."""
    arm_error: torch.Tensor
    """(T, N, U) arm joint angles minus reference [rad]."""
    arm_velocity: torch.Tensor
    """(T, N, U) arm joint rates [rad/s]."""
    arm_torque: torch.Tensor
    """(T, N, U) [Nm]."""
    torque_share: torch.Tensor
    """(T, N, J) size of every joint's torque over its limit, the arms' last."""
    arm_static_torque: torch.Tensor
    """(T, N, U) what statics asks of the arms: nominal gravity at this pose, less what the hand's force does [Nm]."""
    hand_offset: torch.Tensor
    """(T, N, H, 3) hands relative to their reference, which the torso carries along; heading frame [m]."""
    hand_error: torch.Tensor
    """(T, N, H) its length [m]."""
    foot_contact: torch.Tensor
    """(T, N, F) bool."""
    foot_speed: torch.Tensor
    """(T, N, F) horizontal [m/s]."""
    foot_height: torch.Tensor
    """(T, N, F) of the soles' centres [m]."""
    path_error: torch.Tensor
    """(T, N) horizontal distance of the torso from where its path has it [m]; NaN in envs that follow none."""
    fell: torch.Tensor
    """(T, N) bool: the env fell in that step."""
    film: torch.Tensor = field(default_factory=lambda: torch.zeros(0, 0))
    """(F, nq + 6 H) the first env's configuration, its hands' references and the force on each hand, world frame;
    F = T for rollouts in simulation, else 0."""

    def alive(self) -> torch.Tensor:
        """(T, N) bool: the env has not fallen up to and including this step."""
        return self.fell.cumsum(0) == 0


STEPPED = tuple(f.name for f in fields(Trajectory) if f.name not in ("dt", "film"))
"""What a trajectory has of every step and env."""


def record_rollout(
    env: HumanoidEnv, policy: PolicyFunction, steps: int, progress: bool = True,
    before_step: Callable[[HumanoidEnv, int], None] | None = None,
) -> Trajectory:  # fmt: skip
    """Run `policy` for `steps` control steps from a fresh start of every env.

    What an env draws does not depend on who falls: two rollouts of one seed compare env by env.

    Args:
        env: The envs.
        policy: Actions of observations, on the envs' device; what is recorded is on the CPU.
        steps: Number of control steps.
        progress: Whether to show a progress bar.
        before_step: Called before every step with the environment and the step's number: commands, parameters of laws.

    Raises:
        ValueError: there is no memory for the record, and for measures of it, which take as much again.
    """
    env.redraws = True  # should a rollout have been broken off
    obs = env.reset()
    env.redraws = False
    record: dict[str, torch.Tensor] = {}
    frames: list[torch.Tensor] = []
    for step in tqdm(range(steps), desc="rollout", unit="step", disable=None if progress else True, leave=False):
        if before_step:
            before_step(env, step)
        obs, _, _, extras = env.step(policy(as_dict(obs, env.device)))
        row = trajectory_row(env, extras["falls"])
        if step == 0:
            needed = 2 * steps * sum(value.numel() * value.element_size() for value in row.values())
            require_memory(f"a record of {steps} steps of {env.num_envs} envs", needed)
        for name, value in row.items():
            record.setdefault(name, value.new_empty((steps, *value.shape)))[step] = value
        frames.append(picture_row(env))
    env.redraws = True
    return Trajectory(
        dt=env.dt, film=torch.stack(frames).cpu(), **{name: value.cpu() for name, value in record.items()}
    )


def picture_row(env: HumanoidEnv) -> torch.Tensor:
    """What a picture of the first env needs, a row (nq + 6 H,) of a film."""
    hands_t = env.record.key_points_reference_t[0, : len(env.spec.arms)]
    return film_row(env.sim.qpos[0], env.record.state, hands_t, env.hand_force_w[0])


def film_row(qpos: torch.Tensor, s: RobotState, hands_t: torch.Tensor, force_w: torch.Tensor) -> torch.Tensor:
    """A row (nq + 6 H,) of a film: first env of `s`, at `qpos` (nq,), its hands' references (H, 3), torso frame [m],
    and the forces (H, 3) on its hands, world frame [N]."""
    hands_w = hands_t @ s.torso_rotation_w[0].T + s.torso_pos_w[0]
    return torch.cat((qpos, hands_w.flatten(), force_w.flatten())).float()


def reference_actions(env: HumanoidEnv) -> torch.Tensor:
    """Actions (N, U) of the arms' joints that send them to their raw reference; absolute ones to where it is now, which
    is one step late."""
    upper, targets = slice(env.num_lower, None), env.joint_targets
    reference = env.motions.current().position
    if env.cfg.actions.upper_mode == "residual":
        return torch.zeros_like(reference)
    return (reference - targets.default[upper]) / targets.scale[upper]


def upper_share(upper_actions: str) -> float:
    """The share of the policy's own arm actions that acts: 1 for `policy`, 0 for `reference`, or a number between.

    Raises:
        ValueError: it is neither.
    """
    if upper_actions in UPPER_ACTIONS:
        return float(upper_actions == "policy")
    try:
        share = float(upper_actions)
    except ValueError as error:
        known = f"{', '.join(UPPER_ACTIONS)} or a share from 0 to 1"
        raise ValueError(f"upper_actions {quoted(upper_actions)} is unknown; known: {known}") from error
    return require_range("upper_actions", share, 0.0, 1.0)


def acting(env: HumanoidEnv, policy: PolicyFunction, upper_actions: str) -> PolicyFunction:
    """`policy` as it is, or with that `upper_share` of what its upper actions add to the arms' raw reference; what it
    asks of the arms' laws stays. A robot whose base is held has no policy."""
    if env.cfg.fixed_base:
        return idle(env)
    share = upper_share(upper_actions)
    if share == 1.0:
        return policy

    def act(observations: dict[str, torch.Tensor]) -> torch.Tensor:
        reference = reference_actions(env)
        ends = (env.num_lower, env.num_lower + reference.shape[1])
        lower, arms, laws = policy(observations).tensor_split(ends, 1)
        return torch.cat((lower, torch.lerp(reference, arms, share), laws), 1)

    return act


def idle(env: HumanoidEnv) -> PolicyFunction:
    """A policy that leaves the legs in their default pose and sends the arms to their reference, under the laws as they
    are configured."""
    legs = torch.zeros(env.num_envs, env.num_lower, device=env.device)
    laws = torch.zeros(env.num_envs, env.upper_body.modulation.size, device=env.device)
    return lambda _: torch.cat((legs, reference_actions(env), laws), 1)


def arm_static_torque(arms: Arms, s: RobotState, force_w: torch.Tensor) -> torch.Tensor:
    """Torque (N, U) [Nm] that holds the arms still under gravity and forces (N, A, 3) on the hands, world frame [N]."""
    held = gravity_torque(arms.inertias, s.arms, s.torso_rotation_w[:, 2])
    force_t = rotate_inverse(s.torso_rotation_w.unsqueeze(1), force_w)
    return (held - rotate_inverse(arms.chains.jacobian(s.arms), force_t)).flatten(1)


def trajectory_row(env: HumanoidEnv, fell: torch.Tensor) -> dict[str, torch.Tensor]:
    """One step's row (N, ...) of a `Trajectory`, just after `env.step`; `fell` (N,) from its extras."""
    r = env.record
    offset_t = (r.key_points_t - r.key_points_reference_t)[:, : len(env.spec.arms)]
    path_error = (r.state.torso_pos_w[:, :2] - env.path.target_w).norm(dim=1)
    return state_row(
        r.state, env.commands, r.reference.position, r.torque, env.actuation.torque_limit, offset_t, env.hand_force_w,
        env.upper_body.arms, torch.where(env.path.active, path_error, math.nan), fell,
    )  # fmt: skip


def state_row(
    s: RobotState, commands: CommandSource, reference: torch.Tensor, torque: torch.Tensor, torque_limit: torch.Tensor,
    offset_t: torch.Tensor, force_w: torch.Tensor, arms: Arms, path_error: torch.Tensor, fell: torch.Tensor,
) -> dict[str, torch.Tensor]:  # fmt: skip
    """A row (N, ...) of a `Trajectory`.

    Args:
        s: At the end of the step.
        commands: What was asked for.
        reference: (N, U) where the arms were to be [rad].
        torque: (N, J) [Nm].
        torque_limit: (J,) [Nm].
        offset_t: (N, H, 3) hands relative to their reference, torso frame [m].
        force_w: (N, H, 3) on the hands, world frame [N].
        arms: What statics takes the arms for.
        path_error: (N,) as a `Trajectory` has it [m].
        fell: (N,) bool.
    """
    upper = slice(-reference.shape[1], None)
    return {
        "velocity": torch.cat((s.torso_linear_velocity_h[:, :2], s.yaw_rate.unsqueeze(1)), 1),
        "command": commands.asked_velocity.clone(),
        "stand": commands.asked_to_stand,
        "height": s.height,
        "height_command": commands.asked_height.clone(),
        "position": s.torso_pos_w[:, :2],
        "arm_error": s.joint_pos[:, upper] - reference,
        "arm_velocity": s.joint_vel[:, upper],
        "arm_torque": torque[:, upper],
        "torque_share": torque.abs() / torque_limit,
        "arm_static_torque": arm_static_torque(arms, s, force_w),
        "hand_offset": offset_t @ s.torso_to_heading.transpose(1, 2),
        "hand_error": offset_t.norm(dim=2),
        "foot_contact": s.foot_contact,
        "foot_speed": s.foot_velocity_w[:, :, :2].norm(dim=2),
        "foot_height": s.foot_pos_w[:, :, 2],
        "path_error": path_error,
        "fell": fell,
    }
