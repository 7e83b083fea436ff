"""Laws with a wrong model of the arms that they drive: what a law's model is worth shows when it is off."""

from __future__ import annotations

from dataclasses import replace

import torch

from cotap.envs import HumanoidEnv
from cotap.envs.state import RobotState
from cotap.envs.upper_body import UpperBody, UpperBodyConfig
from cotap.robots import RobotSpec
from cotap.robots.chains import arm_chains


def misjudged_arms(spec: RobotSpec, length: float, mass: float) -> RobotSpec:
    """A robot whose arms are longer and heavier by these factors than those of `spec`.

    Longer: where each link, but the first of an arm, begins on the one before it, where its centre of mass is, and
    where the hand is. Heavier: the masses of the same links. The first link keeps its place on the torso, its mass and
    its centre of mass, and all links keep their rotational inertias about their centres of mass.
    """
    links = {b.name for arm in spec.arms for b in spec.chain(arm.hand_body, spec.torso_body)[1:]}
    bodies = tuple(
        replace(b, pos=_scaled(b.pos, length), com=_scaled(b.com, length), mass_kg=mass * b.mass_kg)
        if b.name in links
        else b
        for b in spec.bodies
    )
    arms = tuple(replace(arm, hand_point=_scaled(arm.hand_point, length)) for arm in spec.arms)
    return replace(spec, bodies=bodies, arms=arms)


def _scaled(vector: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    x, y, z = (factor * v for v in vector)
    return x, y, z


class MisjudgingUpperBody(UpperBody):
    """The arms' laws with a model of their own of the arms, kinematics included."""

    def __init__(self, cfg: UpperBodyConfig, believed: RobotSpec, num_envs: int, dt: float) -> None:
        super().__init__(cfg, believed, num_envs, dt)
        self._chains = arm_chains(believed)

    def send(self, state: RobotState, target: torch.Tensor, velocity: torch.Tensor) -> None:
        """As ever, with the arms where the wrong model has them."""
        q = self._upper(state.joint_pos).reshape(self._shape)
        super().send(replace(state, arms=self._chains.pose(q)), target, velocity)


def misjudge(env: HumanoidEnv, length: float, mass: float) -> None:
    """From now on the laws of `env` take the arms for longer and heavier by these factors, see `misjudged_arms`."""
    believed = misjudged_arms(env.spec, length, mass)
    with torch.device(env.device):
        wrong = MisjudgingUpperBody(env.cfg.upper_body, believed, env.num_envs, env.dt)
    env.upper_body = env.actuation.upper_body = wrong
