"""How a hand comes to rest after a push: energy of its oscillation, overshoots, settling (paper, Fig. 9)."""

from __future__ import annotations

import math

import torch

from cotap.evaluation.rollout import Trajectory

BAND = 0.1
"""Share of the largest displacement within which a hand counts as back where it was."""


def transient_measures(
    t: Trajectory, onset: int, release: int, end: int, hit: list[int], before_s: float
) -> dict[str, torch.Tensor]:
    """What the hands in `hit` do about where they were, from the end of a push on, per env, (N,) each.

    A hand's displacement is its offset from the reference, which the torso carries, less the mean offset of the time
    before the onset. It counts as positive on the side of the largest displacement.

    - `transient_energy`: mean of half its velocity squared, from the end of the push to the window's end [J/kg].
    - `oscillation_energy`: of that what moves after the hand has first come back to where it was: what a hand that
      returns without swinging through does not have. A linear oscillator of frequency w and damping ratio z, struck to
      a velocity v, has v^2 / (8 z w) in all (times 1 s), and that times exp(-2 pi z / sqrt(1 - z^2)) after its return.
    - `overshoot`: largest displacement to the other side over the largest.
    - `overshoots`: how often it swings from one side to the other by more than `BAND` of the largest.
    - `settle_s`: time from the onset after which it stays within `BAND` of the largest until the record's end, and
      `settled_fraction`, whether it does.

    Args:
        t: What was recorded.
        onset: Step at which the push begins.
        release: Step at which it ends.
        end: Step at which the window ends.
        hit: Indices of the hands.
        before_s: Time before the onset that displacements are relative to [s].

    Returns:
        Means over the hands in `hit`; NaN for an env that fell before the window's end, and `settle_s` also for one
        that fell later or did not settle.
    """
    moved = t.hand_offset[:, :, hit]
    moved = moved - moved[onset - round(before_s / t.dt) : onset].mean(0)
    velocity = torch.diff(moved, dim=0, prepend=moved[:1]) / t.dt
    side, largest, when = _along_the_largest(moved[onset:end])
    power = 0.5 * velocity[release:end].square().sum(-1)
    returned = _returned(side, when)[release - onset :]
    swung_back = (-side).amax(0).clamp_min(0.0) / largest.clamp_min(1e-9)
    settle_s, settled = back_within(moved.norm(dim=-1), BAND * largest, t.alive(), onset, t.dt)
    out = {
        "transient_energy": power.mean(0),
        "oscillation_energy": torch.where(returned, power, torch.zeros_like(power)).mean(0),
        "overshoot": swung_back,
        "overshoots": _crossings(side, BAND * largest),
        "settle_s": settle_s,
    }
    upright = t.alive()[end - 1]
    return {
        **{name: torch.where(upright, value.mean(1), math.nan) for name, value in out.items()},
        "settled_fraction": settled.all(1),
    }


def _along_the_largest(moved: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Displacements (T, N, H, 3) along the largest of them (T, N, H), its length (N, H), and its step (N, H)."""
    largest, when = moved.norm(dim=-1).max(0)
    index = when[None, ..., None].expand(1, *moved.shape[1:])
    direction = moved.gather(0, index)[0] / largest.clamp_min(1e-9).unsqueeze(-1)
    return (moved * direction).sum(-1), largest, when


def _returned(side: torch.Tensor, when: torch.Tensor) -> torch.Tensor:
    """Where (T, N, H) hands have come back to zero after step `when` (N, H)."""
    after = torch.arange(len(side))[:, None, None] > when
    return ((side <= 0.0) & after).cumsum(0) > 0


def _crossings(side: torch.Tensor, least: torch.Tensor) -> torch.Tensor:
    """How often (N, H) `side` (T, N, H) goes from beyond `least` (N, H) on one side to beyond it on the other."""
    last, count = torch.zeros_like(least), torch.zeros_like(least)
    for now in side:
        beyond = torch.where(now.abs() > least, now.sign(), torch.zeros_like(now))
        count += (beyond * last < 0.0).float()
        last = torch.where(beyond != 0.0, beyond, last)
    return count


def back_within(
    error: torch.Tensor, bound: torch.Tensor, alive: torch.Tensor, onset: int, dt: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """When `error` (T, N, ...) is back for good within `bound` (N, ...).

    Args:
        error: Sizes of errors.
        bound: What they may be.
        alive: (T, N) bool.
        onset: Step from which on they are looked at.
        dt: Control step [s].

    Returns:
        Seconds (N, ...) from the onset, NaN where it never leaves, never comes back within the record, or the robot
        falls; and whether (N, ...) the robot stands and the error is back, or never left, by the record's end.
    """
    over = error[onset:] > bound
    steps = torch.arange(1, len(over) + 1).reshape(-1, *[1] * bound.dim())
    last = torch.where(over, steps, 0).amax(0)
    stands = alive.all(0).reshape(-1, *[1] * (bound.dim() - 1))
    back = (last < len(over)) & stands
    return torch.where(back & (last > 0), last.float() * dt, torch.full_like(bound, math.nan)), back
