"""Reference arm motion from a seeded generator: smooth reaches, punches, waves and swings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.checks import require_range
from cotap.motions.clearance import clear_range
from cotap.persistence import Stateful, uniform
from cotap.robots import RobotSpec

KINDS = ("hold", "reach", "punch", "wave", "swing")
PEAK_SPEED = 1.875
"""Peak speed of a minimum-jerk move, in units of distance over duration."""


@dataclass
class MotionConfig:
    """How often each kind of motion is drawn, and how fast it may be."""

    hold: float = 0.3
    """Weight of holding the present pose."""
    reach: float = 0.3
    """Weight of smooth moves to random poses."""
    punch: float = 0.15
    """Weight of fast out-and-back moves."""
    wave: float = 0.15
    """Weight of oscillations of random joints."""
    swing: float = 0.1
    """Weight of both arms swinging in opposition, as in walking."""
    velocity_share: float = 0.5
    """Fastest reference, as a share of each joint's velocity limit."""
    largest_speed: float = 4.5
    """Fastest reference of any joint [rad/s]: limits that hold without a load say little of what an arm can follow."""
    limit_margin_rad: float = 0.1
    """Distance kept from joint limits [rad]."""
    range_rad: float = 1.2
    """Largest distance of random poses from the default pose, per joint [rad]; less where the arm would meet the body
    before."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for kind in KINDS:
            require_range(f"motions.generator.{kind}", getattr(self, kind), 0.0, math.inf)
        if sum(getattr(self, kind) for kind in KINDS) <= 0.0:
            raise ValueError(
                f"motions.generator: at least one weight of {', '.join(KINDS)} must be positive, got all 0"
            )
        require_range("motions.generator.velocity_share", self.velocity_share, 0.01, 1.0)
        require_range("motions.generator.largest_speed", self.largest_speed, 0.1, 1e3)
        require_range("motions.generator.limit_margin_rad", self.limit_margin_rad, 0.0, 1.0)
        require_range("motions.generator.range_rad", self.range_rad, 0.0, math.pi)


@dataclass(frozen=True)
class ArmReference:
    """Reference of all arm joints of N envs, in the order of the robot's upper joints."""

    position: torch.Tensor
    """(N, U) [rad]."""
    velocity: torch.Tensor
    """(N, U) [rad/s]."""


