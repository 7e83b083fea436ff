"""Rewards of the two agents: each term a pure function of one step's record, weighted by a field of its name.

Terms are rates: the environment multiplies them by the control step, except `fall`, which is paid once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch

from cotap.checks import require_finite
from cotap.envs.commands import Command
from cotap.envs.load_sense import COM_HEIGHT_M
from cotap.envs.motions import ArmReference
from cotap.envs.state import RobotState
from cotap.rotations import rotate


@dataclass(frozen=True)
class StepRecord:
    """All that rewards may depend on. N worlds, J joints of which L lower and U upper, F feet, P key points."""

    state: RobotState
    command: Command
    reference: ArmReference
    action: torch.Tensor
    """(N, J) this step's action."""
    last_action: torch.Tensor
    """(N, J) the action before it."""
    joint_acceleration: torch.Tensor
    """(N, J) mean over the step [rad/s^2]."""
    torque: torch.Tensor
    """(N, J) joint torques at the end of the step [Nm]."""
    arm_target: torch.Tensor
    """(N, U) joint targets that this step's action sent to the arms [rad]."""
    desired_contact: torch.Tensor
    """(N, F) bool."""
    swing: torch.Tensor
    """(N, F) progress through the swing, 0 in stance."""
    key_points_t: torch.Tensor
    """(N, P, 3) hands and elbows in the torso frame [m]."""
    key_points_reference_t: torch.Tensor
    """(N, P, 3) where the reference puts them."""
    key_velocities_t: torch.Tensor
    """(N, P, 3) [m/s]."""
    key_velocities_reference_t: torch.Tensor
    """(N, P, 3) [m/s]."""
    mean_error: torch.Tensor
    """(N, 3) horizontal velocity [m/s] and yaw rate [rad/s] minus their commands, averaged over about half a stride."""
    load_tilt: torch.Tensor
    """(N, 2) by how much loads tilt the vertical that a robot should go by, x and y of the torso frame [rad]."""
    fell: torch.Tensor
    """(N,) bool: the episode ends in a fall."""
    joint_low: torch.Tensor
    """(J,) soft lower limits [rad]."""
    joint_high: torch.Tensor
    """(J,) soft upper limits [rad]."""
    num_lower: int
    """L; the first L joints are the lower agent's."""
    default_position: torch.Tensor
    """(J,) [rad]."""
    sideways: tuple[int, ...]
    """Joints that straight walking does not need (hip yaw and roll, waist), penalised for leaving their default."""


@dataclass
class LowerRewards:
    """Weights of the lower agent's terms [1/s]; 0 switches a term off."""

    track_velocity: float = 1.5
    track_velocity_closely: float = 1.5
    track_mean_velocity: float = 2.0
    track_yaw_rate: float = 0.6
    track_yaw_rate_closely: float = 1.5
    track_mean_yaw_rate: float = 0.8
    track_height: float = 0.75
    track_height_widely: float = 0.4
    balance: float = 0.75
    upright: float = -15.0
    vertical_velocity: float = -1.0
    roll_pitch_rate: float = -0.3
    spin: float = 0.0
    contact_schedule: float = 1.0
    swing_height: float = -15.0
    foot_slip: float = -1.0
    foot_flat: float = -0.3
    foot_yaw: float = -0.5
    feet_apart: float = -5.0
    sideways_joints: float = -0.4
    stand_still: float = -1.0
    lower_torque: float = -1e-5
    lower_acceleration: float = -2e-7
    lower_action_rate: float = -0.01
    lower_joint_limits: float = -5.0
    alive: float = 0.3
    fall: float = -2.0


@dataclass
class UpperRewards:
    """Weights of the upper agent's terms [1/s]; 0 switches a term off."""

    track_arms: float = 1.0
    track_key_points: float = 1.0
    track_key_velocities: float = 0.3
    track_hands_as_facet: float = 0.0
    steady_torso: float = 0.0
    arm_residual: float = -0.02
    upper_torque: float = -2e-5
    upper_acceleration: float = -1e-7
    upper_action_rate: float = -0.02
    upper_joint_limits: float = -5.0
    stay_close: float = 0.0
    alive: float = 0.1
    fall: float = -0.5


