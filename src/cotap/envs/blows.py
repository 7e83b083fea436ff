"""Blows on a hand while a policy learns: short and strong, out of nothing, and harder the better it takes them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.checks import require_interval, require_range
from cotap.envs.persistence import Stateful, uniform

_LARGEST_PITCH_RAD = 0.5
NEVER_S = 1e9


@dataclass
class BlowConfig:
    """Blows of training, and the curriculum of their size."""

    enabled: bool = False
    """Whether there are any; training switches them on."""
    episode_share: float = 0.5
    """Share of the episodes that have blows."""
    force: tuple[float, float] = (100.0, 500.0)
    """Size of a full blow, uniform [N]."""
    duration_s: tuple[float, float] = (0.02, 0.06)
    """How long it lasts, uniform [s]; in whole control steps, at least one."""
    interval_s: tuple[float, float] = (2.5, 6.0)
    """Time from one blow to the next [s]."""
    recovery_s: float = 2.0
    """A robot that is on its feet for so long after a blow has taken it; one that falls within has not."""
    curriculum_start: float = 0.2
    """Share of the force with which worlds begin."""
    curriculum_step: float = 0.02
    """What is added to a world's share for a blow that it took."""
    curriculum_back: float = 0.4
    """What is taken off for one that it did not: the share settles where one blow in twenty throws the robot."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("force", "duration_s", "interval_s"):
            require_interval(f"blows.{name}", getattr(self, name))
        require_range("blows.force[0]", self.force[0], 0.0, 1e6)
        require_range("blows.duration_s[0]", self.duration_s[0], 0.0, 10.0)
        require_range("blows.recovery_s", self.recovery_s, 0.0, 60.0)
        require_range("blows.interval_s[0]", self.interval_s[0], self.recovery_s, 1e6)
        for name in ("episode_share", "curriculum_start", "curriculum_step", "curriculum_back"):
            require_range(f"blows.{name}", getattr(self, name), 0.0, 1.0)


class Blows(Stateful):
    """In every world, one hand at a time is struck; direction about the vertical uniform, pitch up to 0.5 rad."""

    STATE = ("_force_h", "_since_s", "_duration_s", "_interval_s", "scale")

    def __init__(self, cfg: BlowConfig, num_envs: int, num_hands: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt = cfg, dt
        self._force_h = torch.zeros(num_envs, num_hands, 3)
        self._since_s = torch.full((num_envs,), NEVER_S)
        """Since the last blow set in."""
        self._duration_s = torch.zeros(num_envs)
        self._interval_s = torch.full((num_envs,), cfg.interval_s[1])
        self.scale = torch.full((num_envs,), cfg.curriculum_start)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """Worlds of `mask` begin with a free hand; the first blow comes after an interval."""
        if not self.cfg.enabled:
            return
        self._force_h[mask] = 0.0
        # Nothing to recover from: the clock begins where a blow would count as taken.
        self._since_s[mask] = self.cfg.recovery_s + self._dt
        self._interval_s[mask] = uniform(rng, *self.cfg.interval_s, int(mask.sum())) + self.cfg.recovery_s
        spared = torch.rand(int(mask.sum()), generator=rng, device=rng.device) >= self.cfg.episode_share
        self._interval_s[mask] = torch.where(spared, NEVER_S, self._interval_s[mask])

    def recovering(self) -> torch.Tensor:
        """(N,) bool: a blow set in no longer ago than `recovery_s`."""
        return self._since_s <= self.cfg.recovery_s

    def step(self, fell: torch.Tensor, learn: bool, rng: torch.Generator) -> None:
        """Advance by one control step: judge blows that are over, and strike where it is time.

        Args:
            fell: (N,) bool, worlds that fell in this step.
            learn: Whether the sizes adapt.
            rng: Source of the next blows.
        """
        if not self.cfg.enabled:
            return
        before = self.recovering()
        self._since_s = self._since_s + self._dt
        if learn:
            taken, thrown = before & ~self.recovering() & ~fell, before & fell
            change = self.cfg.curriculum_step * taken.float() - self.cfg.curriculum_back * thrown.float()
            self.scale = (self.scale + change).clamp(0.0, 1.0)
        self._strike(self._since_s >= self._interval_s, rng)

    def _strike(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        n, hands = int(mask.sum()), self._force_h.shape[1]
        if n == 0:
            return
        cfg = self.cfg
        yaw, pitch = uniform(rng, -math.pi, math.pi, n), uniform(rng, -_LARGEST_PITCH_RAD, _LARGEST_PITCH_RAD, n)
        direction = torch.stack((pitch.cos() * yaw.cos(), pitch.cos() * yaw.sin(), pitch.sin()), -1)
        hand = torch.randint(hands, (n,), generator=rng, device=rng.device)
        force = torch.zeros(n, hands, 3, device=rng.device)
        size = uniform(rng, *cfg.force, n) * self.scale[mask]
        force[torch.arange(n, device=rng.device), hand] = size.unsqueeze(1) * direction
        self._force_h[mask], self._since_s[mask] = force, 0.0
        self._duration_s[mask] = uniform(rng, *cfg.duration_s, n)
        self._interval_s[mask] = uniform(rng, *cfg.interval_s, n)

    def current(self) -> torch.Tensor:
        """Forces (N, hands, 3) of the next control step in the heading frame [N]."""
        # At least one step, and rounded to the nearest: a step begins at its time.
        on = self._since_s < (self._duration_s - 0.5 * self._dt).clamp_min(0.5 * self._dt)
        return self._force_h * on[:, None, None]
