"""What the protocols have in common that have a robot stand or walk and disturb it."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass

import torch

from cotap.checks import require_one_of, require_range
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluation.arm_watch import ArmWatch
from cotap.evaluation.protocol import Protocol, RolloutProtocol
from cotap.motions.reference import HELD

MODES = ("stance", "walking")
PELVIS = ("free", "fixed")


@dataclass
class Stance(Protocol, ABC):
    """A robot that stands, walks or hangs in the air."""

    mode: str = "stance"
    """stance, or walking forward at --speed."""
    speed: float = 0.5
    """Forward command while walking [m/s]."""
    pelvis: str = "free"
    """free, or fixed in the air, without a policy. Fixed shows the arms alone."""
    unevenness: float = 0.0
    """Height of bumps of the ground [m]. From the lowest to the highest point; 0 is flat."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        require_one_of("mode", self.mode, MODES)
        require_range("speed", self.speed, -5.0, 5.0)
        require_one_of("pelvis", self.pelvis, PELVIS)
        require_range("unevenness", self.unevenness, 0.0, 0.2)
        if self.mode == "stance":
            self.require_default("speed", "in stance: walk with --mode walking")
        if self.pelvis == "fixed":
            for name in ("mode", "unevenness", "upper_actions"):
                self.require_default(name, "while the pelvis is fixed")

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        env_cfg.fixed_base, env_cfg.unevenness_m = self.pelvis == "fixed", self.unevenness
        return env_cfg

    def prepare(self, env: HumanoidEnv) -> None:
        """Give every env the mode's command."""
        super().prepare(env)
        n, walking = env.num_envs, self.mode == "walking"
        velocity = torch.tensor([self.speed if walking else 0.0, 0.0]).repeat(n, 1)
        stand, height = torch.full((n,), float(not walking)), torch.full((n,), env.spec.nominal_height_m)
        env.commands.override(velocity, torch.zeros(n), stand, height)


@dataclass
class Scenario(RolloutProtocol, Stance, ABC):
    """A robot that stands or walks while its arms hold a pose or follow a motion."""

    motion: tuple[str, ...] = (HELD,)
    """Clips for the arms, `mixture` or `none`. mixture: as in the training. none: hold --arm-pose."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.watch = ArmWatch()
