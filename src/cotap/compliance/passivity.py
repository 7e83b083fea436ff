"""Stiffness that changes and yet gives away no more energy than it was allotted (`docs/passivity.md`).

A spring whose stiffness is changed while it is stretched gains or loses energy. A hand that is held by such a spring
can be made to give that energy away. An `EnergyStore` keeps the account; `hold_back` lets a change through as far as
the account allows. Torch alone, for any arm and any batch:

    level = store.filled(level, damping_energy(damping, position - position_before, dt))
    held = hold_back(stiffness, stiffness_wanted, target - position, store.available(level, dt))
    level, stiffness = store.drawn(level, held.energy), held.stiffness

All is computed in float64. Inside of `torch.compile` and `torch.func`, values are not checked. `hold_back` has exact
first derivatives and no others; all else has derivatives of any order.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from cotap.checks import require_finite, require_range
from cotap.compliance.arguments import (
    full_precision,
    one_per_matrix,
    require_floats,
    require_like,
    require_positive_definite,
    require_symmetric,
    symmetric_part,
    values_are_known,
)
from cotap.compliance.geodesic import HeldStiffness, change_energy, held_stiffness, spring_energy

__all__ = ["EnergyStore", "HeldStiffness", "damping_energy", "hold_back", "rate_margin", "stiffness_energy"]


@dataclass(frozen=True)
class EnergyStore:
    """What changes of stiffness may draw on, one level per arm. Levels are tensors (...) that the caller keeps.

    Raises:
        ValueError: a value is out of its range, or floor, first filling and ceiling are not in that order.
    """

    first: float = 2.0
    """Level at first [J]. All that can ever be drawn at the hand, beyond what was put in, is this above the floor."""
    floor: float = 0.0
    """Level that is never gone below [J]."""
    ceiling: float = 2.0
    """Level above which what comes in is lost [J]."""
    power: float = 10.0
    """Most that a change may inject per time [W]."""
    damping_share: float = 0.9
    """Share of the damping's work that goes into the store. What is left makes up for damping that is overrated."""

    def __post_init__(self) -> None:
        for f in fields(self):
            require_range(f.name, getattr(self, f.name), 0.0, 1.0 if f.name == "damping_share" else 1e9)
        if not self.floor <= self.first <= self.ceiling:
            raise ValueError(
                f"floor <= first <= ceiling must hold, got {self.floor!r}, {self.first!r} and {self.ceiling!r}"
            )

    def filled(self, level: torch.Tensor, dissipated: torch.Tensor) -> torch.Tensor:
        """The level (...) once damping has taken `dissipated` (...) [J] out of the motion."""
        return (level + self.damping_share * dissipated).clamp_max(self.ceiling)

    def available(self, level: torch.Tensor, dt: float) -> torch.Tensor:
        """What the next change may inject (...) [J], of a control step of `dt` [s]."""
        return (level - self.floor).clamp(0.0, self.power * dt)

    def drawn(self, level: torch.Tensor, energy: torch.Tensor) -> torch.Tensor:
        """The level (...) once a change has injected `energy` (...) [J]; a negative one fills the store."""
        return (level.double() - energy.double()).clamp(self.floor, self.ceiling).to(level.dtype)


