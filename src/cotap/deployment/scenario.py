"""What a robot is asked to do, from a small file: commands and forces over time, the arms' motion and laws."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from cotap.checks import legible, quoted, require_finite, require_range
from cotap.compliance.laws import LawConfig
from cotap.configs import from_plain
from cotap.envs.commands import CommandConfig, CommandSource
from cotap.envs.scripted_forces import ForceProfile, ScriptedForces
from cotap.evaluation.law_options import parse_law
from cotap.inputs import InputError, read_text
from cotap.motions.reference import MIXTURE, ReferenceConfig, ReferenceMotion
from cotap.robots import RobotSpec

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_LARGEST = 1 << 20
"""Bytes of a scenario that are read; a command takes a hundred."""


@dataclass
class TimedCommand:
    """From a moment on; approached at the rates that the policy was trained with."""

    at: float = 0.0
    """When [s]."""
    velocity: tuple[float, float] = (0.0, 0.0)
    """Forward and leftward [m/s]."""
    yaw_rate: float = 0.0
    """Positive to the left [rad/s]."""
    stand: bool = False
    """Stand; velocities must then be zero."""
    height_offset: float = 0.0
    """Torso height against nominal, in stance [m]."""

    def check(self, where: str) -> None:
        """Raise ValueError naming the first field, under `where`, that is out of its range."""
        require_range(f"{where}.at", self.at, 0.0, 1e6)
        _require_length(f"{where}.velocity", self.velocity, 2)
        for i, value in enumerate(self.velocity):
            require_range(f"{where}.velocity[{i}]", value, -5.0, 5.0)
        require_range(f"{where}.yaw_rate", self.yaw_rate, -5.0, 5.0)
        require_range(f"{where}.height_offset", self.height_offset, -0.5, 0.5)
        if not isinstance(self.stand, bool):
            raise ValueError(f"{where}.stand must be true or false, got {quoted(self.stand)}")
        if self.stand and (any(self.velocity) or self.yaw_rate):
            raise ValueError(f"{where} stands and moves: velocity {self.velocity}, yaw_rate {self.yaw_rate}")
        if self.height_offset and not self.stand:
            raise ValueError(f"{where}.height_offset must be 0 where stand is false, got {self.height_offset}")

    def untrained(self, trained: CommandConfig) -> list[str]:
        """Which values are beyond the ranges of training."""
        ranges = {
            "forward velocity": (self.velocity[0], trained.velocity_x),
            "leftward velocity": (self.velocity[1], trained.velocity_y),
            "yaw rate": (self.yaw_rate, trained.yaw_rate),
            "height offset": (self.height_offset, trained.height_offset),
        }
        return [
            f"{name} {value:g} at {self.at:g} s is beyond training's {low:g} to {high:g}"
            for name, (value, (low, high)) in ranges.items()
            if not low <= value <= high
        ]

    def give(self, commands: CommandSource, nominal_height_m: float) -> None:
        """Hand this command over."""
        commands.override(
            torch.tensor([list(self.velocity)], dtype=torch.float32), torch.tensor([float(self.yaw_rate)]),
            torch.tensor([self.stand]), torch.tensor([nominal_height_m + self.height_offset]),
        )  # fmt: skip


@dataclass
class ArmMotion:
    """What the arms' reference does: holds a pose, or follows a clip; neither for the default pose."""

    pose: tuple[float, ...] = ()
    """Arm joints, left arm first [rad]."""
    clip: str = ""
    """Name of a clip in the motion library; `mixture` mixes clips and generated motion as recipes do."""
    library: str = ""
    """Motion library (.npz) that the clip is taken from; empty for the one that comes with the package."""

    def check(self, spec: RobotSpec) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        if self.pose and self.clip:
            raise ValueError("arms: give a pose or a clip, not both")
        if self.pose:
            _require_length("arms.pose", self.pose, len(spec.upper_joints))
        for i, (value, joint) in enumerate(zip(self.pose, spec.upper_joint_specs, strict=False)):
            require_range(f"arms.pose[{i}] ({joint.name})", value, *joint.range_rad)
        for name in ("clip", "library"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(f"arms.{name} must be a name, got {quoted(getattr(self, name))}")
        if self.library and not self.clip:
            raise ValueError(f"arms.library {self.library!r} does nothing without a clip")

    def reference(self, spec: RobotSpec, dt: float) -> ReferenceMotion:
        """The reference of one robot. Raises MotionError for a clip that is not there."""
        cfg = ReferenceConfig()
        cfg.clips.library = self.library
        if self.clip != MIXTURE:
            cfg.clips.share = 1.0 if self.clip else 0.0
            cfg.clips.only = (self.clip,) if self.clip else ()
        motion = ReferenceMotion(cfg, spec, 1, dt)
        if not self.clip:
            motion.hold(torch.tensor(self.pose) if self.pose else motion.default)
        return motion


@dataclass
class Scenario:
    """All of it. Without commands, random ones as the velocity-tracking evaluation draws them."""

    seconds: float = 20.0
    """How long [s]."""
    arms: ArmMotion = field(default_factory=ArmMotion)
    left: str = ""
    """The left arm's law, as in cotap:alpha=0.7,stiffness=500; by default the one that the policy was trained under."""
    right: str = ""
    """The right arm's law."""
    command: tuple[TimedCommand, ...] = ()
    """In the order of their times, from 0 on."""
    force: tuple[ForceProfile, ...] = ()
    """On the hands, heading frame; they add up."""

    def check(self, spec: RobotSpec) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("seconds", self.seconds, 0.02, 36000.0)
        self.arms.check(spec)
        for side in ("left", "right"):
            if text := getattr(self, side):
                parse_law(side, text, LawConfig()).check()
        for i, command in enumerate(self.command):
            command.check(f"command[{i}]")
            if i == 0 and command.at != 0.0:
                raise ValueError(f"command[0].at must be 0, for the robot begins with it; got {command.at} s")
            if i and command.at < self.command[i - 1].at:
                raise ValueError(f"command[{i}].at is {command.at} s, before the one ahead of it")
        for i, force in enumerate(self.force):
            _require_length(f"force[{i}].force", force.force, 3)
            try:
                force.check()
            except ValueError as error:
                raise ValueError(f"force[{i}]: {error}") from error
            if force.place != "hand":
                raise ValueError(f"force[{i}].place must be 'hand' in a scenario, got {quoted(force.place)}")
            for axis, value in enumerate(force.force):
                require_finite(f"force[{i}].force[{axis}]", value)

    def forces(self, spec: RobotSpec, dt: float, seed: int = 0) -> list[ScriptedForces]:
        """The forces, for one robot with this control step [s]; `seed` draws directions that are random."""
        rng, one = torch.Generator().manual_seed(seed), torch.ones(1, dtype=torch.bool)
        forces = [ScriptedForces(force, tuple(arm.side for arm in spec.arms), 1, dt) for force in self.force]
        for force in forces:
            force.reset(one, rng)
        return forces


def load_scenario(path: Path | str, spec: RobotSpec) -> Scenario:
    """Read a scenario from TOML.

    Raises:
        ValueError: the file cannot be read, is not TOML, or has a field that is unknown or out of its range; the
            message names the file and the field.
    """
    try:
        data = tomllib.loads(read_text(path, _LARGEST))
    except InputError as error:
        raise ValueError(f"scenario {str(path)!r} {error}") from error
    except (ValueError, RecursionError) as error:  # not TOML, or nested without end
        raise ValueError(f"scenario {str(path)!r} is not TOML: {legible(str(error))}") from error
    try:
        scenario = from_plain(Scenario, data)
        if not isinstance(scenario.arms, ArmMotion):
            raise ValueError(f"arms must be a table, got {quoted(scenario.arms)}")
        scenario.check(spec)
    except (ValueError, TypeError) as error:
        raise ValueError(f"scenario {str(path)!r}: {error}") from error
    return scenario


def _require_length(name: str, value: Any, length: int) -> None:
    if not isinstance(value, (tuple, list)) or len(value) != length:
        raise ValueError(f"{name} must hold {length} numbers, got {quoted(value)}")
