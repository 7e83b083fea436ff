"""CoTaP's law with an energy store per arm: what its changing stiffness injects is bounded (`docs/passivity.md`)."""

from __future__ import annotations

import torch

from cotap.compliance.arguments import full_precision
from cotap.compliance.geodesic import held_stiffness, spring_energy
from cotap.compliance.interface import Arms, ArmState, LawParameters, LawReport, Remembering, TorqueLaw
from cotap.compliance.laws import CoTaPLaw, LawConfig
from cotap.compliance.passivity import EnergyStore


class PassiveCoTaPLaw(CoTaPLaw, Remembering):
    """CoTaP's law; a change of its spring that the store cannot pay is held back.

    The spring changes by its stiffness, and by its rest: with the task error it moves with the pose. That the target
    moves does not count. A change whose energy is not a number is not made and empties the store. Reports
    `store_energy`, the level [J], and `held_back`, the share of the change that was not let through.

    Args:
        arms: What is driven.
        cfg: See `CoTaPLaw`; and how much the store holds and gives per time.
    """

    def __init__(self, arms: Arms, cfg: LawConfig) -> None:
        CoTaPLaw.__init__(self, arms, cfg)
        Remembering.__init__(self)
        self._store = EnergyStore(cfg.store_energy, ceiling=cfg.store_energy, power=cfg.store_power)

    @full_precision
    def __call__(self, state: ArmState, parameters: LawParameters) -> tuple[TorqueLaw, LawReport]:
        """See `CoTaPLaw`."""
        torque, report = super().__call__(state, parameters)
        undamped = state.position
        if self._cfg.damping == "critical" and state.target_velocity is not None:
            undamped = undamped + state.dt * state.target_velocity  # what moves with the reference is not damped
        self.memory |= {
            "stiffness": torque.stiffness.flatten(-2),
            "damping": torque.damping.flatten(-2),
            "undamped": undamped,
        }
        return torque, report

    def take_over(self, env: int, arm: int, other: dict[str, torch.Tensor], like: torch.Tensor) -> bool:
        """See `Remembering`. Goes on with the spring and the store of another passive law. Of any other law neither is
        known, and the store begins empty."""
        n = like.shape[-1]
        for name, width in (("stiffness", n * n), ("damping", n * n), ("undamped", n), ("rest", n), ("store", 1)):
            unknown = like.new_full((*like.shape[:2], width), torch.nan)
            mine = self.memory.get(name, unknown).clone()
            mine[env, arm] = other.get(name, unknown)[env, arm]
            self.memory[name] = mine
        return True

    @torch.no_grad()
    def _in_force(
        self, state: ArmState, stiffness: torch.Tensor, error: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
        size = stiffness.shape[-2:]
        old = self.recall(state, "stiffness", stiffness.flatten(-2)).unflatten(-1, size)
        joint_error = state.target - state.position
        rest = self.recall(state, "rest", error - joint_error)
        before = joint_error + rest  # of the spring in force, carried along with the target
        asked, level = stiffness, self._filled(state, size)
        room = self._store.available(level, state.dt)
        energy = spring_energy(stiffness, error) - spring_energy(old, before)
        share, known = torch.ones_like(level), energy.isfinite()
        held = ((energy > room) & known).nonzero(as_tuple=True)
        if len(held[0]):
            stiffness, error = stiffness.clone(), error.clone()
            given = (x[held] for x in (old, stiffness, before, error, room))
            stiffness[held], error[held], share[held], energy[held] = held_spring(*given)
        level = self._store.drawn(level, energy)
        now = error - joint_error
        if not known.all():
            kept = ~known & spring_energy(old, rest).isfinite()  # there is a spring to stay with
            stiffness = torch.where(kept[..., None, None], old, stiffness)
            error = torch.where(kept.unsqueeze(-1), before, error)
            now = torch.where(kept.unsqueeze(-1), rest, now)
            share = torch.where(kept, 0.0, share)
            level = torch.where(known, level, self._store.floor)
        self.memory |= {"store": level.unsqueeze(-1), "rest": now}
        ratio = _trace(stiffness) / _trace(asked)
        return stiffness, error, {"store_energy": level, "held_back": 1.0 - share, "stiffness_ratio": ratio}

    def _filled(self, state: ArmState, size: torch.Size) -> torch.Tensor:
        """The store's level (N, A) once the damping of the past step is in it."""
        q = state.position
        full = torch.full_like(q[..., :1], self._store.first)
        level = self.recall(state, "store", full).squeeze(-1)
        none = torch.zeros_like(q[..., :1]).expand(*q.shape[:-1], size.numel())
        damping = self.recall(state, "damping", none).unflatten(-1, size)
        moved = q - self.recall(state, "undamped", q)
        # See `passivity.damping_energy`.
        dissipated = 2.0 / state.dt * spring_energy(damping, moved)
        return self._store.filled(level, torch.where(dissipated.isfinite(), dissipated, 0.0).to(level.dtype))


def _trace(matrix: torch.Tensor) -> torch.Tensor:
    """Of matrices (..., n, n)."""
    return matrix.diagonal(dim1=-2, dim2=-1).sum(-1)


def held_spring(
    old: torch.Tensor, new: torch.Tensor, before: torch.Tensor, error: torch.Tensor, room: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """From one spring to another, as far as `room` (R,) [J] allows: first the rest, then the stiffness.

    Args:
        old: (R, n, n) stiffness in force.
        new: (R, n, n) asked for.
        before: (R, n) error of the spring in force.
        error: (R, n) of the one asked for.
        room: (R,).

    Returns:
        Stiffness and error to put in force, the share of the change that is made, and what it injects.
    """
    reached, part, spent = _moved_rest(old, before, error, room)
    held = held_stiffness(old, new, reached, room - spent)
    return held.stiffness, reached, (part * held.share).to(error.dtype), spent + held.energy


def _moved_rest(
    stiffness: torch.Tensor, before: torch.Tensor, error: torch.Tensor, room: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """From an error `before` (R, n) towards `error` as far as `room` (R,) [J] allows: the error that is reached, the
    share of the way (R,), 0 where rounding alone needs more, and the energy that it injects (R,) [J]."""
    shift = error - before
    if not shift.any():  # as always with the joint error
        return error, torch.ones_like(room), torch.zeros_like(room)
    held = spring_energy(stiffness, before)
    bend = spring_energy(stiffness, shift)
    slope = spring_energy(stiffness, error) - held - bend
    # Largest r with slope r + bend r^2 <= room, but for rounding.
    most = room.double() - 1e-6 * held
    root = (slope.square() + 4.0 * bend * most).clamp_min(0.0).sqrt()
    tiny = torch.finfo(root.dtype).tiny
    part = torch.where(slope > 0.0, 2.0 * most / (slope + root + tiny), (root - slope) / (2.0 * bend + tiny))
    whole = (slope + bend <= most) | (shift == 0.0).all(-1)
    part = torch.where(whole, 1.0, part.clamp(0.0, 1.0)).to(shift.dtype)
    reached = torch.where((part < 1.0).unsqueeze(-1), before + part.unsqueeze(-1) * shift, error)
    spent = spring_energy(stiffness, reached) - held
    none = spent > room
    return (
        torch.where(none.unsqueeze(-1), before, reached),
        torch.where(none, 0.0, part),
        torch.where(none, 0.0, spent),
    )
