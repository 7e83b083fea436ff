"""What a hand gives away when it is led around a closed path, so slowly that only the law's spring counts.

At constant commanded stiffness, too, a law's torque need not be the gradient of an energy: its joint stiffness changes
with the pose. Then the work around a closed path is not zero, and in one of its two directions energy is drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from cotap.compliance.interface import Arms, ArmState, LawParameters
from cotap.compliance.laws import LAWS, LawConfig

_STEP = 1e-6
"""Of finite differences [rad]."""
_ITERATIONS = 3
"""Of Newton's method, from one point of a path to the next."""

Spring = Callable[[torch.Tensor], torch.Tensor]
"""Torques (N, A, n) [Nm] of a law's spring at joint angles (N, A, n) [rad]."""


@dataclass(frozen=True)
class Loop:
    """N x A hands led once around closed paths of S points, the first of them again at the end."""

    joints: torch.Tensor
    """(S, N, A, n) where the arms come to rest [rad]."""
    hand: torch.Tensor
    """(S, N, A, 3) torso frame [m]."""
    force: torch.Tensor
    """(S, N, A, 3) that holds them there [N]."""
    asymmetry: torch.Tensor
    """(S, N, A) norm of the antisymmetric part of the hand's stiffness over that of the symmetric one; of the gradient
    of an energy it is zero."""
    found: torch.Tensor
    """(N, A) bool: there is such a rest all along."""

    def work(self) -> torch.Tensor:
        """(N, A) work that leading takes [J]; negative where energy is drawn, and the opposite the other way round."""
        mean = 0.5 * (self.force[1:] + self.force[:-1])
        return (mean * self.hand.diff(dim=0)).sum((0, -1))

    def stored(self) -> torch.Tensor:
        """(N, A) difference between the largest and the least work on the way [J]."""
        mean = 0.5 * (self.force[1:] + self.force[:-1])
        along = (mean * self.hand.diff(dim=0)).sum(-1).cumsum(0)
        return along.amax(0).clamp_min(0.0) - along.amin(0).clamp_max(0.0)


def spring_of(law: LawConfig, arms: Arms, target: torch.Tensor) -> Spring:
    """The spring of a law with constant parameters and targets (N, A, n) [rad], in float64, the torso upright."""
    built, shape = LAWS[law.name](arms, law), target.shape[:2]
    upright = torch.eye(3, dtype=target.dtype).expand(len(target), 3, 3)
    parameters = LawParameters(
        torch.tensor(law.stiffness, dtype=target.dtype).expand(*shape, 3),
        torch.full(shape, law.null_stiffness, dtype=target.dtype), torch.full(shape, law.alpha, dtype=target.dtype),
    )  # fmt: skip

    def spring(q: torch.Tensor) -> torch.Tensor:
        state = ArmState(q, torch.zeros_like(q), target, arms.chains.pose(q), upright)
        return built(state, parameters)[0].elastic

    return spring


def circles(center: torch.Tensor, radius: float, offset: float, points: int, rng: torch.Generator) -> torch.Tensor:
    """Paths (points + 1, N, A, 3) on circles of `radius` [m] in random planes, whose centres are `offset` [m] from
    `center` (N, A, 3) in random directions. Closed, and even: the trapezoidal rule is exact to rounding on them."""
    frame, _ = torch.linalg.qr(torch.randn(*center.shape, 3, generator=rng, dtype=center.dtype))
    away = torch.randn(center.shape, generator=rng, dtype=center.dtype)
    middle = center + offset * away / away.norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.pi * torch.arange(points + 1, dtype=center.dtype).reshape(-1, 1, 1, 1) / points
    return middle + radius * (angle.cos() * frame[..., 0] + angle.sin() * frame[..., 1])


def lead(spring: Spring, arms: Arms, start: torch.Tensor, path: torch.Tensor) -> Loop:
    """Lead hands along `path` (S, N, A, 3) [m], torso frame, from arms near `start` (N, A, n) [rad].

    At every point, `spring(q) + J^T F = 0` with the hand on the path: the joint that is left free rests.
    """
    q, force = start.clone(), torch.zeros_like(path[0])
    rows = []
    first = arms.chains.pose(q).tip
    approach = [torch.lerp(first, path[0], share / 10.0) for share in range(1, 10)]
    for number, point in enumerate([*approach, *path]):
        for _ in range(_ITERATIONS):
            residual, slope = _statics(spring, arms, q, force, point)
            step = torch.linalg.lstsq(slope, residual.unsqueeze(-1)).solution.squeeze(-1)
            q, force = q - step[..., : q.shape[-1]], force - step[..., q.shape[-1] :]
        residual, slope = _statics(spring, arms, q, force, point)
        if number >= len(approach):
            rows.append((q, arms.chains.pose(q).tip, force, _asymmetry(slope), residual.abs().amax(-1)))
    joints, hand, forces, asymmetry, missed = (torch.stack(column) for column in zip(*rows, strict=True))
    closed = (joints[-1] - joints[0]).abs().amax(-1) < 1e-5
    return Loop(joints, hand, forces, asymmetry, (missed < 1e-6).all(0) & closed)


def _statics(
    spring: Spring, arms: Arms, q: torch.Tensor, force: torch.Tensor, point: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Torques and distances (N, A, n + 3) that are to be zero, and their slopes in joints and force."""

    def torque(at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        pose = arms.chains.pose(at)
        jacobian = arms.chains.jacobian(pose)
        return spring(at) + (jacobian.transpose(-1, -2) @ force.unsqueeze(-1)).squeeze(-1), jacobian, pose.tip

    now, jacobian, tip = torque(q)
    columns = []
    for i in range(q.shape[-1]):
        moved = q.clone()
        moved[..., i] += _STEP
        columns.append((torque(moved)[0] - now) / _STEP)
    above = torch.cat((torch.stack(columns, -1), jacobian.transpose(-1, -2)), -1)
    below = torch.cat((jacobian, jacobian.new_zeros(*jacobian.shape[:-1], 3)), -1)
    return torch.cat((now, tip - point), -1), torch.cat((above, below), -2)


def _asymmetry(slope: torch.Tensor) -> torch.Tensor:
    """(N, A), see `Loop`. The hand's stiffness is how the force that holds it changes with where it is."""
    joints = slope.shape[-1] - 3
    right = slope.new_zeros(*slope.shape[:-1], 3)
    right[..., joints:, :] = torch.eye(3, dtype=slope.dtype)
    stiffness = torch.linalg.lstsq(slope, right).solution[..., joints:, :]
    even, odd = stiffness + stiffness.transpose(-1, -2), stiffness - stiffness.transpose(-1, -2)
    return odd.norm(dim=(-2, -1)) / even.norm(dim=(-2, -1))
