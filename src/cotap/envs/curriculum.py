"""What changes as training goes on: disturbances grow with the samples, the wrench that assists first steps fades with
them, and arms move less while many robots fall."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cotap.checks import require_range
from cotap.compliance.dynamics import GRAVITY_M_S2
from cotap.envs.commands import Command
from cotap.envs.state import RobotState
from cotap.robots import RobotSpec
from cotap.rotations import rotate

_FALLS_OVER_S = 10.0
"""Time over which falls are averaged."""


@dataclass
class RampConfig:
    """A share that grows linearly from `first` to 1 with the samples (control steps of all envs)."""

    start_samples: float = 0.0
    """Samples up to which the share is `first`."""
    full_samples: float = 0.0
    """Samples from which the share is 1."""
    first: float = 0.0
    """Share at the start."""

    def check(self, where: str) -> None:
        """Raise ValueError naming the first field, under `where`, that is out of its range."""
        require_range(f"{where}.full_samples", self.full_samples, 0.0, 1e15)
        require_range(f"{where}.start_samples", self.start_samples, 0.0, self.full_samples)
        require_range(f"{where}.first", self.first, 0.0, 1.0)

    def share(self, samples: float) -> float:
        """The share after so many samples."""
        if samples >= self.full_samples:
            return 1.0
        if samples <= self.start_samples:
            return self.first
        progress = (samples - self.start_samples) / (self.full_samples - self.start_samples)
        return self.first + (1.0 - self.first) * progress


@dataclass
class CurriculumConfig:
    """What many falls hold back. The assistance fades all the same: robots that keep it lean on it."""

    max_falls_per_s: float = 0.1
    """Falls per second and env above which no disturbance grows and the arms' motion shrinks. Below, that grows back
    first: disturbances wait until it is whole."""
    arm_motion_samples: float = 0.0
    """Samples in which the arms' motion shrinks from whole to none, or grows back; 0 leaves it whole."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("curriculum.max_falls_per_s", self.max_falls_per_s, 0.0, 1e3)
        require_range("curriculum.arm_motion_samples", self.arm_motion_samples, 0.0, 1e15)


class Curriculum:
    """How far disturbances have grown (the samples, but for those that were taken while robots fell too often or arms
    moved less), and how far arms move."""

    def __init__(self, cfg: CurriculumConfig, dt: float) -> None:
        self._cfg, self._dt = cfg, dt
        self._share = min(dt / _FALLS_OVER_S, 1.0)
        self.samples, self.falls_per_s = 0, 0.0
        self.arm_motion = 1.0
        """Share of the way from the default pose to the motion that is drawn for the arms."""

    def step(self, fell: torch.Tensor, samples: int) -> None:
        """Count the `samples` of a step in which the envs of `fell` (N,) have fallen."""
        self.falls_per_s += self._share * (float(fell.float().mean()) / self._dt - self.falls_per_s)
        many = self.falls_per_s > self._cfg.max_falls_per_s
        if self.arm_motion == 1.0 and not many:
            self.samples += samples
        if self._cfg.arm_motion_samples > 0.0:
            change = samples / self._cfg.arm_motion_samples
            self.arm_motion = min(1.0, max(0.0, self.arm_motion + (-change if many else change)))
        else:
            self.arm_motion = 1.0

    def state_dict(self) -> dict[str, float]:
        """What goes on from step to step."""
        return {"samples": self.samples, "falls_per_s": self.falls_per_s, "arm_motion": self.arm_motion}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Take over what `state_dict` returned. Raises KeyError, TypeError or ValueError for something else."""
        self.samples, self.falls_per_s = int(state["samples"]), float(state["falls_per_s"])
        self.arm_motion = require_range("curriculum.arm_motion", float(state["arm_motion"]), 0.0, 1.0)


@dataclass
class AssistConfig:
    """A wrench on the torso that carries the robot through its first steps and fades, ever more slowly.

    Without it, the H1 learned to walk, but hardly to turn and to squat in as many samples. Commands are at full speed
    from the start: where the wrench carried slow ones, the H1 learned to stand, and not to step when pushed. Gains are
    in units of the robot's weight, so that they fit any robot; damping is no more than the torso's inertia bears. It
    lifts a constant share of the weight: a lift that grew as the robot sank would teach it to hang.
    """

    enabled: bool = False
    """Whether to assist; training switches it on."""
    full_samples: float = 2e6
    """Samples with full assistance."""
    end_samples: float = 16e6
    """Samples after which there is none. On the way its share falls as the square of what is left."""
    upright_stiffness: float = 0.8
    """Righting torque per radian of tilt, over weight times nominal height [1/rad]."""
    upright_damping: float = 0.08
    """Righting torque per rad/s of tilt rate, over weight times nominal height [s/rad]."""
    yaw_gain: float = 0.06
    """Turning torque per rad/s that the yaw rate is off its command, over weight times nominal height [s/rad]."""
    velocity_gain: float = 0.6
    """Horizontal pull per m/s that the velocity is off its command, over weight [s/m]."""
    force_limit: float = 0.3
    """Largest pull, over weight."""
    weight_share: float = 0.25
    """Share of the weight that is lifted."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("assist.full_samples", self.full_samples, 0.0, 1e15)
        require_range("assist.end_samples", self.end_samples, self.full_samples, 1e15)
        require_range("assist.weight_share", self.weight_share, 0.0, 1.0)
        for name in ("upright_stiffness", "upright_damping", "yaw_gain", "velocity_gain", "force_limit"):
            require_range(f"assist.{name}", getattr(self, name), 0.0, 100.0)

    def share(self, samples: float) -> float:
        """Share of the assistance that is left after so many samples."""
        if not self.enabled or samples >= self.end_samples:
            return 0.0
        return min(1.0, (self.end_samples - samples) / max(self.end_samples - self.full_samples, 1.0)) ** 2


