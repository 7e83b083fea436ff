"""Weighted sum of the torques of PD and of a Cartesian impedance controller.

HMC as its paper describes it, re-implemented: see `docs/laws.md` for what differs.
"""

from __future__ import annotations

import torch

from cotap.compliance.arguments import full_precision
from cotap.compliance.dynamics import gravity_torque
from cotap.compliance.interface import Arms, ArmState, LawParameters, LawReport, TorqueLaw


class BlendedTorqueLaw:
    """`(1 - w) tau_pd + w tau_impedance`, w = alpha.

    `tau_impedance = tau_gravity + J^T (K (x_target - x) - D x')` with `D = 2 ratio sqrt(K m)`. It says nothing about
    motion that leaves the hand where it is, which has the share 1 - w of the PD law's stiffness, and none at w = 1.

    Args:
        arms: What is driven.
        mass: m [kg].
        damping_ratio: Share of critical damping for a hand of that mass.
    """

    def __init__(self, arms: Arms, mass: float = 1.0, damping_ratio: float = 1.0) -> None:
        self._arms, self._mass, self._damping_ratio = arms, mass, damping_ratio
        self._kp, self._kd = torch.diag_embed(arms.kp), torch.diag_embed(arms.kd)

    @full_precision
    def __call__(self, state: ArmState, parameters: LawParameters) -> tuple[TorqueLaw, LawReport]:
        """Both controllers' torques, weighted."""
        chains, rotation = self._arms.chains, state.to_heading.unsqueeze(1)
        jacobian_h = rotation @ chains.jacobian(state.pose)
        reach_h = (rotation @ (chains.pose(state.target).tip - state.pose.tip).unsqueeze(-1)).squeeze(-1)
        stiffness = parameters.stiffness
        damping = 2.0 * self._damping_ratio * (self._mass * stiffness).sqrt()
        transposed = jacobian_h.transpose(-1, -2)
        weight = parameters.alpha.unsqueeze(-1)
        pull = (transposed @ (stiffness * reach_h).unsqueeze(-1)).squeeze(-1)
        elastic = torch.lerp(self._arms.kp * (state.target - state.position), pull, weight)
        gravity = weight * gravity_torque(self._arms.inertias, state.pose, state.to_heading[:, 2])
        share = weight.unsqueeze(-1)
        felt, damped = (
            torch.lerp(joint.expand(share.shape[0], -1, -1, -1), transposed @ (task.unsqueeze(-1) * jacobian_h), share)
            for joint, task in ((self._kp, stiffness), (self._kd, damping))
        )
        return TorqueLaw(state.position, gravity, elastic, felt, damped), LawReport()
