"""From actions to joint targets: default pose plus scaled action, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.checks import require_one_of, require_range
from cotap.robots import RobotSpec

UPPER_MODES = ("residual", "absolute")


@dataclass
class ActionConfig:
    """How actions become joint targets."""

    lower_scale: float = 0.6
    """Radians per unit of lower action, added to the default pose. For a joint whose PD torque reaches its limit at
    an error below 1 rad, it is multiplied by that error."""
    waist_share: float = 1.0
    """Factor on `lower_scale` for joints between the base and the torso. They turn the torso itself, whose rates are
    observed and rewarded: equal random actions turn a standing G1's torso faster at the waist than at the legs."""
    upper_scale: float = 0.1
    """Radians per unit of upper action."""
    upper_mode: str = "residual"
    """What upper actions are added to: the arms' reference (residual, as FALCON) or the default pose (absolute, the
    paper)."""
    clip: float = 20.0
    """Largest magnitude of an action."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("actions.lower_scale", self.lower_scale, 1e-6, 10.0)
        require_range("actions.waist_share", self.waist_share, 1e-3, 1.0)
        require_range("actions.upper_scale", self.upper_scale, 1e-6, 10.0)
        require_range("actions.clip", self.clip, 1e-3, 1e6)
        require_one_of("actions.upper_mode", self.upper_mode, UPPER_MODES)


class JointTargets:
    """Joint targets (N, J) [rad] of clipped actions (N, J) and the arms' reference position (N, U) [rad].

    Args:
        cfg: Of actions.
        spec: The robot's.
        modulated: Whether the upper agent sets the arms' laws. Arm targets are then the reference itself: if they could
            yield as laws do, the effect of one could not be told from that of the other.
    """

    def __init__(self, cfg: ActionConfig, spec: RobotSpec, modulated: bool = False) -> None:
        cfg.check()
        self.default = torch.tensor([j.default_rad for j in spec.joints])
        """(J,) [rad]."""
        lower, upper = spec.joints[: len(spec.lower_joints)], len(spec.upper_joints)
        waist = dict.fromkeys(spec.waist_joints, cfg.waist_share)
        shares = [min(1.0, j.torque_limit_nm / j.kp) * waist.get(j.name, 1.0) for j in lower]
        self.scale = torch.tensor([cfg.lower_scale * share for share in shares] + [cfg.upper_scale] * upper)
        """(J,) radians per unit of action."""
        self.bound = torch.full_like(self.scale, cfg.clip)
        """(J,) largest magnitude of each action."""
        if modulated:
            self.bound[len(lower) :] = 0.0
        self.upper_mode = "residual" if modulated else cfg.upper_mode
        """What upper actions are added to, as `ActionConfig` has it."""

    def __call__(self, action: torch.Tensor, arm_reference: torch.Tensor) -> torch.Tensor:
        offset = self.default.expand_as(action)
        if self.upper_mode == "residual":
            offset = torch.cat((offset[:, : -arm_reference.shape[1]], arm_reference), 1)
        return offset + self.scale * action
