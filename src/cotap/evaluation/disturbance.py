"""A hand is struck, or loaded and left so: what hand, arm and torso do about it (paper, section IV)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from cotap.agents.checkpoint import write_atomically
from cotap.checks import require_one_of, require_positive_int, require_range
from cotap.envs import H1Env, H1EnvConfig
from cotap.envs.commands import STEADY_RAD
from cotap.envs.forces import ForceProfile
from cotap.evaluation.metrics import masked_mean
from cotap.evaluation.rollout import Trajectory

MODES = ("stance", "walking")


@dataclass
class Impact:
    """A blow on a hand: 500 N for 50 ms."""

    num_envs: int = 1024
    """Number of worlds."""
    seed: int = 0
    """Seed of worlds, directions and bootstrap."""
    mode: str = "stance"
    """stance, or walking forward at `speed`."""
    speed: float = 0.5
    """Forward command while walking [m/s]."""
    force: tuple[float, float, float] = (500.0, 0.0, 0.0)
    """Along x, y and z of the heading frame [N]."""
    hand: str = "left"
    """left, right or both."""
    duration: float = 0.05
    """How long the force lasts [s]."""
    random_direction: bool = False
    """Turn the force about the vertical by a random angle."""
    onset: float = 3.0
    """When it sets in [s]."""
    window: tuple[float, float] = (0.0, 1.0)
    """What is measured, from the onset [s]."""
    motion: tuple[str, ...] = ()
    """Clips that the arms follow; empty holds the default pose."""
    steady_rad: float = STEADY_RAD
    """A standing robot that is leaning further than this, or is about to, steps in place until it is steady [rad]."""
    arm_actions: bool = True
    """Let the policy's own residual move the arms."""
    randomize: bool = True
    """Domain randomisation."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_positive_int("num_envs", self.num_envs)
        require_one_of("mode", self.mode, MODES)
        require_range("speed", self.speed, -5.0, 5.0)
        require_range("onset", self.onset, 1.0, 3600.0)
        require_range("window[0]", self.window[0], 0.0, 3600.0)
        require_range("window[1]", self.window[1], self.window[0] + 0.02, 3600.0)
        require_range("steady_rad", self.steady_rad, 0.0, 10.0)
        require_range("torque_limit_scale", self.torque_limit_scale, 1e-3, 1e6)
        self._profile().check()

    def _profile(self) -> ForceProfile:
        return ForceProfile(self.force, self.hand, self.onset, self.duration, 0.0, self.random_direction)

    @property
    def seconds(self) -> float:
        """Length of the evaluation [s]."""
        return self.onset + self.window[1]

    def configure(self, env: H1EnvConfig) -> H1EnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env`."""
        self.check()
        env.num_envs, env.seed, env.torque_limit_scale = self.num_envs, self.seed, self.torque_limit_scale
        env.assist.enabled = env.hand_forces.enabled = env.blows.enabled = env.observations.noise.enabled = False
        env.randomization.enabled = self.randomize
        env.terminations.episode_s = 1e6
        env.impedance.share, env.commands.steady_rad = 0.0, self.steady_rad
        env.force = self._profile()
        clips = env.motions.clips
        clips.share, clips.only, clips.held_out = (1.0, self.motion, ()) if self.motion else (0.0, (), ())
        return env

    def command(self, env: H1Env) -> None:
        """Give every world the mode's command, and its arms the default pose unless they follow clips."""
        n = env.num_envs
        walking = self.mode == "walking"
        velocity = torch.tensor([self.speed if walking else 0.0, 0.0]).repeat(n, 1)
        stand = torch.full((n,), 0.0 if walking else 1.0)
        env.commands.override(velocity, torch.zeros(n), stand, torch.full((n,), env.spec.nominal_height_m))
        if not self.motion:
            env.motions.hold(env.motions.default)


@dataclass
class ConstantLoad(Impact):
    """A load on a hand, held: 50 N downward."""

    force: tuple[float, float, float] = (0.0, 0.0, -50.0)
    """Along x, y and z of the heading frame [N]."""
    duration: float = 1e5
    """How long the force lasts [s]."""
    window: tuple[float, float] = (2.0, 4.0)
    """What is measured, from the onset [s]."""


