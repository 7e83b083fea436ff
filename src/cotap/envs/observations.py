"""Observations (paper, appendix B): what each agent sees, term by term, with history."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from cotap.checks import require_one_of, require_range
from cotap.envs.commands import Command
from cotap.envs.state import RobotState
from cotap.persistence import Stateful


@dataclass
class NoiseConfig:
    """Half widths of uniform sensor noise on the actor's observation; the critic never sees it."""

    enabled: bool = False
    """Whether sensors are noisy."""
    angular_velocity: float = 0.2
    """[rad/s]."""
    gravity: float = 0.05
    """Unit vector components."""
    joint_position: float = 0.01
    """[rad]."""
    joint_velocity: float = 1.0
    """[rad/s]."""


@dataclass
class ObservationConfig:
    """Layout options of the observation."""

    history: int = 5
    """Steps of history, the present one included."""
    arm_torque: str = "actor"
    """Who sees the arms' torque: actor (and so the critic), or critic alone (the paper's ablation)."""
    critic: str = "present"
    """What critics see: present (this step, what rewards are made of, and the pushes and loads to come), or history
    (all the history that actors see, and the torso's motion; the paper)."""
    goals: bool = False
    """Whether the actor sees the arms' stiffness, null-space stiffness and alpha as they are commanded."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("observations.history", self.history, 1, 100)
        require_one_of("observations.arm_torque", self.arm_torque, ("actor", "critic"))
        require_one_of("observations.critic", self.critic, ("present", "history"))
        for name in ("angular_velocity", "gravity", "joint_position", "joint_velocity"):
            require_range(f"observations.noise.{name}", getattr(self.noise, name), 0.0, 100.0)


Term = tuple[str, int, float]
"""Name, width and scale."""


GOALS_PER_ARM = 5
"""Logarithms of stiffness along x, y and z and of null-space stiffness, and alpha."""


def actor_terms(
    num_joints: int, num_upper: int, arm_torque: bool = True, num_goals: int = 0, laws: tuple[Term, ...] = ()
) -> tuple[Term, ...]:
    """Terms of one step of the actor's observation, in order; `laws` are those of learned modulation."""
    terms: list[Term] = [
        ("torso_angular_velocity", 3, 0.25),
        ("projected_gravity", 3, 1.0),
        ("command_velocity", 2, 1.0),
        ("command_yaw_rate", 1, 1.0),
        ("command_stand", 1, 1.0),
        ("command_height", 1, 2.0),
        ("reference_arm_position", num_upper, 1.0),
        ("joint_position", num_joints, 1.0),
        ("joint_velocity", num_joints, 0.05),
        ("last_action", num_joints, 1.0),
        ("sin_phase", 1, 1.0),
        ("cos_phase", 1, 1.0),
    ]
    if arm_torque:
        terms.append(("arm_torque", num_upper, 1.0))
    if num_goals:
        terms.append(("goals", num_goals, 1.0))
    return (*terms, *laws)


def critic_terms(num_hands: int, num_torques: int = 0, num_feet: int = 0) -> tuple[Term, ...]:
    """Terms that only the critic sees, for the present step, in the heading frame: rewards do not depend on where a
    robot faces. `num_torques` arm torques that the actor does not see.

    With `num_feet`, also what rewards are made of and what is about to happen to the robot. A critic that is surprised
    by a push blames the actions before it (Mao et al., Variance Reduction for Reinforcement Learning in Input-Driven
    Environments, 2019).
    """
    more: tuple[Term, ...] = (
        ("mean_error", 3, 4.0),
        ("torso_height", 1, 4.0),
        ("foot_contact", num_feet, 1.0),
        ("foot_height", num_feet, 10.0),
        ("push_nearness", 1, 1.0),
        ("push_velocity", 3, 1.0),
        ("push_place", 2 + num_hands, 1.0),
        ("load_nearness", 1, 1.0),
        ("coming_load", 3 * num_hands, 0.05),
    )
    return (
        ("torso_orientation", 4, 1.0),
        ("torso_linear_velocity", 3, 2.0),
        *((("arm_torque", num_torques, 1.0),) if num_torques else ()),
        ("hand_force", 3 * num_hands, 0.1),
        *(more if num_feet else ()),
    )


