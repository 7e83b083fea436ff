"""Recipes of stage 1: PD control on all joints; legs follow commands, arms a reference.

A recipe declares all that differs from the defaults. What is to ship is `default`, from nothing, in one run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from cotap.agents.dual_ppo import DualPPOConfig
from cotap.agents.runner_config import RunnerConfig
from cotap.checks import reason_of, require_range
from cotap.envs.actions import ActionConfig
from cotap.envs.commands import CommandConfig
from cotap.envs.config import HumanoidEnvConfig
from cotap.envs.curriculum import AssistConfig, CurriculumConfig, RampConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.gait_phase import GaitConfig
from cotap.envs.hand_loads import HandLoadConfig
from cotap.envs.observations import ObservationConfig
from cotap.envs.pushes import PushConfig
from cotap.envs.rewards import UpperRewards


@dataclass
class BaseTraining:
    """All of a base run."""

    seed: int = 0
    """Seed of networks, exploration and environment."""
    threads: int = 0
    """CPU threads, 0 for every core. A run is reproducible for one number of threads."""
    device: str = "cpu"
    """Where the networks live, such as cpu or cuda. --backend says where the physics lives."""
    env: HumanoidEnvConfig = field(default_factory=HumanoidEnvConfig)
    ppo: DualPPOConfig = field(default_factory=DualPPOConfig)
    runner: RunnerConfig = field(default_factory=RunnerConfig)

    @property
    def samples(self) -> int:
        """What the run takes in all, with one process."""
        return self.runner.iterations * self.ppo.steps * self.env.num_envs

    def train_for(self, samples: float) -> None:
        """Set the iterations that take so many samples, with the envs and steps that are set now."""
        a_time = max(1, self.ppo.steps * self.env.num_envs)  # both are checked later
        self.runner.iterations = max(1, int(samples / a_time))

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("threads", self.threads, 0, 4096)
        try:
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:
            raise ValueError(f"device {self.device!r} cannot be used here: {reason_of(error)}") from error
        self.env.check()
        self.ppo.check()
        self.runner.check()


def default(robot: str = "h1") -> BaseTraining:
    """What is to ship: walks, stands, bears loads on the hands, and takes pushes; 300 M samples."""
    training = BaseTraining(
        env=HumanoidEnvConfig(
            robot=robot,
            num_envs=1024,
            assist=AssistConfig(enabled=True),
            curriculum=CurriculumConfig(arm_motion_samples=3e6),
            forces=ExternalForceConfig(
                hand_loads=HandLoadConfig(
                    enabled=True,
                    episode_share=0.5,
                    force_x=(-50.0, 50.0),
                    force_y=(-50.0, 50.0),
                    force_z=(-60.0, 5.0),
                    ramp=RampConfig(16e6, 60e6, first=0.1),
                ),
                pushes=PushConfig(
                    enabled=True,
                    episode_share=0.5,
                    velocity=(0.3, 1.2),
                    hand_share=0.25,
                    link_share=0.5,
                    largest_pitch=1.0,
                    ramp=RampConfig(20e6, 80e6, first=0.3),
                ),
            ),
        ),
        runner=RunnerConfig(iterations=12_207),
    )
    if robot == "g1":
        training.env.actions.waist_share = 0.5  # three joints in the waist
        # What the punch tour does: pushes, most of them on limbs. Loads made three in four of its falls.
        loads, pushes = training.env.forces.hand_loads, training.env.forces.pushes
        loads.episode_share, pushes.episode_share = 0.3, 1.0
        pushes.interval_s, pushes.hand_share, pushes.link_share = (1.5, 4.0), 0.15, 0.7
    return training


def quick(robot: str = "h1") -> BaseTraining:
    """Walking in the shortest time: no pushes, no loads; 30 M samples."""
    training = default(robot)
    training.env.forces = ExternalForceConfig()
    training.runner.iterations = 1220
    return training


def paper(robot: str = "h1") -> BaseTraining:
    """The paper's value for every setting that it names, and FALCON's for what it takes from there.

    Kept from `default` is what neither names: physics step, wrench of the first steps, most reward weights.
    """
    return BaseTraining(
        env=HumanoidEnvConfig(
            robot=robot, num_envs=4096,
            actions=ActionConfig(lower_scale=0.25, upper_scale=0.25, upper_mode="absolute"),
            observations=ObservationConfig(critic="history"),
            commands=CommandConfig(
                velocity_x=(-1.0, 1.0), velocity_y=(-1.0, 1.0), yaw_rate=(-1.0, 1.0), height_offset=(-0.25, 0.0),
                stand_probability=0.4, axis_zero_probability=0.0, resample_s=(10.0, 10.0),
            ),
            gait=GaitConfig(period_s=1.0),
            assist=AssistConfig(enabled=True),
            curriculum=CurriculumConfig(arm_motion_samples=3e6),
            forces=ExternalForceConfig(
                hand_loads=HandLoadConfig(
                    enabled=True, episode_share=1.0, torque_share=1.0, ramp=RampConfig(20e6, 100e6, first=0.1)
                )
            ),
        ),
        ppo=DualPPOConfig(
            hidden=(512, 256, 128), initial_std=0.8, std_half_life=0.0, entropy=0.01, epochs=5, learning_rate=1e-4,
            desired_kl=0.01, kl_half_life=1e12, symmetric=False, upper_gamma=0.99, value_clip=0.2,
        ),
        runner=RunnerConfig(iterations=20_000),
    )  # fmt: skip


def facet(robot: str = "h1") -> BaseTraining:
    """FACET as the paper trains it: PD arms, its tracking reward on the data's own motion, no moving reference."""
    training = default(robot)
    track_as_facet(training.env.rewards.upper)
    return training


def track_as_facet(weights: UpperRewards) -> None:
    """Put FACET's tracking reward of the hands in the place of that of key points, at their weight."""
    weights.track_hands_as_facet += weights.track_key_points + weights.track_key_velocities
    weights.track_key_points = weights.track_key_velocities = 0.0


BASE_RECIPES: dict[str, Callable[..., BaseTraining]] = {
    "default": default,
    "quick": quick,
    "paper": paper,
    "facet": facet,
}
"""Stage 1, by name; each takes the robot's name, by default the H1's."""
