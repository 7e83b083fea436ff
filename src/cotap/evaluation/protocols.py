"""What is evaluated, as data: the environment's config for a protocol, and which measures are taken."""

from __future__ import annotations

from dataclasses import dataclass

from cotap.checks import require_one_of, require_positive_int, require_range
from cotap.envs import H1EnvConfig
from cotap.envs.commands import STEADY_RAD
from cotap.evaluation.quiet import quiet
from cotap.robots.mjcf import COLLISIONS


@dataclass
class VelocityTracking:
    """Random commands, each held for a while, with randomisation on."""

    num_envs: int = 1024
    """Number of worlds."""
    seed: int = 0
    """Seed of worlds, commands and bootstrap."""
    episode_seconds: float = 20.0
    """Length of the evaluation [s]."""
    command_seconds: float = 5.0
    """How long each command is held [s]."""
    settle_seconds: float = 1.0
    """Errors are measured once a command has held for this long [s]."""
    speed_x: float = 1.0
    """Largest forward and backward command [m/s]."""
    speed_y: float = 0.5
    """Largest sideways command [m/s]."""
    yaw_rate: float = 0.8
    """Largest turning command [rad/s]."""
    height_drop: float = 0.2
    """Lowest stance below nominal [m]."""
    stand_probability: float = 0.2
    """Share of commands that ask the robot to stand."""
    hand_force: float = 0.0
    """Random forces of up to this size, per axis, on both hands [N]."""
    hand_force_size: float = 0.0
    """Random forces in any direction, of a size up to this, on both hands, instead [N]."""
    randomize: bool = True
    """Domain randomisation."""
    arm_motion: bool = True
    """Reference arm motion; otherwise arms hold their default pose."""
    motion: tuple[str, ...] = ()
    """Arms follow these clips only; empty keeps the mixture that the policy was trained on."""
    steady_rad: float = STEADY_RAD
    """A standing robot that is leaning further than this, or is about to, steps in place until it is steady [rad]."""
    follow_path: bool = False
    """Lead the torso along the clips' root path instead of drawing velocity commands."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""
    collision: str = ""
    """feet (only feet meet the floor) or full (all shapes, each other too); empty keeps what the policy was trained
    with."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_positive_int("num_envs", self.num_envs)
        require_range("episode_seconds", self.episode_seconds, self.command_seconds, 3600.0)
        require_range("command_seconds", self.command_seconds, self.settle_seconds + 0.1, 3600.0)
        require_range("settle_seconds", self.settle_seconds, 0.0, 3600.0)
        for name in ("speed_x", "speed_y", "yaw_rate"):
            require_range(name, getattr(self, name), 0.0, 5.0)
        require_range("height_drop", self.height_drop, 0.0, 0.5)
        require_range("stand_probability", self.stand_probability, 0.0, 1.0)
        require_range("steady_rad", self.steady_rad, 0.0, 10.0)
        require_range("hand_force", self.hand_force, 0.0, 1000.0)
        require_range("hand_force_size", self.hand_force_size, 0.0, 1000.0)
        if self.hand_force > 0.0 and self.hand_force_size > 0.0:
            raise ValueError(
                f"hand_force is {self.hand_force:g} and hand_force_size {self.hand_force_size:g}: forces are drawn "
                "either axis by axis or in any direction, so one of them must be 0"
            )
        require_range("torque_limit_scale", self.torque_limit_scale, 1e-3, 1e3)
        if self.collision:
            require_one_of("collision", self.collision, COLLISIONS)

    def configure(self, env: H1EnvConfig) -> H1EnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env`."""
        self.check()
        quiet(env)
        env.num_envs, env.seed, env.torque_limit_scale = self.num_envs, self.seed, self.torque_limit_scale
        env.collision = self.collision or env.collision
        env.randomization.enabled = self.randomize
        # Episodes outlast the evaluation: what ends one is a fall.
        env.terminations.episode_s = 2.0 * self.episode_seconds
        if self.motion:
            clips = env.motions.clips
            clips.share, clips.only, clips.held_out = 1.0, self.motion, ()
        env.commands.steady_rad = self.steady_rad
        env.impedance.share = float(self.follow_path)
        c = env.commands
        c.velocity_x, c.velocity_y = (-self.speed_x, self.speed_x), (-self.speed_y, self.speed_y)
        c.yaw_rate, c.height_offset = (-self.yaw_rate, self.yaw_rate), (-self.height_drop, 0.0)
        c.resample_s = (self.command_seconds, self.command_seconds)
        c.stand_probability, c.axis_zero_probability = self.stand_probability, 0.0
        f = env.hand_forces
        f.enabled, f.size = self.hand_force > 0.0 or self.hand_force_size > 0.0, self.hand_force_size
        f.force_x = f.force_y = f.force_z = (-self.hand_force, self.hand_force)
        f.zero_probability, f.curriculum_start = 0.0, 1.0
        f.curriculum_step = f.curriculum_back = 0.0
        return env