def actor_values(
    s: RobotState, command: Command, arm_reference: torch.Tensor, default: torch.Tensor, last_action: torch.Tensor,
    arm_torque: torch.Tensor,
) -> dict[str, torch.Tensor]:  # fmt: skip
    """What actors observe, by term, unscaled.

    Args:
        s: What the robot's sensors say; of it, only joints, gravity's direction and angular velocity are used.
        command: What is commanded, and the gait's phase.
        arm_reference: (N, U) reference arm position [rad].
        default: (J,) the default pose [rad].
        last_action: (N, J).
        arm_torque: (N, U) [Nm].
    """
    angle, walking = 2.0 * math.pi * command.phase, 1.0 - command.stand
    return {
        "torso_angular_velocity": s.torso_angular_velocity_t,
        "projected_gravity": s.projected_gravity_t,
        "command_velocity": command.velocity_h,
        "command_yaw_rate": command.yaw_rate.unsqueeze(1),
        "command_stand": command.stand.unsqueeze(1),
        "command_height": command.height.unsqueeze(1),
        "reference_arm_position": arm_reference,
        "joint_position": s.joint_pos - default,
        "joint_velocity": s.joint_vel,
        "last_action": last_action,
        "sin_phase": (walking * angle.sin()).unsqueeze(1),
        "cos_phase": (walking * angle.cos()).unsqueeze(1),
        "arm_torque": arm_torque,
    }


class ObservationHistory(Stateful):
    """Keeps the last steps of every term, laid out term by term and oldest first."""

    STATE = ("buffer",)

    def __init__(self, terms: tuple[Term, ...], num_envs: int, steps: int) -> None:
        self.terms, self.steps = terms, steps
        self.width = sum(width for _, width, _ in terms)
        self.scale = torch.cat([torch.full((width,), scale) for _, width, scale in terms])
        self.buffer = torch.zeros(num_envs, self.width * steps)
        self._widths = [width for _, width, _ in terms]

    def scaled(self, values: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """One step (N, width): `values` (N, width of each) in the terms' order, by the terms' scales."""
        return torch.cat([values[name] for name, _, _ in self.terms], 1) * self.scale

    def append(self, present: torch.Tensor, restarted: torch.Tensor) -> torch.Tensor:
        """Add `present` (N, width), already scaled; envs in `restarted` (N,) fill their history with it.

        Returns the new buffer (N, width * steps), which later calls do not change.
        """
        self.buffer = self.with_next(present)
        if restarted.any():
            fresh = [t.repeat(1, self.steps) for t in present[restarted].split(self._widths, 1)]
            self.buffer[restarted] = torch.cat(fresh, 1)
        return self.buffer

    def with_next(self, present: torch.Tensor) -> torch.Tensor:
        """What the history (N, width * steps) would be with `present` (N, width) added."""
        pieces: list[torch.Tensor] = []
        start = 0
        for width, term in zip(self._widths, present.split(self._widths, 1), strict=True):
            pieces += (self.buffer[:, start + width : start + width * self.steps], term)
            start += width * self.steps
        return torch.cat(pieces, 1)


def noise_amplitude(terms: tuple[Term, ...], cfg: NoiseConfig) -> torch.Tensor:
    """Noise half width of each column of one step, scaled as the observation is."""
    widths = {
        "torso_angular_velocity": cfg.angular_velocity,
        "projected_gravity": cfg.gravity,
        "joint_position": cfg.joint_position,
        "joint_velocity": cfg.joint_velocity,
    }
    return torch.cat([torch.full((width,), widths.get(name, 0.0) * scale) for name, width, scale in terms])