def velocity_error(s: StepRecord) -> torch.Tensor:
    """Squared error of the horizontal torso velocity in the heading frame [m^2/s^2]."""
    return (s.command.velocity_h - s.state.torso_linear_velocity_h[:, :2]).square().sum(1)


def track_velocity(s: StepRecord) -> torch.Tensor:
    """Wide kernel: gives a direction to follow from far away."""
    return torch.exp(-velocity_error(s) / 0.25)


def track_velocity_closely(s: StepRecord) -> torch.Tensor:
    """Narrow kernel: rewards the last tenth of a metre per second."""
    return torch.exp(-velocity_error(s) / 0.04)


def track_mean_velocity(s: StepRecord) -> torch.Tensor:
    """Velocity averaged over about half a stride: what sways with every step is no reason to walk too slowly."""
    return torch.exp(-s.mean_error[:, :2].square().sum(1) / 0.015)


def track_yaw_rate(s: StepRecord) -> torch.Tensor:
    """Angular velocity about the vertical against its command, wide kernel."""
    return torch.exp(-(s.command.yaw_rate - s.state.yaw_rate).square())


def track_yaw_rate_closely(s: StepRecord) -> torch.Tensor:
    """As above, narrow kernel."""
    return torch.exp(-(s.command.yaw_rate - s.state.yaw_rate).square() / 0.06)


def track_mean_yaw_rate(s: StepRecord) -> torch.Tensor:
    """Yaw rate averaged over about half a stride."""
    return torch.exp(-s.mean_error[:, 2].square() / 0.02)


def track_height(s: StepRecord) -> torch.Tensor:
    """Height of the torso link against its command."""
    return torch.exp(-(s.command.height - s.state.height).square() / 0.0025)


def track_height_widely(s: StepRecord) -> torch.Tensor:
    """As above, wide kernel: a direction to follow from 0.2 m away."""
    return torch.exp(-(s.command.height - s.state.height).square() / 0.04)


def balance(s: StepRecord) -> torch.Tensor:
    """While standing, closeness of where the torso is heading to to the middle of the feet.

    Where it is heading to is its capture point, position plus velocity times the time constant of falling (0.3 s).
    Under loads that point belongs where the robot leans against them.
    """
    ahead_h = 0.3 * s.state.torso_linear_velocity_h + COM_HEIGHT_M * torch.nn.functional.pad(s.load_tilt, (0, 1))
    heading_to = s.state.torso_pos_w[:, :2] + rotate(s.state.heading_w, ahead_h)[:, :2]
    middle = s.state.foot_pos_w[:, :, :2].mean(1)
    return s.command.stand * torch.exp(-(heading_to - middle).square().sum(1) / 0.01)


def upright(s: StepRecord) -> torch.Tensor:
    """Squared sine of the torso's tilt, from the vertical that loads ask for."""
    return (s.state.projected_gravity_t[:, :2] + s.load_tilt).square().sum(1)


def vertical_velocity(s: StepRecord) -> torch.Tensor:
    """Squared vertical velocity of the torso."""
    return s.state.torso_linear_velocity_h[:, 2].square()


def roll_pitch_rate(s: StepRecord) -> torch.Tensor:
    """Squared angular velocity of the torso about its horizontal axes."""
    return s.state.torso_angular_velocity_t[:, :2].square().sum(1)


def spin(s: StepRecord) -> torch.Tensor:
    """How far beyond 0.5 rad/s the yaw rate is off, at most 3: a way back from where its kernels are flat."""
    return ((s.command.yaw_rate - s.state.yaw_rate).abs() - 0.5).clamp(0.0, 3.0)


def contact_schedule(s: StepRecord) -> torch.Tensor:
    """Share of feet that are on the ground, or off it, as the gait's phase asks."""
    return (s.state.foot_contact == s.desired_contact).float().mean(1)


def swing_clearance(swing: torch.Tensor, peak_m: float = 0.10) -> torch.Tensor:
    """Height that a sole should have at `swing` progress: a smooth bump [m]."""
    return peak_m * torch.sin(torch.pi * swing).square()


