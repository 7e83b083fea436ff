"""Forces on the robot from outside: random loads at the hands, and the assistance that early training leans on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from cotap.checks import require_interval, require_positive_int, require_range
from cotap.envs.persistence import Stateful, uniform


@dataclass
class HandForceConfig:
    """Random hand forces (FALCON's), held for a while, in the heading frame."""

    enabled: bool = True
    """Whether hands are loaded at all."""
    episode_share: float = 1.0
    """Share of the episodes in which hands are loaded."""
    force_x: tuple[float, float] = (-40.0, 40.0)
    """[N]."""
    force_y: tuple[float, float] = (-40.0, 40.0)
    """[N]."""
    force_z: tuple[float, float] = (-50.0, 5.0)
    """[N]."""
    size: float = 0.0
    """Above zero: forces in any direction, of a size up to this, evenly drawn, instead of axis by axis [N]."""
    most_turning_of: int = 1
    """So many are drawn, and the one that turns the robot most about the vertical is taken."""
    zero_probability: float = 0.25
    """Chance of each axis of each hand to be free."""
    hold_s: tuple[float, float] = (3.0, 5.0)
    """Time between changes [s]."""
    torque_share: float = 0.8
    """Forces are scaled down to what this share of the arm's torque limits can hold."""
    curriculum_start: float = 0.0
    """Share of the force with which worlds begin."""
    curriculum_step: float = 0.05
    """What is added to a world's share after an episode that lasted."""
    curriculum_back: float = 0.2
    """What is taken off after an early fall: more, so that the share settles where falls are few."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("force_x", "force_y", "force_z", "hold_s"):
            require_interval(f"hand_forces.{name}", getattr(self, name))
        require_range("hand_forces.hold_s[0]", self.hold_s[0], 0.02, 1e6)
        require_range("hand_forces.size", self.size, 0.0, 1000.0)
        require_positive_int("hand_forces.most_turning_of", self.most_turning_of)
        for name in (
            "episode_share",
            "zero_probability",
            "torque_share",
            "curriculum_start",
            "curriculum_step",
            "curriculum_back",
        ):
            require_range(f"hand_forces.{name}", getattr(self, name), 0.0, 1.0)


class HandForces(Stateful):
    """Piecewise constant forces at each hand, with a curriculum per world.

    Args:
        cfg: What is drawn.
        hands_h: (hands, 3) where hands usually are, from the torso, heading frame [m].
        num_envs: Number of worlds.
        dt: Control step [s].
    """

    STATE = ("_force_h", "_remaining_s", "_loaded", "scale")

    def __init__(self, cfg: HandForceConfig, hands_h: torch.Tensor, num_envs: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._hands_h, self._dt = cfg, hands_h, dt
        self._force_h = torch.zeros(num_envs, len(hands_h), 3)
        self._remaining_s = torch.zeros(num_envs)
        self._loaded = torch.ones(num_envs, dtype=torch.bool)
        self.scale = torch.full((num_envs,), cfg.curriculum_start)

    def finish_episodes(self, lasted: torch.Tensor, fell_early: torch.Tensor) -> None:
        """Adapt the curriculum of worlds whose episode ended; both masks (num_envs,) bool."""
        step = self.cfg.curriculum_step * lasted.float() - self.cfg.curriculum_back * fell_early.float()
        self.scale = (self.scale + step * self._loaded).clamp(0.0, 1.0)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """An episode begins in the worlds of `mask`."""
        if self.cfg.enabled:
            self._loaded[mask] = torch.rand(int(mask.sum()), generator=rng, device=rng.device) < self.cfg.episode_share
            self._draw(mask, rng)

    def _draw(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        n = int(mask.sum())
        if n == 0:
            return
        draw = self._any_direction if self.cfg.size > 0.0 else self._by_axis
        force = draw(n * self.cfg.most_turning_of, rng).unflatten(0, (n, -1))
        turn = torch.linalg.cross(self._hands_h.expand_as(force), force)[..., 2].sum(-1).abs()
        self._force_h[mask] = force[torch.arange(n, device=rng.device), turn.argmax(1)]
        self._remaining_s[mask] = uniform(rng, *self.cfg.hold_s, n)

    def _by_axis(self, n: int, rng: torch.Generator) -> torch.Tensor:
        cfg, hands = self.cfg, self._force_h.shape[1]
        force = torch.stack([uniform(rng, *b, n, hands) for b in (cfg.force_x, cfg.force_y, cfg.force_z)], -1)
        return force * (torch.rand(n, hands, 3, generator=rng, device=rng.device) >= cfg.zero_probability)

    def _any_direction(self, n: int, rng: torch.Generator) -> torch.Tensor:
        hands = self._force_h.shape[1]
        direction = torch.nn.functional.normalize(torch.randn(n, hands, 3, generator=rng, device=rng.device), dim=-1)
        return direction * uniform(rng, 0.0, self.cfg.size, n, hands).unsqueeze(-1)

    def step(self, rng: torch.Generator) -> None:
        """Advance by one control step; forces that have been held long enough change."""
        if self.cfg.enabled:
            self._remaining_s = self._remaining_s - self._dt
            self._draw(self._remaining_s <= 0.0, rng)

    def current(self, jacobian_h: torch.Tensor, torque_limit: torch.Tensor) -> torch.Tensor:
        """Forces (N, hands, 3) in the heading frame, never beyond what the arms' torque limits can hold.

        Args:
            jacobian_h: (N, hands, 3, n) hand Jacobians in the heading frame.
            torque_limit: (hands, n) [Nm].
        """
        force = self._force_h * (self.scale * self._loaded)[:, None, None]
        torque = (jacobian_h.transpose(-1, -2) @ force.unsqueeze(-1)).squeeze(-1).abs()
        holdable = (self.cfg.torque_share * torque_limit / torque.clamp_min(1e-6)).amin(-1).clamp_max(1.0)
        return force * holdable.unsqueeze(-1)


_LAST_SHARE = 0.02


@dataclass
class AssistConfig:
    """A wrench on the base that carries the robot through its first steps and fades as it learns to do without.

    Without it, standing still is a local optimum that plain reward tables do not leave.
    """

    enabled: bool = False
    """Whether to assist; training switches it on."""
    full_samples: float = 4e5
    """Environment steps, over all worlds, with full assistance."""
    fade_samples: float = 8e5
    """Environment steps in which it fades by a factor of e while nothing falls."""
    fall_rate: float = 0.1
    """Falls per second and world at which it stays; beyond, it grows again [1/s]."""
    end_samples: float = 8e6
    """Environment steps after which there is none, whatever falls."""
    upright_stiffness: float = 300.0
    """[Nm/rad]."""
    upright_damping: float = 30.0
    """[Nms/rad]."""
    yaw_gain: float = 15.0
    """Turning torque towards the commanded yaw rate [Nm per rad/s]."""
    velocity_gain: float = 100.0
    """Horizontal pull towards the commanded velocity [N per m/s]."""
    force_limit: float = 50.0
    """Largest pull [N]."""
    weight_share: float = 0.3
    """Share of the robot's weight that is lifted."""
    height_stiffness: float = 2000.0
    """Lift added when the base is below its commanded height [N/m]."""
    height_damping: float = 200.0
    """[Ns/m]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("assist.full_samples", self.full_samples, 0.0, self.end_samples)
        require_range("assist.fade_samples", self.fade_samples, 1.0, 1e12)
        require_range("assist.fall_rate", self.fall_rate, 1e-6, 1e6)
        require_range("assist.weight_share", self.weight_share, 0.0, 1.0)
        for name in (
            "upright_stiffness",
            "upright_damping",
            "yaw_gain",
            "velocity_gain",
            "force_limit",
            "height_stiffness",
            "height_damping",
        ):
            require_range(f"assist.{name}", getattr(self, name), 0.0, 1e6)


class Assistance(Stateful):
    """How much of the assistance is left: less and less as long as robots stay on their feet.

    It fades exponentially: a gantry of half the gains still holds the robot, so equal times go to equal ratios.
    """

    STATE = ("_share", "_fall_rate")

    def __init__(self, cfg: AssistConfig, num_envs: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._num_envs, self._dt = cfg, num_envs, dt
        self._share = torch.ones(())
        self._fall_rate = torch.zeros(())

    def share(self, samples: float) -> float:
        """Share of the assistance left after `samples` environment steps."""
        if not self.cfg.enabled or samples >= self.cfg.end_samples or self.left < _LAST_SHARE:
            return 0.0
        return self.left

    @property
    def left(self) -> float:
        """To what share it has faded, in [0, 1]."""
        return float(self._share)

    @left.setter
    def left(self, value: float) -> None:
        self._share = torch.full_like(self._share, value)

    def step(self, falls: torch.Tensor, samples: float) -> None:
        """Learn of the falls (N,) of one control step; falls are averaged over about a second."""
        rate = falls.float().mean() / self._dt
        self._fall_rate = self._fall_rate + self._dt * (rate - self._fall_rate)
        if samples <= self.cfg.full_samples or self._share < _LAST_SHARE:
            return  # not yet, or gone for good
        direction = (1.0 - self._fall_rate / self.cfg.fall_rate).clamp(-1.0, 1.0)
        progress = self._num_envs / self.cfg.fade_samples
        self._share = (self._share * torch.exp(-progress * direction)).clamp_max(1.0)

    def keep_in_step(self, mean: Callable[[torch.Tensor], torch.Tensor]) -> None:
        """Take over the mean over processes of what is left and of falls."""
        self._share, self._fall_rate = mean(self._share), mean(self._fall_rate)


def assist_wrench(
    cfg: AssistConfig, weight_n: float, up_w: torch.Tensor, angular_velocity_w: torch.Tensor,
    velocity_error_w: torch.Tensor, yaw_rate_error: torch.Tensor, height_error: torch.Tensor, climb: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """Force and torque (N, 3) on the base, world frame, at full assistance.

    Args:
        cfg: Gains.
        weight_n: Weight of the robot [N].
        up_w: (N, 3) the base's z axis.
        angular_velocity_w: (N, 3) [rad/s].
        velocity_error_w: (N, 2) commanded minus actual horizontal velocity [m/s].
        yaw_rate_error: (N,) commanded minus actual yaw rate [rad/s].
        height_error: (N,) commanded minus actual height [m].
        climb: (N,) vertical velocity [m/s].
    """
    vertical = torch.tensor([0.0, 0.0, 1.0], device=up_w.device).expand_as(up_w)
    upright = cfg.upright_stiffness * torch.linalg.cross(up_w, vertical)
    damping = cfg.upright_damping * angular_velocity_w[:, :2]
    turn = cfg.yaw_gain * yaw_rate_error
    pull = cfg.velocity_gain * velocity_error_w
    size = pull.norm(dim=1, keepdim=True).clamp_min(1e-6)
    pull = pull * (cfg.force_limit / size).clamp_max(1.0)
    # Like a gantry: it lifts, and never pushes down.
    spring = cfg.height_stiffness * height_error - cfg.height_damping * climb
    lift = (cfg.weight_share * weight_n + spring).clamp(0.0, weight_n).unsqueeze(1)
    torque = torch.cat((upright[:, :2] - damping, (upright[:, 2] + turn).unsqueeze(1)), 1)
    return torch.cat((pull, lift), 1), torque
