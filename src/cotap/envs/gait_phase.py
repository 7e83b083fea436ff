"""The gait's phase: which foot is where in its stride. It runs while a robot is to walk and rests while it stands."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.checks import require_range
from cotap.persistence import Stateful

STANCE_SHARE = 0.58
"""Part of a stride that a foot spends on the ground."""
_ROUNDING = 1e-4
"""Half strides by which rounding may keep a phase from where both feet are down."""


@dataclass
class GaitConfig:
    """The stride that the phase describes."""

    period_s: float = 0.8
    """Duration of a stride [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("gait.period_s", self.period_s, 0.1, 10.0)


class GaitPhase(Stateful):
    """Phase (N,) in [0, 1) and whether it rests, `stand` (N,) 1 or 0. It comes to rest with both feet down, at 0 or
    0.5, once standing has been asked for during a stride: a robot that stops loses its speed with its last steps."""

    STATE = ("phase", "stand", "_on_the_spot")

    def __init__(self, cfg: GaitConfig, num_envs: int, dt: float) -> None:
        cfg.check()
        self._rate = dt / cfg.period_s
        self.phase, self.stand = torch.zeros(num_envs), torch.zeros(num_envs)
        self._on_the_spot = torch.zeros(num_envs)  # strides walked there

    def reset(self, mask: torch.Tensor, stand: torch.Tensor, rng: torch.Generator) -> None:
        """Begin at rest where `stand` (n,) is 1, else at a random phase, so that envs are not in step."""
        self.stand[mask], self._on_the_spot[mask] = stand, 0.0
        start = torch.rand(len(stand), generator=rng, device=rng.device)
        self.phase[mask] = torch.where(stand > 0.5, 0.5 * (start < 0.5), start)

    def step(self, to_stand: torch.Tensor) -> None:
        """Advance by one control step; `to_stand` (N,) bool says who is to come to rest, or to stay there."""
        half_strides = 2.0 * (self.phase + self._rate)
        landed = (half_strides + _ROUNDING).floor()
        both_down = landed > (2.0 * self.phase + _ROUNDING).floor()
        self._on_the_spot = (self._on_the_spot + self._rate) * to_stand
        stays = (self.stand > 0.5) & to_stand
        stops = ~stays & to_stand & both_down & (self._on_the_spot > 1.0 - _ROUNDING)
        running = 0.5 * torch.where(stops, landed, half_strides)
        self.phase = torch.where(stays, self.phase, running.remainder(1.0))
        self.stand = (stays | stops).float()


def foot_phases(phase: torch.Tensor, num_feet: int) -> torch.Tensor:
    """Each foot's own phase, (N, num_feet) in [0, 1), for the gait's (N,): foot i is i / num_feet ahead."""
    shift = torch.arange(num_feet, dtype=phase.dtype, device=phase.device) / num_feet
    return (phase.unsqueeze(1) + shift).remainder(1.0)


def desired_contact(phase: torch.Tensor, stand: torch.Tensor, num_feet: int) -> torch.Tensor:
    """Which feet should be on the ground, (N, num_feet) bool."""
    return (foot_phases(phase, num_feet) < STANCE_SHARE) | (stand.unsqueeze(1) > 0.5)


def swing_progress(phase: torch.Tensor, num_feet: int) -> torch.Tensor:
    """How far each foot is through its swing, (N, num_feet) in [0, 1]; 0 during stance."""
    return ((foot_phases(phase, num_feet) - STANCE_SHARE) / (1.0 - STANCE_SHARE)).clamp(0.0, 1.0)
