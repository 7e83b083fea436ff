"""Who draws energy from a hand: a force on it and a stiffness that is commanded meanwhile, both found by a search."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.compliance.dynamics import joint_inertia
from cotap.compliance.interface import Arms
from cotap.compliance.kinematics import ChainPose

COMMANDS = ("constant", "sine", "steps", "random", "knowing")
"""How stiffness and alpha are commanded: not at all; swinging or jumping at 0.5 to 2 times the natural frequency of the
hand; drawn anew as often; by where the hand is, where it goes, and whether it is pulled or braked."""
GENES = 21
_DIRECTION, _SIZE, _RATE, _PHASE, _BRAKE, _LAST, _RATIO, _SHIFT = slice(0, 3), *range(3, 10)
_DEPTH, _WAY, _FAR, _ACROSS, _CIRCLE, _SPIN, _ALPHA = slice(10, 13), 13, 14, slice(15, 18), *range(18, 21)
_REACH = 0.05
"""What counts as far from the target [m]."""
_LEAST_SPREAD = 0.15
"""Standard deviation of what the search adds to a gene on which all of the best exciters agree."""


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


def natural_frequency(arms: Arms, pose: ChainPose, stiffness: float) -> torch.Tensor:
    """Natural angular frequency (N, A) [rad/s] of hands of a stiffness [N/m], mean over directions."""
    jacobian = arms.chains.jacobian(pose)
    mobility = jacobian @ torch.linalg.solve(joint_inertia(arms.inertias, pose), jacobian.transpose(-1, -2))
    return (stiffness * mobility.diagonal(dim1=-2, dim2=-1).mean(-1)).sqrt()


class Exciters:
    """One exciter for each of N hands.

    In turns, it pulls the hand and brakes what the hand then does: braking takes energy out. A turn takes between the
    whole time and a quarter of the hand's natural period; from a moment of its own on, it only brakes. The pull is
    steady along a direction, or leads the hand around a circle beside its target, or anything between the two. It knows
    where the hand is and how fast it moves at every control step.

    Args:
        genes: (N, GENES) any numbers; of the order of 1. Zeros are an exciter that is good already: it pulls straight
            with three quarters of the force for most of the time, all axes are as stiff, and alpha stays as it is.
        command: (N,) index into `COMMANDS`.
        natural: (N,) natural angular frequency of the hand at the mean stiffness [rad/s].
        limits: The same for all.
        seed: Of the random command.
    """

    def __init__(
        self, genes: torch.Tensor, command: torch.Tensor, natural: torch.Tensor, limits: Limits, seed: int
    ) -> None:
        g, self._limits, self._command = genes, limits, command
        self._direction = _unit(g[:, _DIRECTION])
        across = g[:, _ACROSS]
        self._across = _unit(across - (across * self._direction).sum(1, keepdim=True) * self._direction)
        self._circle = (g[:, _CIRCLE, None] - 1.0).clamp(0.0, 1.0)
        self._size = limits.force * (1.0 + g[:, _SIZE]).sigmoid()
        slowest, fastest = math.pi / limits.seconds, 2.0 * natural
        self._rate = slowest * (fastest / slowest) ** g[:, _RATE].sigmoid()
        self._spin = 2.0 * slowest * (fastest / slowest) ** g[:, _SPIN].sigmoid()
        self._phase, self._brake = math.pi * g[:, _PHASE], limits.brake * g[:, _BRAKE].sigmoid()
        self._last = limits.seconds * (2.0 + g[:, _LAST]).sigmoid()
        self.frequency = natural * 2.0 ** g[:, _RATIO].tanh()
        """(N,) at which it swings or switches what it commands, where it does so by the clock [rad/s]."""
        self._shift = math.pi * g[:, _SHIFT]
        self._depth, alpha = (3.0 + 2.0 * g[:, _DEPTH]).clamp(-1.0, 1.0), g[:, _ALPHA]
        self._alpha = (alpha - alpha.clamp(-1.0, 1.0)).clamp(-1.0, 1.0)
        self._way, self._far = g[:, _WAY], g[:, _FAR]
        self._rng = torch.Generator().manual_seed(seed)
        self._held = torch.zeros_like(self._size)
        self._turn = torch.full_like(self._size, -1.0)

    def _pulls(self, time: float) -> torch.Tensor:
        """(N,) bool: it is the turn to pull."""
        return (torch.sin(self._rate * time + self._phase) > 0.0) & (self._last > time)

    def force(self, time: float, velocity: torch.Tensor) -> torch.Tensor:
        """Force (N, 3) on the hands [N], at their velocities (N, 3) [m/s]."""
        angle = (self._spin * time).unsqueeze(1)
        around = angle.sin() * self._across - angle.cos() * self._direction
        pull = self._size.unsqueeze(1) * torch.lerp(self._direction, around, self._circle)
        return torch.where(self._pulls(time).unsqueeze(1), pull, -self._brake.unsqueeze(1) * velocity)

    def command(self, time: float, offset: torch.Tensor, velocity: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What is commanded, for hands off their targets by `offset` (N, 3) [m].

        Returns:
            Stiffness (N, 3) along the axes [N/m], and the share (N,) of its first alpha that a law is to have.
        """
        level = self._level(time, offset, velocity)
        low, high = (math.log(bound) for bound in self._limits.stiffness)
        along = self._depth * level.unsqueeze(1)
        return (0.5 * (low + high) + 0.5 * (high - low) * along).exp(), 1.0 - (self._alpha * level).clamp_min(0.0)

    def _level(self, time: float, offset: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """(N,) in [-1, 1]: how far from their mean the commands are."""
        wave = torch.sin(self.frequency * time + self._shift)
        turn = torch.floor(self.frequency * time / math.pi)  # two draws in a period
        drawn = 2.0 * torch.rand(len(turn), generator=self._rng).to(turn.device) - 1.0
        self._held, self._turn = torch.where(turn == self._turn, self._held, drawn), turn
        going_out = (offset * velocity).sum(1) / (offset.norm(dim=1) * velocity.norm(dim=1)).clamp_min(1e-6)
        far = (offset.norm(dim=1) / _REACH - 1.0).clamp(-1.0, 1.0)
        cue = self._far * far - (1.0 + self._way) * going_out - torch.where(self._pulls(time), 1.0, -1.0)
        by_command = torch.stack((torch.zeros_like(wave), wave, wave.sign(), self._held, cue.sign()))
        return by_command.gather(0, self._command.unsqueeze(0)).squeeze(0)


def _unit(vectors: torch.Tensor) -> torch.Tensor:
    return vectors / vectors.norm(dim=1, keepdim=True).clamp_min(1e-6)


def next_generation(
    genes: torch.Tensor, worth: torch.Tensor, group: torch.Tensor, rng: torch.Generator
) -> torch.Tensor:
    """Genes (N, G) to try next, in each group near one of its best quarter.

    As far apart as these best ones are, gene by gene: what they agree on is searched closely, and all else widely.

    Args:
        genes: (N, G) the best so far, of each one.
        worth: (N,) what each got; larger is better, NaN is worst.
        group: (N,) number of its group, from 0; groups do not mix.
        rng: On the CPU.
    """
    out, worth = genes.clone(), worth.nan_to_num(-math.inf, math.inf)
    for number in range(int(group.max()) + 1):
        mine = (group == number).nonzero().squeeze(1)
        best = genes[mine[worth[mine].argsort(descending=True)][: max(2, len(mine) // 4)]]
        spread = (1.3 * best.std(0, correction=0)).clamp_min(_LEAST_SPREAD)
        parents = best[torch.randint(0, len(best), (len(mine),), generator=rng)]
        out[mine] = parents + spread * torch.randn(parents.shape, generator=rng)
    return out
