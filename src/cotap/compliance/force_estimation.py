"""Force on a hand from the arm's torques alone: a momentum observer (De Luca and Mattone, 2003), at 50 Hz."""

from __future__ import annotations

import torch

from cotap.compliance.arguments import full_precision

FORCE_DAMPING_M2 = 1e-3
"""Damping of the inverse from joint torque to hand force [m^2]: a share of 0.1 where a radian moves the hand 0.1 m."""


def observe_torque(
    residual: torch.Tensor, momentum_change: torch.Tensor, effort: torch.Tensor, gravity: torch.Tensor, share: float,
    dt: float,
) -> torch.Tensor:  # fmt: skip
    """Torque (..., n) that something outside puts on the joints, `p' - tau + tau_gravity`, through a low pass [Nm].

    Centrifugal torques and the acceleration of the arm's base are disregarded, and end up in it.

    Args:
        residual: (..., n) the estimate of a step ago [Nm].
        momentum_change: (..., n) of `M(q) dq` over the step [Nms/rad].
        effort: (..., n) mean torque of the motors over the step, less friction [Nm].
        gravity: (..., n) torque that holds the arm against gravity [Nm].
        share: Of the new in the estimate, `1 - exp(-dt / time constant)`.
        dt: [s].
    """
    return torch.lerp(residual, momentum_change / dt - effort + gravity, share)


@full_precision
def hand_force(jacobian: torch.Tensor, torque: torch.Tensor) -> torch.Tensor:
    """Force (..., 3) at the hand that explains joint torques (..., n) best, `tau = J^T f` [N].

    Damped: forces along a straight arm, which no joint feels, come out as none.

    Args:
        jacobian: (..., 3, n) [m/rad].
        torque: [Nm].
    """
    gram = jacobian @ jacobian.transpose(-1, -2)
    eye = torch.eye(3, dtype=gram.dtype, device=gram.device)
    return torch.linalg.solve(gram + FORCE_DAMPING_M2 * eye, (jacobian @ torque.unsqueeze(-1)).squeeze(-1))
