"""Inverse kinematics of many arms at once, a few damped steps per control step: joints for a hand that is somewhere.

A step is `dq = J^T (J J^T + l I)^-1 e`, damped in proportion to the error, `l = LEVER_M |e|` (the Levenberg-Marquardt
method for targets that may lie out of reach; Sugihara, 2011): quick near a solution, and calm where there is none.
Tensors have the batch last in here, (3, n, A, N): a fifth of the time that small matrices cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.checks import require_positive_int, require_shape
from cotap.compliance.kinematics import SerialChains

LEVER_M = 0.3
"""Damping per metre of error: about what turning a joint bends the hand's path by."""
BIAS_M2 = 1e-6
"""Damping that is left without an error [m^2]."""
RETURN = 0.02
"""Share of the way to the posture that joints go per call; steps of the hand take back what would move it."""


@dataclass(frozen=True)
class IKSolution:
    """Where the arms are to be. N envs, A arms of n joints."""

    position: torch.Tensor
    """(N, A, n) within the joints' limits [rad]."""
    error: torch.Tensor
    """(N, A) distance of the hand from where it was wanted, before the last step [m]."""


class ArmIK:
    """Joint angles of serial arms whose hands are to be at given points.

    Redundant joints go to a posture, within about a second. Joint limits hold strictly, and no call moves a joint by
    more than it may: a joint at such a bound that the hand's error pushes outward is left out of the step, and the
    others do without it. For a point out of reach the hand goes as near to it as the joints allow, and rests there as
    long as the point does.

    Args:
        chains: The arms, with 3 joints or more.
        low: (A, n) lower limits [rad].
        high: (A, n) upper limits [rad].
        steps: Steps per call.

    Raises:
        ValueError: limits of another shape or the wrong way round, or no steps.
    """

    def __init__(self, chains: SerialChains, low: torch.Tensor, high: torch.Tensor, steps: int = 3) -> None:
        self.steps = require_positive_int("steps", steps)
        shape = (chains.num_chains, chains.num_joints)
        for name, limit in (("low", low), ("high", high)):
            require_shape(name, limit, shape)
        if (low > high).any():
            raise ValueError(f"low must not exceed high, got {low.tolist()} and {high.tolist()}")
        self._chains = chains
        self._low, self._high = low.T.unsqueeze(-1), high.T.unsqueeze(-1)  # (n, A, 1)

    def __call__(self, tip: torch.Tensor, posture: torch.Tensor, start: torch.Tensor, most: torch.Tensor) -> IKSolution:
        """Joint angles for hands at `tip`, (N, A, 3), in the frame of the arms' root [m].

        Args:
            tip: Wanted positions.
            posture: (N, A, n) what redundant joints go to [rad].
            start: (N, A, n) where the search begins, such as at the last solution [rad].
            most: (A, n) what joints may move by from there [rad].
        """
        wanted, rest = (x.permute(2, 1, 0).contiguous() for x in (tip, posture))
        q = start.permute(2, 1, 0).clamp(self._low, self._high)
        room = most.T.unsqueeze(-1)
        bounds = (q - room).maximum(self._low), (q + room).minimum(self._high)
        q = torch.lerp(q, rest, RETURN).clamp(*bounds)
        error = wanted
        for _ in range(self.steps):
            pose = self._chains.pose(q.permute(2, 1, 0))
            jacobian = self._chains.jacobian(pose).permute(2, 3, 1, 0)
            error = wanted - pose.tip.permute(2, 1, 0)
            q = (q + self._step(q, jacobian, error, *bounds)).clamp(*bounds)
        return IKSolution(q.permute(2, 1, 0), error.square().sum(0).sqrt().T)

    @staticmethod
    def _step(
        q: torch.Tensor, jacobian: torch.Tensor, error: torch.Tensor, low: torch.Tensor, high: torch.Tensor
    ) -> torch.Tensor:
        """One damped step (n, A, N) [rad], in which joints at their bounds do not go beyond."""
        pull = (jacobian * error.unsqueeze(1)).sum(0)
        stuck = ((q <= low) & (pull < 0.0)) | ((q >= high) & (pull > 0.0))
        jacobian = jacobian * ~stuck
        damping = BIAS_M2 + LEVER_M * error.square().sum(0).sqrt()
        return (jacobian * _solve_gram(jacobian, damping, error).unsqueeze(1)).sum(0)


def _solve_gram(jacobian: torch.Tensor, damping: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """`(J J^T + damping I)^-1 right`, (3, A, N), by Cramer's rule."""
    x, y, z = jacobian.unbind(0)
    xx, yy, zz = ((v * v).sum(0) + damping for v in (x, y, z))
    xy, xz, yz = (x * y).sum(0), (x * z).sum(0), (y * z).sum(0)
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    cyy, cyz, czz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    a, b, c = right.unbind(0)
    solved = torch.stack((cxx * a + cxy * b + cxz * c, cxy * a + cyy * b + cyz * c, cxz * a + cyz * b + czz * c))
    return solved / (xx * cxx + xy * cxy + xz * cxz)
