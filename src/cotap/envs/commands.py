"""What the lower body is asked to do: velocity, yaw rate, stand, torso height; and the gait clock that goes with it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from cotap.checks import require_interval, require_range
from cotap.envs.persistence import Stateful, uniform

STEADY_RAD = 0.2
"""Lean at which a standing robot steps outside of training [rad]: 19 of 20 that fall have leant so far 0.4 s before."""

TURNED_RAD_S = 1.0
"""Yaw rate from which a robot counts as turned by a blow [rad/s]; balance is lost at less, and then says nothing."""

BRACE_TILT_RAD = 0.05
"""Tilt that loads ask for from which walking robots fall much more often than standing ones [rad]: a pull of about 20 N
at the hands. Without loads, less than one moment in a thousand has it."""

HURRY = 1.3
"""How much faster the gait clock of a robot runs that catches itself."""


@dataclass
class CommandConfig:
    """Ranges that commands are drawn from, uniformly."""

    velocity_x: tuple[float, float] = (-1.1, 1.1)
    """Forward velocity [m/s]."""
    velocity_y: tuple[float, float] = (-0.6, 0.6)
    """Leftward velocity [m/s]."""
    yaw_rate: tuple[float, float] = (-0.9, 0.9)
    """Turning rate, positive to the left [rad/s]."""
    height_offset: tuple[float, float] = (-0.2, 0.0)
    """Torso height relative to nominal while standing [m]."""
    stand_probability: float = 0.3
    """Share of commands that ask the robot to stand."""
    axis_zero_probability: float = 0.2
    """Chance that each of the three velocities of a walking command is zero."""
    resample_s: tuple[float, float] = (4.0, 8.0)
    """Time between commands [s]."""
    height_rate: float = 0.25
    """Fastest change of the height command [m/s]."""
    acceleration: float = 1.5
    """Fastest change of each velocity command [m/s^2]."""
    yaw_acceleration: float = 3.0
    """Fastest change of the yaw rate command [rad/s^2]."""
    steady_rad: float = 10.0
    """A standing robot that is leaning further than this, or is about to, steps in place until it is steady [rad].
    Evaluation uses `STEADY_RAD`. Training does without (10): a robot that always steps never learns to stand."""
    gait_period_s: float = 0.8
    """Duration of a stride [s]."""
    step_apart_m: float = 0.0
    """How much further apart than in the default pose feet are put while stepping [m]."""
    step_clear_m: float = 0.0
    """Sideways distance of the soles below which the swinging leg rolls outwards while stepping; 0 for never [m]."""
    step_hold_back_m: float = 0.0
    """By how much less the swinging foot reaches to where the torso leans, per sine of its tilt [m]."""
    step_catch_lift: float = 0.0
    """By what share of itself the swinging foot's lift grows under a torso that leans far."""
    step_roll_damping_s: float = 0.0
    """How far joints of the legs that roll are sent against their velocity while stepping [s]; adds to PD's damping."""
    step_twist_damping_s: float = 0.0
    """The same of joints that turn about the vertical [s]."""
    step_straighten_rad: float = 0.0
    """By how much less than in the default pose knees are bent while stepping [rad]."""
    waist_yield_s: float = 0.0
    """How far the waist gives way, per rad/s by which the torso turns faster than it should, beyond 1 rad/s [s]."""
    waist_damping_s: float = 0.0
    """How far the waist turns against the torso, per rad/s by which it turns faster than it should [s]; fading up to
    1 rad/s. From 0.1 s on control delay makes it shake instead."""
    foresee_falls: bool = False
    """Whether a standing robot steps as soon as its joints and IMU tell that it will fall (`Foresight`), instead of
    from `steady_rad` on."""
    lean_into_loads: bool = False
    """Whether the vertical that steps, standing and policy go by is tilted by what pulls at the robot (`LoadSense`)."""
    brace_tilt_rad: float = 0.0
    """Tilt that loads ask for from which a robot that senses them stops and stands, whatever its command, until they
    are less [rad]; 0 for never. One that is led along a path goes on."""
    step_timing: bool = False
    """Whether the gait clock jumps to where a robot that was struck catches itself (`StepTiming`)."""
    step_correct_s: float = 0.0
    """For how long after a jump of the clock it may be corrected; 0 for not at all [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("velocity_x", "velocity_y", "yaw_rate", "height_offset", "resample_s"):
            require_interval(f"commands.{name}", getattr(self, name))
        require_range("commands.resample_s[0]", self.resample_s[0], 0.02, math.inf)
        require_range("commands.stand_probability", self.stand_probability, 0.0, 1.0)
        require_range("commands.axis_zero_probability", self.axis_zero_probability, 0.0, 1.0)
        require_range("commands.height_rate", self.height_rate, 1e-3, 10.0)
        require_range("commands.acceleration", self.acceleration, 1e-2, 1e3)
        require_range("commands.yaw_acceleration", self.yaw_acceleration, 1e-2, 1e3)
        require_range("commands.steady_rad", self.steady_rad, 0.0, 10.0)
        require_range("commands.gait_period_s", self.gait_period_s, 0.1, 10.0)
        require_range("commands.step_apart_m", self.step_apart_m, 0.0, 0.5)
        require_range("commands.step_clear_m", self.step_clear_m, 0.0, 0.5)
        require_range("commands.step_hold_back_m", self.step_hold_back_m, 0.0, 2.0)
        require_range("commands.step_catch_lift", self.step_catch_lift, 0.0, 2.0)
        require_range("commands.step_roll_damping_s", self.step_roll_damping_s, 0.0, 0.1)
        require_range("commands.step_twist_damping_s", self.step_twist_damping_s, 0.0, 0.1)
        require_range("commands.step_straighten_rad", self.step_straighten_rad, -0.2, 0.2)
        require_range("commands.waist_yield_s", self.waist_yield_s, 0.0, 1.0)
        require_range("commands.waist_damping_s", self.waist_damping_s, 0.0, 0.2)
        require_range("commands.step_correct_s", self.step_correct_s, 0.0, 1.0)
        require_range("commands.brace_tilt_rad", self.brace_tilt_rad, 0.0, 1.0)
        if self.brace_tilt_rad > 0.0 and not self.lean_into_loads:
            raise ValueError(
                f"commands.brace_tilt_rad is {self.brace_tilt_rad:g}, but robots that do not lean into loads "
                "(commands.lean_into_loads) do not sense them: it must be 0"
            )


@dataclass(frozen=True)
class Command:
    """Commands of N worlds, and the gait's phase."""

    velocity_h: torch.Tensor
    """(N, 2) horizontal velocity in the heading frame [m/s]."""
    yaw_rate: torch.Tensor
    """(N,) [rad/s]."""
    stand: torch.Tensor
    """(N,) 1 to stand, 0 to walk."""
    height: torch.Tensor
    """(N,) height of the torso link above the ground [m]."""
    phase: torch.Tensor
    """(N,) of the gait clock, in [0, 1); it rests at 0 or 0.5, both feet down, while standing."""