def swing_height(s: StepRecord) -> torch.Tensor:
    """Error of the swinging soles' height [m]; linear, so that the first centimetre is worth as much as the last."""
    error = s.state.foot_pos_w[:, :, 2] - swing_clearance(s.swing)
    return (error.abs() * ~s.desired_contact).sum(1)


def foot_slip(s: StepRecord) -> torch.Tensor:
    """Horizontal speed of the feet that are in contact."""
    return (s.state.foot_velocity_w[:, :, :2].norm(dim=2) * s.state.foot_contact).sum(1)


def foot_flat(s: StepRecord) -> torch.Tensor:
    """Squared sine of the soles' tilt."""
    return s.state.foot_up_w[:, :, :2].square().sum((1, 2))


def foot_yaw(s: StepRecord) -> torch.Tensor:
    """Squared sine of the angle between the feet and the heading."""
    lateral = s.state.heading_w[:, None, :2, 1]
    return (s.state.foot_forward_w[:, :, :2] * lateral).sum(2).square().sum(1)


def feet_apart(s: StepRecord) -> torch.Tensor:
    """By how much the first two feet are closer than 0.18 m to each other sideways [m]."""
    between = s.state.foot_pos_w[:, 0, :2] - s.state.foot_pos_w[:, 1, :2]
    distance = (between * s.state.heading_w[:, :2, 1]).sum(1)
    return (0.18 - distance).clamp(0.0, 0.3)


def sideways_joints(s: StepRecord) -> torch.Tensor:
    """Squared deviation of hip yaw, hip roll and waist from their default."""
    ids = list(s.sideways)
    return (s.state.joint_pos[:, ids] - s.default_position[ids]).square().sum(1)


def stand_still(s: StepRecord) -> torch.Tensor:
    """Horizontal speed of the torso plus a little joint speed, while standing."""
    speed = s.state.torso_linear_velocity_h[:, :2].norm(dim=1)
    return s.command.stand * (speed + 0.01 * s.state.joint_vel[:, : s.num_lower].square().sum(1))


def _limit_excess(s: StepRecord, joints: slice) -> torch.Tensor:
    q = s.state.joint_pos[:, joints]
    return ((s.joint_low[joints] - q).clamp_min(0.0) + (q - s.joint_high[joints]).clamp_min(0.0)).sum(1)


def lower_torque(s: StepRecord) -> torch.Tensor:
    """Squared torques of the lower joints."""
    return s.torque[:, : s.num_lower].square().sum(1)


def lower_acceleration(s: StepRecord) -> torch.Tensor:
    """Squared accelerations of the lower joints."""
    return s.joint_acceleration[:, : s.num_lower].square().sum(1)


def lower_action_rate(s: StepRecord) -> torch.Tensor:
    """Squared change of the lower action."""
    return (s.action - s.last_action)[:, : s.num_lower].square().sum(1)


def lower_joint_limits(s: StepRecord) -> torch.Tensor:
    """By how much lower joints exceed their soft limits [rad]."""
    return _limit_excess(s, slice(0, s.num_lower))


def alive(s: StepRecord) -> torch.Tensor:
    """One for every step that is not a fall."""
    return (~s.fell).float()


def fall(s: StepRecord) -> torch.Tensor:
    """One when the episode ends in a fall."""
    return s.fell.float()


def track_arms(s: StepRecord) -> torch.Tensor:
    """Arm joint angles against the reference."""
    error = s.state.joint_pos[:, s.num_lower :] - s.reference.position
    return torch.exp(-error.square().sum(1) / 0.06)


def track_key_points(s: StepRecord) -> torch.Tensor:
    """Hands and elbows against the reference, carried in the torso frame (paper, appendices A and B)."""
    return torch.exp(-(s.key_points_t - s.key_points_reference_t).square().sum((1, 2)) / 0.01)


def track_key_velocities(s: StepRecord) -> torch.Tensor:
    """Velocities of hands and elbows in the torso frame against the reference's."""
    return torch.exp(-(s.key_velocities_t - s.key_velocities_reference_t).square().sum((1, 2)))


