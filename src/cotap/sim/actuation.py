"""Control delay: each world's targets reach its joints late by a time of its own."""

from __future__ import annotations

import torch


class DelayedTargets:
    """Joint targets that take effect `delay_s` after they were sent, with 0 <= delay_s <= the control step.

    Within the physics step in which a target arrives, old and new are mixed by the share of the step that each holds,
    so that any delay, not only multiples of the physics step, has its exact mean effect.
    """

    def __init__(self, num_envs: int, num_joints: int, substeps: int, control_dt: float) -> None:
        self.delay_s = torch.zeros(num_envs)
        self.previous = torch.zeros(num_envs, num_joints)
        self.current = torch.zeros(num_envs, num_joints)
        self._physics_dt = control_dt / substeps

    def reset(self, mask: torch.Tensor, target: torch.Tensor) -> None:
        """Hold `target` (n, num_joints) in the worlds of `mask`, as if it had always been sent."""
        self.previous[mask] = target
        self.current[mask] = target

    def send(self, target: torch.Tensor) -> None:
        """Send `target` (num_envs, num_joints) at the start of a control step."""
        self.previous, self.current = self.current, target

    def at(self, substep: int) -> torch.Tensor:
        """Mean target over physics step number `substep` of the control step, (num_envs, num_joints)."""
        return torch.lerp(self.previous, self.current, self.arrived(substep).unsqueeze(1))

    def arrived(self, substep: int) -> torch.Tensor:
        """Share (num_envs,) of physics step number `substep` in which the newest target holds."""
        return ((substep + 1) * self._physics_dt - self.delay_s).div_(self._physics_dt).clamp_(0.0, 1.0)
