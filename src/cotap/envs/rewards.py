"""Rewards of the two agents. A term is written once: a function of the step's record, with its weight above it.

Terms are rates: the environment multiplies them by the control step, except `fall`, which is paid once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any, TypeVar, cast

import torch
import tyro

# Terms stand in the classes of their weights, and are functions of a step's record, no methods.
# pyright: reportGeneralTypeIssues=false
from cotap.checks import require_finite
from cotap.envs.commands import Command
from cotap.envs.scales import RobotScales
from cotap.envs.state import RobotState
from cotap.motions.generator import ArmReference
from cotap.rotations import rotate


@dataclass(frozen=True)
class StepRecord:
    """All that rewards may depend on. N envs, J joints, F feet, P key points."""

    state: RobotState
    command: Command
    reference: ArmReference
    action: torch.Tensor
    """(N, J) this step's action; with learned modulation (N, J + M), what is asked of the laws behind."""
    last_action: torch.Tensor
    """The action before it."""
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
    """(N, P, 3) relative to the torso, in its frame [m/s]."""
    key_velocities_reference_t: torch.Tensor
    """(N, P, 3) [m/s]."""
    mean_error: torch.Tensor
    """(N, 3) horizontal velocity [m/s] and yaw rate [rad/s] minus their commands, averaged over the last stride."""
    fell: torch.Tensor
    """(N,) bool: the episode ends in a fall."""
    hand_force_w: torch.Tensor
    """(N, H, 3) force on each hand during the step, world frame [N]."""
    hand_push_w: torch.Tensor
    """(N, H, 3) what of that is a push."""
    compliant_arms: torch.Tensor
    """(N, H) bool: the arm's law commands a stiffness of the hand."""
    scales: RobotScales

    @cached_property
    def free_hands(self) -> torch.Tensor:
        """(N, H) bool: no force acts on the hand."""
        return ~self.hand_force_w.any(2)

    @cached_property
    def tracking_arms(self) -> torch.Tensor:
        """(N, H) bool: the arm is asked to be at its reference. One that is compliant and under a force is not: it
        would be paid for being stiffer than its law."""
        return self.free_hands | ~self.compliant_arms

    @property
    def loaded_hands(self) -> torch.Tensor:
        """(N, H) bool: a load acts on the hand, and no push."""
        return self.hand_force_w.any(2) & ~self.hand_push_w.any(2)

    @property
    def pushed_hands(self) -> torch.Tensor:
        """(N, H) bool: a push acts on the hand, and no load."""
        return self.hand_push_w.any(2) & (self.hand_force_w == self.hand_push_w).all(2)


TermFunction = Callable[[StepRecord], torch.Tensor]


@dataclass(frozen=True)
class Term:
    """A reward term: what is rewarded, and its weight by default."""

    function: TermFunction
    weight: float
    once: bool


def term(weight: float, once: bool = False) -> Callable[[TermFunction], float]:
    """Declare the function below as a term of its group, with this weight [1/s]; `once` for what is no rate.

    What it declares is, after `reward_group`, a field of the group's config that holds the weight.
    """
    return lambda function: cast(float, Term(function, weight, once))


_Group = TypeVar("_Group")


def reward_group(cls: type[_Group]) -> type[_Group]:
    """Make a class of terms a dataclass of their weights; the functions are in its `TERMS`, by name, and so are those
    of the group that it derives from."""
    terms = {name: value for name, value in vars(cls).items() if isinstance(value, Term)}
    for name, declared in terms.items():
        text = (declared.function.__doc__ or "").strip()
        cls.__annotations__[name] = Annotated[float, tyro.conf.arg(help=text)]
        setattr(cls, name, declared.weight)
    cls.TERMS = getattr(cls, "TERMS", {}) | terms  # pyright: ignore[reportAttributeAccessIssue]
    return dataclass(cls)


def _velocity_error(s: StepRecord) -> torch.Tensor:
    """Squared error of the horizontal torso velocity in the heading frame [m^2/s^2]."""
    return (s.command.velocity_h - s.state.torso_linear_velocity_h[:, :2]).square().sum(1)


