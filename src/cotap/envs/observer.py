"""What agents observe: one step's terms, the actors' history of them, and what critics see beside it."""

from __future__ import annotations

from typing import Any

import torch

from cotap.compliance.interface import LawParameters
from cotap.envs.commands import Command
from cotap.envs.modulation import ModulationConfig, observed_laws
from cotap.envs.observations import (
    GOALS_PER_ARM,
    ObservationConfig,
    ObservationHistory,
    actor_terms,
    actor_values,
    critic_terms,
    noise_amplitude,
)
from cotap.envs.state import RobotState
from cotap.envs.symmetry import actor_reflection, critic_reflection, joint_reflection, law_reflection
from cotap.persistence import Stateful, uniform
from cotap.reflection import Symmetry, join
from cotap.robots import RobotSpec
from cotap.rotations import quat_from_matrix


class Observer(Stateful):
    """Assembles the observation groups: `policy` (actors: history, with sensor noise if there is any), `present` or
    `clean` (critics: the step, or the history without noise), and `privileged`.

    Args:
        cfg: What is observed.
        spec: The robot.
        num_envs: Number of envs.
        modulation: What of the arms' laws is set by actions, and so is observed.
    """

    STATE = ("last_action",)

    def __init__(
        self, cfg: ObservationConfig, spec: RobotSpec, num_envs: int, modulation: ModulationConfig | None = None
    ) -> None:
        cfg.check()
        self.cfg = cfg
        self._joints, arms, self._upper = len(spec.joints), len(spec.arms), len(spec.upper_joints)
        modulation = modulation or ModulationConfig()
        laws = modulation.terms(arms)
        self._shows_laws = bool(laws)
        self._default = torch.tensor([j.default_rad for j in spec.joints])
        seen = cfg.arm_torque == "actor"
        terms = actor_terms(self._joints, self._upper, seen, GOALS_PER_ARM * arms * cfg.goals, laws)
        feet = len(spec.feet) if cfg.critic == "present" else 0
        self._critic_terms = critic_terms(arms, 0 if seen else self._upper, feet)
        self._critic_scale = torch.cat([torch.full((width,), scale) for _, width, scale in self._critic_terms])
        self.history = ObservationHistory(terms, num_envs, cfg.history)
        self._noise = noise_amplitude(terms, cfg.noise)
        self._clean = ObservationHistory(terms, num_envs, cfg.history) if "clean" in self.groups["critic"] else None
        sides = [arm.side for arm in spec.arms]
        self._of_laws = len(modulation.targets(sides))
        self.last_action = torch.zeros(num_envs, self._joints + self._of_laws)
        """(N, J + M) what was done in the last step."""

    @property
    def groups(self) -> dict[str, list[str]]:
        """Which observation groups actors and critics read."""
        history = "clean" if self.cfg.noise.enabled else "policy"
        return {"actor": ["policy"], "critic": ["present" if self.cfg.critic == "present" else history, "privileged"]}

    def layout(self) -> dict[str, Any]:
        """Terms and history, for those who must agree with them."""
        return {"terms": self.history.terms, "history": self.history.steps, "critic_terms": self._critic_terms}

    def symmetry(self, spec: RobotSpec) -> Symmetry:
        """The mirror images of all groups and of actions."""
        terms, steps = self.history.terms, self.history.steps
        full, critic = actor_reflection(spec, terms, steps), critic_reflection(spec, self._critic_terms)
        groups = {"policy": full, "clean": full, "present": actor_reflection(spec, terms, 1), "privileged": critic}
        actions = join([joint_reflection(spec, spec.joint_names), law_reflection(spec, self._of_laws)])
        return Symmetry(groups, actions)

    def reset(self, mask: torch.Tensor) -> None:
        """Nothing was done yet in the envs of `mask` (N,)."""
        self.last_action = self.last_action.masked_fill(mask.unsqueeze(1), 0.0)

    def observe(
        self, s: RobotState, command: Command, arm_reference: torch.Tensor, torque: torch.Tensor,
        hand_force_w: torch.Tensor, goals: LawParameters, mean_error: torch.Tensor, ahead: torch.Tensor,
        restarted: torch.Tensor, rng: torch.Generator,
    ) -> dict[str, torch.Tensor]:  # fmt: skip
        """The groups, by name, and what they hold added to the history.

        Args:
            s: The state.
            command: What is commanded, and the gait's phase.
            arm_reference: (N, U) [rad].
            torque: (N, J) joint torques [Nm].
            hand_force_w: (N, A, 3) forces on the hands, world frame [N].
            goals: What the arms' laws are asked for.
            mean_error: (N, 3) the velocities' averaged errors, as in `StepRecord`.
            ahead: (N, 7 + 4 A) what forces are to come, as `ExternalForces.ahead` says.
            restarted: (N,) bool, envs that have no history.
            rng: Of sensor noise.
        """
        present = self._present(s, command, arm_reference, torque, goals)
        privileged = [quat_from_matrix(s.torso_to_heading), s.torso_linear_velocity_h]
        if self.cfg.arm_torque != "actor":
            privileged.append(torque[:, -self._upper :])
        privileged.append((hand_force_w @ s.heading_w).flatten(1))
        groups: dict[str, torch.Tensor] = {}
        if self.cfg.critic == "present":
            groups["present"] = present
            height = s.height.unsqueeze(1)
            privileged += (mean_error, height, s.foot_contact.to(height), s.foot_pos_w[:, :, 2], ahead)
        groups["privileged"] = torch.cat(privileged, 1) * self._critic_scale
        if self._clean:
            groups["clean"] = self._clean.append(present, restarted)
        if self.cfg.noise.enabled:
            present = present + self._noise * uniform(rng, -1.0, 1.0, *present.shape)
        groups["policy"] = self.history.append(present, restarted)
        return groups

    def preview(
        self, s: RobotState, command: Command, arm_reference: torch.Tensor, torque: torch.Tensor,
        hand_force_w: torch.Tensor, goals: LawParameters,  # noqa: ARG002 - as `observe`
    ) -> torch.Tensor:  # fmt: skip
        """What actors would observe now without noise, (N, width * history); the history stays as it is."""
        return self.history.with_next(self._present(s, command, arm_reference, torque, goals))

    def _present(
        self, s: RobotState, command: Command, arm_reference: torch.Tensor, torque: torch.Tensor, goals: LawParameters
    ) -> torch.Tensor:
        done = self.last_action[:, : self._joints]
        values = actor_values(s, command, arm_reference, self._default, done, torque[:, -self._upper :])
        if self._shows_laws:
            values |= observed_laws(goals)
        if self.cfg.goals:
            stiffness, null = (goals.stiffness / 300.0).log(), (goals.null_stiffness / 40.0).log()
            values["goals"] = torch.cat((stiffness, null.unsqueeze(2), goals.alpha.unsqueeze(2)), 2).flatten(1)
        return self.history.scaled(values)

    def state_dict(self) -> dict[str, Any]:
        """Its own state and the histories'."""
        clean = {"clean": self._clean.state_dict()} if self._clean else {}
        return super().state_dict() | {"history": self.history.state_dict()} | clean

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned. Raises ValueError for another size or a missing name."""
        own = dict(state)
        self.history.load_state_dict(own.pop("history", {}))
        if self._clean:
            self._clean.load_state_dict(own.pop("clean", {}))
        super().load_state_dict(own)
