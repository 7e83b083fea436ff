"""Pushes while a policy learns: short and strong, on the base, a hand or any link, out of nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch

from cotap.checks import require_interval, require_range
from cotap.envs.curriculum import RampConfig
from cotap.persistence import Stateful, uniform
from cotap.rotations import rotate_inverse

_NEVER_S = 1e9


@dataclass
class PushConfig:
    """Pushes of training. Impulses are given as the velocity that they would give the whole robot."""

    enabled: bool = False
    """Whether there are any; training switches them on."""
    episode_share: float = 0.8
    """Share of the episodes that have pushes."""
    velocity: tuple[float, float] = (0.0, 1.0)
    """Impulse over the robot's mass, uniform [m/s]."""
    beside_base: float = 1.0
    """Factor on the impulse of pushes that hit a hand or a link."""
    hand_share: float = 0.3
    """Share of the pushes that hit a hand."""
    link_share: float = 0.3
    """Share of the pushes that hit the centre of mass of a link drawn from all; the rest hit the base."""
    largest_pitch: float = 0.5
    """Largest angle between a push and the ground, uniform up to that, upward or downward [rad]."""
    duration_s: tuple[float, float] = (0.04, 0.12)
    """How long a push lasts, uniform [s]."""
    interval_s: tuple[float, float] = (2.0, 6.0)
    """Time from one push to the next, uniform [s]."""
    ramp: RampConfig = field(default_factory=RampConfig)
    """How the share of the impulse grows in training."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("velocity", "duration_s", "interval_s"):
            require_interval(f"pushes.{name}", getattr(self, name))
            require_range(f"pushes.{name}[0]", getattr(self, name)[0], 0.0, 1e3)
        require_range("pushes.duration_s[0]", self.duration_s[0], 1e-3, 10.0)
        require_range("pushes.interval_s[0]", self.interval_s[0], self.duration_s[1], 1e6)
        require_range("pushes.episode_share", self.episode_share, 0.0, 1.0)
        require_range("pushes.hand_share", self.hand_share, 0.0, 1.0)
        require_range("pushes.link_share", self.link_share, 0.0, round(1.0 - self.hand_share, 9))
        require_range("pushes.beside_base", self.beside_base, 0.0, 1e3)
        require_range("pushes.largest_pitch", self.largest_pitch, 0.0, 0.5 * math.pi)
        self.ramp.check("pushes.ramp")


class Pushes(Stateful):
    """One push at a time in each of N envs; direction uniform about the vertical.

    Where a push acts is a number: 0 for the base, then the hands, then the links.

    Args:
        cfg: What is drawn.
        num_hands: Hands of the robot.
        num_links: Links of the robot that may be pushed.
        mass_kg: The robot's mass [kg].
        num_envs: Number of envs.
        dt: Control step [s].
    """

    STATE = ("force_w", "place", "_left_s", "_next_s", "_coming_w", "_coming_place", "_coming_s")

    def __init__(
        self, cfg: PushConfig, num_hands: int, num_links: int, mass_kg: float, num_envs: int, dt: float
    ) -> None:
        cfg.check()
        self.cfg, self._dt, self._mass = cfg, dt, mass_kg
        self._num_hands, self._num_links = num_hands, num_links
        self.force_w = torch.zeros(num_envs, 3)
        """(N, 3) of the present or last push [N]."""
        self.place = torch.zeros(num_envs, dtype=torch.long)
        """(N,) where it acts."""
        self._left_s, self._next_s = torch.zeros(num_envs), torch.full((num_envs,), _NEVER_S)
        # The next push: its impulse over the robot's mass [m/s], how long it will last [s], and where it will act.
        self._coming_w, self._coming_s = torch.zeros(num_envs, 3), torch.zeros(num_envs)
        self._coming_place = torch.zeros_like(self.place)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """An episode begins in the envs of `mask`; the first push comes after an interval."""
        n = int(mask.sum())
        if not self.cfg.enabled or n == 0:
            return
        spared = torch.rand(n, generator=rng, device=rng.device) >= self.cfg.episode_share
        self._left_s[mask] = 0.0
        self._draw(mask, rng)
        self._next_s[mask] = self._next_s[mask].masked_fill(spared, _NEVER_S)

    def step(self, samples: float, rng: torch.Generator) -> None:
        """Advance by one control step, and push where it is time. `samples` says how far training has come."""
        if not self.cfg.enabled:
            return
        self._left_s = (self._left_s - self._dt).clamp_min(0.0)
        self._next_s = self._next_s - self._dt
        due = self._next_s <= 0.0
        if due.any():
            self.place = torch.where(due, self._coming_place, self.place)
            impulse = self.cfg.ramp.share(samples) * self._mass * self._coming_w
            force_w = impulse / self._coming_s.clamp_min(1e-6).unsqueeze(1)
            self.force_w = torch.where(due.unsqueeze(1), force_w, self.force_w)
            self._left_s = torch.where(due, self._coming_s, self._left_s)
            self._draw(due, rng)

    def _draw(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """Draw the coming pushes of the envs of `mask`, one ahead, so that critics can see what will come."""
        cfg, n = self.cfg, int(mask.sum())
        yaw, pitch = uniform(rng, -math.pi, math.pi, n), uniform(rng, -cfg.largest_pitch, cfg.largest_pitch, n)
        direction = torch.stack((pitch.cos() * yaw.cos(), pitch.cos() * yaw.sin(), pitch.sin()), -1)
        kind = torch.rand(n, generator=rng, device=rng.device)
        hand = torch.randint(1, 1 + self._num_hands, (n,), generator=rng, device=rng.device)
        link = torch.randint(self._num_links, (n,), generator=rng, device=rng.device) + 1 + self._num_hands
        on_hand, on_link = kind < cfg.hand_share, kind >= 1.0 - cfg.link_share
        self._coming_place[mask] = torch.where(on_hand, hand, torch.where(on_link, link, torch.zeros_like(hand)))
        velocity = uniform(rng, *cfg.velocity, n) * torch.where(on_hand | on_link, cfg.beside_base, 1.0)
        self._coming_w[mask] = direction * velocity.unsqueeze(1)
        self._coming_s[mask] = uniform(rng, *cfg.duration_s, n)
        self._next_s[mask] = uniform(rng, *cfg.interval_s, n)

    def current(self) -> torch.Tensor:
        """Force (N, 3) [N] of the coming control step, world frame: the mean over it, so that the impulse is exact."""
        return self.force_w * (self._left_s / self._dt).clamp(0.0, 1.0).unsqueeze(1)

    def ahead(self, heading_w: torch.Tensor, samples: float) -> torch.Tensor:
        """What critics see of the present push, or else of the next, (N, 6 + hands): its nearness (1 once it begins,
        1/e a second before), and, times that nearness, the velocity (3) that it has yet to give in the heading frame
        [m/s] and, one-hot, whether it is on the base, on each hand, or on a link."""
        on = self._left_s > 0.0
        left_w = self.force_w * (self._left_s / self._mass).unsqueeze(1)
        velocity_w = torch.where(on.unsqueeze(1), left_w, self.cfg.ramp.share(samples) * self._coming_w)
        place = torch.where(on, self.place, self._coming_place).clamp_max(1 + self._num_hands)
        near = torch.where(on, 1.0, (-self._next_s).exp()).unsqueeze(1)
        kind = torch.nn.functional.one_hot(place, 2 + self._num_hands)
        return near * torch.cat((torch.ones_like(near), rotate_inverse(heading_w, velocity_w), kind), 1)