def _on_course(s: StepRecord) -> torch.Tensor:
    """1 at the commanded velocity, towards 0 far off it. It scales the terms of the gait's phase: a pushed robot needs
    steps that no phase has, and some that were rewarded for the phase regardless stood on one leg and fell."""
    return torch.exp(-_velocity_error(s) / 0.25)


def _linear(error: torch.Tensor, none_at: float) -> torch.Tensor:
    """One where there is no error, none at `none_at`, and minus one from twice that on. Without this bound, robots that
    step to catch themselves lose more, and the H1 fell more often when pushed (one training each)."""
    return 1.0 - (error / none_at).clamp_max(2.0)


def _limit_excess(s: StepRecord, joints: slice) -> torch.Tensor:
    """By how much joints exceed their soft limits [rad]."""
    q, low, high = s.state.joint_pos[:, joints], s.scales.joint_low[joints], s.scales.joint_high[joints]
    return ((low - q).clamp_min(0.0) + (q - high).clamp_min(0.0)).sum(1)


def _of_tracking_arms(s: StepRecord, error: torch.Tensor) -> torch.Tensor:
    """Squared error (N,) of key points (N, P, 3), hands then elbows, of arms that are to be at their reference."""
    arms, squared = s.tracking_arms, error.square().sum(2)
    return (squared * arms.repeat(1, squared.shape[1] // arms.shape[1])).sum(1)


def _lower(s: StepRecord) -> slice:
    return slice(0, s.scales.num_lower)


def _upper(s: StepRecord) -> slice:
    return slice(s.scales.num_lower, None)


def _hand_offset(s: StepRecord) -> torch.Tensor:
    """Hands (N, H, 3) relative to their reference, which the torso carries, torso frame [m]."""
    return (s.key_points_t - s.key_points_reference_t)[:, : s.hand_push_w.shape[1]]


def _sole_height(swing: torch.Tensor, peak_m: float) -> torch.Tensor:
    """Height that a sole should have at `swing` progress: a smooth bump of height `peak_m` [m]."""
    return peak_m * torch.sin(torch.pi * swing).square()


@reward_group
class LowerRewards:
    """Weights of the lower agent's terms [1/s]; 0 switches a term off."""

    @term(4.0)
    def track_velocity(s: StepRecord) -> torch.Tensor:
        """Velocity against its command, wide kernel: a direction to follow from far away."""
        return _on_course(s)

    @term(1.5)
    def track_velocity_closely(s: StepRecord) -> torch.Tensor:
        """Velocity against its command, narrow kernel: the last tenth of a metre per second."""
        return torch.exp(-_velocity_error(s) / 0.04)

    @term(6.0)
    def track_mean_velocity(s: StepRecord) -> torch.Tensor:
        """Velocity averaged over a stride, so that sway costs nothing: 1 at its command, 0 where forward and leftward
        errors add up to 0.5 m/s. Linear: an exponential kernel is flat at the slow walk that training begins with, and
        a norm is flat in the smaller of the two errors."""
        return _linear(s.mean_error[:, :2].abs().sum(1), 0.5)

    @term(1.0)
    def track_yaw_rate(s: StepRecord) -> torch.Tensor:
        """Angular velocity about the vertical against its command, wide kernel."""
        return torch.exp(-(s.command.yaw_rate - s.state.yaw_rate).square())

    @term(2.0)
    def track_yaw_rate_closely(s: StepRecord) -> torch.Tensor:
        """Angular velocity about the vertical against its command, narrow kernel."""
        return torch.exp(-(s.command.yaw_rate - s.state.yaw_rate).square() / 0.06)

    @term(6.0)
    def track_mean_yaw_rate(s: StepRecord) -> torch.Tensor:
        """Yaw rate averaged over a stride, so that robots that twist with every step are paid for turning all the same:
        one at its command, none at 0.6 rad/s off."""
        return _linear(s.mean_error[:, 2].abs(), 0.6)

    @term(7.0)
    def track_height(s: StepRecord) -> torch.Tensor:
        """Height of the torso link against its command: one at it, none at 0.15 m off. Linear: a kernel is flat for
        robots that do not squat yet."""
        return _linear((s.command.height - s.state.height).abs(), 0.15)

    @term(0.75)
    def capture_point(s: StepRecord) -> torch.Tensor:
        """While standing, closeness of the torso's capture point to the middle of the feet, less the distance by which
        the default pose has the torso ahead of it."""
        ahead_h = s.scales.falling_time_s * s.state.torso_linear_velocity_h
        ahead_h = torch.cat((ahead_h[:, :1] - s.scales.torso_ahead_m, ahead_h[:, 1:]), 1)
        point = (s.state.torso_pos_w + rotate(s.state.heading_w, ahead_h))[:, :2]
        middle = s.state.foot_pos_w[:, :, :2].mean(1)
        return s.command.stand * torch.exp(-(point - middle).square().sum(1) / 0.01)

    @term(-15.0)
    def upright(s: StepRecord) -> torch.Tensor:
        """Squared sine of the torso's tilt."""
        return s.state.projected_gravity_t[:, :2].square().sum(1)

    @term(-1.0)
    def vertical_velocity(s: StepRecord) -> torch.Tensor:
        """Squared vertical velocity of the torso, up to 5 m/s: one diverging simulation would outweigh all others."""
        return s.state.torso_linear_velocity_h[:, 2].clamp(-5.0, 5.0).square()

    @term(-0.3)
    def roll_pitch_rate(s: StepRecord) -> torch.Tensor:
        """Squared angular velocity of the torso about its x and y axes, each up to 20 rad/s: one robot whose
        simulation diverges would outweigh all others."""
        return s.state.torso_angular_velocity_t[:, :2].clamp(-20.0, 20.0).square().sum(1)

    @term(7.0)
    def contact_schedule(s: StepRecord) -> torch.Tensor:
        """Share of feet that are on the ground, or off it, as the phase asks; worth less the further the velocity
        is off its command."""
        return _on_course(s) * (s.state.foot_contact == s.desired_contact).float().mean(1)

    @term(-60.0)
    def swing_height(s: StepRecord) -> torch.Tensor:
        """How far the swinging soles are above or below the height that they should have [m]; linear: the first
        centimetre is worth as much as the last. It weighs less the further the velocity is off its command."""
        # Of both signs: swings that were only kept from being too low grew to 0.16 m.
        off = _sole_height(s.swing, s.scales.foot_clearance_m) - s.state.foot_pos_w[:, :, 2]
        return _on_course(s) * (off.abs() * ~s.desired_contact).sum(1)

    @term(-5.0)
    def foot_slip(s: StepRecord) -> torch.Tensor:
        """Horizontal speed of the feet that are in contact."""
        return (s.state.foot_velocity_w[:, :, :2].norm(dim=2) * s.state.foot_contact).sum(1)

    @term(-0.3)
    def foot_flat(s: StepRecord) -> torch.Tensor:
        """Squared sine of the soles' tilt."""
        return s.state.foot_up_w[:, :, :2].square().sum((1, 2))

    @term(-0.5)
    def foot_yaw(s: StepRecord) -> torch.Tensor:
        """Squared sine of the angle between the feet and the heading."""
        lateral = s.state.heading_w[:, None, :2, 1]
        return (s.state.foot_forward_w[:, :, :2] * lateral).sum(2).square().sum(1)

    @term(-5.0)
    def feet_apart(s: StepRecord) -> torch.Tensor:
        """By how much the first two feet are too close to each other sideways [m]."""
        between = s.state.foot_pos_w[:, 0, :2] - s.state.foot_pos_w[:, 1, :2]
        distance = (between * s.state.heading_w[:, :2, 1]).sum(1)
        return (s.scales.foot_distance_m - distance).clamp(0.0, 0.3)

    @term(-0.4)
    def hip_waist_deviation(s: StepRecord) -> torch.Tensor:
        """Squared deviation from the default pose of joints of hip and waist that roll or turn."""
        ids = list(s.scales.hip_waist)
        return (s.state.joint_pos[:, ids] - s.scales.default_position[ids]).square().sum(1)

    @term(-1.0)
    def stand_still(s: StepRecord) -> torch.Tensor:
        """Horizontal speed of the torso plus a little joint speed, while standing."""
        speed = s.state.torso_linear_velocity_h[:, :2].norm(dim=1)
        return s.command.stand * (speed + 0.01 * s.state.joint_vel[:, _lower(s)].square().sum(1))

    @term(-1e-5)
    def lower_torque(s: StepRecord) -> torch.Tensor:
        """Squared torques of the lower joints."""
        return s.torque[:, _lower(s)].square().sum(1)

    @term(-2e-7)
    def lower_acceleration(s: StepRecord) -> torch.Tensor:
        """Squared accelerations of the lower joints."""
        return s.joint_acceleration[:, _lower(s)].square().sum(1)

    @term(-0.01)
    def lower_action_rate(s: StepRecord) -> torch.Tensor:
        """Squared change of the lower action."""
        return (s.action - s.last_action)[:, _lower(s)].square().sum(1)

    @term(-5.0)
    def lower_joint_limits(s: StepRecord) -> torch.Tensor:
        """By how much lower joints exceed their soft limits [rad]."""
        return _limit_excess(s, _lower(s))

    @term(0.3)
    def alive(s: StepRecord) -> torch.Tensor:
        """One for every step that is not a fall."""
        return (~s.fell).float()

    @term(-50.0, once=True)
    def fall(s: StepRecord) -> torch.Tensor:
        """One when the episode ends in a fall. At 10, giving up was worth more than a struggle to recover (G1)."""
        return s.fell.float()


@reward_group
class UpperRewards:
    """Weights of the upper agent's terms [1/s]; 0 switches a term off."""

    @term(3.0)
    def track_arms(s: StepRecord) -> torch.Tensor:
        """Closeness of joint angles to their reference, of arms under no force, or whose law commands no stiffness."""
        error = s.state.joint_pos[:, _upper(s)] - s.reference.position
        arms = s.tracking_arms
        return torch.exp(-(error.square().unflatten(1, (arms.shape[1], -1)).sum(2) * arms).sum(1) / 0.06)

    @term(1.0)
    def track_key_points(s: StepRecord) -> torch.Tensor:
        """Closeness of hands and elbows to their reference, torso frame, of the same arms (appendices A and B)."""
        return torch.exp(-_of_tracking_arms(s, s.key_points_t - s.key_points_reference_t) / 0.01)

    @term(0.3)
    def track_key_velocities(s: StepRecord) -> torch.Tensor:
        """Closeness of the velocities of hands and elbows in the world to those of their reference, which the torso
        carries, over the arms of `track_arms` (paper, appendix A)."""
        spin = s.state.torso_angular_velocity_t.unsqueeze(1)
        offset = s.key_points_t - s.key_points_reference_t
        error = s.key_velocities_t - s.key_velocities_reference_t + torch.linalg.cross(spin.expand_as(offset), offset)
        return torch.exp(-_of_tracking_arms(s, error))

    @term(0.0)
    def track_hands_as_facet(s: StepRecord) -> torch.Tensor:
        """FACET's reward: position and velocity of each hand against the reference, mean over hands (appendix D).

        On the data's own motion, as the paper trains it: the reference is not moved by forces.
        """
        hands = s.key_points_t.shape[1] // 2  # as many elbows follow
        position = (s.key_points_reference_t - s.key_points_t)[:, :hands].square().sum(-1)
        velocity = (s.key_velocities_reference_t - s.key_velocities_t)[:, :hands].square().sum(-1)
        return torch.exp(-velocity - position).mean(1)

    @term(-0.5)
    def arm_target_offset(s: StepRecord) -> torch.Tensor:
        """Squared distance of the arms' joint targets from their reference [rad^2]."""
        return (s.arm_target - s.reference.position).square().sum(1)

    @term(0.0)
    def reference_closeness(s: StepRecord) -> torch.Tensor:
        """Closeness of the arms' joint targets to their reference (paper, section III-D); for distillation."""
        return torch.exp(-2.0 * (s.arm_target - s.reference.position).norm(dim=1))

    @term(0.0)
    def free_hand_error(s: StepRecord) -> torch.Tensor:
        """Distance from the reference of hands that are free, mean over all hands [m]; for learned modulation."""
        return (_hand_offset(s).norm(dim=2) * s.free_hands).mean(1)

    @term(0.0)
    def loaded_hand_error(s: StepRecord) -> torch.Tensor:
        """Distance from the reference of hands under a load and no push, mean over all hands [m]."""
        return (_hand_offset(s).norm(dim=2) * s.loaded_hands).mean(1)

    @term(0.0)
    def push_resistance(s: StepRecord) -> torch.Tensor:
        """What hands under a push, and no load, resist it with: its force beyond that of a spring of 150 N/m, mean over
        all hands [N]."""
        push_t = s.hand_push_w @ s.state.torso_rotation_w
        force = push_t.norm(dim=2)
        given_way = (_hand_offset(s) * push_t).sum(2) / force.clamp_min(1e-6)
        return ((force - 150.0 * given_way).clamp_min(0.0) * s.pushed_hands).mean(1)

    @term(-2e-5)
    def upper_torque(s: StepRecord) -> torch.Tensor:
        """Squared torques of the arms."""
        return s.torque[:, _upper(s)].square().sum(1)

    @term(-1e-7)
    def upper_acceleration(s: StepRecord) -> torch.Tensor:
        """Squared accelerations of the arm joints."""
        return s.joint_acceleration[:, _upper(s)].square().sum(1)

    @term(-0.02)
    def upper_action_rate(s: StepRecord) -> torch.Tensor:
        """Squared change of the arm joints' actions. A penalty on actions for laws would drive them to their bounds."""
        return (s.action - s.last_action)[:, s.scales.num_lower : s.torque.shape[1]].square().sum(1)

    @term(-5.0)
    def upper_joint_limits(s: StepRecord) -> torch.Tensor:
        """By how much arm joints exceed their soft limits [rad]."""
        return _limit_excess(s, _upper(s))

    @term(0.1)
    def alive(s: StepRecord) -> torch.Tensor:
        """One for every step that is not a fall."""
        return (~s.fell).float()

    @term(-5.0, once=True)
    def fall(s: StepRecord) -> torch.Tensor:
        """One when the episode ends in a fall."""
        return s.fell.float()


class RewardGroup:
    """The weighted sum of one agent's terms.

    Args:
        name: Of the agent.
        weights: A dataclass that `reward_group` made.
        dt: Control step [s].

    Raises:
        ValueError: a weight is not finite.
    """

    def __init__(self, name: str, weights: Any, dt: float) -> None:
        check_weights(name, weights)
        self.name = name
        declared: dict[str, Term] = type(weights).TERMS
        chosen = {f.name: getattr(weights, f.name) for f in fields(weights) if getattr(weights, f.name) != 0.0}
        self.terms = {name: declared[name].function for name in chosen}
        """Those whose weight is not zero, by name."""
        shares = [weight * (1.0 if declared[name].once else dt) for name, weight in chosen.items()]
        self._weights = torch.tensor(shares).unsqueeze(1)

    def __call__(self, record: StepRecord) -> tuple[torch.Tensor, torch.Tensor]:
        """Total reward (N,) of a step, and the weighted terms (K, N) in the order of `terms`."""
        values = torch.stack([function(record) for function in self.terms.values()]) * self._weights
        return values.sum(0), values


def check_weights(name: str, weights: Any) -> None:
    """Raise ValueError naming the first weight of the group `name` that is not finite."""
    for f in fields(weights):
        require_finite(f"rewards.{name}.{f.name}", getattr(weights, f.name))
    if not any(getattr(weights, f.name) for f in fields(weights)):
        raise ValueError(f"rewards.{name} must have a weight that is not 0")
