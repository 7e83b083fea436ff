"""Kinematic chains of a robot, from its description."""

from __future__ import annotations

import torch

from cotap.compliance.dynamics import LinkInertias
from cotap.compliance.interface import Arms
from cotap.compliance.kinematics import SerialChains
from cotap.robots.spec import RobotSpec
from cotap.rotations import matrix_from_quat


def chains_between(
    spec: RobotSpec, root: str, tips: list[tuple[str, tuple[float, float, float]]], dtype: torch.dtype = torch.float32
) -> SerialChains:
    """Kinematic chains from body `root` to points (body, point in its frame), all of equal length."""
    chains = [spec.chain(body, root) for body, _ in tips]
    return SerialChains(
        torch.tensor([[b.pos for b in chain] for chain in chains], dtype=dtype),
        torch.tensor([[b.quat for b in chain] for chain in chains], dtype=dtype),
        torch.tensor([[spec.joint(b.joint or "").axis for b in chain] for chain in chains], dtype=dtype),
        torch.tensor([point for _, point in tips], dtype=dtype),
    )


class LinkRotations:
    """Orientations of the links, by the joint that moves each."""

    def __init__(self, spec: RobotSpec) -> None:
        parents = {b.parent for b in spec.bodies}
        leaves = [b.name for b in spec.bodies if b.name not in parents and b.name != spec.base_body]
        chains = [(chains_between(spec, spec.base_body, [(leaf, (0.0, 0.0, 0.0))]), leaf) for leaf in leaves]
        self._chains = [
            (chain, torch.tensor(spec.indices([b.joint or "" for b in spec.chain(leaf, spec.base_body)])))
            for chain, leaf in chains
        ]

    def __call__(self, base_w: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
        """(N, J, 3, 3) link to world, for a base at `base_w` (N, 3, 3) and joints at (N, J) [rad]."""
        out = base_w.unsqueeze(1).repeat(1, joint_pos.shape[1], 1, 1)
        for chain, joints in self._chains:
            out[:, joints] = base_w.unsqueeze(1) @ chain.pose(joint_pos[:, None, joints]).rotations[:, 0]
        return out


def arm_chains(spec: RobotSpec, dtype: torch.dtype = torch.float32) -> SerialChains:
    """The arms, from the torso link to the hand points."""
    return chains_between(spec, spec.torso_body, [(a.hand_body, a.hand_point) for a in spec.arms], dtype)


def arm_inertias(spec: RobotSpec, dtype: torch.dtype = torch.float32) -> LinkInertias:
    """Nominal masses of the arms' links, arm by arm."""
    chains = [spec.chain(arm.hand_body, spec.torso_body) for arm in spec.arms]
    armature = [[spec.joint(b.joint or "").armature_kg_m2 for b in chain] for chain in chains]
    frames = matrix_from_quat(torch.tensor([[b.inertia_quat for b in chain] for chain in chains], dtype=dtype))
    principal = torch.diag_embed(torch.tensor([[b.diaginertia for b in chain] for chain in chains], dtype=dtype))
    return LinkInertias(
        torch.tensor([[b.mass_kg for b in chain] for chain in chains], dtype=dtype),
        torch.tensor([[b.com for b in chain] for chain in chains], dtype=dtype),
        frames @ principal @ frames.transpose(-1, -2),
        torch.tensor(armature, dtype=dtype),
    )


def arm_model(spec: RobotSpec, dtype: torch.dtype = torch.float32) -> Arms:
    """All that laws may know of the arms: nominal kinematics, masses, gains and limits."""
    joints = [[spec.joint(name) for name in arm.joints] for arm in spec.arms]
    kp, kd, low, high, speed, friction = torch.tensor(
        [[(j.kp, j.kd, *j.range_rad, j.velocity_limit_rad_s, j.damping_nms_rad) for j in arm] for arm in joints],
        dtype=dtype,
    ).unbind(-1)
    return Arms(arm_chains(spec, dtype), arm_inertias(spec, dtype), kp, kd, low, high, speed, friction)
