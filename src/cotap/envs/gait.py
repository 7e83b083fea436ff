"""The gait clock: which foot is where in its stride, and the stepping motion that it feeds forward to the legs."""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import mujoco
import numpy as np
import torch

from cotap.robots import RobotSpec
from cotap.robots.chains import chains_between

STANCE_SHARE = 0.58
"""Part of a stride that a foot spends on the ground."""

CATCH_TILT = (0.05, 0.2)
"""Sines of the tilt at which the swinging foot begins to be lifted higher, and at which it is lifted highest."""

LARGEST_HOLD_BACK_M = 0.15
"""The map from a sole's way to joints is of the first order, and made for small ways."""

AHEAD_S = 0.1
"""How far ahead the swinging foot is seen coming at the other one: about what a leg takes to give way [s]."""


def foot_phases(phase: torch.Tensor, num_feet: int) -> torch.Tensor:
    """Each foot's own phase, (N, num_feet) in [0, 1), for the clock's (N,): foot i is i / num_feet ahead."""
    shift = torch.arange(num_feet, dtype=phase.dtype, device=phase.device) / num_feet
    return (phase.unsqueeze(1) + shift).remainder(1.0)


def desired_contact(phase: torch.Tensor, stand: torch.Tensor, num_feet: int) -> torch.Tensor:
    """Which feet should be on the ground, (N, num_feet) bool."""
    return (foot_phases(phase, num_feet) < STANCE_SHARE) | (stand.unsqueeze(1) > 0.5)


def swing_progress(phase: torch.Tensor, num_feet: int) -> torch.Tensor:
    """How far each foot is through its swing, (N, num_feet) in [0, 1]; 0 during stance."""
    return ((foot_phases(phase, num_feet) - STANCE_SHARE) / (1.0 - STANCE_SHARE)).clamp(0.0, 1.0)


def sweep(phase: torch.Tensor, num_feet: int) -> torch.Tensor:
    """Where each foot is between the front (1) and the back (-1) of its stride, (N, num_feet).

    It moves back at constant speed in stance, as the ground does, and swings forward smoothly.
    """
    progress = foot_phases(phase, num_feet)
    stance = 1.0 - 2.0 * progress / STANCE_SHARE
    swing = -torch.cos(torch.pi * (progress - STANCE_SHARE) / (1.0 - STANCE_SHARE))
    return torch.where(progress < STANCE_SHARE, stance, swing)


