"""Who draws energy from a hand: a force on it and a stiffness that is commanded meanwhile, both found by a search."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

COMMANDS = ("constant", "sine", "steps", "random", "knowing")
"""How stiffness is commanded: not at all; swinging or jumping at 0.5 to 2 times the natural frequency of the hand;
drawn anew as often; stiff or soft by where the hand is, where it goes, and whether it is pulled or braked."""
GENES = 13
_DIRECTION, _SIZE, _RATE, _PHASE, _BRAKE, _LAST, _RATIO, _SHIFT, _DEPTH, _WAY, _FAR = slice(0, 3), *range(3, 13)
_REACH = 0.05
"""What counts as far from the target [m]."""


@dataclass(frozen=True)
class Limits:
    """What exciters have."""

    force: float
    """Largest force that pulls the hand [N]."""
    brake: float
    """Largest coefficient of a braking force [Ns/m]."""
    stiffness: tuple[float, float]
    """Softest and stiffest that may be commanded [N/m]."""
    seconds: float
    """How long they have [s]."""


class Exciters:
    """One exciter for each of N hands.

    In turns, it pulls the hand along a direction and brakes what the hand then does: braking takes energy out. A turn
    takes half a period of a 16th to twice the hand's natural frequency; from a moment of its own on, it only brakes. It
    knows where the hand is and how fast it moves at every control step.

    Args:
        genes: (N, GENES) any numbers; of the order of 1.
        command: (N,) index into `COMMANDS`.
        natural: (N,) natural angular frequency of the hand at the mean stiffness [rad/s].
        limits: The same for all.
        seed: Of the random command.
    """

    def __init__(
        self, genes: torch.Tensor, command: torch.Tensor, natural: torch.Tensor, limits: Limits, seed: int
    ) -> None:
        g, self._limits, self._command = genes, limits, command
        direction = g[:, _DIRECTION]
        self._direction = direction / direction.norm(dim=1, keepdim=True).clamp_min(1e-6)
        self._size = limits.force * g[:, _SIZE].sigmoid()
        self._rate, self._phase = natural * 2.0 ** (2.5 * g[:, _RATE].tanh() - 1.5), math.pi * g[:, _PHASE]
        self._brake = limits.brake * g[:, _BRAKE].sigmoid()
        self._last = limits.seconds * g[:, _LAST].sigmoid()
        self._ratio, self._shift = natural * 2.0 ** g[:, _RATIO].tanh(), math.pi * g[:, _SHIFT]
        self._depth, self._way, self._far = g[:, _DEPTH].tanh(), g[:, _WAY], g[:, _FAR]
        self._rng = torch.Generator().manual_seed(seed)
        self._held = torch.zeros_like(self._size)
        self._turn = torch.full_like(self._size, -1.0)

    def _pulls(self, time: float) -> torch.Tensor:
        """(N,) bool: it is the turn to pull."""
        return (torch.sin(self._rate * time + self._phase) > 0.0) & (self._last > time)

    def force(self, time: float, velocity: torch.Tensor) -> torch.Tensor:
        """Force (N, 3) on the hands [N], at their velocities (N, 3) [m/s]."""
        pull = self._size.unsqueeze(1) * self._direction
        return torch.where(self._pulls(time).unsqueeze(1), pull, -self._brake.unsqueeze(1) * velocity)

    def stiffness(self, time: float, offset: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Stiffness (N,) that is commanded [N/m], for hands off their targets by `offset` (N, 3) [m]."""
        wave = torch.sin(self._ratio * time + self._shift)
        turn = torch.floor(self._ratio * time / math.pi)  # two draws in a period
        drawn = 2.0 * torch.rand(len(turn), generator=self._rng).to(turn.device) - 1.0
        self._held, self._turn = torch.where(turn == self._turn, self._held, drawn), turn
        going_out = (offset * velocity).sum(1) / (offset.norm(dim=1) * velocity.norm(dim=1)).clamp_min(1e-6)
        far = (offset.norm(dim=1) / _REACH - 1.0).clamp(-1.0, 1.0)
        cue = self._far * far - (1.0 + self._way) * going_out - torch.where(self._pulls(time), 1.0, -1.0)
        by_command = torch.stack((torch.zeros_like(wave), self._depth * wave, wave.sign(), self._held, cue.sign()))
        level = by_command.gather(0, self._command.unsqueeze(0)).squeeze(0)
        low, high = (math.log(bound) for bound in self._limits.stiffness)
        return (0.5 * (low + high) + 0.5 * (high - low) * level).exp()


def next_generation(
    genes: torch.Tensor, worth: torch.Tensor, group: torch.Tensor, rng: torch.Generator, spread: float
) -> torch.Tensor:
    """Genes (N, G) to try next: in each group the best quarter stay, and the others are near one of them.

    Args:
        genes: (N, G) that were tried.
        worth: (N,) what each got; larger is better, NaN is worst.
        group: (N,) number of its group, from 0; groups do not mix.
        rng: On the CPU.
        spread: Standard deviation of what is added.
    """
    out, worth = genes.clone(), worth.nan_to_num(-math.inf, math.inf)
    for number in range(int(group.max()) + 1):
        mine = (group == number).nonzero().squeeze(1)
        ranked = mine[worth[mine].argsort(descending=True)]
        best = ranked[: max(1, len(ranked) // 4)]
        others = ranked[len(best) :]
        parents = best[torch.randint(0, len(best), (len(others),), generator=rng)]
        out[others] = genes[parents] + spread * torch.randn(len(others), genes.shape[1], generator=rng)
    return out


def best_of(genes: torch.Tensor, worth: torch.Tensor, group: torch.Tensor) -> torch.Tensor:
    """The best genes (N, G) of each one's group."""
    out, worth = genes.clone(), worth.nan_to_num(-math.inf, math.inf)
    for number in range(int(group.max()) + 1):
        mine = (group == number).nonzero().squeeze(1)
        out[mine] = genes[mine[worth[mine].argmax()]]
    return out
