"""Laws that move the arms' reference with the force on the hand, through inverse kinematics, and track it with another.

FACET and DCC as their papers describe them, re-implemented: see `docs/laws.md` for what differs.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

import torch

from cotap.compliance.interface import (
    Arms,
    ArmState,
    LawParameters,
    LawReport,
    Remembering,
    TorqueLaw,
    UpperBodyLaw,
)
from cotap.compliance.inverse_kinematics import ArmIK
from cotap.rotations import rotate


class HandModel(Protocol):
    """How a hand that obeys the model moves in one control step, axis by axis."""

    def __call__(
        self, position: torch.Tensor, velocity: torch.Tensor, before: torch.Tensor, wanted: torch.Tensor,
        stiffness: torch.Tensor, force: torch.Tensor, dt: float,
    ) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
        """Position [m] and velocity [m/s] at the end of the step, all tensors (..., 3).

        Args:
            position: At its beginning [m].
            velocity: At its beginning [m/s].
            before: Where the hand was wanted at its beginning [m].
            wanted: Where it is wanted at its end; in between it moves evenly [m].
            stiffness: [N/m].
            force: On the hand from outside, constant over the step [N].
            dt: [s].
        """
        ...


class VirtualMass:
    """FACET's mass-spring-damper, `m x'' = K (x_des - x) + D (x_des' - x') + f`, integrated exactly over a step.

    `D = 2 ratio sqrt(K m)`.

    Args:
        mass: m [kg].
        damping_ratio: Share of critical damping.
    """

    def __init__(self, mass: float = 1.0, damping_ratio: float = 1.0) -> None:
        self.mass, self.damping_ratio = mass, damping_ratio

    def __call__(
        self, position: torch.Tensor, velocity: torch.Tensor, before: torch.Tensor, wanted: torch.Tensor,
        stiffness: torch.Tensor, force: torch.Tensor, dt: float,
    ) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
        """See `HandModel`."""
        target_velocity = (wanted - before) / dt
        rest = force / stiffness
        # Away from where the force would hold it, relative to the moving target: a free oscillation.
        y, rate = position - before - rest, velocity - target_velocity
        natural = (stiffness / self.mass).sqrt()
        decay = self.damping_ratio * natural
        cosine, sine = self._waves(natural, decay, dt)
        moved = y * (cosine + decay * sine) + rate * sine
        rate = rate * (cosine - decay * sine) - natural.square() * y * sine
        return wanted + rest + moved, target_velocity + rate

    def _waves(self, natural: torch.Tensor, decay: torch.Tensor, dt: float) -> tuple[torch.Tensor, torch.Tensor]:
        """`cos(w t)` and `sin(w t) / w` of the damped frequency w, hyperbolic where it is imaginary, times
        `exp(-decay t)`: the hyperbolic ones alone would overflow."""
        square, shrink = 1.0 - self.damping_ratio**2, torch.exp(-decay * dt)
        if square == 0.0:
            return shrink, shrink * dt
        root = math.sqrt(abs(square))
        damped = root * natural
        if square > 0.0:
            return shrink * torch.cos(damped * dt), shrink * torch.sin(damped * dt) / damped
        sum_of_rates = self.damping_ratio + root  # one over their difference, which would lose digits
        slow = torch.exp(-natural * dt / sum_of_rates)
        gone = -torch.expm1(-2.0 * damped * dt)  # the faster one is less by this share
        return slow * (1.0 - 0.5 * gone), 0.5 * slow * gone / damped


class StaticShift:
    """DCC's admittance: the wanted position, shifted by force over stiffness at once."""

    def __call__(
        self, position: torch.Tensor, velocity: torch.Tensor, before: torch.Tensor, wanted: torch.Tensor,  # noqa: ARG002
        stiffness: torch.Tensor, force: torch.Tensor, dt: float,
    ) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
        """See `HandModel`."""
        moved = wanted + force / stiffness
        return moved, (moved - position) / dt


class AdmittanceLaw(Remembering):
    """The reference moves as a model of the hand does; another law tracks it.

    The model lives in the heading frame, at the torso's origin. Inverse kinematics makes joint targets of it, which
    leave those that were sent by what the hand's displacement asks for and no faster than joints can turn: without a
    force, targets at rest are tracked as they were sent.

    The tracking law is told the rate of the targets that were sent, not of the moved ones: critical damping resists
    what the force adds to the motion. With the moved rate it would not, and nor would it hold against stiff walls.

    Args:
        arms: What is driven.
        model: Of the hand.
        tracking: Law that drives the arms to the moved targets.
        model_scale: Factor on the stiffness commanded, for the model.
        tracking_scale: The same for the tracking law.
    """

    def __init__(
        self, arms: Arms, model: HandModel, tracking: UpperBodyLaw, model_scale: float = 1.0,
        tracking_scale: float = 1.0,
    ) -> None:  # fmt: skip
        super().__init__()
        self._arms, self._model, self._tracking = arms, model, tracking
        self._model_scale, self._tracking_scale = model_scale, tracking_scale
        self._ik = ArmIK(arms.chains, arms.low, arms.high)

    def __call__(self, state: ArmState, parameters: LawParameters) -> tuple[TorqueLaw, LawReport]:
        """The tracking law's torque for the moved targets."""
        to_heading = state.to_heading.unsqueeze(1)
        wanted_h = rotate(to_heading, self._arms.chains.pose(state.target).tip)
        position_h = self._move(state, wanted_h, self._model_scale * parameters.stiffness)
        target, error = self._reach(state, rotate(to_heading.transpose(-1, -2), position_h))
        scaled = replace(parameters, stiffness=self._tracking_scale * parameters.stiffness)
        torque, report = self._tracking(replace(state, target=target), scaled)
        own = {"reference_shift": (position_h - wanted_h).norm(dim=-1), "ik_error": error}
        return torque, LawReport(report.values | own)

    def _move(self, state: ArmState, wanted_h: torch.Tensor, stiffness: torch.Tensor) -> torch.Tensor:
        """Where the model has the hand at the end of this step, (N, A, 3) [m]."""
        position = self.recall(state, "position_h", wanted_h)
        velocity = self.recall(state, "velocity_h", torch.zeros_like(wanted_h))
        before = self.recall(state, "wanted_h", wanted_h)
        force = torch.zeros_like(wanted_h) if state.hand_force_h is None else state.hand_force_h
        position, velocity = self._model(position, velocity, before, wanted_h, stiffness, force, state.dt)
        self.memory |= {"position_h": position, "velocity_h": velocity, "wanted_h": wanted_h}
        return position

    def _reach(self, state: ArmState, tip_t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Joint targets (N, A, n) [rad] for hands at `tip_t` in the torso frame, and by how much (N, A) they miss [m].

        The search begins at the sent target plus what it was moved by a step ago.
        """
        held = self.recall(state, "offset", torch.zeros_like(state.target))
        solution = self._ik(tip_t, state.target, state.target + held, state.dt * self._arms.speed)
        self.memory["offset"] = solution.position - state.target
        return solution.position, solution.error
