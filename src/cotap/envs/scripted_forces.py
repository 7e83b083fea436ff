"""Forces on hands or base that follow a script: held, struck or swinging, one profile for every protocol."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.checks import require_finite, require_one_of, require_range
from cotap.persistence import Stateful

HANDS = ("left", "right", "both")
PLACES = ("hand", "base")


@dataclass
class ForceProfile:
    """A force on one hand or both, or on the base, in the heading frame, from a moment on and for a while."""

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
    """Turn the force about the vertical by a random angle, drawn per env and episode."""
    place: str = "hand"
    """hand, or base: at the base's centre of mass, and on no hand."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_one_of("force.hand", self.hand, HANDS)
        require_one_of("force.place", self.place, PLACES)
        for i, value in enumerate(self.force):
            require_finite(f"force.force[{i}]", value)
        require_range("force.start_s", self.start_s, 0.0, 1e6)
        require_range("force.duration_s", self.duration_s, 0.0, 1e6)
        require_range("force.period_s", self.period_s, 0.0, 1e6)


class ScriptedForces(Stateful):
    """`ForceProfile` in N envs. `amplitude_h` (N, H + 1, 3), hands first, then the base, may be written to, for
    envs that differ."""

    STATE = ("amplitude_h",)

    def __init__(self, cfg: ForceProfile, sides: tuple[str, ...], num_envs: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt = cfg, dt
        self.active = any(cfg.force)
        """Whether there is any force at all."""
        at_hand = cfg.place == "hand"
        pushed = torch.tensor([*(at_hand and cfg.hand in (side, "both") for side in sides), not at_hand])
        self.amplitude_h = (pushed[:, None] * torch.tensor(cfg.force)).repeat(num_envs, 1, 1)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """New directions for the envs of `mask`, if they are random."""
        n = int(mask.sum())
        if not (self.cfg.random_direction and self.active) or n == 0:
            return
        angle = 2.0 * math.pi * torch.rand(n, generator=rng, device=rng.device)
        c, s = angle.cos()[:, None], angle.sin()[:, None]
        x, y, z = self.amplitude_h[mask].unbind(-1)
        self.amplitude_h[mask] = torch.stack((c * x - s * y, s * x + c * y, z), -1)

    def at(self, time_s: torch.Tensor) -> torch.Tensor:
        """Forces (N, H + 1, 3) [N] on hands and base, heading frame.

        They are means over the control steps that begin at `time_s` (N,) since each env's start [s], so that the
        impulse is exact whatever the step; a periodic force is that of the step's middle.
        """
        since = time_s.double() - self.cfg.start_s
        end = (since + self._dt).clamp(0.0, self.cfg.duration_s)
        share = (end - since.clamp(0.0, self.cfg.duration_s)) / self._dt
        # Times are rounded; a force must neither miss its first step nor linger in one more.
        share = (1e4 * share).round() / 1e4
        if self.cfg.period_s > 0.0:
            share = share * torch.sin(2.0 * math.pi * (since + 0.5 * self._dt) / self.cfg.period_s)
        return share.to(self.amplitude_h)[:, None, None] * self.amplitude_h