def track_hands_as_facet(s: StepRecord) -> torch.Tensor:
    """FACET's reward: position and velocity of each hand against the reference, mean over hands (paper, appendix D).

    On the data's own motion, as the paper trains it: the reference is not moved by forces.
    """
    hands = s.key_points_t.shape[1] // 2  # as many elbows follow
    position = (s.key_points_reference_t - s.key_points_t)[:, :hands].square().sum(-1)
    velocity = (s.key_velocities_reference_t - s.key_velocities_t)[:, :hands].square().sum(-1)
    return torch.exp(-velocity - position).mean(1)


def steady_torso(s: StepRecord) -> torch.Tensor:
    """The torso's yaw rate against its command, for the arms: what they swing, the torso is turned by."""
    return track_yaw_rate_closely(s)


def arm_residual(s: StepRecord) -> torch.Tensor:
    """Squared residual action of the arms."""
    return s.action[:, s.num_lower :].square().sum(1)


def upper_torque(s: StepRecord) -> torch.Tensor:
    """Squared torques of the arms."""
    return s.torque[:, s.num_lower :].square().sum(1)


def upper_acceleration(s: StepRecord) -> torch.Tensor:
    """Squared accelerations of the arm joints."""
    return s.joint_acceleration[:, s.num_lower :].square().sum(1)


def upper_action_rate(s: StepRecord) -> torch.Tensor:
    """Squared change of the arms' residual action."""
    return (s.action - s.last_action)[:, s.num_lower :].square().sum(1)


def stay_close(s: StepRecord) -> torch.Tensor:
    """Closeness of the arms' joint targets to their reference (paper, section III-D); for distillation."""
    return torch.exp(-2.0 * (s.arm_target - s.reference.position).norm(dim=1))


def upper_joint_limits(s: StepRecord) -> torch.Tensor:
    """By how much arm joints exceed their soft limits [rad]."""
    return _limit_excess(s, slice(s.num_lower, None))


def check_weights(name: str, weights: LowerRewards | UpperRewards) -> None:
    """Raise ValueError naming the first weight of the group `name` that is not finite."""
    for f in fields(weights):
        require_finite(f"rewards.{name}.{f.name}", getattr(weights, f.name))


TERMS: dict[str, Callable[[StepRecord], torch.Tensor]] = {
    term.__name__: term
    for term in (
        track_velocity,
        track_velocity_closely,
        track_mean_velocity,
        track_yaw_rate,
        track_yaw_rate_closely,
        track_mean_yaw_rate,
        track_height,
        track_height_widely,
        balance,
        upright,
        vertical_velocity,
        roll_pitch_rate,
        spin,
        contact_schedule,
        swing_height,
        foot_slip,
        foot_flat,
        foot_yaw,
        feet_apart,
        sideways_joints,
        stand_still,
        lower_torque,
        lower_acceleration,
        lower_action_rate,
        lower_joint_limits,
        alive,
        fall,
        track_arms,
        track_key_points,
        track_key_velocities,
        track_hands_as_facet,
        steady_torso,
        arm_residual,
        upper_torque,
        upper_acceleration,
        upper_action_rate,
        upper_joint_limits,
        stay_close,
    )
}
"""Every term, by the name of its weight."""


ONCE = ("fall",)
"""Terms that are not rates."""


class RewardGroup:
    """The weighted sum of one agent's terms."""

    def __init__(self, name: str, weights: LowerRewards | UpperRewards, dt: float) -> None:
        check_weights(name, weights)
        self.name = name
        chosen = {f.name: getattr(weights, f.name) for f in fields(weights) if getattr(weights, f.name) != 0.0}
        self.terms: dict[str, Callable[[StepRecord], torch.Tensor]] = {name: TERMS[name] for name in chosen}
        """Those whose weight is not zero, by name."""
        shares = [weight * (1.0 if name in ONCE else dt) for name, weight in chosen.items()]
        self._weights = torch.tensor(shares).unsqueeze(1)

    def __call__(self, record: StepRecord) -> tuple[torch.Tensor, torch.Tensor]:
        """Total reward (N,) of a step, and the weighted terms (K, N) in the order of `terms`."""
        values = torch.stack([term(record) for term in self.terms.values()]) * self._weights
        return values.sum(0), values
