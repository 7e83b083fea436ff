"""When a robot must stop, and the start-up that brings it under control in the first place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from cotap.checks import require_range
from cotap.deployment.controller import Readings
from cotap.deployment.joint_law import JointLaw


@dataclass
class SafetyConfig:
    """Start-up and safe stop."""

    ramp_s: float = 1.0
    """Time in which gains rise from nothing [s]. The base is held meanwhile; 0 starts at once."""
    settle_s: float = 0.5
    """Time under full gains before the base is let go [s]."""
    max_tilt: float = 1.0
    """Stop when the torso tilts further [rad]."""
    saturation_s: float = 1.0
    """Stop when a joint is this long at its limit [s]. Its torque limit, without a break."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("ramp_s", self.ramp_s, 0.0, 60.0)
        require_range("settle_s", self.settle_s, 0.0, 60.0)
        if self.ramp_s == 0.0 and self.settle_s not in (0.0, SafetyConfig.settle_s):
            raise ValueError(f"settle_s does nothing while ramp_s is 0, got {self.settle_s!r}")
        require_range("max_tilt", self.max_tilt, 0.1, 3.2)
        require_range("saturation_s", self.saturation_s, 0.02, 1e6)


class Watchdog:
    """Looks at every reading before the policy gets it, and at every law before the motors do, from when it is let go.

    Args:
        cfg: When to stop.
        joints: (J,) names, for the report.
        torque_limit: (J,) [Nm].
        dt: Control step [s].
    """

    def __init__(self, cfg: SafetyConfig, joints: tuple[str, ...], torque_limit: np.ndarray, dt: float) -> None:
        cfg.check()
        self._cfg, self._joints, self._limit, self._dt = cfg, joints, torque_limit, dt
        self._saturated_s = np.zeros(len(self._joints))

    def of_readings(self, readings: Readings) -> str:
        """Why to stop now; empty while all is well. To be asked once a control step."""
        s = readings.state
        sensed = torch.cat((s.joint_pos, s.joint_vel, s.projected_gravity_t, s.torso_angular_velocity_t), 1)
        if not (torch.isfinite(sensed).all() and np.isfinite(readings.torque).all()):
            return "a reading is not finite"
        tilt = float(torch.acos((-s.projected_gravity_t[0, 2]).clamp(-1.0, 1.0)))
        if tilt > self._cfg.max_tilt:
            return f"the torso is tilted by {tilt:.2f} rad"
        at_limit = np.abs(readings.torque) > 0.999 * self._limit
        self._saturated_s = np.where(at_limit, self._saturated_s + self._dt, 0.0)
        worst = int(self._saturated_s.argmax())
        if self._saturated_s[worst] >= self._cfg.saturation_s - 1e-9:
            return f"{self._joints[worst]} is at its torque limit for {self._saturated_s[worst]:.2f} s"
        return ""

    def of_law(self, law: JointLaw) -> str:
        """Why to stop instead of sending this to the motors; empty if it can be sent."""
        finite = all(np.isfinite(part).all() for part in (law.bias, law.stiffness, law.damping))
        return "" if finite else "the policy's output is not finite"