class StepMotion:
    """Joint offsets of the legs that lift the swinging foot and sweep both feet under a body that moves as commanded,
    and that keep feet out of each other's way.

    The sweep is kinematics of the first order about the default pose: the least-squares solution that moves a sole
    forward, sideways and in yaw, and keeps it level and at its height.

    Args:
        spec: The robot.
        model: Its compiled model.
        period_s: Duration of a stride [s].
        lift: Factor on the lift of the swinging foot.
        stride: Factor on the sweep.
        apart_m: How much further apart than in the default pose the feet are put.
        clear_m: Sideways distance of two soles below which the swinging one gives way; 0 for never.
        hold_back_m: By how much less the swinging foot reaches to where the torso leans, per sine of its tilt.
        catch_lift: By what share of itself the lift grows under a torso that leans far.
        roll_damping_s: How far joints that roll are sent against their velocity [s].
        twist_damping_s: The same of joints that turn about the vertical [s].
        straighten_rad: By how much less than in the default pose knees are bent [rad].
    """

    def __init__(
        self, spec: RobotSpec, model: mujoco.MjModel, period_s: float, lift: float = 1.0, stride: float = 1.0,
        apart_m: float = 0.0, clear_m: float = 0.0, hold_back_m: float = 0.0, catch_lift: float = 0.0,
        roll_damping_s: float = 0.0, twist_damping_s: float = 0.0, straighten_rad: float = 0.0,
    ) -> None:  # fmt: skip
        chains = [spec.chain(foot.body, spec.base_body) for foot in spec.feet]
        names = [[b.joint or "" for b in chain] for chain in chains]
        self.joints = torch.tensor([spec.indices(chain) for chain in names])
        """(F, n) which joints are moved."""
        self._lift = torch.zeros(self.joints.shape)
        for i, foot in enumerate(spec.feet):
            for joint, angle in foot.flexion:
                self._lift[i, names[i].index(joint)] = lift * angle
        axes = [[spec.joints[i].axis for i in chain] for chain in self.joints.tolist()]
        damping = {(1.0, 0.0, 0.0): roll_damping_s, (0.0, 0.0, 1.0): twist_damping_s}
        self._damping = torch.tensor([[damping.get(axis, 0.0) for axis in chain] for chain in axes])
        """(F, n) [s]."""
        kinematics = [_sole_kinematics(spec, model, i, names[i]) for i in range(len(spec.feet))]
        maps, outward, lateral = zip(*kinematics, strict=True)
        # Half of the way that the ground moves during a stance, per unit of velocity.
        self._per_metre = torch.stack(maps)
        self._per_velocity = 0.5 * stride * STANCE_SHARE * period_s * self._per_metre
        self._hold_back, self._catch_lift = hold_back_m, catch_lift
        self._lateral = torch.tensor(lateral)
        self._outward = torch.stack(outward)
        self._clear = clear_m
        self._pose = 0.5 * apart_m * self._outward
        """Offsets (F, n) [rad] of the pose that is stepped from."""
        for i, (_, knee, *_) in enumerate(spec.stance.joints):
            self._pose[i, names[i].index(knee)] -= straighten_rad
        self._chains = chains_between(spec, spec.base_body, [(foot.body, foot.sole) for foot in spec.feet])

    def __call__(self, phase: torch.Tensor, velocity_h: torch.Tensor, yaw_rate: torch.Tensor) -> torch.Tensor:
        """Offsets (N, F, n) [rad] for the clock's phase (N,), velocities (N, 2) and yaw rates (N,)."""
        feet = self.joints.shape[0]
        # The ground under a foot at (0, y) moves at -(v + w x r): turning adds -w y forwards.
        forward = velocity_h[:, :1] - yaw_rate.unsqueeze(1) * self._lateral
        rates = torch.stack((forward, velocity_h[:, 1:].expand(-1, feet), yaw_rate.unsqueeze(1).expand(-1, feet)), 2)
        stride = (self._per_velocity * rates.unsqueeze(2)).sum(3)
        return self._pose + self._lifting(phase) + sweep(phase, feet).unsqueeze(2) * stride

    def _lifting(self, phase: torch.Tensor) -> torch.Tensor:
        """Offsets (N, F, n) [rad] that lift the swinging foot."""
        bump = torch.sin(torch.pi * swing_progress(phase, self.joints.shape[0])).square()
        return bump.unsqueeze(2) * self._lift

    def damping(self, joint_vel: torch.Tensor) -> torch.Tensor:
        """Offsets (N, F, n) [rad] against joint velocities (N, J) [rad/s]."""
        return -self._damping * joint_vel[:, self.joints]

    def catching(self, phase: torch.Tensor, projected_gravity: torch.Tensor) -> torch.Tensor:
        """Offsets (N, F, n) [rad] that lift the swinging foot higher under a torso that leans far, so that what
        is to catch the robot meets neither the floor nor the other leg on its way.

        Args:
            phase: (N,) of the clock.
            projected_gravity: (N, 3) unit vector in the torso frame.
        """
        first, full = CATCH_TILT
        share = ((projected_gravity[:, :2].norm(dim=1) - first) / (full - first)).clamp(0.0, 1.0)
        return (self._catch_lift * share)[:, None, None] * self._lifting(phase)

    def holding_back(self, phase: torch.Tensor, projected_gravity: torch.Tensor) -> torch.Tensor:
        """Offsets (N, F, n) [rad] that keep the swinging foot from reaching too far to where the torso leans.

        A foot that comes down beyond where it would catch the robot throws it to the other side.

        Args:
            phase: (N,) of the clock.
            projected_gravity: (N, 3) unit vector in the torso frame.
        """
        way = (-self._hold_back * projected_gravity[:, :2]).clamp(-LARGEST_HOLD_BACK_M, LARGEST_HOLD_BACK_M)
        swings = (swing_progress(phase, self.joints.shape[0]) > 0.0).to(way.dtype)
        return swings.unsqueeze(2) * (self._per_metre[..., :2] * way[:, None, None]).sum(3)

    def giving_way(self, phase: torch.Tensor, joint_pos: torch.Tensor, joint_vel: torch.Tensor) -> torch.Tensor:
        """Offsets (N, F, n) [rad] that keep the swinging foot from the other one, the first two feet being a pair.

        Args:
            phase: (N,) of the clock.
            joint_pos: (N, J) [rad].
            joint_vel: (N, J) [rad/s].
        """
        if self._clear == 0.0:
            return torch.zeros_like(self._outward).expand(len(phase), -1, -1)
        pose = self._chains.pose(joint_pos[:, self.joints])
        rate = (self._chains.jacobian(pose)[:, :, 1] * joint_vel[:, self.joints]).sum(2)
        sideways = (pose.tip[:, :, 1] + AHEAD_S * rate) * self._lateral.sign()
        short = (self._clear - sideways[:, 0] - sideways[:, 1]).clamp(0.0, 2.0 * self._clear)
        swings = (swing_progress(phase, self.joints.shape[0]) > 0.0).to(short.dtype)
        return (short.unsqueeze(1) * swings).unsqueeze(2) * self._outward


def _sole_kinematics(
    spec: RobotSpec, model: mujoco.MjModel, foot: int, joints: list[str]
) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Joint rates (n, 3) per unit of the sole's forward, sideways and yaw rate; angles (n,) that put it outwards, per
    metre, by the least motion and whatever becomes of its height; and where it is sideways [m]."""
    data = mujoco.MjData(model)
    data.qpos[3] = 1.0
    data.qpos[7:] = [j.default_rad for j in spec.joints]
    mujoco.mj_forward(model, data)
    body = model.body(spec.feet[foot].body).id
    point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ spec.feet[foot].sole
    position, rotation = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, position, rotation, point, body)
    columns = [model.joint(name).dofadr[0] for name in joints]
    # Rolling is given up first: a leg of five joints cannot do all six.
    weight = np.array([1.0, 1.0, 1.0, 1e-3, 1.0, 1.0])
    jacobian = np.concatenate((position, rotation))[:, columns] * weight[:, None]
    inverse = np.linalg.pinv(jacobian) * weight
    outward = np.sign(point[1]) * np.linalg.pinv(position[1:2, columns])[:, 0]
    rates = torch.tensor(inverse[:, [0, 1, 5]], dtype=torch.float32)
    return rates, torch.tensor(outward, dtype=torch.float32), float(point[1])
