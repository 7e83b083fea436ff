"""What a protocol is: the environment that it needs, what it runs there, what it measures and shows."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch

from cotap.checks import LARGEST_SEED, require_positive_int, require_range, require_seed
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.terminations import TerminationConfig
from cotap.evaluation import report
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.rollout import PolicyFunction, Trajectory, acting, record_rollout, upper_share
from cotap.evaluation.undisturbed import disable_disturbances
from cotap.motions.reference import HELD, MIXTURE, ClipConfig

FIRST_SEED = 2**31
"""Seed of an evaluation's envs where --seed is 0. Masses are drawn once: with the seed of the training they would be
those that the policy knows. Random number generators read only the lowest 32 bits of a seed."""


@dataclass
class Protocol(ABC):
    """Options that all protocols have."""

    laws: ClassVar[LawOptions] = LawOptions()
    """Laws of the arms where the command line names none and the policy was trained under PD."""
    laws_for_all: ClassVar[bool] = False
    """Whether `laws` are the default of policies that were trained under others too."""
    drives: ClassVar[dict[str, str]] = {}
    """Fields of laws that the protocol sets itself, each with the option that says how."""

    num_envs: int = 1024
    """Number of envs."""
    seed: int = 0
    """Seed of envs and of all that is drawn."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""
    randomize: bool = True
    """Vary masses, friction, gains and delay."""

    def __post_init__(self) -> None:
        self.film = torch.zeros(0, 0)

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_positive_int("num_envs", self.num_envs)
        require_seed("seed", self.seed)
        require_range("torque_limit_scale", self.torque_limit_scale, 1e-3, 1e3)

    def require_default(self, name: str, when: str) -> None:
        """Raise ValueError if an option was changed that does nothing `when` the others are as they are."""
        if getattr(self, name) != getattr(type(self), name):
            raise ValueError(f"{name} does nothing {when}, got {getattr(self, name)!r}")

    @property
    def arms(self) -> str:
        """Whether the arms' reference moves: moving or held."""
        return "held"

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        self.check()
        disable_disturbances(env_cfg)
        env_cfg.num_envs, env_cfg.torque_limit_scale = self.num_envs, self.torque_limit_scale
        env_cfg.seed = (FIRST_SEED + self.seed) % LARGEST_SEED
        late = min(RandomizationConfig().delay_s[1], env_cfg.control_dt)
        env_cfg.randomization = RandomizationConfig(enabled=self.randomize, delay_s=(0.0, late))
        env_cfg.terminations = TerminationConfig(episode_s=1e6)  # what ends an episode is a fall
        if self.arms == "held":
            select_motion(env_cfg.motions.clips, (HELD,), "")
        return env_cfg

    def prepare(self, env: HumanoidEnv) -> None:  # noqa: B027  (some have nothing to prepare)
        """Set up an environment that was made from the config."""

    @abstractmethod
    def evaluate(self, env: HumanoidEnv, policy: PolicyFunction) -> dict[str, Any]:
        """Run in an environment that is prepared. Returns the measured part of the JSON; `film` (T, nq + 6 H) of the
        first env, as `Trajectory` has it, is kept."""

    def table(self, result: dict[str, Any]) -> str:
        """The result as Markdown."""
        return report.table(result)

    @abstractmethod
    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Draw the result, as a PNG file."""

    def video(self, path: Path, sheet: Path, env: HumanoidEnv) -> None:
        """Write a video of the first env as it was evaluated, and a contact sheet."""
        from cotap.evaluation.render import film_video

        film_video(path, env, self.film, sheet)


@dataclass
class RolloutProtocol(Protocol):
    """A protocol that measures what it recorded of one rollout, in which arms may move."""

    motion: tuple[str, ...] = (MIXTURE,)
    """Clips for the arms, `mixture` or `none`. mixture: as in the training. none: hold --arm-pose."""
    arm_pose: tuple[float, ...] = ()
    """Arm joints to hold, as of the left arm [rad]. The right arm mirrors it. By default the default pose."""
    library: str = ""
    """Motion library (.npz) of the clips. By default that of the policy."""
    upper_actions: str = "policy"
    """What moves the arms: policy or reference. reference leaves out the policy's own arm actions; a number from 0 to 1
    is the share of them that is left."""
    per_env: bool = False
    """Write the figures of every env as well. `cotap compare` then compares env by env."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        upper_share(self.upper_actions)
        if not self.motion:
            raise ValueError(f"motion must name clips, {MIXTURE!r} or {HELD!r}, got nothing")
        if len(self.motion) > 1 and not {MIXTURE, HELD}.isdisjoint(self.motion):
            raise ValueError(f"motion: {MIXTURE!r} and {HELD!r} stand alone, got {self.motion}")
        require_pose(self.arm_pose)
        if self.arm_pose and self.arms == "moving":
            raise ValueError(f"arm_pose is held only with motion {HELD!r}, got motion {self.motion}")
        if self.arms == "held":
            self.require_default("library", "while arms hold a pose")

    @property
    def arms(self) -> str:
        """Whether the arms' reference moves: moving or held."""
        return "held" if self.motion == (HELD,) else "moving"

    @property
    @abstractmethod
    def seconds(self) -> float:
        """Length of the evaluation [s]."""

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        if self.arms == "moving":
            select_motion(env_cfg.motions.clips, self.motion, self.library)
        return env_cfg

    def prepare(self, env: HumanoidEnv) -> None:
        """Give the arms their pose, unless they follow a motion."""
        super().prepare(env)
        if self.arms == "held":
            env.motions.hold(mirrored_pose(env, self.arm_pose))

    def before_step(self, env: HumanoidEnv, step: int) -> None:
        """Whatever the protocol changes as it goes along."""

    @abstractmethod
    def measure(self, trajectory: Trajectory, env: HumanoidEnv) -> dict[str, Any]:
        """The measured part of the evaluation's JSON, falls aside."""

    def record(self, env: HumanoidEnv, policy: PolicyFunction, seconds: float) -> Trajectory:
        """Run in an environment that is prepared, for so long [s]."""
        act = acting(env, policy, self.upper_actions)
        return record_rollout(env, act, round(seconds / env.dt), before_step=self.before_step)

    def evaluate(self, env: HumanoidEnv, policy: PolicyFunction) -> dict[str, Any]:
        """Run in an environment that is prepared. Returns the measured part of the JSON; `trajectory` is kept."""
        self.trajectory = self.record(env, policy, self.seconds)
        self.film = self.trajectory.film
        return {"num_falls": int(self.trajectory.fell.any(0).sum()), **self.measure(self.trajectory, env)}


