"""What a robot must put into each term of the observation: quantity, unit, range."""

from __future__ import annotations

import math
from typing import Any

from cotap.envs import HumanoidEnvConfig
from cotap.envs.modulation import OBSERVED_STIFFNESS
from cotap.envs.observations import Term
from cotap.robots import RobotSpec


def about_terms(cfg: HumanoidEnvConfig, spec: RobotSpec, terms: tuple[Term, ...]) -> dict[str, dict[str, Any]]:
    """For each term `what` it is, its `unit` and its `range`, before it is multiplied by its scale.

    A range is (low, high), each one number or one for every joint: that of training for commands, what can be for the
    rest, null where there is no bound.
    """
    joints, arms, c = spec.joints, spec.upper_joint_specs, cfg.commands
    low, high = ([j.range_rad[i] for j in arms] for i in (0, 1))
    limits = [cfg.torque_limit_scale * j.torque_limit_nm for j in arms]
    speeds = [j.velocity_limit_rad_s for j in joints]
    moved = [[j.range_rad[i] - j.default_rad for j in joints] for i in (0, 1)]
    velocity = [list(bounds) for bounds in zip(c.velocity_x, c.velocity_y, strict=True)]
    height = [spec.nominal_height_m + offset for offset in c.height_offset]
    laws = cfg.upper_body.modulation
    stiffness = [math.log(bound / OBSERVED_STIFFNESS) for bound in laws.stiffness]
    about: dict[str, tuple[str, str, Any]] = {
        "torso_angular_velocity": ("of the torso link, in its own frame: x, y, z", "rad/s", None),
        "projected_gravity": ("unit vector that points down, in the torso link's frame", "1", [-1.0, 1.0]),
        "command_velocity": ("commanded velocity, forward and leftward, heading frame", "m/s", velocity),
        "command_yaw_rate": ("commanded turning rate, positive to the left", "rad/s", list(c.yaw_rate)),
        "command_stand": ("1 stands, 0 walks", "1", [0.0, 1.0]),
        "command_height": ("torso link's origin above the ground; nominal while walking", "m", height),
        "reference_arm_position": ("angles that the arms are to have, absolute", "rad", [low, high]),
        "joint_position": ("joint angles minus the default pose", "rad", moved),
        "joint_velocity": ("joint rates", "rad/s", [[-v for v in speeds], speeds]),
        "last_action": ("action of the step before", "1", [-cfg.actions.clip, cfg.actions.clip]),
        "sin_phase": ("sine of the gait's phase; 0 while standing", "1", [-1.0, 1.0]),
        "cos_phase": ("cosine of the gait's phase; 0 while standing", "1", [-1.0, 1.0]),
        "arm_torque": ("torque of the arms' law at present, within limits", "Nm", [[-t for t in limits], limits]),
        "law_alpha": ("alpha of each arm's law at present", "1", list(laws.alpha)),
        "law_log_stiffness": (f"logarithm of stiffness along x, y, z over {OBSERVED_STIFFNESS:g} N/m", "1", stiffness),
    }  # fmt: skip
    return {name: dict(zip(("what", "unit", "range"), about[name], strict=True)) for name, _, _ in terms}
