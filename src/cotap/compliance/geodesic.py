"""From one stiffness to another by the largest share that an amount of energy allows.

Unchecked, for rollouts; `cotap.compliance.passivity` checks what it is given. All is computed in float64.

With `K_old = L L^T` and `L^-1 K_new L^-T = Q diag(r) Q^T`, the geodesic of the affine-invariant metric is
`K(s) = L Q diag(r^s) Q^T L^T`. The energy of a displacement along it is a sum of exponentials of s with positive
weights, `e^T K(s) e = sum_i w_i r_i^s` with `w = (Q^T L^T e)^2`, and so is convex. Therefore the shares that an amount
of energy allows are an interval that begins at 0, and its end is well defined.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from cotap.compliance.arguments import symmetric_part, values_are_known
from cotap.compliance.spd import log_from_eigenvectors

_ITERATIONS = 24
"""Most Newton steps of the search for a share. They converge quadratically."""
_CLOSE = 1e-12
"""The search ends with the first step, mostly the fifth, that lowers no arm's share by more than this."""


class HeldStiffness(NamedTuple):
    """A change of stiffness, held back where it asked for too much energy."""

    stiffness: torch.Tensor
    """(..., n, n) what may be put in force [Nm/rad]."""
    share: torch.Tensor
    """(...) how far it is from the old stiffness (0) to the one asked for (1)."""
    energy: torch.Tensor
    """(...) what the change injects [J], never more than was available; negative if it takes energy out."""


def spring_energy(stiffness: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """`1/2 e^T K e`, (...) in float64, for (..., n, n) and (..., n)."""
    e = error.double()
    return 0.5 * (e * (stiffness.double() @ e.unsqueeze(-1)).squeeze(-1)).sum(-1)


def change_energy(k_old: torch.Tensor, k_new: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """`1/2 e^T (K_new - K_old) e`, (...) in float64."""
    return spring_energy(k_new.double() - k_old.double(), error)


def held_stiffness(
    k_old: torch.Tensor, k_new: torch.Tensor, error: torch.Tensor, available: torch.Tensor
) -> HeldStiffness:
    """The change from `k_old` to `k_new`, both (..., n, n), by the largest share that `available` (...) [J] allows.

    See `cotap.compliance.passivity.hold_back`. Energy and share are in float64.
    """
    old, new, e, room = (x.double() for x in (k_old, k_new, error, available))
    factor, info = torch.linalg.cholesky_ex(old)
    refused = info > 0  # an arm whose stiffness is not positive definite, by rounding, keeps it; others go on
    factor = torch.where(refused[..., None, None], torch.eye(old.shape[-1], dtype=old.dtype, device=old.device), factor)
    half = torch.linalg.solve_triangular(factor, new, upper=False)
    ratio = symmetric_part(torch.linalg.solve_triangular(factor, half.transpose(-1, -2), upper=False))
    values, vectors = torch.linalg.eigh(ratio.detach())
    axes = factor.detach() @ vectors
    weights = (axes.transpose(-1, -2) @ e.detach().unsqueeze(-1)).squeeze(-1).square()
    rates = values.clamp_min(torch.finfo(torch.float64).tiny).log()
    left = 2.0 * room.detach() - _rounding(old, new, e, k_old.dtype).detach()
    share = _largest_share(weights, rates, weights.sum(-1) + left)

    if torch.is_grad_enabled():  # differentiable at equal eigenvalues, too
        log = log_from_eigenvectors(ratio, values, vectors)
        whole = torch.linalg.matrix_exp(share[..., None, None] * log)
        # Value zero; derivatives those of the equation that the share solves (implicit function theorem).
        tall = (factor.transpose(-1, -2) @ e.unsqueeze(-1)).squeeze(-1)
        excess = (tall * (whole @ tall.unsqueeze(-1)).squeeze(-1)).sum(-1) - tall.square().sum(-1) - 2.0 * room
        slope = (weights * rates * (share.unsqueeze(-1) * rates).exp()).sum(-1)
        moved = -(excess - excess.detach()) / torch.where(slope > 0.0, slope, torch.inf)
        whole = whole + moved[..., None, None] * (log @ whole)
        share = share + moved
        between = factor @ whole @ factor.transpose(-1, -2)
    else:
        between = (axes * (share.unsqueeze(-1) * rates).exp().unsqueeze(-2)) @ axes.transpose(-1, -2)
    between = symmetric_part(between).to(k_old.dtype)

    free = change_energy(old, new, e) <= room
    stiffness = torch.where(free[..., None, None], k_new, between)
    energy = change_energy(k_old, stiffness, error)
    none = (energy > room) | refused  # less is available than rounding needs
    return HeldStiffness(
        torch.where(none[..., None, None], k_old, stiffness),
        torch.where(none, 0.0, torch.where(free, 1.0, share)),
        torch.where(none, 0.0, energy),
    )


def _rounding(old: torch.Tensor, new: torch.Tensor, error: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Bound (...) on twice the energy that rounding adds: of the result to `dtype`, and in getting there."""
    most = torch.maximum(old, new).diagonal(dim1=-2, dim2=-1)
    entries = (most.sqrt() * error.abs()).sum(-1).square()
    return torch.finfo(dtype).eps * entries + 64.0 * torch.finfo(old.dtype).eps * most.sum(-1) * error.square().sum(-1)


def _largest_share(weights: torch.Tensor, rates: torch.Tensor, bound: torch.Tensor) -> torch.Tensor:
    """Largest s (...) with `sum_i w_i exp(r_i s) <= bound`, for weights and rates (..., n).

    At 0 the sum must be within the bound, but for rounding, and at 1 above it; otherwise the result means nothing. Its
    logarithm is convex and nearly straight: Newton's steps from 1 come down to where it meets the bound. It bends by at
    most a quarter of the squared spread of the rates, which tells how much further down it is surely within.
    """
    tiny = torch.finfo(weights.dtype).tiny
    aim = bound.clamp_min(tiny).log()

    def excess(s: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Logarithm of sum over bound at s, and its slope."""
        terms = weights * (s.unsqueeze(-1) * rates).exp()
        total = terms.sum(-1).clamp_min(tiny)
        return total.log() - aim, (terms * rates).sum(-1) / total

    share = torch.ones_like(bound)
    for _ in range(_ITERATIONS):
        over, slope = excess(share)
        before, share = share, (share - over / torch.where(slope > 0.0, slope, torch.inf)).clamp(0.0, 1.0)
        if values_are_known() and (share >= before - _CLOSE).all():
            break
    over, slope = excess(share)
    over = over.clamp_min(0.0)
    bend = 0.25 * (rates.amax(-1) - rates.amin(-1)).square()
    square = slope.square() - 2.0 * bend * over
    within = share - 2.0 * over / (slope + square.clamp_min(0.0).sqrt())
    return torch.where((slope > 0.0) & (square > 0.0), within, 0.0).clamp_min(0.0)
