"""What runs on the robot at the control rate: readings in, joint law out."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from cotap.compliance.kinematics import ChainPose
from cotap.compliance.laws import SENSING_FORCE
from cotap.configs import from_plain
from cotap.deployment.joint_law import JointLaw, pd_law
from cotap.deployment.metadata import PolicyError, PolicyMetadata
from cotap.deployment.policy import OnnxPolicy, arm_advance
from cotap.envs.commands import CommandConfig, CommandSource, leaning
from cotap.envs.foresight import Foresight
from cotap.envs.load_sense import LoadSense
from cotap.envs.observations import ObservationHistory, actor_terms, actor_values
from cotap.envs.reference import ReferenceMotion
from cotap.envs.state import RobotState
from cotap.envs.step_timing import StepTiming
from cotap.envs.upper_body import UpperBody, UpperBodyConfig
from cotap.robots import ROBOTS, RobotSpec
from cotap.robots.chains import arm_chains


@dataclass(frozen=True)
class Readings:
    """What a robot's own sensors say, and what of the state follows from that."""

    state: RobotState
    """One world, float64; what no joint encoder or IMU measures is NaN."""
    torque: np.ndarray
    """(J,) joint torques, as the motors report them [Nm]."""


def robot_of(metadata: PolicyMetadata) -> RobotSpec:
    """The robot that a policy is for.

    Raises:
        PolicyError: cotap does not know it, or knows it with another value of an entry that is the robot's own.
    """
    if metadata.robot not in ROBOTS:
        raise PolicyError(f"the policy is for the robot {metadata.robot!r}; known: {', '.join(ROBOTS)}")
    spec = ROBOTS[metadata.robot]()
    terms, lower = actor_terms(len(spec.joints), len(spec.upper_joints)), len(spec.lower_joints)
    own = {
        "joints": list(spec.joint_names),
        "default_pose_rad": [j.default_rad for j in spec.joints],
        "kp": [j.kp for j in spec.joints],
        "kd": [j.kd for j in spec.joints],
        "joint_range_rad": [list(j.range_rad) for j in spec.joints],
        "velocity_limit_rad_s": [j.velocity_limit_rad_s for j in spec.joints],
        "nominal_height_m": spec.nominal_height_m,
        "agents": {"lower": [0, lower], "upper": [lower, len(spec.joints)]},
        "observation terms": [list(t) for t in terms],
    }
    for name, value in own.items():
        found = metadata.observation["terms"] if name == "observation terms" else getattr(metadata, name)
        if found != value:
            raise PolicyError(f"the policy was trained on a {spec.name} with other {name}: {found}, here {value}")
    limits = np.array([j.torque_limit_nm for j in spec.joints])
    shares = np.array(metadata.torque_limit_nm) / limits
    if not (shares[0] > 0.0 and np.allclose(shares, shares[0], rtol=1e-9, atol=0.0)):
        raise PolicyError(
            f"the policy was trained on a {spec.name} with other torque_limit_nm: {metadata.torque_limit_nm}, "
            f"not one factor times {limits.tolist()}"
        )
    return spec


def command_config(metadata: PolicyMetadata) -> CommandConfig:
    """The gait's period and the rates that commands change at. Raises PolicyError if they cannot be read."""
    try:
        cfg = from_plain(CommandConfig, metadata.commands)
        cfg.check()
    except (ValueError, TypeError) as error:
        raise PolicyError(f"the policy's metadata commands cannot be used: {error}") from error
    return cfg


def law_config(metadata: PolicyMetadata) -> UpperBodyConfig:
    """The laws that the arms were trained under. Raises PolicyError if they cannot be read."""
    try:
        # Files of earlier versions have neither of the last two.
        known = ("left", "right", "torso", "singularity_ratio")
        cfg = from_plain(UpperBodyConfig, {name: metadata.law[name] for name in known if name in metadata.law})
        cfg.check()
    except (ValueError, TypeError) as error:
        raise PolicyError(f"the policy's metadata law cannot be used: {error}") from error
    return cfg