def select_motion(clips: ClipConfig, motion: tuple[str, ...], library: str) -> None:
    """Have `clips` play what `motion` and `library` say."""
    if library:
        clips.library, clips.library_sha256 = library, ""
    if motion == (HELD,):
        clips.share, clips.only = 0.0, ()
    elif motion != (MIXTURE,):
        clips.share, clips.only, clips.held_out = 1.0, motion, ()


def require_pose(pose: tuple[float, ...]) -> None:
    """Raise ValueError for an arm joint [rad] that no robot has."""
    for i, value in enumerate(pose):
        require_range(f"arm_pose[{i}]", value, -math.pi, 1.5 * math.pi)


def mirrored_pose(env: HumanoidEnv, left: tuple[float, ...]) -> torch.Tensor:
    """Arm joints (U,) with `left` on the first arm and its mirror image on every other; the default pose for ().

    Raises:
        ValueError: `left` has another number of joints than an arm.
    """
    if not left:
        return env.motions.default
    by_name, first = {j.name: j for j in env.spec.joints}, env.spec.arms[0].joints
    if len(left) != len(first):
        raise ValueError(f"arm_pose must have {len(first)} numbers, one for each of {first}, got {len(left)}")
    values = dict(zip(first, left, strict=True))
    values |= {by_name[name].mirror_name: by_name[name].mirror_sign * value for name, value in values.items()}
    return torch.tensor([values[n] for n in env.spec.upper_joints])
