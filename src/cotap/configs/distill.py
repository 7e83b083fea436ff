"""Recipes of stage 2: arms under compliance, legs guided by the frozen base (paper, section III-D)."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field

from cotap.agents.distillation import DistillationConfig
from cotap.configs.base import BaseTraining, calm_the_arms, let_legs_collide, reward_as_facet
from cotap.configs.base import default as base_default
from cotap.envs.upper_body import UpperBodyConfig


@dataclass
class DistillTraining(BaseTraining):
    """All of a distillation run."""

    distillation: DistillationConfig = field(default_factory=DistillationConfig)

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        self.distillation.check()


def default(base: BaseTraining) -> DistillTraining:
    """The base's own environment and networks, with arms under CoTaP over a wide range of stiffness."""
    training = DistillTraining(
        seed=base.seed, env=copy.deepcopy(base.env), ppo=copy.deepcopy(base.ppo), runner=copy.deepcopy(base.runner)
    )
    env = training.env
    env.assist.enabled = False
    env.commands.step_timing = env.commands.foresee_falls = True
    let_legs_collide(env)
    calm_the_arms(env)
    # Under blows from every side these more than halve the falls, without any training.
    env.commands.step_hold_back_m, env.commands.step_catch_lift = 0.5, 1.0
    env.commands.waist_yield_s = 0.05
    env.commands.step_correct_s = 0.1
    env.commands.step_roll_damping_s, env.commands.step_twist_damping_s = 0.024, 0.006
    env.commands.step_straighten_rad = 0.01
    for law in (env.upper_body.left, env.upper_body.right):
        law.name, law.damping = "cotap", "critical"
    env.upper_body.sampling.enabled = True
    env.upper_body.sampling.full_alpha = 0.25
    # The base has taken smaller ones already. From here on one blow in six may throw the robot, and all are hard.
    env.blows.enabled = env.hand_forces.enabled = True
    blows = env.blows
    blows.force, blows.duration_s, blows.episode_share = (300.0, 600.0), (0.03, 0.06), 0.6
    blows.curriculum_start, blows.curriculum_back = 0.65, 0.1
    env.hand_forces.curriculum_start = 0.4
    # What the base's upper agent adds to the reference is feedback; through a stiffness of several times PD's it swings
    # the arms, and through any it is felt at the hand beside the stiffness that is asked for.
    env.rewards.upper.arm_residual = -10.0
    env.rewards.upper.upper_action_rate = -0.05
    env.rewards.upper.stay_close = 1.0
    env.rewards.upper.steady_torso = 0.0  # it would move the arms from where compliance puts them
    env.rewards.lower.track_mean_velocity = 6.0
    env.commands.stand_probability = 0.3
    # The base's spread is where exploration goes on from, not where it began.
    training.ppo.initial_std = training.ppo.least_std
    training.ppo.desired_kl = 0.01
    training.runner.iterations = 3670
    return training


def paper(base: BaseTraining) -> DistillTraining:
    """The paper's range of stiffness (its Table II), and PD's damping."""
    training = default(base)
    arms = training.env.upper_body
    arms.left.damping = arms.right.damping = "pd"
    sampling = training.env.upper_body.sampling
    sampling.stiffness, sampling.full_alpha = (150.0, 450.0), 0.0
    return training


def without_ratio(training: DistillTraining) -> DistillTraining:
    """Ablation: compliance does not give way to PD near singular arms (paper, Table IV)."""
    training = copy.deepcopy(training)
    training.env.upper_body.singularity_ratio = False
    return training


def with_torque_for_critics(training: DistillTraining) -> DistillTraining:
    """Ablation: the arms' torque is seen by the critics only (paper, appendix C)."""
    training = copy.deepcopy(training)
    training.env.observations.arm_torque = "critic"
    return training


def with_goals(training: DistillTraining) -> DistillTraining:
    """Ablation: actors see stiffness and alpha as commanded."""
    training = copy.deepcopy(training)
    training.env.observations.goals = True
    return training


def facet(base: BaseTraining) -> DistillTraining:
    """Arms under FACET, its tracking reward in place of that of key points."""
    training = default(base)
    env = training.env
    env.upper_body.left.name = env.upper_body.right.name = "facet"
    reward_as_facet(env)
    return training


def as_base(training: DistillTraining) -> BaseTraining:
    """Stage 1 as a distilled policy goes on with it: its own environment, arms back under PD, no guide."""
    env, runner = copy.deepcopy(training.env), copy.deepcopy(training.runner)
    env.upper_body = UpperBodyConfig()
    runner.iterations = base_default().runner.iterations  # counted anew
    return BaseTraining(
        seed=training.seed, threads=training.threads, device=training.device, env=env,
        ppo=copy.deepcopy(training.ppo), runner=runner,
    )  # fmt: skip


DISTILL_CONTINUATIONS: dict[str, Callable[[DistillTraining], DistillTraining]] = {
    "no-ratio": without_ratio,
    "torque-critic": with_torque_for_critics,
    "goals": with_goals,
}
"""Recipes that may also go on from a checkpoint of stage 2, and then change its config."""
OTHER_TERMS = ("torque-critic", "goals")
"""Recipes that change what networks see, and so refit those of the checkpoint that they begin from."""


def _from_base(change: Callable[[DistillTraining], DistillTraining]) -> Callable[[BaseTraining], DistillTraining]:
    return lambda base: change(default(base))


DISTILL_RECIPES: dict[str, Callable[[BaseTraining], DistillTraining]] = {
    "default": default,
    "paper": paper,
    **{name: _from_base(change) for name, change in DISTILL_CONTINUATIONS.items()},
    "facet": facet,
}
"""Stage 2, by name."""
