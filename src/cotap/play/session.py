"""The simulation behind the page: two robots in one batch, what the page asks of them, one step at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from cotap.agents.actors import as_dict
from cotap.agents.checkpoint import sha256
from cotap.checks import quoted
from cotap.compliance.laws import LAWS, LawConfig, reads
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.evaluation.policy import Policy, load_policy, require_acting
from cotap.evaluation.protocol import select_motion
from cotap.evaluation.rollout import reference_actions
from cotap.evaluation.undisturbed import disable_disturbances
from cotap.motions.library import MotionError, library_sha256
from cotap.motions.reference import MIXTURE, REST, ClipConfig
from cotap.play import ROBOTS
from cotap.play.controls import AXES, Control, Ranges, make_controls
from cotap.play.forces import HandForces, Push
from cotap.play.rules import VELOCITIES
from cotap.play.sample import Sample, take_sample

DOMAIN = ("friction", "mass_scale")
"""What is a robot's own from the start, beside its laws."""


class Session:
    """Robots a and b, always both simulated: a batch of two costs what one does. `controls` is what may be set.

    Robots start in the same state, facing along x, and get the same commands, forces and arm motion; laws, policy and
    domain are their own.

    Args:
        checkpoints: Policies to choose from, by the names that are shown; the first runs at first.
        seed: Of the robots' starts.
        library: Motion library (.npz) of the clips to choose from; empty for the first policy's.

    Raises:
        CheckpointError: the first checkpoint cannot be used.
        MotionError: the library cannot.
    """

    def __init__(self, checkpoints: Mapping[str, Path], seed: int = 0, library: str = "") -> None:
        self._checkpoints, self._seed = dict(checkpoints), seed
        first = next(iter(self._checkpoints))
        policy = load_policy(self._checkpoints[first])
        self.env = HumanoidEnv(play_config(policy.env_config, library))
        self._loaded: dict[str, Policy] = {}
        self._sha256: dict[str, str] = {}
        self._policies = [self._policy(first)] * len(ROBOTS)
        env = self.env
        self.sides = tuple(arm.side for arm in env.spec.arms)
        clips = env.motions.clips.names if env.motions.clips else []
        c = env.cfg.commands
        self.controls: dict[str, Control] = make_controls(
            Ranges(
                c.velocity_x, c.velocity_y, c.yaw_rate, c.height_offset,
                self.sides, tuple(LAWS), (REST, *clips), tuple(self._checkpoints),
            )
        )  # fmt: skip
        self.values: dict[str, Any] = {name: control.default for name, control in self.controls.items()}
        self.hand_forces = HandForces(len(ROBOTS), self.sides, env.dt)
        env.forces.scripted.active = True
        self.num_steps = 0
        self._sample: Sample = {}
        self.falls = [0] * len(ROBOTS)
        self._apply_all()
        self.reset()

    @property
    def dt(self) -> float:
        """Control step [s]."""
        return self.env.dt

    @torch.inference_mode()
    def set(self, values: Mapping[str, Any]) -> list[str]:
        """Bring values, cleaned by their controls, into force. Returns notices to people.

        Values that cannot be brought into force, such as a checkpoint that does not fit, are put back.
        """
        notices = []
        for name, value in values.items():
            before, self.values[name] = self.values[name], value
            if value == before:
                continue
            try:
                self._apply(name)
            except (ValueError, OSError) as error:
                self.values[name] = before
                notices.append(str(error))
        return notices

    def trained_otherwise(self, checkpoint: str) -> str:
        """A notice if a checkpoint was trained with another stride than the first one, whose environment runs here."""
        trained, here = self._policy(checkpoint).env_config.gait.period_s, self.env.cfg.gait.period_s
        return f"{checkpoint} was trained with a stride of {trained:g} s; here it is {here:g} s" * (trained != here)

    def push(self, push: Push) -> None:
        """Push every robot's hand."""
        self.hand_forces.push(push)

    @torch.inference_mode()
    def reset(self) -> None:
        """Put both robots on their feet in the same state; pushes end."""
        self.hand_forces.clear()
        self._observations = self.env.reset_identical(self._seed)
        self._face_forward(torch.ones(self.env.num_envs, dtype=torch.bool))

    @torch.inference_mode()
    def step(self) -> Sample:
        """Advance by one control step."""
        env = self.env
        s = env.state
        force_h = self.hand_forces.step(s.hand_pos_w, s.heading_w)
        env.forces.scripted.amplitude_h[:, :-1] = force_h
        self._observations, _, done, extras = env.step(self._act())
        self.num_steps += 1
        laws = [[self.values[f"{robot}.{side}.law"] for side in self.sides] for robot in ROBOTS]
        self._sample = sample = take_sample(env, extras["falls"], laws, force_h, self._sample)
        for i, fell in enumerate(extras["falls"].tolist()):
            self.falls[i] += fell
        if done.any():
            self._face_forward(done)
        return sample

    def describe(self) -> dict[str, Any]:
        """What a recording keeps beside its arrays."""
        return {
            "robot": self.env.spec.name,
            "sides": list(self.sides),
            "gait_period_s": self.env.cfg.gait.period_s,
            "values": {name: value for name, value in self.values.items() if not name.endswith(".drag")},
            "checkpoints_sha256": {r: self._sha256[self.values[f"{r}.checkpoint"]] for r in ROBOTS},
        }

    def _act(self) -> torch.Tensor:
        observations = as_dict(self._observations)
        actions = self._policies[0](observations)
        if self._policies[1] is not self._policies[0]:
            actions = torch.cat((actions[:1], self._policies[1](observations)[1:]))
        if not self.values["arm_actions"]:
            actions = actions.clone()
            reference, first = reference_actions(self.env), self.env.num_lower
            actions[:, first : first + reference.shape[1]] = reference
        return actions

    def _policy(self, name: str) -> Policy:
        """The policy called `name`. Raises CheckpointError if it is unusable, or not for this environment."""
        if name not in self._loaded:
            path = self._checkpoints[name]
            policy = load_policy(path)
            require_acting(path, policy, self.env.layout())
            self._loaded[name], self._sha256[name] = policy, sha256(path)
        return self._loaded[name]

    def _apply_all(self) -> None:
        for name in ("velocity_x", "motion", *(f"{r}.{part}" for r in ROBOTS for part in DOMAIN)):
            self._apply(name)
        for robot in ROBOTS:
            for side in self.sides:
                self._apply(f"{robot}.{side}.law")

    def _apply(self, name: str) -> None:
        """Bring one value into force."""
        head, *rest = name.split(".")
        if head in ROBOTS:
            self._apply_to_robot(ROBOTS.index(head), rest)
        elif head == "held":
            side = rest[0]
            force = torch.tensor([self.values[f"held.{side}.{axis}"] for axis in AXES])
            self.hand_forces.held_h[self.sides.index(side)] = force
        elif head == "motion":
            self.env.motions.lead(self.values["motion"])
        elif head in (*VELOCITIES, "height_offset", "stand"):
            self._command()

    def _apply_to_robot(self, robot: int, rest: list[str]) -> None:
        value = self.values[".".join((ROBOTS[robot], *rest))]
        if rest[0] in self.sides:
            arm = self.sides.index(rest[0])
            if rest[1] == "drag":
                self.hand_forces.drag_w[robot][arm] = value
            else:
                self.env.set_law(robot, arm, self._law(robot, rest[0]))
        elif rest[0] == "checkpoint":
            self._policies[robot] = self._policy(value)
        elif rest[0] == "friction":
            mask = torch.arange(self.env.num_envs) == robot
            self.env.randomizer.set_friction(mask, torch.tensor([value]))
        else:
            self._set_mass()

    def _law(self, robot: int, side: str) -> LawConfig:
        arm = f"{ROBOTS[robot]}.{side}"
        name = self.values[f"{arm}.law"]
        own = {n: self.values[f"{arm}.{n}"] for n in ("null_stiffness", "alpha", "error", "damping")}
        own["passive"] = self.values[f"{arm}.passive"] and reads(name, "passive")
        x, y, z = (self.values[f"{arm}.stiffness_{axis}"] for axis in AXES)
        return replace(LawConfig(name, (x, y, z)), **own)

    def _set_mass(self) -> None:
        scale = torch.tensor([self.values[f"{r}.mass_scale"] for r in ROBOTS])
        load = torch.tensor([self.values[f"{r}.load_kg"] for r in ROBOTS])
        bodies = self.env.sim.model.nbody
        self.env.randomizer.set_mass(scale.unsqueeze(1).expand(-1, bodies), load)

    def _command(self) -> None:
        v, n = self.values, len(ROBOTS)
        stand = v["stand"]
        velocity = torch.tensor([0.0, 0.0] if stand else [v["velocity_x"], v["velocity_y"]]).repeat(n, 1)
        yaw_rate = torch.full((n,), 0.0 if stand else v["yaw_rate"])
        # Robots that walk learn to do so at their nominal height only.
        height = torch.full((n,), self.env.spec.nominal_height_m + (v["height_offset"] if stand else 0.0))
        self.env.commands.override(velocity, yaw_rate, torch.full((n,), float(stand)), height)

    def _face_forward(self, mask: torch.Tensor) -> None:
        """Turn robots that have just restarted along x. Nothing that is observed depends on it."""
        env = self.env
        env.sim.qpos[mask, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        env.state = env.reader.read()


def play_config(env_cfg: HumanoidEnvConfig, library: str = "") -> HumanoidEnvConfig:
    """Turn the environment that a policy was trained in into the page's. Changes and returns `env_cfg`."""
    select_motion(env_cfg.motions.clips, (MIXTURE,), library)
    _find_library(env_cfg.motions.clips)
    disable_disturbances(env_cfg)
    env_cfg.num_envs, env_cfg.num_threads, env_cfg.backend = len(ROBOTS), 1, "mujoco"
    env_cfg.terminations.episode_s = 1e6
    env_cfg.upper_body.sampling.enabled = False  # what the page sets stays
    env_cfg.upper_body.modulation.hold()
    env_cfg.motions.clips.share, env_cfg.motions.clips.only, env_cfg.motions.clips.held_out = 1.0, (), ()
    for weights in (env_cfg.rewards.lower, env_cfg.rewards.upper):  # nobody learns here; a group must have one term
        for name in vars(weights):
            if name != "alive":
                setattr(weights, name, 0.0)
    env_cfg.forces.scripted = ForceProfile(start_s=0.0)
    return env_cfg


def _find_library(clips: ClipConfig) -> None:
    """Offer the clips that come with the package where a policy's own are not on this machine, or are others now."""
    if not clips.library_sha256:  # given just now, or none
        return
    try:
        same = library_sha256(clips.library) == clips.library_sha256
    except MotionError:
        same = False
    if not same:
        print(
            f"motion library {quoted(clips.library, 1000)} of this policy is not here: --library names one", flush=True
        )
        clips.library = clips.library_sha256 = ""
