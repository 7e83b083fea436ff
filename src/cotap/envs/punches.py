"""Punches on the arms: short pushes at random joints in random directions, one in every stretch of time."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.checks import require_range
from cotap.persistence import Stateful, uniform


@dataclass
class PunchConfig:
    """One punch per segment of time, each at a random moment, on a random arm joint, in a random direction."""

    force_n: float = 0.0
    """Largest force [N]; punches are uniform between 0 and this. 0 for none."""
    duration_s: float = 0.08
    """How long a punch lasts [s]."""
    segment_s: float = 5.0
    """Time in which there is one punch [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("punches.force_n", self.force_n, 0.0, 1e5)
        require_range("punches.duration_s", self.duration_s, 0.0, 1e3)
        require_range("punches.segment_s", self.segment_s, self.duration_s, 1e6)


class Punches(Stateful):
    """The punch that each of N envs takes in its present segment, on one of `num_joints` arm joints."""

    STATE = ("joint", "_force_w", "_start_s", "_left_s")

    def __init__(self, cfg: PunchConfig, num_envs: int, num_joints: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt, self._num_joints = cfg, dt, num_joints
        self.active = cfg.force_n > 0.0
        """Whether there are any punches."""
        self.joint = torch.zeros(num_envs, dtype=torch.long)
        """(N,) which arm joint is struck."""
        self._force_w = torch.zeros(num_envs, 3)
        self._start_s, self._left_s = torch.zeros(num_envs), torch.zeros(num_envs)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """A new segment with a new punch for the envs of `mask`."""
        n = int(mask.sum())
        if not self.active or n == 0:
            return
        cfg = self.cfg
        direction = torch.nn.functional.normalize(torch.randn(n, 3, generator=rng, device=rng.device), dim=1)
        self._force_w[mask] = direction * uniform(rng, 0.0, cfg.force_n, n, 1)
        self.joint[mask] = torch.randint(0, self._num_joints, (n,), generator=rng, device=rng.device)
        self._start_s[mask] = uniform(rng, 0.0, cfg.segment_s - cfg.duration_s, n)
        self._left_s[mask] = cfg.segment_s

    def step(self, rng: torch.Generator) -> None:
        """Advance by one control step; segments that have ended are followed by new ones."""
        if self.active:
            self._left_s = self._left_s - self._dt
            self.reset(self._left_s < 0.5 * self._dt, rng)

    def current(self) -> torch.Tensor:
        """Forces (N, num_joints, 3) on the arm joints now [N], world frame."""
        since = self.cfg.segment_s - self._left_s - self._start_s
        # The share of this control step that the punch lasts: its impulse is exact whatever the step.
        begin, end = since.clamp(0.0, self.cfg.duration_s), (since + self._dt).clamp(0.0, self.cfg.duration_s)
        force = self._force_w * ((end - begin) / self._dt).unsqueeze(1)
        struck = torch.nn.functional.one_hot(self.joint, self._num_joints)
        return struck.unsqueeze(2) * force.unsqueeze(1)
