"""Recipes of stage 2: arms under compliance, legs guided by the frozen base (paper, section III-D)."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field

from cotap.agents.distillation import DistillationConfig
from cotap.configs.base import BaseTraining, reward_as_facet


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
    env.upper_body.left.name = env.upper_body.right.name = "cotap"
    env.upper_body.sampling.enabled = True
    env.rewards.upper.stay_close = 0.5
    env.hand_forces.curriculum_start = 0.5
    # The base's spread is where exploration goes on from, not where it began.
    training.ppo.initial_std = training.ppo.least_std
    training.runner.iterations = 400
    return training


def paper(base: BaseTraining) -> DistillTraining:
    """The paper's range of stiffness (its Table II)."""
    training = default(base)
    training.env.upper_body.sampling.stiffness = (150.0, 450.0)
    return training


def facet(base: BaseTraining) -> DistillTraining:
    """Arms under FACET, its tracking reward in place of that of key points."""
    training = default(base)
    env = training.env
    env.upper_body.left.name = env.upper_body.right.name = "facet"
    reward_as_facet(env)
    return training


DISTILL_RECIPES: dict[str, Callable[[BaseTraining], DistillTraining]] = {
    "default": default,
    "paper": paper,
    "facet": facet,
}
