"""A law's closed loop about a pose, as it is sampled: the law at the control rate, the arm in continuous time.

The law itself is differentiated by finite differences, its memory included, so that any law can be asked. Pelvis fixed,
nominal masses, no torque limits, no delay; velocities are small, so that nothing depends on their squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from cotap.compliance.dynamics import gravity_torque, joint_inertia
from cotap.compliance.interface import Arms, ArmState, LawParameters, Remembering, UpperBodyLaw

_STEP = 1e-6
"""Of finite differences: radians, metres, newtons and what memories are in."""


@dataclass(frozen=True)
class ClosedLoop:
    """The parts of P poses' loops that no wall changes. n joints, k remembered numbers, all float64."""

    flow: torch.Tensor
    """(P, 2n, 2n) of joints and rates in continuous time, under the law's stiffness and damping [1/s]."""
    push: torch.Tensor
    """(P, 2n, n) accelerations per torque."""
    jacobian: torch.Tensor
    """(P, 3, n) of the hands [m/rad]."""
    torque: torch.Tensor
    """(P, n, 2n + k + 3) sampled torque per joint, rate, memory and force on the hand."""
    memory: torch.Tensor
    """(P, k, 2n + k + 3) next memory, likewise."""
    dt: float

    def growth(self, wall: float = 0.0) -> torch.Tensor:
        """Largest real part (P,) of the loop's exponents [1/s], the hand held by a spring of stiffness `wall` [N/m].

        That of the eigenvalue z of one control step is `log|z| / dt`; positive is unstable.
        """
        n, k = self.push.shape[2], self.memory.shape[1]
        flow = self.flow.clone()
        spring = self.push @ (wall * self.jacobian.transpose(1, 2) @ self.jacobian)
        flow[:, :, :n] -= spring
        block = torch.zeros(len(flow), 3 * n, 3 * n, dtype=flow.dtype)
        block[:, : 2 * n, : 2 * n], block[:, : 2 * n, 2 * n :] = flow, self.push
        over = torch.linalg.matrix_exp(self.dt * block)
        felt = torch.zeros(len(flow), 3, 2 * n + k, dtype=flow.dtype)
        felt[:, :, :n] = -wall * self.jacobian
        torque = self.torque[:, :, : 2 * n + k] + self.torque[:, :, 2 * n + k :] @ felt
        memory = self.memory[:, :, : 2 * n + k] + self.memory[:, :, 2 * n + k :] @ felt
        arm = over[:, : 2 * n, 2 * n :] @ torque
        arm[:, :, : 2 * n] += over[:, : 2 * n, : 2 * n]
        largest = torch.linalg.eigvals(torch.cat((arm, memory), 1)).abs().amax(1)
        return largest.clamp_min(1e-300).log() / self.dt


def linearize(
    make: Callable[[Arms], UpperBodyLaw], arms: Arms, q: torch.Tensor, target: torch.Tensor,
    parameters: LawParameters, dt: float,
) -> ClosedLoop:  # fmt: skip
    """The loop about arms at rest at `q` that are sent to `target`, both (N, A, n); P = N A poses.

    Where they differ, a load that does not change is taken to hold the arm there.
    """
    arms, q, target = arms.to(torch.float64), q.double(), target.double()
    parameters = LawParameters(*(getattr(parameters, f).double() for f in ("stiffness", "null_stiffness", "alpha")))
    law, joints, num_arms = make(arms), q.shape[2], q.shape[1]
    upright = torch.eye(3, dtype=q.dtype).expand(len(q), 3, 3)
    rest, none = torch.zeros_like(q), torch.zeros(*q.shape[:2], 3, dtype=q.dtype)
    beginning, later = torch.ones(q.shape[:2], dtype=torch.bool), torch.zeros(q.shape[:2], dtype=torch.bool)

    def ask(at: torch.Tensor, rate: torch.Tensor, force: torch.Tensor, memory: dict[str, torch.Tensor] | None):
        """The law's answer, and what it remembers of it, (N, A, k)."""
        if memory is not None and isinstance(law, Remembering):
            law.memory = dict(memory)
        state = ArmState(
            at, rate, target, arms.chains.pose(at), upright, hand_force_h=force,
            fresh=beginning if memory is None else later, dt=dt,
        )  # fmt: skip
        answer, _ = law(state, parameters)
        return answer, dict(law.memory) if isinstance(law, Remembering) else {}

    _, memory = ask(q, rest, none, None)
    for _ in range(20):  # until what is remembered is at rest as well
        _, memory = ask(q, rest, none, memory)
    answer, now = ask(q, rest, none, memory)
    torque, after = answer.at(q, rest), _flat(now, q)
    columns, remembered = [], []

    def differentiate(*changed: object) -> None:
        moved, next_memory = ask(*changed)  # pyright: ignore[reportArgumentType]
        columns.append((moved.at(q, rest) - torque) / _STEP)
        remembered.append((_flat(next_memory, q) - after) / _STEP)

    for i in range(joints):
        differentiate(q + _unit(q, i), rest, none, memory)
    for i in range(joints):
        differentiate(q, _unit(q, i), none, memory)
    for name, value in memory.items():
        for i in range(value.shape[2]):
            differentiate(q, rest, none, memory | {name: value + _unit(value, i)})
    for i in range(3):
        differentiate(q, rest, _unit(none, i), memory)

    pose = arms.chains.pose(q)
    inertia = joint_inertia(arms.inertias, pose)
    up = upright[:, 2]
    weight = gravity_torque(arms.inertias, pose, up)
    sag = torch.stack(
        [
            (gravity_torque(arms.inertias, arms.chains.pose(q + _unit(q, i)), up) - weight) / _STEP
            for i in range(joints)
        ],
        -1,
    )
    poses = len(q) * num_arms
    push = torch.zeros(poses, 2 * joints, joints, dtype=q.dtype)
    push[:, joints:] = torch.linalg.inv(inertia).flatten(0, 1)
    flow = torch.zeros(poses, 2 * joints, 2 * joints, dtype=q.dtype)
    flow[:, :joints, joints:] = torch.eye(joints, dtype=q.dtype)
    damping = answer.damping + torch.diag_embed(arms.friction)
    springs = torch.cat((answer.stiffness + sag, damping), -1).flatten(0, 1)
    flow -= push @ springs
    return ClosedLoop(
        flow, push, arms.chains.jacobian(pose).flatten(0, 1), torch.stack(columns, -1).flatten(0, 1),
        torch.stack(remembered, -1).flatten(0, 1), dt,
    )  # fmt: skip


def _unit(like: torch.Tensor, i: int) -> torch.Tensor:
    """A small step along the last axis' entry `i`."""
    out = torch.zeros_like(like)
    out[..., i] = _STEP
    return out


def _flat(memory: dict[str, torch.Tensor], like: torch.Tensor) -> torch.Tensor:
    """Memory tensors (N, A, k_i) side by side, (N, A, k)."""
    return torch.cat([*memory.values(), like[..., :0]], -1)
