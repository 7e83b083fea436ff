"""What a law of the arms is given and what it answers: the interface that all laws share.

A law is asked once a control step and answers with a torque that is affine in the joints' state,
`tau(q, dq) = feedforward + elastic - K (q - anchor) - D dq`, which then acts at the physics rate.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import torch

from cotap.compliance.dynamics import LinkInertias
from cotap.compliance.kinematics import ChainPose, SerialChains


@dataclass
class LawParameters:
    """What may differ between envs and change at any step. N envs, A arms."""

    stiffness: torch.Tensor
    """(N, A, 3) hand stiffness along the axes of the heading frame [N/m]."""
    null_stiffness: torch.Tensor
    """(N, A) [Nm/rad]."""
    alpha: torch.Tensor
    """(N, A) in [0, 1]."""


@dataclass(frozen=True)
class Arms:
    """What a law may know of the arms it drives: nominal gains, limits, masses, kinematics. A arms of n joints."""

    chains: SerialChains
    inertias: LinkInertias
    kp: torch.Tensor
    """(A, n) PD position gains [Nm/rad]."""
    kd: torch.Tensor
    """(A, n) PD damping gains [Nms/rad]."""
    low: torch.Tensor
    """(A, n) lower joint limits [rad]."""
    high: torch.Tensor
    """(A, n) upper joint limits [rad]."""
    speed: torch.Tensor
    """(A, n) joint velocity limits [rad/s]."""
    friction: torch.Tensor
    """(A, n) viscous friction of the joints, beside what a law adds [Nms/rad]."""

    def to(self, dtype: torch.dtype) -> Arms:
        """The same arms in another precision."""
        i = self.inertias
        links = LinkInertias(*(x.to(dtype) for x in (i.mass, i.com, i.inertia, i.armature)))
        own = (self.kp, self.kd, self.low, self.high, self.speed, self.friction)
        return Arms(self.chains.to(dtype), links, *(x.to(dtype) for x in own))


@dataclass(frozen=True)
class ArmState:
    """What a law senses at the start of a control step."""

    position: torch.Tensor
    """(N, A, n) joint angles [rad]."""
    velocity: torch.Tensor
    """(N, A, n) [rad/s]."""
    target: torch.Tensor
    """(N, A, n) joint angles that are wanted [rad]."""
    pose: ChainPose
    """The arms in the torso frame."""
    to_heading: torch.Tensor
    """(N, 3, 3) from the torso to the heading frame."""
    base_compliance_h: torch.Tensor | None = None
    """(N, A, 3, 3) the hands' compliance through a moving torso, heading frame [m/N]; None counts as none."""
    hand_force_h: torch.Tensor | None = None
    """(N, A, 3) force on the hands from outside, heading frame [N]; None counts as none."""
    target_velocity: torch.Tensor | None = None
    """(N, A, n) how fast the reference moves [rad/s]; None counts as at rest."""
    fresh: torch.Tensor | None = None
    """(N, A) bool: the arm's law or its episode has just begun and nothing is remembered. Laws that remember something
    cannot do without."""
    dt: float = 0.02
    """Control step [s]."""


@dataclass(frozen=True)
class TorqueLaw:
    """`tau(q, dq) = feedforward + elastic - K (q - anchor) - D dq`, for one control step."""

    anchor: torch.Tensor
    """(N, A, n) [rad]."""
    feedforward: torch.Tensor
    """(N, A, n) what does not depend on the target [Nm]."""
    elastic: torch.Tensor
    """(N, A, n) K times the error at the anchor [Nm]."""
    stiffness: torch.Tensor
    """(N, A, n, n) [Nm/rad]."""
    damping: torch.Tensor
    """(N, A, n, n) [Nms/rad]."""

    def at(
        self,
        q: torch.Tensor,
        dq: torch.Tensor,
        kp_scale: torch.Tensor | float = 1.0,
        kd_scale: torch.Tensor | float = 1.0,
    ) -> torch.Tensor:
        """Torques (N, A, n) [Nm] at joint angles and rates (N, A, n), gains off by these factors."""
        elastic = self.elastic - (self.stiffness * (q - self.anchor).unsqueeze(-2)).sum(-1)
        viscous = (self.damping * dq.unsqueeze(-2)).sum(-1)
        return self.feedforward + kp_scale * elastic - kd_scale * viscous


@dataclass
class LawReport:
    """What a law did in one step, for the log; (N, A) each. Laws that blend nothing leave it empty."""

    values: dict[str, torch.Tensor] = field(default_factory=dict)


class UpperBodyLaw(Protocol):
    """How one kind of law is asked. To add one, write a class with this method and name it in `LAWS`."""

    def __call__(self, state: ArmState, parameters: LawParameters) -> tuple[TorqueLaw, LawReport]:
        """The torque law of this control step."""
        ...


class Remembering:
    """Base of laws that carry something from step to step: tensors (N, A, ...), in `memory` by name.

    Whoever asks a law saves its memory with everything else, and marks arms that begin anew as fresh.
    """

    def __init__(self) -> None:
        self.memory: dict[str, torch.Tensor] = {}

    def recall(self, state: ArmState, name: str, initial: torch.Tensor) -> torch.Tensor:
        """What was remembered under `name`, and `initial` (N, A, ...) of arms that are fresh.

        Raises:
            ValueError: `state.fresh` is missing or has another shape.
        """
        if state.fresh is None or state.fresh.shape != initial.shape[:2]:
            got = None if state.fresh is None else tuple(state.fresh.shape)
            raise ValueError(f"fresh must have shape {tuple(initial.shape[:2])} for a law that remembers, got {got}")
        held = self.memory.get(name)
        if held is None:
            return initial
        if not state.fresh.any():
            return held
        return torch.where(state.fresh[(..., *[None] * (initial.dim() - 2))], initial, held)

    def take_over(self, env: int, arm: int, other: dict[str, torch.Tensor], like: torch.Tensor) -> bool:
        """Go on with an arm that has moved under another law. Returns whether it is remembered, and so not fresh.

        Args:
            env: Its env.
            arm: Which of that env's arms it is.
            other: The memory of the law before, empty if it remembers nothing.
            like: (N, A, n) as joint angles are.
        """
        del env, arm, other, like
        return False
