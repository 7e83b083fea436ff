"""A walk that comes to rest, worked out step by step, for users to check a loop of their own against."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch

from cotap.envs import HumanoidEnvConfig
from cotap.envs.commands import CommandSource
from cotap.envs.modulation import OBSERVED_STIFFNESS
from cotap.envs.observations import ObservationHistory, Term, actor_values
from cotap.robots import RobotSpec

WALKING = 8
"""Steps in which the robot is asked to walk. It then stands, which takes the rest of a stride, and then squats."""
RESTED = 4
"""Steps at rest: the height is then still on its way."""
PHASE = 0.9
"""Of the gait at the start, so that it begins anew on the way."""
VELOCITY, YAW_RATE = (0.4, -0.2), 0.3
"""What is asked for at first [m/s], [rad/s]."""
SQUAT_M = 0.1

Targets = Callable[[torch.Tensor], torch.Tensor]


def golden_steps(
    cfg: HumanoidEnvConfig, spec: RobotSpec, terms: tuple[Term, ...], history: int, targets: Targets, offset: Targets,
    scale: torch.Tensor, seed: int,
) -> tuple[dict[str, Any], torch.Tensor]:  # fmt: skip
    """Made-up readings of a robot that is asked to walk, to stand and to squat, and the last observation (W,) that they
    lead to.

    Each of the readings has the `command`, `joint_pos` and `joint_vel` (J,), `angular_velocity` and `gravity` (3,) of
    the torso, and `arm_reference` (U,), where the arms are to be at the step's end; and `joint_targets` (J,), where the
    loop sends the joints. What follows from a law and not from the loop is among them under its term's name: torques of
    arms that are not under PD, and what modulated laws are set to.

    Args:
        cfg: The policy's environment.
        spec: Its robot.
        terms: Of its observation.
        history: Steps in it.
        targets: Observations (1, W) to joint targets (1, J) [rad].
        offset: Reference (1, U) to what scaled actions (1, J) are added to [rad].
        scale: (J,) radians per unit of action.
        seed: Of what is made up.
    """
    rng = torch.Generator().manual_seed(seed)
    joints, arms = spec.joints, slice(len(spec.lower_joints), None)
    default, kp, kd, limit = (
        torch.tensor([[getattr(j, name) for j in joints]], dtype=torch.float64)
        for name in ("default_rad", "kp", "kd", "torque_limit_nm")
    )
    limit = cfg.torque_limit_scale * limit
    commands = CommandSource(cfg.commands, cfg.gait, 1, spec.nominal_height_m, cfg.control_dt)
    _ask(commands, asked := _asked(0, 0, spec))
    commands.reset(torch.ones(1, dtype=torch.bool), rng)
    commands.gait.phase[:] = PHASE
    buffer = ObservationHistory(terms, 1, history)
    reference, action, sent, readings = default[:, arms], torch.zeros_like(default), default, []
    observation, rested = torch.zeros(0), 0
    while rested < RESTED:
        k = len(readings)
        if k > 0:
            _ask(commands, asked := _asked(k, rested, spec))
            commands.step(rng)
            rested += int(commands.current().stand[0])
        made_up = {"command": asked} | _reading(cfg, spec, rng)
        if rested == RESTED:  # so that what is sent is what the network said
            made_up["arm_reference"] = readings[-1]["arm_reference"]
        q, dq = (torch.tensor([made_up[name]], dtype=torch.float64) for name in ("joint_pos", "joint_vel"))
        torque = (kp * (sent - q) - kd * dq).clamp(-limit, limit)[:, arms] * (k > 0)
        turn, down = (torch.tensor([made_up[name]], dtype=torch.float64) for name in ("angular_velocity", "gravity"))
        # Of the state, actors observe this alone.
        state: Any = SimpleNamespace(torso_angular_velocity_t=turn, projected_gravity_t=down, joint_pos=q, joint_vel=dq)
        values = actor_values(state, commands.current(), reference, default, action, torque)
        values |= {name: torch.tensor([made_up[name]]) for name in made_up.keys() & {name for name, _, _ in terms}}
        present = buffer.scaled({name: value.double() for name, value in values.items()}).float()
        observation = buffer.append(present, torch.tensor([k == 0]))
        action = (targets(observation).double() - offset(reference)) / scale
        reference = torch.tensor([made_up["arm_reference"]], dtype=torch.float64)
        sent = offset(reference) + scale * action
        readings.append(made_up | {"joint_targets": [round(target, 7) for target in sent[0].tolist()]})
    return {"phase": PHASE, "readings": readings}, observation[0]


def _asked(step: int, rested: int, spec: RobotSpec) -> dict[str, Any]:
    """The command of a step, after so many steps at rest."""
    walks, height = step < WALKING, spec.nominal_height_m
    return {
        "velocity": list(VELOCITY) if walks else [0.0, 0.0],
        "yaw_rate": YAW_RATE if walks else 0.0,
        "stand": not walks,
        "height": height - SQUAT_M if rested else height,
    }


def _ask(commands: CommandSource, asked: dict[str, Any]) -> None:
    stand = torch.tensor([float(asked["stand"])])
    commands.override(
        torch.tensor([asked["velocity"]]), torch.tensor([asked["yaw_rate"]]), stand, torch.tensor([asked["height"]])
    )


def _reading(cfg: HumanoidEnvConfig, spec: RobotSpec, rng: torch.Generator) -> dict[str, Any]:
    """One step's readings, each a little off what it is at rest."""

    def near(values: list[float], width: float) -> list[float]:
        return [round(v + width * (2.0 * float(torch.rand(1, generator=rng)) - 1.0), 4) for v in values]

    default = [j.default_rad for j in spec.joints]
    tilt = near([0.0, 0.0], 0.1)
    reading = {
        "joint_pos": near(default, 0.1), "joint_vel": near([0.0] * len(default), 0.5),
        "angular_velocity": near([0.0] * 3, 0.3), "gravity": [*tilt, -math.sqrt(1.0 - tilt[0] ** 2 - tilt[1] ** 2)],
        "arm_reference": near(default[len(spec.lower_joints) :], 0.05),
    }  # fmt: skip
    laws = [cfg.upper_body.of(arm.side) for arm in spec.arms]
    if any(law.name != "pd" for law in laws):
        reading["arm_torque"] = near([0.0] * len(spec.upper_joints), 5.0)
    if cfg.upper_body.modulation.terms(len(laws)):
        reading["law_alpha"] = [law.alpha for law in laws]
        reading["law_log_stiffness"] = [math.log(k / OBSERVED_STIFFNESS) for law in laws for k in law.stiffness]
    return reading
