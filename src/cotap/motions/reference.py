"""The arms' reference: generated motion and clips of real motion, one flowing into the other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cotap.checks import require_interval, require_one_of, require_range
from cotap.motions.clip_player import ClipPlayer
from cotap.motions.generator import PEAK_SPEED, ArmReference, MotionConfig, MotionGenerator, minimum_jerk, within_limits
from cotap.motions.library import MotionError, MotionLibrary, has_shipped_library, library_sha256, shipped_library
from cotap.motions.pace import pace
from cotap.persistence import Stateful, uniform
from cotap.robots import RobotSpec

REST = "rest"
"""The name of the motion that is none: the default pose."""


MIXTURE, HELD = "mixture", "none"
"""In place of a clip's name, where one is asked for: clips and generated motion as in training, and a pose that is
held."""


@dataclass
class ClipConfig:
    """Real motion beside the generator's."""

    share: float = 0.5
    """Share of time that arms follow clips; 0 leaves all to the generator."""
    library: str = ""
    """A motion library (.npz); empty takes the one that comes with the package for the robot. Where there is none, and
    `only` is empty too, all is left to the generator."""
    library_sha256: str = ""
    """Hex digest of that library; one with another is refused. Empty takes any, and a training fills it in."""
    only: tuple[str, ...] = ()
    """Play these clips; empty plays all but `held_out`."""
    held_out: tuple[str, ...] = ("dance_b", "dance_b_mirrored", "kick", "kick_mirrored")
    """Clips kept out, for evaluation. Names that a library of one's own lacks are ignored."""
    velocity_share: float = 0.5
    """Fastest playing, as a share of each joint's velocity limit; faster passages are slowed down."""
    acceleration: float = 40.0
    """Largest joint acceleration in playing [rad/s^2]; passages beyond it are slowed down."""
    hold_s: tuple[float, float] = (4.0, 10.0)
    """Time before another motion is drawn [s]."""
    blend_s: float = 0.3
    """Shortest time of a transition from one motion to another [s]."""
    blend_speed: float = 0.12
    """Fastest transition, as a share of each joint's velocity limit."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("clips.share", self.share, 0.0, 1.0)
        require_range("clips.velocity_share", self.velocity_share, 0.01, 1.0)
        require_range("clips.acceleration", self.acceleration, 1.0, 1e6)
        require_interval("clips.hold_s", self.hold_s)
        require_range("clips.hold_s[0]", self.hold_s[0], 0.02, math.inf)
        require_range("clips.blend_s", self.blend_s, 0.02, 10.0)
        require_range("clips.blend_speed", self.blend_speed, 0.01, 1.0)


@dataclass
class ReferenceConfig:
    """Where the arms' reference comes from."""

    generator: MotionConfig = field(default_factory=MotionConfig)
    clips: ClipConfig = field(default_factory=ClipConfig)

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        self.generator.check()
        self.clips.check()


def plays_clips(cfg: ClipConfig, spec: RobotSpec) -> bool:
    """Whether there is a share of clips, and they are asked for by library or name, or come with the package."""
    return cfg.share > 0.0 and bool(cfg.library or cfg.only or has_shipped_library(spec))


def pin_library(cfg: ClipConfig) -> None:
    """Write down where the library lies, and its digest unless there is one: a policy is used in other folders than
    where it was trained. Raises MotionError for a library that cannot be read."""
    if not cfg.library:
        cfg.library_sha256 = ""
        return
    cfg.library = str(Path(cfg.library).resolve())
    cfg.library_sha256 = cfg.library_sha256 or library_sha256(cfg.library)