def disturbance_measures(t: Trajectory, protocol: Impact, sides: tuple[str, ...]) -> dict[str, torch.Tensor]:
    """Measures of the window per world, (N,) each, up to a fall; NaN where there is nothing to measure.

    Hand errors are against the reference carried in the torso frame; `e_ee_hit` is that of the disturbed hands.
    """
    onset = round(protocol.onset / t.dt)
    begin, end = (onset + round(bound / t.dt) for bound in protocol.window)
    part = replace(t, **{name: getattr(t, name)[begin:end] for name in _TENSORS})
    alive = t.alive()[begin:end]
    hit = [i for i, side in enumerate(sides) if protocol.hand in (side, "both")]
    hit_error = t.hand_error[..., hit].mean(2)
    torque = part.arm_torque.norm(dim=2)
    power = (part.arm_torque * part.arm_velocity).abs().sum(2)
    fell = t.fell.any(0)
    return {
        "e_torso": masked_mean((part.velocity - part.command)[..., :2].norm(dim=2), alive),
        "e_ee": masked_mean(part.hand_error.mean(2), alive),
        "e_ee_hit": masked_mean(hit_error[begin:end], alive),
        "j_upper": masked_mean(torque, alive),
        "e_upper": masked_mean(part.arm_error.norm(dim=2), alive),
        "peak_torque": torch.where(alive, part.arm_torque.abs().amax(2), torch.zeros_like(torque)).amax(0),
        "share_at_limit": masked_mean(part.arm_at_limit.float(), alive),
        "energy": torch.where(alive, power, torch.zeros_like(power)).sum(0) * t.dt,
        "recovery_s": recovery_time(hit_error, t.alive(), onset, t.dt),
        "fall_fraction": fell.float(),
    }


_TENSORS = ("velocity", "command", "hand_error", "arm_torque", "arm_velocity", "arm_error", "arm_at_limit")


def recovery_time(error: torch.Tensor, alive: torch.Tensor, onset: int, dt: float) -> torch.Tensor:
    """Seconds (N,) from the onset until `error` (T, N) is back under 1.5 times its mean of the half second before.

    NaN where it never leaves, never comes back within the record, or the robot falls.
    """
    before = error[max(0, onset - round(0.5 / dt)) : onset].mean(0)
    over = error[onset:] > 1.5 * before
    left = over.any(0)
    last = torch.where(over, torch.arange(over.shape[0]).unsqueeze(1), -1).amax(0)
    back = left & (last < over.shape[0] - 1) & alive.all(0)
    return torch.where(back, (last + 1).float() * dt, torch.full_like(before, math.nan))


def curve(t: Trajectory, protocol: Impact, sides: tuple[str, ...]) -> dict[str, list[float | None]]:
    """Mean over standing worlds of what happens over time, from a second before the onset."""
    onset = round(protocol.onset / t.dt)
    begin = onset - round(1.0 / t.dt)
    stood = ~t.fell.any(0)
    hit = [i for i, side in enumerate(sides) if protocol.hand in (side, "both")]
    if not stood.any():
        return {"time": []}
    rows = {
        "time": (torch.arange(begin, len(t.fell)) - onset) * t.dt,
        "hand_error": t.hand_error[begin:, stood][..., hit].mean((1, 2)),
        "hand_displacement_z": (t.hand_position[begin:, stood] - t.hand_position[onset - 1, stood])[:, :, hit, 2].mean(
            (1, 2)
        ),
        "torso_velocity_error": (t.velocity - t.command)[begin:, stood, :2].norm(dim=2).mean(1),
        "arm_torque": t.arm_torque[begin:, stood].norm(dim=2).mean(1),
    }
    return {name: values.tolist() for name, values in rows.items()}


def plot(path: Path, curves: dict[str, Any], title: str) -> None:
    """Hand error, torso velocity error and arm torque over time, means over the worlds that stood."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    panels = (("hand_error", "hand error [m]"), ("torso_velocity_error", "torso velocity error [m/s]"),
              ("arm_torque", "arm torque, 2-norm [Nm]"))  # fmt: skip
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), constrained_layout=True)
    for axis, (name, label) in zip(axes, panels, strict=True):
        if curves["time"]:
            axis.plot(curves["time"], curves[name], color="#2171b5")
        axis.axvline(0.0, color="0.6", lw=0.8)
        axis.set(xlabel="time since the force set in [s]", ylabel=label)
        axis.grid(alpha=0.2)
    figure.suptitle(title)
    write_atomically(path, lambda p: figure.savefig(p, dpi=130, format=path.suffix.lstrip(".") or "png"))
    plt.close(figure)
