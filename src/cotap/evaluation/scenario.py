"""What the protocols have in common that run a policy in one mode and disturb it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cotap.checks import require_one_of, require_positive_int, require_range
from cotap.envs import H1Env, H1EnvConfig
from cotap.envs.commands import STEADY_RAD
from cotap.evaluation.quiet import quiet
from cotap.evaluation.rollout import Trajectory

MODES = ("stance", "walking")
PELVIS = ("free", "fixed")
MIXTURE = "mixture"
"""In place of a clip's name: the mixture of clips and generated motion that the policy was trained on."""


@dataclass
class Scenario(ABC):
    """A robot that stands or walks while its arms hold a pose or follow a motion."""

    num_envs: int = 1024
    """Number of worlds."""
    seed: int = 0
    """Seed of worlds, motions, directions and bootstrap."""
    mode: str = "stance"
    """stance, or walking forward at `speed`."""
    speed: float = 0.5
    """Forward command while walking [m/s]."""
    motion: tuple[str, ...] = ()
    """Clips that the arms follow, or `mixture` for what the policy was trained on; empty holds `arm_pose`."""
    arm_pose: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Arm joints that are held [rad], as of the left arm; the right arm takes the mirror image."""
    pelvis: str = "free"
    """free, or fixed: held in the air, without a policy, to see the arms alone."""
    unevenness: float = 0.0
    """Height of the ground's bumps from lowest to highest [m]; 0 is flat."""
    steady_rad: float = STEADY_RAD
    """A standing robot that is leaning further than this, or is about to, steps in place until it is steady [rad]."""
    arm_actions: bool = True
    """Let the policy's own residual move the arms."""
    randomize: bool = True
    """Domain randomisation."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_positive_int("num_envs", self.num_envs)
        require_one_of("mode", self.mode, MODES)
        require_range("speed", self.speed, -5.0, 5.0)
        require_one_of("pelvis", self.pelvis, PELVIS)
        for i, value in enumerate(self.arm_pose):
            require_range(f"arm_pose[{i}]", value, -math.pi, 1.5 * math.pi)
        require_range("unevenness", self.unevenness, 0.0, 0.2)
        require_range("steady_rad", self.steady_rad, 0.0, 10.0)
        require_range("torque_limit_scale", self.torque_limit_scale, 1e-3, 1e3)
        if MIXTURE in self.motion and len(self.motion) > 1:
            raise ValueError(f"motion {MIXTURE!r} stands alone, got {self.motion}")

    @property
    @abstractmethod
    def seconds(self) -> float:
        """Length of the evaluation [s]."""

    def configure(self, env: H1EnvConfig) -> H1EnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env`."""
        self.check()
        quiet(env)
        env.num_envs, env.seed, env.torque_limit_scale = self.num_envs, self.seed, self.torque_limit_scale
        env.fixed_base, env.unevenness_m = self.pelvis == "fixed", self.unevenness
        env.randomization.enabled = self.randomize
        env.terminations.episode_s = 1e6
        env.commands.steady_rad = self.steady_rad
        clips = env.motions.clips
        if not self.motion:
            clips.share, clips.only = 0.0, ()
        elif self.motion != (MIXTURE,):
            clips.share, clips.only, clips.held_out = 1.0, self.motion, ()
        return env

    def prepare(self, env: H1Env) -> None:
        """Give every world the mode's command, and its arms their pose unless they follow a motion."""
        n = env.num_envs
        walking = self.mode == "walking"
        velocity = torch.tensor([self.speed if walking else 0.0, 0.0]).repeat(n, 1)
        stand = torch.full((n,), 0.0 if walking else 1.0)
        env.commands.override(velocity, torch.zeros(n), stand, torch.full((n,), env.spec.nominal_height_m))
        if not self.motion:
            env.motions.hold(mirrored_pose(env, self.arm_pose))

    def before_step(self, env: H1Env, step: int) -> None:  # noqa: B027  (most protocols change nothing)
        """Whatever the protocol changes as it goes along."""

    @abstractmethod
    def measure(self, trajectory: Trajectory, env: H1Env) -> dict[str, Any]:
        """The measured part of the evaluation's JSON."""

    @abstractmethod
    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Draw a result, as a PNG file."""


def mirrored_pose(env: H1Env, left: tuple[float, ...]) -> torch.Tensor:
    """Arm joints (U,) with `left` on the left arm and its mirror image on every other."""
    by_name = {j.name: j for j in env.spec.joints}
    values = dict(zip(env.spec.arms[0].joints, left, strict=True))
    for name in list(values):
        joint = by_name[name]
        values[joint.mirror_name] = joint.mirror_sign * values[name]
    return torch.tensor([values[n] for n in env.spec.upper_joints])
