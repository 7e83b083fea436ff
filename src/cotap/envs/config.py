"""Everything that defines the environment."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from cotap.checks import require_one_of, require_positive_int, require_range, require_seed
from cotap.envs.actions import ActionConfig
from cotap.envs.commands import CommandConfig
from cotap.envs.curriculum import AssistConfig, CurriculumConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.gait_phase import GaitConfig
from cotap.envs.observations import ObservationConfig
from cotap.envs.path_following import PathConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.rewards import LowerRewards, UpperRewards, check_weights
from cotap.envs.terminations import TerminationConfig
from cotap.envs.upper_body import UpperBodyConfig
from cotap.motions.reference import ReferenceConfig
from cotap.robots import ROBOTS
from cotap.robots.mjcf import COLLISIONS
from cotap.sim import resolve_backend


@dataclass
class RewardConfig:
    """Weights of both agents' rewards."""

    lower: LowerRewards = field(default_factory=LowerRewards)
    upper: UpperRewards = field(default_factory=UpperRewards)


@dataclass
class HumanoidEnvConfig:
    """Everything that defines the environment."""

    robot: str = "h1"
    """Name of the robot."""
    num_envs: int = 2048
    """Number of envs."""
    seed: Annotated[int, tyro.conf.Suppress] = 0
    """Seed of the environment's own random numbers. A training sets it, as it does the threads."""
    backend: str = "auto"
    """What simulates: mujoco, mjbatch (both on the CPU), warp (a GPU) or auto. auto takes warp if there
    is a GPU and the extra `warp` is installed, else mjbatch if that is installed, else mujoco."""
    num_threads: Annotated[int, tyro.conf.Suppress] = 0
    """Physics threads on the CPU; 0 takes every core."""
    collision: str = "full"
    """full (all shapes, against the floor and each other) or feet (only feet meet the floor)."""
    control_dt: float = 0.02
    """Control step [s]."""
    substeps: int = 2
    """Physics steps per control step."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""
    fixed_base: bool = False
    """Hold the base in the air: for measurements on the arms alone."""
    unevenness_m: float = 0.0
    """Height of the ground's bumps from lowest to highest [m]; 0 is flat. Envs start at different places on it unless
    their base is held."""
    actions: ActionConfig = field(default_factory=ActionConfig)
    upper_body: UpperBodyConfig = field(default_factory=UpperBodyConfig)
    observations: ObservationConfig = field(default_factory=ObservationConfig)
    commands: CommandConfig = field(default_factory=CommandConfig)
    gait: GaitConfig = field(default_factory=GaitConfig)
    motions: ReferenceConfig = field(default_factory=ReferenceConfig)
    path: PathConfig = field(default_factory=PathConfig)
    rewards: RewardConfig = field(default_factory=RewardConfig)
    terminations: TerminationConfig = field(default_factory=TerminationConfig)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    forces: ExternalForceConfig = field(default_factory=ExternalForceConfig)
    assist: AssistConfig = field(default_factory=AssistConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_positive_int("num_envs", self.num_envs)
        require_range("substeps", require_positive_int("substeps", self.substeps), 1, 1000)
        require_seed("seed", self.seed)
        require_one_of("robot", self.robot, ROBOTS.keys())
        resolve_backend(self.backend)
        require_one_of("collision", self.collision, COLLISIONS)
        require_range("control_dt", self.control_dt, 1e-4, 1.0)
        require_range("torque_limit_scale", self.torque_limit_scale, 1e-3, 1e3)
        require_range("unevenness_m", self.unevenness_m, 0.0, 0.2)
        for part in (
            self.actions, self.upper_body, self.observations, self.commands, self.gait, self.motions, self.path,
            self.terminations, self.forces, self.assist, self.curriculum,
        ):  # fmt: skip
            part.check()
        self.randomization.check(self.control_dt)
        check_weights("lower", self.rewards.lower)
        check_weights("upper", self.rewards.upper)
