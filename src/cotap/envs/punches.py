"""Punches: short pushes on random joints in random directions, one in every segment of time, growing in an episode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from cotap.checks import require_positive_int, require_range

FIRST_CEILING = 1.0 / 3.0
"""Ceiling of the force at the start, as a share of the final one."""
LEAST_SHARE = 0.5
"""Weakest punch, as a share of the ceiling."""
_STREAM = 0
"""Keeps the generator of punches apart from others of the same seed and run."""


@dataclass
class PunchConfig:
    """One punch per segment of time, on any joint, in any direction, of half to all of a ceiling that rises linearly.

    What an env gets depends on `seed` and the number of the env alone.
    """

    force_n: float = 0.0
    """Ceiling of the force after `ramp_s` [N]; it is a third of that at the start. 0 for no punches."""
    duration_s: float = 0.08
    """How long a punch lasts [s]."""
    segment_s: float = 5.0
    """Time in which there is one punch [s]."""
    first_s: float = 0.1
    """When it comes, from the segment's start [s]."""
    count: int = 18
    """Segments in an episode."""
    ramp_s: float = 60.0
    """Time in which the ceiling rises [s]."""
    seed: int = 0
    """Seed of all that is drawn."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("punches.force_n", self.force_n, 0.0, 1e5)
        require_range("punches.duration_s", self.duration_s, 0.0, 1e3)
        require_range("punches.first_s", self.first_s, 0.0, 1e3)
        require_range("punches.segment_s", self.segment_s, round(self.first_s + self.duration_s, 9), 1e6)
        require_positive_int("punches.count", self.count)
        require_range("punches.ramp_s", self.ramp_s, 1e-3, 1e6)
        require_range("punches.seed", self.seed, 0, 2**64)

    def ceiling_n(self, time_s: np.ndarray) -> np.ndarray:
        """Largest force [N] of punches that begin at `time_s` (...) [s]."""
        return self.force_n * (FIRST_CEILING + (1.0 - FIRST_CEILING) * np.minimum(time_s / self.ramp_s, 1.0))


def draw_punches(cfg: PunchConfig, run: int, num_joints: int) -> tuple[np.ndarray, np.ndarray]:
    """The punches of run number `run`: joints (count,) and forces (count, 3) [N], world frame."""
    rng = np.random.default_rng((cfg.seed, run, _STREAM))
    joint = rng.integers(num_joints, size=cfg.count)
    direction = rng.normal(size=(cfg.count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ceiling = cfg.ceiling_n(cfg.segment_s * np.arange(cfg.count) + cfg.first_s)
    return joint, direction * (ceiling * rng.uniform(LEAST_SHARE, 1.0, cfg.count))[:, None]


class Punches:
    """The punches of N envs, by time. It remembers nothing: all is drawn at the beginning.

    Args:
        cfg: What is drawn.
        num_joints: Joints of the robot.
        num_envs: N; env i has the punches of run `first_run` + i.
        dt: Control step [s].
        first_run: See there.
    """

    def __init__(self, cfg: PunchConfig, num_joints: int, num_envs: int, dt: float, first_run: int = 0) -> None:
        cfg.check()
        self.cfg, self._dt = cfg, dt
        self.active = cfg.force_n > 0.0
        """Whether there are any punches."""
        drawn = [draw_punches(cfg, first_run + i, num_joints) for i in range(num_envs if self.active else 0)]
        self.joint = torch.tensor([joint.tolist() for joint, _ in drawn])
        """(N, count) which joint is struck in each segment; empty without punches."""
        self.force_w = torch.tensor([force.tolist() for _, force in drawn])
        """(N, count, 3) [N]."""

    def at(self, time_s: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Joint (N,) and force (N, 3) [N], world frame, of the control step that begins at `time_s` (N,) [s].

        The force is the mean over the step, so that its impulse is exact whatever the step.
        """
        cfg = self.cfg
        segment = (time_s / cfg.segment_s + 1e-6).floor().long()
        # Single precision may put a time beside a multiple of the step.
        since = self._dt * ((time_s - cfg.segment_s * segment - cfg.first_s) / self._dt).round(decimals=2)
        begin, end = since.clamp(0.0, cfg.duration_s), (since + self._dt).clamp(0.0, cfg.duration_s)
        share = (end - begin) / self._dt * (segment < cfg.count)
        row = torch.arange(len(time_s), device=time_s.device), segment.clamp_max(cfg.count - 1)
        return self.joint[row], share.to(self.force_w).unsqueeze(1) * self.force_w[row]