@dataclass(frozen=True)
class Catch:
    """What the gait clock is to do in N worlds."""

    jumps: torch.Tensor
    """(N,) bool: start stepping, or go on stepping, from `phase`."""
    phase: torch.Tensor
    """(N,) in [0, 1)."""
    hurries: torch.Tensor
    """(N,) bool: run `HURRY` times as fast."""


class CommandSource(Stateful):
    """Random commands, held for a random time. `override` puts fixed ones in their place.

    What is commanded approaches what was drawn at limited rates, as a pilot's stick does. A robot told to stand slows
    down, ends its step, and stands: the stand flag is raised once the velocity command is zero and both feet are down,
    and lowered, for a step or more, when it loses its balance. One that braces itself does so whatever it is told.
    A velocity source (such as the torso-position impedance) may replace the velocities at every step.
    """

    STATE = ("_target", "_velocity", "_stand", "_height", "_phase", "_remaining_s")

    def __init__(self, cfg: CommandConfig, num_envs: int, nominal_height: float, dt: float) -> None:
        cfg.check()
        self.cfg, self._dt, self._nominal = cfg, dt, nominal_height
        # Columns: vx, vy, yaw rate, stand, height.
        self._target = torch.zeros(num_envs, 5)
        self._target[:, 4] = nominal_height
        self._velocity = torch.zeros(num_envs, 3)
        self._stand = torch.zeros(num_envs)
        self._rate = dt * torch.tensor([cfg.acceleration, cfg.acceleration, cfg.yaw_acceleration])
        self._height = torch.full((num_envs,), nominal_height)
        self._phase = torch.zeros(num_envs)
        self._remaining_s = torch.zeros(num_envs)
        self.resample = True

    @property
    def told_to_stand(self) -> torch.Tensor:
        """(N,) bool: to stand is what was drawn, whether or not the robot still steps, or does for its balance."""
        return self._target[:, 3] > 0.5

    def override(
        self, velocity: torch.Tensor, yaw_rate: torch.Tensor, stand: torch.Tensor, height: torch.Tensor
    ) -> None:
        """Hold these commands, (N, 2), (N,), (N,), (N,), until further notice; each is approached at its rate."""
        self.resample = False
        target = torch.cat((velocity, torch.stack((yaw_rate, stand.float(), height), 1)), 1)
        self._target = target.to(self._velocity.device)

    def set_velocity(self, velocity: torch.Tensor, yaw_rate: torch.Tensor, mask: torch.Tensor) -> None:
        """In the worlds of `mask` (N,), walk at these velocities (N, 2) and yaw rates (N,), at once."""
        walk = torch.cat((velocity, yaw_rate.unsqueeze(1)), 1)
        self._target[:, :3] = torch.where(mask.unsqueeze(1), walk, self._target[:, :3])
        self._target[:, 3] = torch.where(mask, torch.zeros_like(self._stand), self._target[:, 3])
        self._target[:, 4] = torch.where(mask, torch.full_like(self._stand, self._nominal), self._target[:, 4])
        self._velocity = torch.where(mask.unsqueeze(1), walk, self._velocity)
        self._stand = torch.where(mask, torch.zeros_like(self._stand), self._stand)

    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        """New commands for the worlds in `mask`, approached from rest at nominal height."""
        self._draw(mask, rng)
        self._height[mask] = self._nominal
        self._velocity[mask] = 0.0
        stand = self._target[mask, 3]
        self._stand[mask] = stand
        # A random start in the stride, so that worlds are not in step with each other.
        start = torch.rand(int(mask.sum()), generator=rng, device=rng.device)
        self._phase[mask] = torch.where(stand > 0.5, 0.5 * (start < 0.5), start)

    def step(
        self, rng: torch.Generator, lean: torch.Tensor | None = None, turning: torch.Tensor | None = None,
        catch: Catch | None = None, braces: torch.Tensor | None = None,
    ) -> None:  # fmt: skip
        """Advance clocks by one control step and resample what is due.

        Args:
            rng: Random numbers.
            lean: (N,) how far each robot is about to lean [rad], from `leaning`; None counts as upright.
            turning: (N,) how fast each robot turns, positive to the left [rad/s]; None counts as not at all.
            catch: Where the clock jumps, and who hurries; None leaves that to `turning`.
            braces: (N,) bool, who stops and stands whatever was drawn; None for nobody.
        """
        self._remaining_s -= self._dt
        self._draw(self._remaining_s <= 0.0, rng)
        limit = self.cfg.height_rate * self._dt
        # Stepping is done at nominal height.
        wanted = torch.where(self._stand > 0.5, self._target[:, 4], self._target[:, 4].clamp_min(self._nominal))
        self._height = self._height + (wanted - self._height).clamp(-limit, limit)
        to_stand, velocity = self.told_to_stand, self._target[:, :3]
        if braces is not None:
            to_stand, velocity = to_stand | braces, velocity.masked_fill(braces.unsqueeze(1), 0.0)
        self._velocity = self._velocity + (velocity - self._velocity).clamp(-self._rate, self._rate)
        nothing = torch.zeros_like(self._phase)
        lean, turning = nothing if lean is None else lean, nothing if turning is None else turning
        rate = torch.full_like(self._phase, self._dt / self.cfg.gait_period_s)
        if catch is None:
            self._choose_foot(lean, turning)
        else:
            self._phase = torch.where(catch.jumps, catch.phase, self._phase)
            self._stand = torch.where(catch.jumps, 0.0, self._stand)
            rate = torch.where(catch.hurries, HURRY * rate, rate)
        self._advance_gait(to_stand, lean <= self.cfg.steady_rad, rate)

    def _choose_foot(self, lean: torch.Tensor, turning: torch.Tensor) -> None:
        """A standing robot that steps for its balance while it is being turned begins with the foot that the turn
        carries forward: the left one, phase 0.5, if it is turned to the right. With the other one it would cross its
        legs."""
        leans = lean > self.cfg.steady_rad
        catches = (self._stand > 0.5) & leans & (turning.abs() > TURNED_RAD_S)
        self._phase = torch.where(catches, 0.5 * (turning < 0.0), self._phase)

    def _advance_gait(self, to_stand: torch.Tensor, steady: torch.Tensor, rate: torch.Tensor) -> None:
        """Run the clock while walking; come to rest at the next double support, 0 or 0.5, once asked to and steady."""
        half_strides = 2.0 * (self._phase + rate)
        both_down = half_strides.floor() > (2.0 * self._phase).floor()
        at_rest = (self._velocity == 0.0).all(1) & to_stand & steady
        stays = (self._stand > 0.5) & to_stand & steady
        stops = ~stays & at_rest & both_down
        running = 0.5 * torch.where(stops, half_strides.floor(), half_strides)
        self._phase = torch.where(stays, self._phase, running.remainder(1.0))
        self._stand = (stays | stops).float()

    def current(self) -> Command:
        """The commands now."""
        v = self._velocity
        return Command(
            v[:, :2].clone(), v[:, 2].clone(), self._stand.clone(), self._height.clone(), self._phase.clone()
        )

    def _draw(self, mask: torch.Tensor, rng: torch.Generator) -> None:
        n = int(mask.sum())
        if n == 0 or not self.resample:
            return
        cfg = self.cfg
        velocity = torch.stack(
            [uniform(rng, *bounds, n) for bounds in (cfg.velocity_x, cfg.velocity_y, cfg.yaw_rate)], 1
        )
        velocity *= torch.rand(n, 3, generator=rng, device=rng.device) >= cfg.axis_zero_probability
        stand = (torch.rand(n, generator=rng, device=rng.device) < cfg.stand_probability).float()
        offset = uniform(rng, *cfg.height_offset, n)
        # Height is commanded in stance only; half of the stances are at nominal height.
        offset *= stand * (torch.rand(n, generator=rng, device=rng.device) < 0.5)
        self._target[mask] = torch.cat(
            (velocity * (1.0 - stand).unsqueeze(1), torch.stack((stand, self._nominal + offset), 1)), 1
        )
        self._remaining_s[mask] = uniform(rng, *cfg.resample_s, n)


def leaning(projected_gravity_t: torch.Tensor, angular_velocity_t: torch.Tensor, ahead_s: float = 0.3) -> torch.Tensor:
    """How far (N,) a torso will lean `ahead_s` from now if it goes on turning as it does [rad]; an IMU measures it.

    Args:
        projected_gravity_t: (N, 3) unit vector of gravity in the torso frame.
        angular_velocity_t: (N, 3) [rad/s].
        ahead_s: About the time constant of falling [s].
    """
    rate = torch.linalg.cross(projected_gravity_t, angular_velocity_t)
    return (projected_gravity_t + ahead_s * rate)[:, :2].norm(dim=1)
