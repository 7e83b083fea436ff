"""The record of a step: what rewards, measures and the training log are computed from."""

from __future__ import annotations

import torch

from cotap.compliance.kinematics import ChainPose
from cotap.envs.commands import Command
from cotap.envs.gait_phase import desired_contact, swing_progress
from cotap.envs.rewards import StepRecord
from cotap.envs.scales import RobotScales
from cotap.envs.state import RobotState, StateReader
from cotap.motions.elbow import elbow_index
from cotap.motions.generator import ArmReference
from cotap.persistence import Stateful
from cotap.robots import RobotSpec


class Recorder(Stateful):
    """Makes each step's record, and keeps the velocity errors of the last stride.

    Args:
        spec: The robot.
        reader: Reads its state.
        num_envs: Number of envs.
        dt: Control step [s].
        gait_period_s: Duration of a stride [s].
    """

    STATE = ("_errors",)

    def __init__(self, spec: RobotSpec, reader: StateReader, num_envs: int, dt: float, gait_period_s: float) -> None:
        self._scales, self._reader = RobotScales.of(spec), reader
        self._num_feet, self._num_arms = len(spec.feet), len(spec.arms)
        self._elbows = [elbow_index(spec, arm) for arm in spec.arms]
        self._errors = torch.zeros(num_envs, max(1, round(gait_period_s / dt)), 3)  # of each step, the newest last

    @property
    def mean_error(self) -> torch.Tensor:
        """(N, 3) velocity errors, averaged over the last stride, zero before the episode: what sways or twists with
        every step cancels out."""
        return self._errors.mean(1)

    def reset(self, mask: torch.Tensor) -> None:
        """Episodes begin in the envs of `mask` (N,)."""
        self._errors = self._errors.masked_fill(mask[:, None, None], 0.0)

    def record(
        self, s: RobotState, command: Command, reference: ArmReference, action: torch.Tensor,
        last_action: torch.Tensor, acceleration: torch.Tensor, torque: torch.Tensor, target: torch.Tensor,
        fell: torch.Tensor, hand_force_w: torch.Tensor, hand_push_w: torch.Tensor, compliant_arms: torch.Tensor,
    ) -> StepRecord:  # fmt: skip
        """The record of a step, once. Arguments are as its fields; `target` (N, J) are all joints' [rad]."""
        wanted = self._reader.arm_chains.pose(reference.position.unflatten(1, (self._num_arms, -1)))
        points, velocities = self._key_points(s.arms, self._reader.arm_joints(s.joint_vel))
        ref_points, ref_velocities = self._key_points(wanted, reference.velocity.unflatten(1, (self._num_arms, -1)))
        return StepRecord(
            state=s,
            command=command,
            reference=reference,
            action=action,
            last_action=last_action,
            joint_acceleration=acceleration,
            torque=torque,
            arm_target=target[:, self._scales.num_lower :],
            desired_contact=desired_contact(command.phase, command.stand, self._num_feet),
            swing=swing_progress(command.phase, self._num_feet),
            key_points_t=points,
            key_points_reference_t=ref_points,
            key_velocities_t=velocities,
            key_velocities_reference_t=ref_velocities,
            mean_error=self._average_error(s, command),
            fell=fell,
            hand_force_w=hand_force_w,
            hand_push_w=hand_push_w,
            compliant_arms=compliant_arms,
            scales=self._scales,
        )

    def _average_error(self, s: RobotState, c: Command) -> torch.Tensor:
        error = torch.cat((s.torso_linear_velocity_h[:, :2] - c.velocity_h, (s.yaw_rate - c.yaw_rate).unsqueeze(1)), 1)
        # An env that has diverged is about to restart; its error must not outlast it.
        error = torch.nan_to_num(error, 0.0, 0.0, 0.0).clamp(-10.0, 10.0)
        self._errors = torch.cat((self._errors[:, 1:], error.unsqueeze(1)), 1)
        return self.mean_error

    def _key_points(self, arms: ChainPose, rates: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Hands and elbows (N, 2A, 3) in the torso frame and their velocities there, for joint rates (N, A, n)."""
        elbows = torch.stack([arms.anchors[:, a, j] for a, j in enumerate(self._elbows)], 1)
        spin = arms.axes * rates.unsqueeze(-1)
        hand_velocity = torch.linalg.cross(spin, arms.tip.unsqueeze(2) - arms.anchors).sum(2)
        elbow_velocity = torch.stack(
            [
                torch.linalg.cross(spin[:, a, :j], elbows[:, a, None] - arms.anchors[:, a, :j]).sum(1)
                for a, j in enumerate(self._elbows)
            ],
            1,
        )
        return torch.cat((arms.tip, elbows), 1), torch.cat((hand_velocity, elbow_velocity), 1)


def step_log(r: StepRecord, time_out: torch.Tensor, ok: torch.Tensor | slice, dt: float) -> dict[str, torch.Tensor]:
    """What training logs of a step: errors, slopes and falls, over the envs in `ok`."""
    s, c, upper = r.state, r.command, slice(r.scales.num_lower, None)
    measured = torch.cat((s.torso_linear_velocity_h[:, :2], s.yaw_rate.unsqueeze(1)), 1)[ok]
    commanded = torch.cat((c.velocity_h, c.yaw_rate.unsqueeze(1)), 1)[ok]
    slope = (measured * commanded).sum(0) / commanded.square().sum(0).clamp_min(1e-6)
    means = {
        "/command/error_velocity": (measured - commanded)[:, :2].norm(dim=1),
        "/command/error_yaw_rate": (measured - commanded)[:, 2].abs(),
        "/command/error_height": (s.height - c.height)[ok].abs(),
        "/command/e_upper": (s.joint_pos[:, upper] - r.reference.position)[ok].norm(dim=1),
        "/command/highest_foot": s.foot_pos_w[ok][:, :, 2].amax(1),
    }
    return {name: values.mean().nan_to_num(0.0) for name, values in means.items()} | {
        "/command/slope_x": slope[0],
        "/command/slope_y": slope[1],
        "/command/slope_yaw": slope[2],
        "/command/slope_height": height_slope(s.height[ok], c.height[ok], c.stand[ok]),
        "/command/in_phase": in_phase((s.foot_contact == r.desired_contact)[ok], c.stand[ok]),
        "/episode/falls_per_s": r.fell.float().mean() / dt,
        "/episode/time_outs_per_s": time_out.float().mean() / dt,
    }


def in_phase(as_asked: torch.Tensor, stand: torch.Tensor) -> torch.Tensor:
    """Share of the feet (N, F) of walking robots that rest or swing as the gait asks."""
    walking = 1.0 - stand
    return (walking * as_asked.float().mean(1)).sum() / walking.sum().clamp_min(1.0)


def height_slope(measured: torch.Tensor, commanded: torch.Tensor, stand: torch.Tensor) -> torch.Tensor:
    """Regression of measured on commanded height (N,) over the robots that are asked to stand."""
    share = stand / stand.sum().clamp_min(1.0)
    about = commanded - (share * commanded).sum()
    return (share * about * measured).sum() / (share * about.square()).sum().clamp_min(1e-6)
