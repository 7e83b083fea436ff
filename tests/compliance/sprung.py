"""A mass on springs whose stiffness changes, with exact energy accounts: what tests of passivity push about."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from cotap.compliance.passivity import EnergyStore, damping_energy, hold_back

DT = 0.02
Wanted = Callable[[int, torch.Tensor, torch.Tensor], torch.Tensor]
"""Stiffness (B, n, n) asked for at a control step, at positions and velocities (B, n)."""
Force = Callable[[int, torch.Tensor, torch.Tensor], torch.Tensor]
"""Force (B, n) from outside in a control step."""


@dataclass
class Run:
    """T control steps of B masses."""

    drawn: torch.Tensor
    """(T, B) work that the forces from outside have taken out since the beginning [J]."""
    level: torch.Tensor
    """(T, B) of the store [J]."""
    share: torch.Tensor
    """(T, B) of the change asked for that was let through."""
    stiffness: torch.Tensor
    """(T, B, n, n) in force."""
    injected: torch.Tensor
    """(T, B) by the change of that step [J]."""
    position: torch.Tensor
    """(T, B, n) after the step."""


def run(
    wanted: Wanted, force: Force, start: torch.Tensor, damping: torch.Tensor, steps: int, store: EnergyStore | None,
    mass: torch.Tensor | None = None, wall: torch.Tensor | None = None, substeps: int = 8,
    at: torch.Tensor | None = None, dtype: torch.dtype = torch.float64,
) -> Run:  # fmt: skip
    """`M x'' = -K x - D x' - W x + f` from rest; the filter sees x in `dtype`.

    The midpoint rule conserves the energy of every one of its steps to rounding: what is drawn comes from the springs
    and from nowhere else, whatever the size of the step.

    Args:
        wanted: The stiffness that is asked for.
        force: From outside.
        start: (B, n, n) stiffness in force at first.
        damping: (B, n, n).
        steps: Of control.
        store: None for no filter.
        mass: (n, n), the identity by default.
        wall: (B, n, n) a spring between the mass and the world, part of what is outside.
        at: (B, n) where it begins, the springs' rest by default; the energy in them counts as stored at first.
    """
    batch, n = start.shape[:2]
    inertia = torch.eye(n, dtype=torch.float64) if mass is None else mass
    wall = torch.zeros_like(damping) if wall is None else wall
    x = torch.zeros(batch, n, dtype=torch.float64) if at is None else at.clone()
    v, k, drawn = torch.zeros_like(x), start.to(dtype), torch.zeros(batch, dtype=torch.float64)
    level = torch.full((batch,), 0.0 if store is None else store.first, dtype=dtype)
    before, h, rows = x, DT / substeps, []
    for step in range(steps):
        ask = wanted(step, x, v).to(dtype)
        share, energy = torch.ones_like(level), torch.zeros_like(level)
        if store is None:
            k = ask
        else:
            level = store.filled(level, damping_energy(damping.to(dtype), (x - before).to(dtype), DT))
            held = hold_back(k, ask, -x.to(dtype), store.available(level, DT))
            k, share, energy = held.stiffness, held.share, held.energy
            level = store.drawn(level, energy)
        before, f = x, force(step, x, v)
        spring = k.double() + wall
        # M 2 (v_mid - v) / h = f - K (x + h v_mid / 2) - D v_mid.
        solve = torch.linalg.inv(2.0 * inertia / h + damping + 0.5 * h * spring)
        for _ in range(substeps):
            push = f - _apply(spring, x) + 2.0 / h * v @ inertia
            middle = _apply(solve, push)
            pull = -_apply(wall, x + 0.5 * h * middle)
            drawn = drawn - h * ((f + pull) * middle).sum(-1)
            x, v = x + h * middle, 2.0 * middle - v
        rows.append((drawn, level, share, k, energy, x))
    return Run(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _apply(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)
