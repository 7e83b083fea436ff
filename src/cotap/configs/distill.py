"""Recipes of stage 2: arms under compliance, legs guided by the frozen base (paper, section III-D)."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field

from cotap.agents.distillation import DistillationConfig
from cotap.compliance.laws import LawConfig
from cotap.configs.base import BaseTraining, track_as_facet
from cotap.envs.arm_task import TASK_WEIGHTS, task_forces
from cotap.envs.curriculum import AssistConfig, CurriculumConfig, RampConfig
from cotap.envs.modulation import ModulationConfig
from cotap.envs.upper_body import LawSampling, UpperBodyConfig


@dataclass
class DistillTraining(BaseTraining):
    """All of a distillation run."""

    distillation: DistillationConfig = field(default_factory=DistillationConfig)

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        self.distillation.check()


def default(base: BaseTraining) -> DistillTraining:
    """The base's own environment and networks, with arms under CoTaP over a wide range of stiffness; 75 M samples."""
    training = DistillTraining(
        seed=base.seed, env=copy.deepcopy(base.env), ppo=copy.deepcopy(base.ppo), runner=copy.deepcopy(base.runner)
    )
    env = training.env
    env.upper_body = UpperBodyConfig(
        left=LawConfig(name="cotap"), right=LawConfig(name="cotap"), sampling=LawSampling(enabled=True, full_alpha=0.25)
    )
    _after_base(training)
    pushes = env.forces.pushes
    pushes.episode_share = 0.8
    pushes.hand_share, pushes.link_share = 0.5, 0.3  # hands are what the law is for
    pushes.velocity, pushes.largest_pitch = (0.0, 1.5), 0.5 * math.pi
    env.path.share = 0.1
    # The gait is there. With these weights from the start, exploring widely for longer, H1 stepped twice as often.
    weights = env.rewards.lower
    weights.track_mean_velocity, weights.track_yaw_rate, weights.contact_schedule = 10.0, 8.0, 5.0
    # At 0.1 the agent brought arms 2 % closer, and resisted small loads: hands felt stiffer by up to a quarter.
    env.rewards.upper.reference_closeness = 1.0
    if env.actions.upper_mode == "residual":
        training.distillation.anew = ("upper",)  # under PD it has learned to resist loads
    _for(training, 75e6)
    return training


def _for(training: DistillTraining, samples: float) -> None:
    """So many samples, over which exploration and the change that updates aim at fall to a half and a quarter. The base
    guides for an eighth of them."""
    training.train_for(samples)
    training.distillation.end_samples = samples / 8.0
    training.ppo.std_half_life, training.ppo.kl_half_life = samples, samples / 2.0


def quick(base: BaseTraining) -> DistillTraining:
    """Compliance in the shortest time, and what ablations change one part of; 15 M samples."""
    training = default(base)
    _for(training, 15e6)
    return training


def paper(base: BaseTraining) -> DistillTraining:
    """The paper's range of stiffness (its Table II), drawn uniformly, PD's damping, no pushes, and as many samples as
    its 20,000 iterations of 4096 envs have. All else is as in `default`: begin with a base of recipe `paper`."""
    training = default(base)
    pd_damped = LawConfig(name="cotap", damping="pd")
    sampling = LawSampling(enabled=True, stiffness=(150.0, 450.0), log_uniform=False)
    training.env.upper_body = UpperBodyConfig(left=pd_damped, right=copy.deepcopy(pd_damped), sampling=sampling)
    training.env.forces.pushes.enabled = False
    training.distillation.anew = ()
    _for(training, 20_000 * training.ppo.steps * 4096)
    training.ppo.std_half_life, training.ppo.kl_half_life = base.ppo.std_half_life, base.ppo.kl_half_life
    return training


def _after_base(training: DistillTraining) -> None:
    """What the base has learned is there from the start."""
    env = training.env
    env.assist, env.curriculum = AssistConfig(), CurriculumConfig()
    env.forces.pushes.ramp, env.forces.hand_loads.ramp = RampConfig(), RampConfig()
    # Actions that begin anew explore as widely as a base's do at first, all others half as widely: with the narrow
    # exploration at which a base ends, little more was learned.
    training.ppo.initial_std, training.ppo.least_std = 0.5 * training.distillation.new_std, 0.12


def without_ratio(base: BaseTraining) -> DistillTraining:
    """Ablation: compliance does not give way to PD near singular arms (paper, Table IV)."""
    training = quick(base)
    training.env.upper_body.singularity_ratio = False
    return training


def with_torque_for_critics(base: BaseTraining) -> DistillTraining:
    """Ablation: the arms' torque is seen by the critics only (paper, appendix C). So it is for the base that guides:
    its networks, refitted, take the torque for what it is on average."""
    training = quick(base)
    training.env.observations.arm_torque = "critic"
    return training


def with_goals(base: BaseTraining) -> DistillTraining:
    """Ablation: actors see stiffness and alpha as commanded."""
    training = quick(base)
    training.env.observations.goals = True
    return training


def facet(base: BaseTraining) -> DistillTraining:
    """FACET as the paper trains it (appendix D): its tracking reward on the data's own motion, arms under PD. Forces
    move the reference in evaluation alone, by the law `facet`."""
    training = quick(base)
    training.env.upper_body = UpperBodyConfig()
    training.distillation.anew = ()
    training.env.rewards.upper.reference_closeness = 0.0  # which is CoTaP's
    track_as_facet(training.env.rewards.upper)
    return training


def modulated(base: BaseTraining) -> DistillTraining:
    """The upper agent sets alpha and stiffness itself, through an energy store, for a task in which that pays
    (`cotap.envs.arm_task`); best begun from a policy that is distilled already; 60 M samples."""
    training = default(base)
    env, law = training.env, LawConfig(name="cotap", alpha=0.75, passive=True)
    env.upper_body = UpperBodyConfig(law, copy.deepcopy(law), modulation=ModulationConfig("stiffness"))
    env.forces = task_forces()
    for name, weight in TASK_WEIGHTS.items():
        setattr(env.rewards.upper, name, weight)
    env.rewards.upper.track_arms = env.rewards.upper.track_key_points = 0.0  # which would not give way
    env.rewards.upper.reference_closeness = 0.0  # targets are the reference
    training.distillation.anew = ()
    training.distillation.new_std = 1.0  # of what is asked of the laws, whose rates smooth it
    training.ppo.upper_gamma = 0.97  # a hand that gave way takes half a second to return
    _for(training, 60e6)
    return training


DISTILL_RECIPES: dict[str, Callable[[BaseTraining], DistillTraining]] = {
    "default": default,
    "quick": quick,
    "paper": paper,
    "no-ratio": without_ratio,
    "torque-critic": with_torque_for_critics,
    "goals": with_goals,
    "facet": facet,
    "modulated": modulated,
}
"""Stage 2, by name. Each makes its configuration of the base's."""
