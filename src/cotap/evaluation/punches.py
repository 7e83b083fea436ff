"""A walk over waypoints while the arms take punches: who arrives (after a harness for FALCON's policies)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cotap.checks import require_positive_int, require_range
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.punches import PunchConfig
from cotap.evaluation.course import Course, steer
from cotap.evaluation.disturbance import window_measures
from cotap.evaluation.metrics import summaries
from cotap.evaluation.report import save_figure
from cotap.evaluation.rollout import Trajectory
from cotap.evaluation.scenario import Scenario


@dataclass
class PunchWalk(Scenario):
    """A walk over waypoints while the arms take punches, one in every segment of time: who arrives."""

    mode: str = "walking"
    """walking; what a robot does that is to get anywhere."""
    speed: float = 0.7
    """Forward command towards a waypoint that lies ahead [m/s]."""
    force_size: float = 600.0
    """Largest push [N]; pushes are uniform between 0 and this, in random directions."""
    duration: float = 0.08
    """How long a push lasts [s]."""
    waypoints: int = 12
    """How many; there are as many pushes."""
    leg: float = 1.5
    """Distance from one waypoint to the next [m]."""
    turn: float = 1.0
    """Largest change of direction at a waypoint [rad]."""
    radius: float = 0.5
    """A waypoint is reached within this distance [m]."""
    episode_seconds: float = 60.0
    """Time to reach them all [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        if self.mode != "walking" or self.pelvis != "free":
            raise ValueError(f"punches are for walking with a free pelvis, got mode {self.mode!r}, {self.pelvis!r}")
        require_positive_int("waypoints", self.waypoints)
        require_range("leg", self.leg, 0.1, 100.0)
        require_range("turn", self.turn, 0.0, math.pi)
        require_range("radius", self.radius, 0.01, 10.0)
        require_range("episode_seconds", self.episode_seconds, 1.0, 3600.0)
        self._punches().check()

    def _punches(self) -> PunchConfig:
        return PunchConfig(self.force_size, self.duration, self.episode_seconds / self.waypoints)

    @property
    def seconds(self) -> float:
        """Length of the evaluation [s]."""
        return self.episode_seconds

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        env_cfg.forces.punches = self._punches()
        return env_cfg

    def prepare(self, env: HumanoidEnv) -> None:
        """Lay out the waypoints."""
        super().prepare(env)
        rng = torch.Generator().manual_seed(self.seed)
        self.course = Course(self.waypoints, self.leg, self.turn, self.radius, env.num_envs, rng, env.device)

    def before_step(self, env: HumanoidEnv, step: int) -> None:
        """Steer towards the next waypoint."""
        s = env.state
        if step == 0:
            self.course.start(s.torso_pos_w[:, :2], s.heading_w)
        else:
            self.course.leave(env.record.fell)
        ahead = self.course.step(s.torso_pos_w[:, :2], s.heading_w)
        velocity, yaw_rate = steer(ahead, self.speed)
        done = self.course.reached >= self.waypoints
        n = env.num_envs
        stand, height = done.float(), torch.full((n,), env.spec.nominal_height_m, device=env.device)
        env.commands.override(velocity * ~done.unsqueeze(1), yaw_rate * ~done, stand, height)

    def measure(self, trajectory: Trajectory, env: HumanoidEnv) -> dict[str, Any]:
        """The measured part of the evaluation's JSON, the number of falls aside."""
        t = trajectory
        fell = t.fell.any(0)
        reached = self.course.reached.cpu()
        completed = (reached >= self.waypoints) & ~fell
        measures = {
            "completed_fraction": completed,
            "waypoints_reached": reached.float(),
            "seconds_upright": t.alive().float().sum(0) * t.dt,
            **window_measures(t, 0, len(t.fell), list(range(len(env.spec.arms)))),
        }
        return {
            "completion_rate": float(completed.float().mean()),
            "metrics": summaries(measures, torch.ones_like(fell), self.seed),
            "metrics_without_falls": summaries(measures, ~fell, self.seed),
            "window": {"start": 0.0, "end": self.seconds},
            "curve": {
                "time": (torch.arange(1, len(t.fell) + 1) * t.dt).tolist(),
                "upright": t.alive().float().mean(1).tolist(),
            },
        }

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Share of envs that are still upright, over time."""
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(5.2, 3.6), constrained_layout=True)
        axis.plot(result["curve"]["time"], result["curve"]["upright"], color="#2171b5")
        axis.set(xlabel="time [s]", ylabel="share of envs upright", ylim=(0.0, 1.02))
        axis.grid(alpha=0.2)
        save_figure(figure, path)
