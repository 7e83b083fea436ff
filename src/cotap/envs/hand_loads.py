"""Random loads on the hands, held for a while: what is carried, pulled and pushed."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from cotap.checks import require_interval, require_range
from cotap.envs.curriculum import RampConfig
from cotap.persistence import Stateful, uniform


@dataclass
class HandLoadConfig:
    """Random forces on the hands (FALCON's), in the heading frame: those of an H1; for others in proportion to mass."""

    enabled: bool = False
    """Whether hands are loaded at all; training switches it on."""
    episode_share: float = 0.5
    """Share of the episodes in which hands are loaded."""
    force_x: tuple[float, float] = (-40.0, 40.0)
    """Forward force on a hand [N]."""
    force_y: tuple[float, float] = (-40.0, 40.0)
    """Leftward force on a hand [N]."""
    force_z: tuple[float, float] = (-50.0, 5.0)
    """Upward force on a hand [N]."""
    zero_probability: float = 0.25
    """Chance of each axis of each hand to be free."""
    hold_s: tuple[float, float] = (3.0, 5.0)
    """Time between changes [s]."""
    torque_share: float = 0.8
    """Forces are scaled down to what this share of the arm's torque limits can hold."""
    weak_joint: float = 0.25
    """A joint whose torque limit is below this share of the arm's largest does not count there, such as G1's wrist."""
    ramp: RampConfig = field(default_factory=RampConfig)
    """How the share of the force grows in training."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("force_x", "force_y", "force_z", "hold_s"):
            require_interval(f"hand_loads.{name}", getattr(self, name))
        require_range("hand_loads.hold_s[0]", self.hold_s[0], 0.02, 1e6)
        for name in ("episode_share", "zero_probability", "torque_share", "weak_joint"):
            require_range(f"hand_loads.{name}", getattr(self, name), 0.0, 1.0)
        self.ramp.check("hand_loads.ramp")


class HandLoads(Stateful):
    """Piecewise constant forces at each hand."""

    STATE = ("_force_h", "_coming_h", "_remaining_s", "_loaded")

    def __init__(self, cfg: HandLoadConfig, num_hands: int, num_envs: int, dt: float, scale: float = 1.0) -> None:
        cfg.check()
        self.cfg, self._dt, self._scale = cfg, dt, scale
        self._force_h, self._coming_h = torch.zeros(2, num_envs, num_hands, 3)
        self._remaining_s = torch.zeros(num_envs)
        self._loaded = torch.ones(num_envs, dtype=torch.bool)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """An episode begins in the envs of `mask`."""
        if self.cfg.enabled:
            self._loaded[mask] = torch.rand(int(mask.sum()), generator=rng, device=rng.device) < self.cfg.episode_share
            self._draw(mask, rng)  # the first,
            self._draw(mask, rng)  # and the one after it

    def step(self, rng: torch.Generator) -> None:
        """Advance by one control step; forces that have been held long enough change."""
        if self.cfg.enabled:
            self._remaining_s = self._remaining_s - self._dt
            self._draw(self._remaining_s <= 0.0, rng)

    def _draw(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """Take up the forces that were drawn last, and draw those after them, so that critics can see what comes."""
        n, cfg, hands = int(mask.sum()), self.cfg, self._force_h.shape[1]
        if n == 0:
            return
        force = torch.stack([uniform(rng, *b, n, hands) for b in (cfg.force_x, cfg.force_y, cfg.force_z)], -1)
        force *= self._scale * (torch.rand(n, hands, 3, generator=rng, device=rng.device) >= cfg.zero_probability)
        self._force_h[mask], self._coming_h[mask] = self._coming_h[mask], force
        self._remaining_s[mask] = uniform(rng, *cfg.hold_s, n)

    def current(self, jacobian_h: torch.Tensor, torque_limit: torch.Tensor, samples: float) -> torch.Tensor:
        """Forces (N, hands, 3) in the heading frame, never beyond what the arms' stronger joints can hold.

        Args:
            jacobian_h: (N, hands, 3, n) hand Jacobians in the heading frame.
            torque_limit: (hands, n) [Nm].
            samples: How far training has come.
        """
        force = self._force_h * (self.cfg.ramp.share(samples) * self._loaded)[:, None, None]
        torque = (jacobian_h.transpose(-1, -2) @ force.unsqueeze(-1)).squeeze(-1).abs()
        weak = torque_limit < self.cfg.weak_joint * torque_limit.amax(-1, keepdim=True)
        limit = (self.cfg.torque_share * torque_limit).masked_fill(weak, torch.inf)
        holdable = (limit / torque.clamp_min(1e-6)).amin(-1).clamp_max(1.0)
        return force * holdable.unsqueeze(-1)

    def ahead(self, samples: float) -> torch.Tensor:
        """What critics see of the coming change, (N, 1 + 3 hands): its nearness (1 as it comes, 1/e a second before; 0
        where there are no loads), and, times that nearness, the forces then in the heading frame [N], before torque
        limits scale them down."""
        near = (self._loaded * (-self._remaining_s).exp()).unsqueeze(1)
        coming = self.cfg.ramp.share(samples) * self._coming_h.flatten(1)
        return float(self.cfg.enabled) * near * torch.cat((torch.ones_like(near), coming), 1)