def within_limits(low: torch.Tensor, high: torch.Tensor, margin_rad: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Ranges (U,) brought in by a margin at either end; a joint that has no room for it keeps to its middle."""
    margin = (0.5 * (high - low)).clamp_max(margin_rad)
    return low + margin, high - margin


class MotionGenerator(Stateful):
    """Plays segments, each a minimum-jerk move plus an enveloped oscillation, that join with zero velocity.

    Every segment obeys the joints' position limits (less a margin) and a share of their velocity limits, and keeps each
    joint from where it alone would bring the arm to the body.
    """

    STATE = ("_start", "_goal", "_amplitude", "_cycles", "_out_and_back", "_duration_s", "_time_s")

    def __init__(self, cfg: MotionConfig, spec: RobotSpec, num_envs: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt = cfg, dt
        joints = spec.upper_joint_specs
        default = torch.tensor([j.default_rad for j in joints])
        low, high = torch.tensor([j.range_rad for j in joints]).unbind(1)
        self.default = default
        low, high = within_limits(low, high, cfg.limit_margin_rad)
        low, high = torch.maximum(low, default - cfg.range_rad), torch.minimum(high, default + cfg.range_rad)
        self._low, self._high = clear_range(spec, low, high)
        limit = torch.tensor([j.velocity_limit_rad_s for j in joints])
        self._speed = (cfg.velocity_share * limit).clamp_max(cfg.largest_speed)
        self._joints_per_arm = len(spec.arms[0].joints)
        self._weights = torch.tensor([float(getattr(cfg, kind)) for kind in KINDS])
        n, u = num_envs, len(joints)
        self._start, self._goal = default.repeat(n, 1), default.repeat(n, 1)
        self._amplitude = torch.zeros(n, u)
        self._cycles, self._out_and_back = torch.zeros(n), torch.zeros(n)
        self._duration_s, self._time_s = torch.ones(n), torch.zeros(n)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """Start the envs of `mask` at a random pose with a random segment."""
        n = int(mask.sum())
        if n == 0:
            return
        near = 0.5 * uniform(rng, -1.0, 1.0, n, self.default.shape[0])
        span = torch.where(near < 0.0, self.default - self._low, self._high - self.default)
        self._goal[mask] = self.default + near * span
        self._out_and_back[mask] = 0.0  # else an interrupted punch would start again from where it began
        self._draw(mask, rng)

    def step(self, rng: torch.Generator) -> None:
        """Advance by one control step; envs whose segment has ended draw the next."""
        self._time_s = self._time_s + self._dt
        self._draw(self._time_s >= self._duration_s, rng)

    def current(self) -> ArmReference:
        """The reference now."""
        s = (self._time_s / self._duration_s).clamp(0.0, 1.0)
        # Out-and-back segments run the move forward in their first half and backward in their second.
        back = self._out_and_back > 0.5
        u = torch.where(back, 1.0 - (2.0 * s - 1.0).abs(), s)
        rate = torch.where(back, 2.0 * torch.sign(0.5 - s), torch.ones_like(s)) / self._duration_s
        move, move_rate = minimum_jerk(u)
        angle = 2.0 * math.pi * self._cycles * s
        window, window_rate = torch.sin(math.pi * s).square(), math.pi * torch.sin(2.0 * math.pi * s)
        wave = window * angle.sin()
        wave_rate = (window_rate * angle.sin() + window * 2.0 * math.pi * self._cycles * angle.cos()) / self._duration_s
        distance = self._goal - self._start
        position = self._start + move.unsqueeze(1) * distance + wave.unsqueeze(1) * self._amplitude
        velocity = (move_rate * rate).unsqueeze(1) * distance + wave_rate.unsqueeze(1) * self._amplitude
        return ArmReference(position, velocity)

    def _draw(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        ids = mask.nonzero().squeeze(1)
        n = len(ids)
        if n == 0:
            return
        u = self.default.shape[0]
        # Where an env ends up: out-and-back and oscillating segments end where they began.
        start = torch.where(self._out_and_back[ids, None] > 0.5, self._start[ids], self._goal[ids])
        kind = torch.multinomial(self._weights, n, replacement=True, generator=rng)
        is_kind = {name: (kind == i).float().unsqueeze(1) for i, name in enumerate(KINDS)}
        goal = self._low + (self._high - self._low) * torch.rand(n, u, generator=rng, device=rng.device)
        goal = start + (goal - start) * (is_kind["reach"] + is_kind["punch"])
        # Some reaches and all punches move one arm only.
        arm = torch.randint(0, u // self._joints_per_arm, (n, 1), generator=rng, device=rng.device)
        own = (torch.arange(u, device=rng.device) // self._joints_per_arm == arm).float()
        single = torch.maximum(
            is_kind["punch"], (torch.rand(n, 1, generator=rng, device=rng.device) < 0.5).float() * is_kind["reach"]
        )
        goal = start + (goal - start) * torch.where(single > 0.5, own, torch.ones_like(own))
        amplitude = self._oscillation(start, is_kind, rng)
        fastest = ((goal - start).abs() / self._speed).amax(1) * PEAK_SPEED
        legs = 1.0 + is_kind["punch"].squeeze(1)
        slack = torch.where(is_kind["punch"].squeeze(1) > 0.5, uniform(rng, 1.0, 1.8, n), uniform(rng, 1.3, 5.0, n))
        duration = (fastest * legs * slack).clamp_min(0.5)
        oscillates = (is_kind["wave"] + is_kind["swing"]).squeeze(1) > 0.5
        duration = torch.where(oscillates, uniform(rng, 2.0, 5.0, n), duration)
        cycles = torch.where(oscillates, (duration * uniform(rng, 0.5, 1.8, n)).round(), torch.zeros_like(duration))
        # The oscillation's speed is at most amplitude * pi (2 cycles + 1) / duration.
        peak = math.pi * (2.0 * cycles + 1.0) / duration
        amplitude = amplitude.sign() * torch.minimum(amplitude.abs(), self._speed / peak.unsqueeze(1))
        self._start[ids], self._goal[ids], self._amplitude[ids] = start, goal, amplitude
        self._duration_s[ids], self._cycles[ids], self._time_s[ids] = duration, cycles, 0.0
        self._out_and_back[ids] = is_kind["punch"].squeeze(1)

    def _oscillation(self, start: torch.Tensor, is_kind: dict[str, torch.Tensor], rng: torch.Generator) -> torch.Tensor:
        """Signed amplitudes (n, U) that keep within the limits around `start`."""
        n, u = start.shape
        room = torch.minimum(start - self._low, self._high - start).clamp_min(0.0)
        chosen = (torch.rand(n, u, generator=rng, device=rng.device) < 0.4).float()
        wave = chosen * uniform(rng, -0.8, 0.8, n, u)
        # The first joint of each arm swings, each arm against the one before.
        index = torch.arange(u, device=rng.device)
        sign = 1.0 - 2.0 * ((index // self._joints_per_arm) % 2).float()
        swing = sign * (index % self._joints_per_arm == 0) * uniform(rng, 0.2, 0.6, n, 1)
        amplitude = wave * is_kind["wave"] + swing * is_kind["swing"]
        return amplitude.sign() * torch.minimum(amplitude.abs(), room)


def minimum_jerk(s: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Position and slope at `s` in [0, 1] of the minimum-jerk profile from 0 to 1."""
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2), 30.0 * s**2 * (1.0 - s) ** 2
