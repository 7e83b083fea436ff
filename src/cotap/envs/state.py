"""What the robot is doing, read from the simulation once a control step."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol, TypeVar

import torch

from cotap.compliance.kinematics import ChainPose
from cotap.robots import RobotSpec
from cotap.robots.chains import arm_chains, chains_between
from cotap.rotations import heading_matrix, matrix_from_quat, rotate, rotate_inverse

CONTACT_FORCE_N = 5.0
"""A foot that carries more than this is in contact."""


@dataclass(frozen=True)
class RobotState:
    """N envs. Suffixes name frames: `_w` world, `_t` torso link, `_h` heading (z up, x along the torso's yaw).

    Joints and all that follows from them are current; the four `foot_*` tensors come from sensors and are one
    physics step older (the simulation's contract).
    """

    joint_pos: torch.Tensor
    """(N, J) [rad], in the robot's joint order."""
    joint_vel: torch.Tensor
    """(N, J) [rad/s]."""
    base_rotation_w: torch.Tensor
    """(N, 3, 3)."""
    torso_pos_w: torch.Tensor
    """(N, 3) [m]."""
    torso_rotation_w: torch.Tensor
    """(N, 3, 3)."""
    heading_w: torch.Tensor
    """(N, 3, 3), heading frame to world."""
    torso_linear_velocity_h: torch.Tensor
    """(N, 3) [m/s]."""
    torso_angular_velocity_t: torch.Tensor
    """(N, 3) [rad/s]."""
    yaw_rate: torch.Tensor
    """(N,) angular velocity about the vertical [rad/s]."""
    projected_gravity_t: torch.Tensor
    """(N, 3) unit vector."""
    arms: ChainPose
    """Pose of the arms in the torso frame."""
    foot_force: torch.Tensor
    """(N, F) normal force [N]."""
    foot_pos_w: torch.Tensor
    """(N, F, 3) sole centres [m]."""
    foot_velocity_w: torch.Tensor
    """(N, F, 3) [m/s]."""
    foot_up_w: torch.Tensor
    """(N, F, 3) the soles' normals."""
    foot_forward_w: torch.Tensor
    """(N, F, 3) the feet's forward axes."""

    @property
    def foot_contact(self) -> torch.Tensor:
        """(N, F) bool."""
        return self.foot_force > CONTACT_FORCE_N

    @property
    def height(self) -> torch.Tensor:
        """(N,) height of the torso link's origin above z = 0 [m]: the ground if flat, else halfway up its bumps."""
        return self.torso_pos_w[:, 2]

    @property
    def torso_to_heading(self) -> torch.Tensor:
        """(N, 3, 3) rotation from the torso's frame to the heading frame."""
        return self.heading_w.transpose(1, 2) @ self.torso_rotation_w

    @property
    def hand_pos_w(self) -> torch.Tensor:
        """(N, A, 3) where the hand points are [m]."""
        return self.torso_pos_w.unsqueeze(1) + self.arms.tip @ self.torso_rotation_w.transpose(1, 2)

    def with_envs(self, ids: torch.Tensor, other: RobotState) -> RobotState:
        """A copy in which the envs `ids` (n,) are in the state of `other`, which has n envs."""
        return _with_rows(self, ids, other)


_Rows = TypeVar("_Rows", RobotState, ChainPose)


def _with_rows(mine: _Rows, ids: torch.Tensor, other: _Rows) -> _Rows:
    """A copy of `mine`, envs first in every tensor, with `other` in the rows `ids`."""
    values = {}
    for f in fields(mine):
        value, new = getattr(mine, f.name), getattr(other, f.name)
        values[f.name] = (
            value.index_put((ids,), new) if isinstance(value, torch.Tensor) else _with_rows(value, ids, new)
        )
    return type(mine)(**values)


class StateSource(Protocol):
    """Where raw vectors come from: a batched simulation, or one robot as a batch of one."""

    @property
    def qpos(self) -> torch.Tensor:
        """(N, 7 + J) base position [m], base quaternion, joint angles [rad]."""
        ...

    @property
    def qvel(self) -> torch.Tensor:
        """(N, 6 + J) base velocity in the world [m/s], base rates in its frame [rad/s], joint rates [rad/s]."""
        ...

    def sensor(self, name: str) -> torch.Tensor:
        """Live (N, dim) view of a named sensor."""
        ...


class StateReader:
    """Turns a simulation's raw vectors into a `RobotState` of tensors of `dtype`."""

    def __init__(self, spec: RobotSpec, source: StateSource, dtype: torch.dtype = torch.float32) -> None:
        self._source, self._dtype = source, dtype
        self.arm_chains = arm_chains(spec, dtype)
        self._waist = chains_between(spec, spec.base_body, [(spec.torso_body, (0.0, 0.0, 0.0))], dtype)
        self._waist_ids = spec.indices(spec.waist_joints)
        self._arm_ids = torch.tensor(spec.indices(spec.upper_joints))
        self._num_arms = len(spec.arms)
        names = [f"{foot.side}_foot" for foot in spec.feet]
        self._foot_sensors = {k: [source.sensor(f"{n}_{k}") for n in names] for k in ("pos", "vel", "up", "forward")}
        self._touch = [source.sensor(f"{n}_touch") for n in names]

    def arm_joints(self, values: torch.Tensor) -> torch.Tensor:
        """Pick the arms out of (N, J): (N, arms, joints per arm)."""
        return values[:, self._arm_ids].unflatten(1, (self._num_arms, -1))

    def read(self, ids: torch.Tensor | None = None) -> RobotState:
        """The state now, of all envs or of the envs `ids` (n,)."""
        rows = slice(None) if ids is None else ids
        qpos, qvel = (x[rows].to(self._dtype, copy=True) for x in (self._source.qpos, self._source.qvel))
        q, dq = qpos[:, 7:], qvel[:, 6:]
        base = matrix_from_quat(torch.nn.functional.normalize(qpos[:, 3:7], dim=-1))
        waist = self._waist.pose(q[:, None, self._waist_ids])
        rates = waist.axes[:, 0] * dq[:, self._waist_ids, None]  # (N, waist joints, 3), base frame
        offset = waist.tip[:, 0]
        angular_b = qvel[:, 3:6] + rates.sum(1)
        linear_b = torch.linalg.cross(qvel[:, 3:6], offset)
        linear_b = linear_b + torch.linalg.cross(rates, offset.unsqueeze(1) - waist.anchors[:, 0]).sum(1)
        torso = base @ waist.rotation[:, 0]
        heading = heading_matrix(torso)
        angular_w = rotate(base, angular_b)
        foot = {k: torch.stack([view[rows] for view in v], 1) for k, v in self._foot_sensors.items()}
        return RobotState(
            joint_pos=q,
            joint_vel=dq,
            base_rotation_w=base,
            torso_pos_w=qpos[:, :3] + rotate(base, offset),
            torso_rotation_w=torso,
            heading_w=heading,
            torso_linear_velocity_h=rotate_inverse(heading, qvel[:, :3] + rotate(base, linear_b)),
            torso_angular_velocity_t=rotate_inverse(torso, angular_w),
            yaw_rate=angular_w[:, 2],
            projected_gravity_t=-torso[:, 2, :],
            arms=self.arm_chains.pose(self.arm_joints(q)),
            foot_force=torch.cat([view[rows] for view in self._touch], 1),
            foot_pos_w=foot["pos"],
            foot_velocity_w=foot["vel"],
            foot_up_w=foot["up"],
            foot_forward_w=foot["forward"],
        )
