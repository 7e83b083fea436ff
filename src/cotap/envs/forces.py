"""Forces on the hands that follow a script: held, struck or swinging, the same profile for every protocol."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.checks import require_finite, require_one_of, require_range
from cotap.envs.persistence import Stateful

HANDS = ("left", "right", "both")


@dataclass
class ForceProfile:
    """A force on one hand or both, in the heading frame, from a moment on and for a while."""

    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Along x, y and z [N]; zero for none."""
    hand: str = "left"
    """left, right or both."""
    start_s: float = 1.0
    """When it sets in, from the episode's start [s]."""
    duration_s: float = 1e6
    """How long it lasts [s]."""
    period_s: float = 0.0
    """0 for a constant force; otherwise it swings as a sine with this period [s]."""
    random_direction: bool = False
    """Turn the force about the vertical by a random angle, drawn per world and episode."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_one_of("force.hand", self.hand, HANDS)
        for i, value in enumerate(self.force):
            require_finite(f"force.force[{i}]", value)
        require_range("force.start_s", self.start_s, 0.0, 1e6)
        require_range("force.duration_s", self.duration_s, 0.0, 1e6)
        require_range("force.period_s", self.period_s, 0.0, 1e6)


class ScriptedForces(Stateful):
    """`ForceProfile` in N worlds. `amplitude_h` (N, H, 3) may be written to, for worlds that differ."""

    STATE = ("amplitude_h",)

    def __init__(self, cfg: ForceProfile, sides: tuple[str, ...], num_envs: int) -> None:
        cfg.check()
        self.cfg = cfg
        self.active = any(cfg.force)
        """Whether there is any force at all."""
        pushed = torch.tensor([cfg.hand in (side, "both") for side in sides])
        self.amplitude_h = (pushed[:, None] * torch.tensor(cfg.force)).repeat(num_envs, 1, 1)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """New directions for the worlds of `mask`, if they are random."""
        n = int(mask.sum())
        if not (self.cfg.random_direction and self.active) or n == 0:
            return
        angle = 2.0 * math.pi * torch.rand(n, generator=rng)
        c, s = angle.cos()[:, None], angle.sin()[:, None]
        x, y, z = self.amplitude_h[mask].unbind(-1)
        self.amplitude_h[mask] = torch.stack((c * x - s * y, s * x + c * y, z), -1)

    def at(self, time_s: torch.Tensor) -> torch.Tensor:
        """Forces (N, H, 3) [N], heading frame, at times (N,) [s] since each world's start."""
        since = time_s - self.cfg.start_s
        # A control step begins at its time; rounding must not cost it its first or add another.
        on = (since > -1e-4) & (since < self.cfg.duration_s - 1e-4)
        share = on.float()
        if self.cfg.period_s > 0.0:
            share = share * torch.sin(2.0 * math.pi * since / self.cfg.period_s)
        return share[:, None, None] * self.amplitude_h