def load_clips(cfg: ClipConfig, spec: RobotSpec, margin_rad: float = 0.0) -> MotionLibrary:
    """The clips that a config asks for, at its pace, with joints that stay `margin_rad` off their limits [rad].

    Raises:
        MotionError: a clip is not there, or a library is not there or has changed.
    """
    if cfg.library and cfg.library_sha256 not in ("", library_sha256(cfg.library)):
        raise MotionError(
            f"motion library {cfg.library!r} has changed since the policy was trained with it; give the library that "
            "is meant by name"
        )
    library = MotionLibrary.load(cfg.library, spec) if cfg.library else shipped_library(spec)
    names = list(cfg.only) or [name for name in library.names() if name not in cfg.held_out]
    if not names:
        raise MotionError("clips.held_out leaves no clip to play")
    limit = np.array([j.velocity_limit_rad_s for j in spec.upper_joint_specs])
    limits = torch.tensor([j.range_rad for j in spec.upper_joint_specs], device="cpu").unbind(1)
    low, high = (bound.numpy() for bound in within_limits(limits[0], limits[1], margin_rad))
    clips = (replace(clip, arms=clip.arms.clip(low, high)) for clip in library.select(names, spec).clips)
    return MotionLibrary([pace(clip, cfg.velocity_share * limit, cfg.acceleration) for clip in clips], spec)