_DAMPING_SHARE = 1.5
"""Largest damping times the control step, over the torso's inertia. A damping torque that is held for a step amplifies
the motion from 2 on. The H1's gains stay below this."""


class AssistWrench:
    """Force [N] and torque [Nm] on the torso, (N, 6) in the world frame, at full assistance.

    Args:
        cfg: Its gains.
        spec: The robot, whose weight and height they are units of.
        inertia: (3,) torque over angular acceleration of the torso about x, y and z [kg m^2], which bounds damping.
        dt: Control step [s].
    """

    def __init__(self, cfg: AssistConfig, spec: RobotSpec, inertia: torch.Tensor, dt: float) -> None:
        self._cfg, self._weight = cfg, spec.mass_kg * GRAVITY_M_S2
        lever, most = self._weight * spec.nominal_height_m, _DAMPING_SHARE * inertia / dt
        self._stiffness = lever * cfg.upright_stiffness
        self._damping = min(lever * cfg.upright_damping, float(most[:2].min()))
        self._yaw_gain = min(lever * cfg.yaw_gain, float(most[2]))

    def __call__(self, s: RobotState, command: Command) -> torch.Tensor:
        cfg, up_w = self._cfg, s.torso_rotation_w[:, :, 2]
        vertical = torch.tensor([0.0, 0.0, 1.0], device=up_w.device).expand_as(up_w)
        tilting_w = rotate(s.torso_rotation_w, s.torso_angular_velocity_t) * torch.tensor([1.0, 1.0, 0.0]).to(up_w)
        torque = self._stiffness * torch.linalg.cross(up_w, vertical) - self._damping * tilting_w
        torque = torque + self._yaw_gain * (command.yaw_rate - s.yaw_rate).unsqueeze(1) * vertical
        error_h = torch.nn.functional.pad(command.velocity_h - s.torso_linear_velocity_h[:, :2], (0, 1))
        pull = cfg.velocity_gain * rotate(s.heading_w, error_h)
        pull = pull * (cfg.force_limit / pull.norm(dim=1, keepdim=True).clamp_min(1e-6)).clamp_max(1.0)
        return torch.cat((self._weight * (pull + cfg.weight_share * vertical), torque), 1)
