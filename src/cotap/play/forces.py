"""Forces on the hands as people make them: pushes, held loads, and a hand dragged by a spring."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.play.controls import PUSH_N, PUSH_S, Refused

DRAG_N_M, DRAG_N = 150.0, 60.0
"""Stiffness of the spring that drags a hand [N/m] and its largest force [N]."""
PUSHES = 8
"""How many pushes act at once at most; a further one takes the oldest's place."""


@dataclass(frozen=True)
class Push:
    """A force on one hand of every robot, from the next step on."""

    side: str
    force: tuple[float, float, float]
    """In the heading frame [N]."""
    seconds: float

    def check(self) -> None:
        """Raise Refused for a push that is not finite or too strong or too long."""
        size = math.sqrt(sum(f * f for f in self.force))
        if not (math.isfinite(size) and size <= PUSH_N * (1.0 + 1e-9)):
            raise Refused(f"a push must be finite and at most {PUSH_N:g} N, got {size:g} N")
        if not (math.isfinite(self.seconds) and 0.0 < self.seconds <= PUSH_S):
            raise Refused(f"a push must last between 0 and {PUSH_S:g} s, got {self.seconds:g} s")


class HandForces:
    """The sum of everything that pulls on N robots' H hands, step by step.

    Args:
        num_envs: N.
        sides: Names of the H hands.
        dt: Control step [s].
    """

    def __init__(self, num_envs: int, sides: tuple[str, ...], dt: float) -> None:
        self._sides, self._dt = sides, dt
        self.held_h = torch.zeros(len(sides), 3)
        """(H, 3) held loads, the same on every robot [N]."""
        self.drag_w: list[list[tuple[float, ...] | None]] = [[None] * len(sides) for _ in range(num_envs)]
        """[N][H] where hands are dragged to, world frame [m]; None where they are not."""
        self._pushes: list[tuple[torch.Tensor, int]] = []

    def push(self, push: Push) -> None:
        """Begin a push; it lasts a step at least."""
        force = torch.zeros_like(self.held_h)
        force[self._sides.index(push.side)] = torch.tensor(push.force)
        self._pushes = [*self._pushes, (force, max(1, round(push.seconds / self._dt)))][-PUSHES:]

    def clear(self) -> None:
        """End all pushes."""
        self._pushes = []

    def step(self, hand_w: torch.Tensor, heading_w: torch.Tensor) -> torch.Tensor:
        """Forces (N, H, 3) of the coming step in the heading frame [N].

        Args:
            hand_w: (N, H, 3) where hands are [m].
            heading_w: (N, 3, 3) heading frame to world.
        """
        common = self.held_h + sum((force for force, _ in self._pushes), torch.zeros_like(self.held_h))
        self._pushes = [(force, left - 1) for force, left in self._pushes if left > 1]
        out = common.expand(len(self.drag_w), -1, -1).clone()
        for i, row in enumerate(self.drag_w):
            for h, target in enumerate(row):
                if target is not None:
                    force_w = DRAG_N_M * (torch.tensor(target) - hand_w[i, h])
                    force_w = force_w * min(1.0, DRAG_N / max(float(force_w.norm()), 1e-6))
                    out[i, h] += heading_w[i].T @ force_w
        return out