@full_precision
def stiffness_energy(k_old: torch.Tensor, k_new: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """`1/2 e^T (K_new - K_old) e`, (...) [J]: what a change of stiffness injects at once, exactly.

    Args:
        k_old: (..., n, n) symmetric [Nm/rad, or N/m of a hand].
        k_new: The same after the change.
        error: (..., n) target minus position [rad, or m].

    Raises:
        ValueError: dtypes or shapes do not fit, or values are not finite or not symmetric.
    """
    _require_change(k_old, k_new, error)
    return change_energy(k_old, k_new, error).to(k_old.dtype)


@full_precision
def damping_energy(damping: torch.Tensor, displacement: torch.Tensor, dt: float) -> torch.Tensor:
    """`d^T D d / dt`, (...) [J]: least energy that damping has taken out of a motion that covered d in a time dt.

    No motion between the same ends dissipates less (Jensen's inequality). The energy that the store gets so never
    exceeds the true one, whatever happened between two readings, and needs no velocity.

    Args:
        damping: (..., n, n) symmetric positive semidefinite, in force throughout [Nms/rad].
        displacement: (..., n) of the joints, against what the damping holds on to [rad].
        dt: [s].

    Raises:
        ValueError: dtypes or shapes do not fit, values are not finite or not symmetric, or `dt` is not positive.
    """
    require_symmetric("damping", damping)
    _require_vector("displacement", displacement, "damping", damping)
    _require_positive("dt", dt)
    return (2.0 / dt * spring_energy(damping, displacement)).to(damping.dtype)


@full_precision
def hold_back(
    k_old: torch.Tensor, k_new: torch.Tensor, error: torch.Tensor, available: torch.Tensor | float
) -> HeldStiffness:
    """The change from one stiffness to another, by the largest share that its energy allows.

    The share s moves along the geodesic `K(s) = K_old^1/2 (K_old^-1/2 K_new K_old^-1/2)^s K_old^1/2`. All that lies on
    it is positive definite. Along it, the energy `1/2 e^T K(s) e` is convex: a share is admissible if and only if all
    smaller ones are, and if `k_new` is, the result is `k_new`, unchanged. With nothing available, what takes energy
    out still passes.

    Args:
        k_old: (..., n, n) symmetric positive definite, in force [Nm/rad].
        k_new: (..., n, n) the same, asked for.
        error: (..., n) target minus position [rad].
        available: (...) or one number, not negative [J].

    Returns:
        The stiffness to put in force, its share in [0, 1] and the energy that it injects, at most `available`.

    Raises:
        ValueError: dtypes or shapes do not fit, values are not finite, a stiffness is not symmetric positive definite
            (see `spd_log`), or `available` is negative.
    """
    _require_change(k_old, k_new, error)
    for name, matrix in (("k_old", k_old), ("k_new", k_new)):
        if values_are_known():
            values = torch.linalg.eigvalsh(symmetric_part(matrix.detach().double()))
            require_positive_definite(name, values, matrix.dtype)
    room = one_per_matrix("available", available, "k_old", k_old).expand(error.shape[:-1])
    if values_are_known() and (room.detach() < 0.0).any():
        raise ValueError(f"available must not be negative, got {float(room.detach().amin()):g}")
    held = held_stiffness(k_old, k_new, error, room)
    return HeldStiffness(held.stiffness, held.share.to(k_old.dtype), held.energy.to(k_old.dtype))


@full_precision
def rate_margin(
    inertia: torch.Tensor,
    damping: torch.Tensor,
    stiffness: torch.Tensor,
    stiffness_rate: torch.Tensor,
    damping_rate: torch.Tensor | None = None,
) -> torch.Tensor:
    """Smallest eigenvalue (...) of `2 a K - a D' - K'`, a that of `H^-1 D`: stable without a store where not negative.

    The condition of Kronander and Billard (T-RO 2016) for a constant inertia H: there is an `a > 0` for which both
    `a H - D` and `K' + a D' - 2 a K` are negative semidefinite. The largest a that the first allows is the best one
    for the second wherever `D' <= 2 K`. Stiffness may then grow as `exp(2 a t)` and no faster.

    Args:
        inertia: H (..., n, n) symmetric positive definite [kg m^2].
        damping: D (..., n, n) symmetric positive definite [Nms/rad].
        stiffness: K (..., n, n) symmetric positive definite [Nm/rad].
        stiffness_rate: K' (..., n, n) symmetric [Nm/rad/s].
        damping_rate: D' (..., n, n) symmetric [Nm/rad]; None for none.

    Raises:
        ValueError: dtypes or shapes do not fit, values are not finite or not symmetric, or inertia, damping or
            stiffness is not positive definite.
    """
    given = {"inertia": inertia, "damping": damping, "stiffness": stiffness, "stiffness_rate": stiffness_rate}
    if damping_rate is not None:
        given["damping_rate"] = damping_rate
    require_symmetric("inertia", inertia)
    for name, matrix in given.items():
        _require_same(name, matrix, "inertia", inertia)
        require_symmetric(name, matrix)
        if not name.endswith("_rate") and values_are_known():
            values = torch.linalg.eigvalsh(symmetric_part(matrix.detach().double()))
            require_positive_definite(name, values, matrix.dtype)
    factor = torch.linalg.cholesky(inertia.double())
    half = torch.linalg.solve_triangular(factor, damping.double(), upper=False)
    decay = torch.linalg.solve_triangular(factor, half.transpose(-1, -2), upper=False)
    rate = torch.linalg.eigvalsh(symmetric_part(decay))[..., 0, None, None]
    allowed = 2.0 * rate * stiffness.double() - stiffness_rate.double()
    if damping_rate is not None:
        allowed = allowed - rate * damping_rate.double()
    return torch.linalg.eigvalsh(symmetric_part(allowed))[..., 0].to(inertia.dtype)


def _require_change(k_old: torch.Tensor, k_new: torch.Tensor, error: torch.Tensor) -> None:
    require_symmetric("k_old", k_old)
    _require_same("k_new", k_new, "k_old", k_old)
    require_symmetric("k_new", k_new)
    _require_vector("error", error, "k_old", k_old)


def _require_same(name: str, value: torch.Tensor, of: str, other: torch.Tensor) -> None:
    """Raise ValueError unless `value` has dtype, device and shape of `other`, the argument `of`."""
    require_like(name, value, of, other)
    require_floats(name, value)
    if value.shape != other.shape:
        raise ValueError(f"{name} must have the shape of {of}, {tuple(other.shape)}, got {tuple(value.shape)}")


def _require_vector(name: str, value: torch.Tensor, of: str, matrix: torch.Tensor) -> None:
    """Raise ValueError unless `value` is (..., n) to the (..., n, n) `matrix`, the argument `of`."""
    require_like(name, value, of, matrix)
    if value.shape != matrix.shape[:-1]:
        raise ValueError(f"{name} must have shape {tuple(matrix.shape[:-1])}, got {tuple(value.shape)}")


def _require_positive(name: str, value: float) -> None:
    if require_finite(name, value) <= 0.0:
        raise ValueError(f"{name} must be positive, got {value!r}")
