"""Recipes of stage 1: PD control on all joints; legs follow commands, arms a reference."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from cotap.agents.dual_ppo import DualPPOConfig
from cotap.agents.runner_config import RunnerConfig
from cotap.checks import reason_of, require_range
from cotap.envs import H1EnvConfig
from cotap.envs.commands import STEADY_RAD


@dataclass
class BaseTraining:
    """All of a base run."""

    seed: int = 0
    """Seed of networks, exploration and environment."""
    threads: int = 0
    """Processor threads of torch and physics; 0 takes every processor. A run is reproducible for one number."""
    device: str = "cpu"
    """Where the networks live; physics is where `env.backend` has it."""
    env: H1EnvConfig = field(default_factory=H1EnvConfig)
    ppo: DualPPOConfig = field(default_factory=DualPPOConfig)
    runner: RunnerConfig = field(default_factory=RunnerConfig)

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


def default() -> BaseTraining:
    """From nothing to a policy that walks."""
    training = BaseTraining()
    training.env.assist.enabled = True
    training.env.num_envs = 1024
    training.env.commands.foresee_falls = True
    training.env.commands.step_roll_damping_s = 0.02
    # Loads on its hands slow down learning to walk; `robust` brings them.
    training.env.hand_forces.enabled = False
    training.runner.iterations = 1225
    return training


def paper() -> BaseTraining:
    """The paper's networks, otherwise the default."""
    training = default()
    training.ppo.hidden = (512, 256, 128)
    return training


def walk(training: BaseTraining | None = None) -> BaseTraining:
    """What a policy that walks learns next, on top of its own config or else of the default: to walk and stand well,
    arms moving, with legs that may not pass through each other."""
    training = copy.deepcopy(training) if training else default()
    env = training.env
    let_legs_collide(env)
    env.commands.steady_rad = STEADY_RAD
    env.commands.foresee_falls = True
    calm_the_arms(env)
    env.commands.stand_probability = 0.3
    env.rewards.lower.track_mean_velocity = 6.0
    env.rewards.lower.track_mean_yaw_rate = 2.4
    env.rewards.upper.steady_torso = 3.0
    training.ppo.least_std = 0.12
    training.ppo.desired_kl = 0.01
    training.runner.iterations = 2085
    return training


def robust(training: BaseTraining | None = None) -> BaseTraining:
    """What a policy that walks learns next, on top of its own config or else of the default: to take blows and loads
    on its hands, and to step where standing does not do any more."""
    training = walk(training)
    env = training.env
    env.commands.step_timing = True
    env.blows.enabled = True
    env.hand_forces.enabled = True
    env.hand_forces.episode_share = 0.6
    env.hand_forces.curriculum_start = 0.2
    env.hand_forces.curriculum_back = 0.1
    return training


def let_legs_collide(env: H1EnvConfig) -> None:
    """All shapes meet, and feet keep apart: legs that may pass through each other learn to, and trip anywhere else."""
    env.collision = "full"
    commands = env.commands
    commands.step_apart_m, commands.step_clear_m = max(commands.step_apart_m, 0.08), max(commands.step_clear_m, 0.25)


def calm_the_arms(env: H1EnvConfig) -> None:
    """Arms that move throw the torso around. Targets that do not run ahead of their reference do it less, the waist
    takes some of it, and rewards are steep where a policy that walks already is."""
    env.actions.reference_lead_s = 0.0
    env.commands.waist_damping_s = 0.08
    env.rewards.lower.track_yaw_rate_closely = 5.0
    env.rewards.lower.foot_slip = -5.0


def facet() -> BaseTraining:
    """FACET as the paper trains it: PD arms, its tracking reward on the data's own motion, no moving reference."""
    training = default()
    training.env.hand_forces.enabled = True
    reward_as_facet(training.env)
    return training


def reward_as_facet(env: H1EnvConfig) -> None:
    """FACET's tracking reward of the hands takes the place of that of key points, at their weight."""
    upper = env.rewards.upper
    upper.track_hands_as_facet += upper.track_key_points + upper.track_key_velocities
    upper.track_key_points = upper.track_key_velocities = 0.0


BASE_RECIPES: dict[str, Callable[[], BaseTraining]] = {
    "default": default,
    "paper": paper,
    "walk": walk,
    "robust": robust,
    "facet": facet,
}
"""Stage 1, by name."""
CONTINUATIONS: dict[str, Callable[[BaseTraining], BaseTraining]] = {"walk": walk, "robust": robust}
"""Recipes that may also go on from a checkpoint, and then change its config."""