class Controller:
    """The policy's loop: commands and gait clock, arm reference, observation history, targets, the arms' law.

    All but the networks (onnxruntime) is the environment's own code with one world, laws in float64.

    Args:
        policy: The policy.
        spec: Its robot.
        laws: What drives the arms.
        commands: How commands are drawn and approached.
        motion: The arms' reference.
        seed: Of random commands and random motion.
    """

    def __init__(
        self, policy: OnnxPolicy, spec: RobotSpec, laws: UpperBodyConfig, commands: CommandConfig,
        motion: ReferenceMotion, seed: int,
    ) -> None:  # fmt: skip
        if laws.torso.model == "support":
            raise ValueError("upper_body.torso.model 'support' needs foot contacts, which the robot does not measure")
        for arm in spec.arms:
            if (name := laws.of(arm.side).name) in SENSING_FORCE:
                raise ValueError(f"law {name!r} of the {arm.side} arm needs a hand's force, which is not measured")
        self._policy, self.dt = policy, policy.metadata.control_dt
        self._rng = torch.Generator().manual_seed(seed)
        self._everyone = torch.ones(1, dtype=torch.bool)
        self.commands = CommandSource(commands, 1, spec.nominal_height_m, self.dt)
        self._foresight = Foresight(spec) if commands.foresee_falls else None
        self._load_sense = LoadSense(spec, 1, self.dt, commands.brace_tilt_rad) if commands.lean_into_loads else None
        self._timing = StepTiming(spec, 1, self.dt, commands.step_correct_s) if commands.step_timing else None
        self.motion = motion
        self.upper_body = UpperBody(laws, spec, 1, self.dt, torch.float64)
        terms = actor_terms(len(spec.joints), len(spec.upper_joints))
        self._history = ObservationHistory(terms, 1, policy.metadata.observation["history"])
        self._default = torch.tensor([[j.default_rad for j in spec.joints]], dtype=torch.float64)
        self._kp, self._kd = np.array([j.kp for j in spec.joints]), np.array([j.kd for j in spec.joints])
        self._num_lower = len(spec.lower_joints)
        self._chains, self._shape = arm_chains(spec, torch.float64), (len(spec.arms), len(spec.arms[0].joints))
        self._action = np.zeros(len(spec.joints))
        self._started = False

    def restart(self) -> None:
        """Begin anew, with a fresh history: at the command that was given, or a random one, from rest."""
        self._started, self._action = False, np.zeros_like(self._action)
        self.upper_body.reset(self._everyone, self._rng)
        self.commands.reset(self._everyone, self._rng)
        if self._timing:
            self._timing.reset(self._everyone)
        if self._load_sense:
            self._load_sense.reset(self._everyone)
        self.motion.reset(self._everyone, self._rng)

    @property
    def initial_arms(self) -> np.ndarray:
        """(U,) where the arms' reference begins [rad]."""
        return self.motion.current().position[0].double().numpy()

    def arm_pose(self, joints: torch.Tensor) -> ChainPose:
        """Where arm joints (1, U) [rad] put the arms, in the torso frame."""
        return self._chains.pose(joints.unflatten(1, self._shape))

    def step(self, readings: Readings) -> JointLaw:
        """The law for the next control step. The first call fills the observation's history."""
        s = readings.state
        if self._started:
            turning = s.torso_angular_velocity_t
            if self._load_sense:
                torque = torch.from_numpy(readings.torque).unsqueeze(0)
                self._load_sense.step(s, self.commands.current(), torque)
                s = self._load_sense.felt(s)
            lean, command = leaning(s.projected_gravity_t, turning), self.commands.current()
            if self._foresight:
                lean = self._foresight.lean(lean, s, command)
            catch = self._timing.step(s, command, lean > self.commands.cfg.steady_rad) if self._timing else None
            braces = self._load_sense.braces if self._load_sense else None
            self.commands.step(self._rng, lean.float(), turning[:, 2].float(), catch, braces)
            self.upper_body.step(self.dt, self._rng)
        observed = self.motion.current().position
        values = actor_values(
            s, self.commands.current(), observed, self._default, torch.from_numpy(self._action).unsqueeze(0),
            torch.from_numpy(readings.torque[self._num_lower :]).unsqueeze(0),
        )  # fmt: skip
        present = self._history.scaled(values).float()
        fresh = torch.full((1,), not self._started)
        targets, self._action = self._policy(self._history.append(present, fresh)[0].numpy())
        self._started = True
        self.motion.step(self._rng)
        reference = self.motion.current()
        advance = (x[0].double().numpy() for x in (observed, reference.position, reference.velocity))
        targets[self._num_lower :] += arm_advance(self._policy.metadata, *advance)
        law = pd_law(self._kp, self._kd, targets)
        if not self.upper_body.active:
            return law
        self.upper_body.send(s, torch.from_numpy(targets[self._num_lower :]).unsqueeze(0), reference.velocity.double())
        return law.with_arms(self.upper_body.newest, self._num_lower)


def measured(truth: RobotState, **readings: Any) -> RobotState:
    """`truth` with `readings` in place of what they name, and NaN in place of what is not measured at all."""
    unknown = (
        "base_rotation_w", "torso_pos_w", "torso_linear_velocity_h", "foot_force", "foot_pos_w", "foot_velocity_w",
        "foot_up_w", "foot_forward_w",
    )  # fmt: skip
    blind = {name: torch.full_like(getattr(truth, name), torch.nan) for name in unknown}
    return dataclasses.replace(truth, **blind, **readings)
