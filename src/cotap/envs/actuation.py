"""From joint targets to torques: delay, PD, and the arms' laws on top, in one place."""

from __future__ import annotations

from typing import Any

import torch

from cotap.compliance.laws import LawConfig
from cotap.envs.randomization import Randomizer
from cotap.envs.state import RobotState
from cotap.envs.upper_body import UpperBody
from cotap.persistence import Stateful
from cotap.robots import RobotSpec
from cotap.sim import Simulation


class Actuation(Stateful):
    """Drives the simulation's actuators, which subtract `kp q + kd dq` themselves; under laws, arms' only `kd dq`.

    Commands take effect `delay_s` after they were sent, with 0 <= delay_s <= the control step. Within the physics step
    in which a command arrives, old and new are mixed by the share of the step that each holds, so that any delay, not
    only multiples of the physics step, has its exact mean effect.

    Args:
        spec: The robot.
        sim: The simulation that is driven.
        randomizer: Has each env's gains.
        upper_body: The arms' laws.
        torque_limit: (J,) [Nm].
    """

    STATE = ("delay_s", "previous", "current")

    def __init__(
        self, spec: RobotSpec, sim: Simulation, randomizer: Randomizer, upper_body: UpperBody,
        torque_limit: torch.Tensor,
    ) -> None:  # fmt: skip
        n, joints = sim.num_envs, len(spec.joints)
        self._sim, self._randomizer, self.upper_body, self.torque_limit = (
            sim, randomizer, upper_body, torque_limit,
        )  # fmt: skip
        self._arms = slice(len(spec.lower_joints), None)
        self._first_arm = len(spec.lower_joints)
        self._physics_dt = sim.dt / sim.substeps
        self.delay_s = torch.zeros(n)
        """(N,) [s]."""
        self.previous, self.current = torch.zeros(n, joints), torch.zeros(n, joints)
        """(N, J) joint targets, those before and the newest [rad]."""
        self.arm_effort = torch.zeros(n, joints - self._first_arm)
        """(N, U) mean torque of the arms' motors over the last control step [Nm]; zero under plain PD."""
        self.refresh_gains()

    def refresh_gains(self) -> None:
        """Take over the randomiser's gains."""
        self._kp, self._kd = self._randomizer.gains()

    def reset(self, mask: torch.Tensor, target: torch.Tensor) -> None:
        """Hold `target` (n, J) in the envs of `mask`, as if it had always been sent."""
        self.previous, self.current = self.previous.clone(), self.current.clone()
        self.previous[mask], self.current[mask] = target, target
        self.refresh_gains()

    def send(self, state: RobotState, target: torch.Tensor, arm_velocity: torch.Tensor) -> None:
        """Send targets (N, J) at the start of a control step, the arms' moving at `arm_velocity` (N, U) [rad/s]."""
        self.previous, self.current = self.current, target
        if not self.upper_body.active:
            return
        self.arm_effort.zero_()
        self.upper_body.send(state, target[:, self._arms], arm_velocity)
        # The simulator integrates the damping's diagonal implicitly, and knows nothing of the stiffness.
        kd = self.upper_body.implicit_damping()
        self._kd[:, self._arms] = kd
        bias = self._sim.field("actuator_biasprm")
        bias[:, self._arms, 1], bias[:, self._arms, 2] = 0.0, -kd.to(bias)

    def arrived(self, substep: int) -> torch.Tensor:
        """Share (N,) of physics step number `substep` in which the newest command holds."""
        return ((substep + 1) * self._physics_dt - self.delay_s).div_(self._physics_dt).clamp_(0.0, 1.0)

    def drive(self, substep: int) -> torch.Tensor:
        """`ctrl` (N, J) [Nm] in physics step `substep`: `kp target`, for arms under laws torque plus `kd dq`."""
        arrived = self.arrived(substep)
        control = self._kp * torch.lerp(self.previous, self.current, arrived.unsqueeze(1))
        if self.upper_body.active:
            arms, limit = self._arms, self.torque_limit[self._arms]
            q = self._sim.qpos[:, 7 + self._first_arm :].float()
            dq = self._sim.qvel[:, 6 + self._first_arm :].float()
            torque = self._arm_torque(q, dq, arrived)
            self.arm_effort += torque.clamp(-limit, limit) / self._sim.substeps
            control[:, arms] = torque + self._kd[:, arms] * dq
        return control

    def joint_torque(self, state: RobotState) -> torch.Tensor:
        """Torque (N, J) [Nm] at `state`, at the end of a control step."""
        arrived = self.arrived(self._sim.substeps - 1)
        target = torch.lerp(self.previous, self.current, arrived.unsqueeze(1))
        torque = self._kp * (target - state.joint_pos) - self._kd * state.joint_vel
        if self.upper_body.active:
            torque[:, self._arms] = self._arm_torque(
                state.joint_pos[:, self._arms], state.joint_vel[:, self._arms], arrived
            )
        return torch.clamp(torque, -self.torque_limit, self.torque_limit)

    def _arm_torque(self, q: torch.Tensor, dq: torch.Tensor, arrived: torch.Tensor) -> torch.Tensor:
        """Torque (N, U) that the arms' laws ask for, gains as randomised."""
        scales = self._randomizer.kp_scale[:, self._arms], self._randomizer.kd_scale[:, self._arms]
        return self.upper_body.torque(q, dq, arrived, *scales)

    def set_law(self, env: int, arm: int, law: LawConfig) -> None:
        """Put one arm of one env under another law, from the next step on. Raises ValueError as `law.check` does."""
        ruled = self.upper_body.active
        self.upper_body.set_law(env, arm, law)
        if ruled and not self.upper_body.active:  # actuators are the arms' own PD again
            self._randomizer.write_gains(torch.ones_like(self.delay_s, dtype=torch.bool))
            self.refresh_gains()

    def arm_stiffness(self) -> torch.Tensor:
        """Joint stiffness of the arms under the laws in force, (N, A, n, n) [Nm/rad]."""
        if self.upper_body.active:
            return self.upper_body.stiffness
        own = self._randomizer.gains()[0][:, self._arms]
        return torch.diag_embed(own.reshape(self.upper_body.stiffness.shape[:3]))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned. Raises ValueError for another size or a missing name."""
        super().load_state_dict(state)
        self.refresh_gains()
