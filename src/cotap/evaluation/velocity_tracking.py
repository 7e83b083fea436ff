"""Velocity tracking: random commands, each held for a while, against what the robot does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cotap.checks import require_one_of, require_range
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.hand_loads import HandLoadConfig
from cotap.evaluation.metrics import outcome, tracking_measures, tracking_slopes
from cotap.evaluation.protocol import RolloutProtocol
from cotap.evaluation.report import plot_tracking
from cotap.evaluation.rollout import Trajectory
from cotap.robots.mjcf import COLLISIONS


@dataclass
class VelocityTracking(RolloutProtocol):
    """Commanded against measured velocity: errors, slopes, falls, gait quality."""

    episode_seconds: float = 20.0
    """Length of the evaluation [s]."""
    command_seconds: float = 5.0
    """How long each command is held [s]."""
    settle_seconds: float = 1.0
    """Time a command must have held to be measured [s]."""
    speed_x: float = 1.0
    """Largest forward and backward command [m/s]."""
    speed_y: float = 0.5
    """Largest sideways command [m/s]."""
    yaw_rate: float = 0.8
    """Largest turning command [rad/s]."""
    height_drop: float = 0.2
    """How far below nominal height stances go [m]."""
    stand_probability: float = 0.2
    """Share of commands that are to stand."""
    hand_loads: bool = False
    """Put random loads on both hands. On an H1, x and y up to 40 N, z from -50 to 5 N; on others in proportion to
    their mass. Each is held for 3 to 5 s."""
    follow_path: bool = False
    """Lead the torso along the root path of the clips. This takes the place of random commands."""
    collision: str = ""
    """What collides: feet (with the floor) or full (all shapes). By default as in the training. With full, shapes also
    meet each other."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        require_range("episode_seconds", self.episode_seconds, self.command_seconds, 3600.0)
        require_range("command_seconds", self.command_seconds, self.settle_seconds + 0.1, 3600.0)
        require_range("settle_seconds", self.settle_seconds, 0.0, 3600.0)
        for name in ("speed_x", "speed_y", "yaw_rate"):
            require_range(name, getattr(self, name), 0.0, 5.0)
        require_range("height_drop", self.height_drop, 0.0, 0.5)
        require_range("stand_probability", self.stand_probability, 0.0, 1.0)
        if self.follow_path:
            for name in ("command_seconds", "speed_x", "speed_y", "yaw_rate", "height_drop", "stand_probability"):
                self.require_default(name, "while a path is followed")
        if self.collision:
            require_one_of("collision", self.collision, COLLISIONS)

    @property
    def seconds(self) -> float:
        """Length of the evaluation [s]."""
        return self.episode_seconds

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        env_cfg.collision = self.collision or env_cfg.collision
        env_cfg.path.share = float(self.follow_path)
        env_cfg.forces.hand_loads = HandLoadConfig(enabled=self.hand_loads, episode_share=1.0)
        c = env_cfg.commands
        c.velocity_x, c.velocity_y = (-self.speed_x, self.speed_x), (-self.speed_y, self.speed_y)
        c.yaw_rate, c.height_offset = (-self.yaw_rate, self.yaw_rate), (-self.height_drop, 0.0)
        c.resample_s = (self.command_seconds, self.command_seconds)
        c.stand_probability, c.axis_zero_probability = self.stand_probability, 0.0
        return env_cfg

    def measure(self, trajectory: Trajectory, env: HumanoidEnv) -> dict[str, Any]:
        """The measured part of the evaluation's JSON, falls aside."""
        period = env.cfg.gait.period_s
        measures = tracking_measures(trajectory, period, self.settle_seconds)
        found = outcome(measures, ~trajectory.fell.any(0), self.seed, self.per_env)
        slopes = tracking_slopes(trajectory, period, self.settle_seconds, self.seed)
        if self.follow_path:
            for summary in (*found["metrics"].values(), *found["metrics_without_falls"].values()):
                if summary["n"] == 0:
                    summary["reason"] = "commands change all the time while a path is followed"
        return {
            **{name: found["metrics"][name]["mean"] for name in ("e_lin", "e_yaw", "episode_length_fraction")},
            "slopes": {name: slope["mean"] for name, slope in slopes.items()},
            "slopes_ci95": {name: slope["ci95"] for name, slope in slopes.items()},
            **found,
            "window": {"start": 0.0, "end": self.episode_seconds},
        }

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Commanded against measured velocity, and heights in stance."""
        plot_tracking(path, self.trajectory, result["settings"]["env"]["gait"]["period_s"], self.settle_seconds)
