"""From actions to joint targets: what policies learn, on top of what is fed forward."""

from __future__ import annotations

from dataclasses import dataclass

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco
import torch

from cotap.checks import require_one_of, require_range
from cotap.envs.commands import Command, CommandConfig
from cotap.envs.gait import StepMotion
from cotap.envs.stance import StanceBalance
from cotap.robots import RobotSpec

SPIN_RAD_S = 1.0
"""What walking itself adds to the yaw rate: up to here the waist resists, beyond it gives way."""
LARGEST_TURN_RAD = 0.5
"""How far the waist's target runs ahead at most."""


@dataclass
class ActionConfig:
    """How actions become joint targets."""

    lower_scale: float = 0.25
    """Radians per unit of lower action, added to the default pose."""
    twist_scale: float = 0.1
    """The same of the joints that turn about the vertical, hip yaw and waist: less, so that exploring shakes less."""
    step_lift: float = 1.0
    """Share of the swinging foot's lift that the gait clock feeds forward to the legs; 0 leaves it to the policy."""
    step_stride: float = 1.0
    """Share of the feet's sweep at the commanded velocity that is fed forward; 0 leaves it to the policy."""
    stance_balance: float = 1.0
    """Share of the standing pose and the feedback that balances it that are fed forward; 0 leaves it to the policy."""
    upper_scale: float = 0.1
    """Radians per unit of upper action, added to the reference (residual) or to the default pose (absolute)."""
    reference_lead_s: float = 0.03
    """How far ahead of the arms' reference their targets run [s]: what damping and delay hold back."""
    upper_mode: str = "residual"
    """residual (FALCON) or absolute (the paper)."""
    clip: float = 20.0
    """Largest magnitude of an action."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("actions.lower_scale", self.lower_scale, 0.0, 10.0)
        require_range("actions.step_lift", self.step_lift, 0.0, 2.0)
        require_range("actions.step_stride", self.step_stride, 0.0, 2.0)
        require_range("actions.stance_balance", self.stance_balance, 0.0, 2.0)
        require_range("actions.twist_scale", self.twist_scale, 0.0, 10.0)
        require_range("actions.upper_scale", self.upper_scale, 0.0, 10.0)
        require_range("actions.reference_lead_s", self.reference_lead_s, 0.0, 1.0)
        require_range("actions.clip", self.clip, 1e-3, 1e6)
        require_one_of("actions.upper_mode", self.upper_mode, ("residual", "absolute"))


class JointTargets:
    """Default pose plus scaled action, plus steps by the gait clock, plus the feedback that stands, plus the arms'
    reference.

    A function of what an observation holds and of nothing else, so that an exported policy can contain it.
    """

    def __init__(self, cfg: ActionConfig, spec: RobotSpec, model: mujoco.MjModel, commands: CommandConfig) -> None:
        cfg.check()
        self.cfg = cfg
        self.default = torch.tensor([j.default_rad for j in spec.joints])
        """(J,) [rad]."""
        self.num_lower = len(spec.lower_joints)
        self.steps = StepMotion(
            spec, model, commands.gait_period_s, cfg.step_lift, cfg.step_stride, commands.step_apart_m,
            commands.step_clear_m, commands.step_hold_back_m, commands.step_catch_lift, commands.step_roll_damping_s,
            commands.step_twist_damping_s, commands.step_straighten_rad,
        )  # fmt: skip
        waist = [body.joint or "" for body in spec.chain(spec.torso_body, spec.base_body)]
        self.waist = spec.indices(waist)
        """Joints that turn the torso."""
        self._waist_yield_s, self._waist_damping_s = commands.waist_yield_s, commands.waist_damping_s
        self.stance = StanceBalance(spec, model)
        twists = [j.axis == (0.0, 0.0, 1.0) for j in spec.joints]
        self.scale = torch.tensor([cfg.twist_scale if twist else cfg.lower_scale for twist in twists])
        """(J,) radians per unit of action."""
        self.scale[self.num_lower :] = cfg.upper_scale

    def __call__(
        self, action: torch.Tensor, command: Command, joint_pos: torch.Tensor, joint_vel: torch.Tensor,
        projected_gravity: torch.Tensor, angular_velocity: torch.Tensor, arm_position: torch.Tensor,
    ) -> torch.Tensor:  # fmt: skip
        """Joint targets (N, J) [rad].

        Args:
            action: (N, J).
            command: What is commanded, and the gait's phase.
            joint_pos: (N, J) [rad].
            joint_vel: (N, J) [rad/s].
            projected_gravity: (N, 3) unit vector in the torso frame.
            angular_velocity: (N, 3) of the torso, in its frame [rad/s].
            arm_position: (N, U) what residual actions are added to [rad].
        """
        target = self.default + self.scale * action
        step = self.steps(command.phase, command.velocity_h, command.yaw_rate)
        step = step + self.steps.giving_way(command.phase, joint_pos, joint_vel)
        step = step + self.steps.holding_back(command.phase, projected_gravity)
        step = step + self.steps.catching(command.phase, projected_gravity)
        step = step + self.steps.damping(joint_vel)
        target[:, self.steps.joints] += (1.0 - command.stand)[:, None, None] * step
        if self._waist_yield_s > 0.0 or self._waist_damping_s > 0.0:
            target[:, self.waist] += self._waist_turn(command, projected_gravity, angular_velocity).unsqueeze(1)
        legs = self.stance.joints
        stance = self.stance(command.height, joint_pos, joint_vel, projected_gravity, angular_velocity)
        share = self.cfg.stance_balance * command.stand[:, None, None]
        target[:, legs] += share * (stance.unsqueeze(1) - self.default[legs])
        if self.cfg.upper_mode == "residual":
            upper = slice(self.num_lower, None)
            target[:, upper] += arm_position - self.default[upper]
        return target

    def _waist_turn(
        self, command: Command, projected_gravity: torch.Tensor, angular_velocity: torch.Tensor
    ) -> torch.Tensor:
        """How far (N,) [rad] the waist turns against what shakes the torso, and with what throws it around.

        Damping the torso in the world keeps the sway of steps and the arms' reaction from it. It fades up to
        `SPIN_RAD_S`: a blow would throw the whole robot around, so the waist gives way and feet need not take all at
        once.
        """
        yaw_rate = -(projected_gravity * angular_velocity).sum(1)
        spin = yaw_rate - command.yaw_rate
        slow = spin.clamp(-SPIN_RAD_S, SPIN_RAD_S)
        resisted = slow * (1.0 - slow.abs() / SPIN_RAD_S)
        turn = self._waist_yield_s * (spin - slow) - self._waist_damping_s * resisted
        return turn.clamp(-LARGEST_TURN_RAD, LARGEST_TURN_RAD)
