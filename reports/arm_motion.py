"""An arm on a fixed base, integrated so that not a nanojoule is made or lost but by what acts on it.

Accounts of energy that are to hold to 1e-9 J need a simulation that keeps them itself. The method of discrete
gradients does (O. Gonzalez, Time integration and discrete Hamiltonian systems, J. Nonlinear Sci. 6, 1996): over every
step, the energy of motion and spring changes by the work of the force on the hand less that of the damping, to
rounding and however long the step is. Gravity is left out: a law compensates it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.compliance.dynamics import joint_inertia
from cotap.compliance.interface import Arms, TorqueLaw

_SOLVED = 1e-11
"""Change of an iteration [rad, or kg m^2/s] below which a step is solved."""
_ITERATIONS = 40
_LINEARIZATIONS = 2
"""Iterations with derivatives of their own, which takes most of the time: what the second order needs."""
_AT_REST = 1e-9
"""Square of a step's motion below which its energy is not corrected: rounding would spoil it, and what is missed is of
third order."""


@dataclass(frozen=True)
class Motion:
    """N robots' A arms of n joints, in float64."""

    angle: torch.Tensor
    """(N, A, n) [rad]."""
    momentum: torch.Tensor
    """(N, A, n) [kg m^2/s]."""


def rates(arms: Arms, motion: Motion) -> torch.Tensor:
    """Joint rates (N, A, n) [rad/s]."""
    return torch.linalg.solve(joint_inertia(arms.inertias, arms.chains.pose(motion.angle)), motion.momentum)


class Pulled:
    """Arms under a torque law for a control step, each with a constant force on its hand.

    Args:
        arms: Of which robot.
        law: In force; its feed-forward torque is taken to cancel gravity.
        force: (N, A, 3) on the hands, frame of the arms' root [N].
    """

    def __init__(self, arms: Arms, law: TorqueLaw, force: torch.Tensor) -> None:
        self._arms, self._law, self._force = arms, law, force

    def energy(self, angle: torch.Tensor, momentum: torch.Tensor) -> torch.Tensor:
        """(N, A) of motion and spring [J], less the work of the force from the root's origin to the hand."""
        pose, moved = self._arms.chains.pose(angle), angle - self._law.anchor
        motion = 0.5 * momentum * torch.linalg.solve(joint_inertia(self._arms.inertias, pose), momentum)
        spring = moved * (0.5 * _times(self._law.stiffness, moved) - self._law.elastic)
        return (motion + spring).sum(-1) - (self._force * pose.tip).sum(-1)

    def after(self, motion: Motion, seconds: float) -> Motion:
        """Where the arms are `seconds` later.

        Raises:
            ArithmeticError: the step is too long for its equations to be solved.
        """
        q0, p0, h = motion.angle, motion.momentum, seconds
        mass = joint_inertia(self._arms.inertias, self._arms.chains.pose(q0))
        damping, stiffness, before = self._law.damping, self._law.stiffness, self.energy(q0, p0)
        bent = 0.5 * h * stiffness + damping
        solve = torch.linalg.inv(2.0 / h * mass + bent)
        q, p = q0 + h * torch.linalg.solve(mass, p0), p0
        for iteration in range(_ITERATIONS):
            dq, dp = q - q0, p - p0
            if iteration < _LINEARIZATIONS:
                half_q, half_p = q0 + 0.5 * dq, p0 + 0.5 * dp
                slope_q, slope_p = self._gradient(half_q, half_p)
            # Linear about the last of these, and corrected along the motion to account for all of the energy.
            by_angle = slope_q + _times(stiffness, q0 + 0.5 * dq - half_q)
            by_momentum = slope_p + torch.linalg.solve(mass, p0 + 0.5 * dp - half_p)
            missed = self.energy(q, p) - before - (by_angle * dq).sum(-1) - (by_momentum * dp).sum(-1)
            square = dq.square().sum(-1) + dp.square().sum(-1)
            share = torch.where(square > _AT_REST, missed / square.clamp_min(_AT_REST), 0.0).unsqueeze(-1)
            off_q = dq - h * (by_momentum + share * dp)
            off_p = dp + h * (by_angle + share * dq) + _times(damping, dq)
            step_q = -_times(solve, 2.0 / h * _times(mass, off_q) + off_p)
            step_p = -off_p - _times(bent, step_q)
            q, p = q + step_q, p + step_p
            if max(float(step_q.abs().max()), float(step_p.abs().max())) < _SOLVED:
                return Motion(q, p)
        raise ArithmeticError(f"steps of {seconds:g} s are too long for this arm: raise --substeps")

    @torch.enable_grad()
    def _gradient(self, angle: torch.Tensor, momentum: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Derivatives of the energy by angle and momentum, (N, A, n) each."""
        at = angle.detach().requires_grad_(), momentum.detach().requires_grad_()
        by_angle, by_momentum = torch.autograd.grad(self.energy(*at).sum(), at)
        return by_angle, by_momentum


def _times(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """(..., n, n) times (..., n)."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