class ReferenceMotion(Stateful):
    """Draws, per env, the generator or a clip; carries over what is left of the old motion, fading, into the new.

    The offset between the two at the moment of the change fades along a minimum-jerk curve, as slowly as the joints'
    speed asks for; beyond that no step of the reference exceeds the joints' velocity limits.
    """

    STATE = ("_from_clip", "_remaining_s", "_offset", "_fade_s", "_since_s", "_position", "_velocity")

    def __init__(self, cfg: ReferenceConfig, spec: RobotSpec, num_envs: int, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt = cfg.clips, dt
        self.generator = MotionGenerator(cfg.generator, spec, num_envs, dt)
        self.default = self.generator.default
        joints = spec.upper_joint_specs
        low, high = torch.tensor([j.range_rad for j in joints]).unbind(1)
        margin = cfg.generator.limit_margin_rad
        self._low, self._high = within_limits(low, high, margin)
        self.clips = (
            ClipPlayer(load_clips(cfg.clips, spec, margin), num_envs, dt) if plays_clips(cfg.clips, spec) else None
        )
        limit = torch.tensor([j.velocity_limit_rad_s for j in joints])
        self._largest_step, self._blend_speed = dt * limit, cfg.clips.blend_speed * limit
        n = num_envs
        self._from_clip = torch.zeros(n, dtype=torch.bool)
        self._remaining_s = torch.zeros(n)
        self._offset = torch.zeros(n, len(joints))
        self._fade_s, self._since_s = torch.ones(n), torch.ones(n)
        self._position = self.default.repeat(n, 1)
        self._velocity = torch.zeros(n, len(joints))
        self._fixed = False
        self._led: str | None = None
        self.share = 1.0
        """Share of the way from the default pose to motion that arms are asked to go; poses that are held aside."""

    def lead(self, motion: str) -> None:
        """Take all envs from where their arms are, held or not, into `motion`, until further notice: a clip's name,
        from its beginning and over again, or `REST`, the default pose.

        Raises:
            ValueError: no clip is called so, or clips are switched off.
        """
        self._led = require_one_of("motion", motion, (REST, *(self.clips.names if self.clips else ())))
        self._fixed = False
        everyone = torch.ones_like(self._from_clip)
        self._begin(everyone, motion)
        self._blend(everyone, self._raw().position)

    def hold(self, pose: torch.Tensor) -> None:
        """Hold `pose` (U,) or (N, U) in all envs until further notice."""
        self.place(pose, torch.zeros_like(self._velocity))

    def place(self, position: torch.Tensor, velocity: torch.Tensor) -> None:
        """Be at `position` (U,) or (N, U) [rad], moving at `velocity` (N, U) [rad/s], until it is placed elsewhere."""
        self._fixed = True
        self._position = position.to(self._position).expand_as(self._position).clone()
        self._velocity = velocity.to(self._velocity)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """Start the envs of `mask` anew, with no memory of what they did."""
        if self._fixed or not mask.any():
            return
        self.generator.reset(mask, rng)
        self._draw(mask, rng)
        self._offset[mask] = 0.0
        raw, ids = self._raw(), mask.nonzero().squeeze(1)
        self._position = self._position.index_put((ids,), raw.position[ids].clamp(self._low, self._high))
        self._velocity = self._velocity.index_put((ids,), raw.velocity[ids])

    def step(self, rng: torch.Generator) -> None:
        """Advance by one control step."""
        if self._fixed:
            return
        raw = self._advance(rng)
        self._since_s = self._since_s + self._dt
        left = 1.0 - minimum_jerk((self._since_s / self._fade_s).clamp_max(1.0))[0]
        target = (raw + left.unsqueeze(1) * self._offset).clamp(self._low, self._high)
        position = self._position + (target - self._position).clamp(-self._largest_step, self._largest_step)
        self._velocity = (position - self._position) / self._dt
        self._position = position

    def current(self) -> ArmReference:
        """The reference now."""
        return ArmReference(self._position, self._velocity)

    def root_velocity(self) -> torch.Tensor:
        """Root velocity (N, 3) of the clip that an env plays: forward, leftward [m/s], turning [rad/s]; else zero."""
        if self.clips is None:
            return torch.zeros(self._from_clip.shape[0], 3, device=self._position.device)
        return self.clips.root_velocity() * self._from_clip.unsqueeze(1)

    def state_dict(self) -> dict[str, Any]:
        """Its own state, the generator's and the clips'."""
        parts = {"generator": self.generator.state_dict(), "clips": self.clips.state_dict() if self.clips else {}}
        return super().state_dict() | parts

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned. Raises ValueError for another size or a missing name."""
        own = dict(state)
        self.generator.load_state_dict(own.pop("generator", {}))
        clips = own.pop("clips", {})
        super().load_state_dict(own)
        if self.clips and clips:
            self.clips.load_state_dict(clips)
            self.clips.clip.clamp_(max=len(self.clips.names) - 1)

    def _draw(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        if self._led is not None:
            self._begin(mask, self._led)
            return
        n = int(mask.sum())
        self._remaining_s[mask] = uniform(rng, *self.cfg.hold_s, n)
        if self.clips:
            self._from_clip[mask] = torch.rand(n, generator=rng, device=rng.device) < self.cfg.share
            self.clips.draw(mask, rng)

    def _begin(self, mask: torch.Tensor, motion: str) -> None:
        """Start the clip called `motion`, or none, in the envs of `mask`."""
        self._remaining_s[mask] = math.inf
        self._from_clip[mask] = motion != REST
        if self.clips and motion != REST:
            self.clips.start(mask, self.clips.names.index(motion))

    def _raw(self) -> ArmReference:
        """What generator or clip ask for, or the share of it, transitions aside."""
        motion = self.generator.current()
        if self._led == REST:
            return ArmReference(self.default.expand_as(motion.position), torch.zeros_like(motion.velocity))
        if self.clips is not None:
            chosen = self._from_clip.unsqueeze(1)
            motion = ArmReference(
                torch.where(chosen, self.clips.current(), motion.position),
                motion.velocity.masked_fill(chosen, 0.0),
            )
        if self.share == 1.0:
            return motion
        return ArmReference(self.default.lerp(motion.position, self.share), self.share * motion.velocity)

    def _advance(self, rng: torch.Generator) -> torch.Tensor:
        """Advance generator and clips, change motions that are due, and return the raw positions (N, U)."""
        self.generator.step(rng)
        self._remaining_s = self._remaining_s - self._dt
        if self.clips is None:
            return self._raw().position
        changed = self.clips.step() & self._from_clip
        due = self._remaining_s <= 0.0
        if due.any():
            self._draw(due, rng)
            changed = changed | due
        raw = self._raw().position
        if changed.any():
            self._blend(changed, raw)
        return raw

    def _blend(self, changed: torch.Tensor, raw: torch.Tensor) -> None:
        """Carry what the envs of `changed` (N,) are off from `raw` (N, U) over into their new motion."""
        offset = self._position - raw
        fade = (PEAK_SPEED * (offset.abs() / self._blend_speed).amax(1)).clamp_min(self.cfg.blend_s)
        self._offset = torch.where(changed.unsqueeze(1), offset, self._offset)
        self._fade_s = torch.where(changed, fade, self._fade_s)
        self._since_s = torch.where(changed, torch.zeros_like(fade), self._since_s)
