"""What runs on the robot at the control rate: readings in, joint law out."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
import torch

from cotap.checks import quoted, require_one_of
from cotap.compliance.kinematics import ChainPose
from cotap.compliance.laws import SENSING_FORCE
from cotap.configs import from_plain
from cotap.deployment.joint_law import JointLaw, pd_law
from cotap.deployment.metadata import PolicyError, PolicyMetadata
from cotap.deployment.policy import OnnxPolicy
from cotap.envs.commands import CommandConfig, CommandSource
from cotap.envs.gait_phase import GaitConfig
from cotap.envs.modulation import observed_laws
from cotap.envs.observations import ObservationHistory, Term, actor_terms, actor_values
from cotap.envs.state import RobotState
from cotap.envs.terminations import TerminationConfig
from cotap.envs.upper_body import UpperBody, UpperBodyConfig
from cotap.evaluation.rollout import UPPER_ACTIONS
from cotap.motions.generator import ArmReference
from cotap.robots import ROBOTS, RobotSpec
from cotap.robots.chains import arm_chains

Config = TypeVar("Config", CommandConfig, GaitConfig, TerminationConfig, UpperBodyConfig)


@dataclass(frozen=True)
class Readings:
    """What a robot's own sensors say, and what of the state follows from that."""

    state: RobotState
    """One env, float64; what no joint encoder or IMU measures is NaN."""
    torque: np.ndarray
    """(J,) joint torques, as the motors report them [Nm]."""


def robot_of(metadata: PolicyMetadata) -> RobotSpec:
    """The robot that a policy is for, with the torque limits that it was trained with.

    Raises:
        PolicyError: cotap does not know it, or knows it with another value of an entry that is the robot's own.
    """
    if metadata.robot not in ROBOTS:
        raise PolicyError(f"the policy is for the robot {quoted(metadata.robot)}; known: {', '.join(ROBOTS)}")
    spec = ROBOTS[metadata.robot]()
    own = {
        "joints": list(spec.joint_names),
        "default_pose_rad": [j.default_rad for j in spec.joints],
        "kp": [j.kp for j in spec.joints],
        "kd": [j.kd for j in spec.joints],
        "nominal_height_m": spec.nominal_height_m,
        "observation terms": [list(t) for t in observed_terms(metadata, spec)],
        "law_targets": law_config(metadata).modulation.targets([arm.side for arm in spec.arms]),
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
    joints = (
        dataclasses.replace(j, torque_limit_nm=t) for j, t in zip(spec.joints, metadata.torque_limit_nm, strict=True)
    )
    return dataclasses.replace(spec, joints=tuple(joints))


def observed_terms(metadata: PolicyMetadata, spec: RobotSpec) -> tuple[Term, ...]:
    """What is observed of `spec`, with the arms' torque if the policy sees it, and with the laws if it sets them."""
    sees_torque = "arm_torque" in (name for name, _, _ in metadata.observation["terms"])
    laws = law_config(metadata).modulation.terms(len(spec.arms))
    return actor_terms(len(spec.joints), len(spec.upper_joints), sees_torque, laws=laws)


def command_config(metadata: PolicyMetadata) -> CommandConfig:
    """Ranges of commands and the rates that they change at. Raises PolicyError if they cannot be read."""
    return _config(CommandConfig, "commands", metadata.commands)


def gait_config(metadata: PolicyMetadata) -> GaitConfig:
    """The stride. Raises PolicyError if it cannot be read."""
    return _config(GaitConfig, "gait", metadata.gait)


def termination_config(metadata: PolicyMetadata) -> TerminationConfig:
    """What is a fall. Raises PolicyError if it cannot be read."""
    return _config(TerminationConfig, "terminations", metadata.terminations)


def law_config(metadata: PolicyMetadata) -> UpperBodyConfig:
    """The laws that the arms were trained under, with fixed parameters. Raises PolicyError if they cannot be read."""
    laws = _config(UpperBodyConfig, "law", metadata.law)
    laws.sampling.enabled = False
    return laws


def _config(cls: type[Config], entry: str, plain: dict[str, Any]) -> Config:
    try:
        cfg = from_plain(cls, plain)
        cfg.check()
    except (ValueError, TypeError) as error:
        raise PolicyError(f"the policy's metadata {entry} cannot be used: {error}") from error
    return cfg


class ArmMotion(Protocol):
    """What the arms' reference is to a controller: see `ReferenceMotion`."""

    def current(self) -> ArmReference: ...
    def step(self, rng: torch.Generator) -> None: ...
    def reset(self, mask: torch.Tensor, rng: torch.Generator) -> None: ...


class Controller:
    """The policy's loop: observation history, gait phase, and the arms' law, perhaps as the policy sets it.

    All but the networks (onnxruntime) is the environment's own code with one env, laws in float64.

    Args:
        policy: The policy.
        spec: Its robot.
        laws: What drives the arms.
        commands: How commands are drawn and approached.
        motion: The arms' reference.
        seed: Of random commands and random motion.
        upper_actions: What moves the arms: policy, or reference for the raw reference in place of its upper actions.
    """

    def __init__(
        self, policy: OnnxPolicy, spec: RobotSpec, laws: UpperBodyConfig, commands: CommandConfig,
        motion: ArmMotion, seed: int, upper_actions: str = "policy",
    ) -> None:  # fmt: skip
        if laws.torso.model == "support":
            raise ValueError("upper_body.torso.model 'support' needs foot contacts, which the robot does not measure")
        for arm in spec.arms:
            if (name := laws.of(arm.side).name) in SENSING_FORCE:
                raise ValueError(f"law {name!r} of the {arm.side} arm needs a hand's force, which is not measured")
        self._policy, self.metadata, self.dt = policy, policy.metadata, policy.metadata.control_dt
        self._rng = torch.Generator().manual_seed(seed)
        self._everyone = torch.ones(1, dtype=torch.bool)
        self.commands = CommandSource(commands, gait_config(policy.metadata), 1, spec.nominal_height_m, self.dt)
        self.motion = motion
        self.upper_body = UpperBody(laws, spec, 1, self.dt, torch.float64)
        terms = observed_terms(policy.metadata, spec)
        self._history = ObservationHistory(terms, 1, policy.metadata.observation["history"])
        self._default = torch.tensor([[j.default_rad for j in spec.joints]], dtype=torch.float64)
        self._kp, self._kd = np.array([j.kp for j in spec.joints]), np.array([j.kd for j in spec.joints])
        self._num_lower = len(spec.lower_joints)
        self._raw_arms = require_one_of("upper_actions", upper_actions, UPPER_ACTIONS) == "reference"
        self._chains, self._shape = arm_chains(spec, torch.float64), (len(spec.arms), len(spec.arms[0].joints))
        self._action = np.zeros(len(spec.joints))
        self.targets = np.array([j.default_rad for j in spec.joints])
        """(J,) where joints were sent last [rad]."""
        self._started = False

    def restart(self) -> None:
        """Begin anew, with a fresh history: at the command that was given, or a random one, from rest."""
        self._started, self._action = False, np.zeros_like(self._action)
        self.upper_body.reset(self._everyone, self._rng)
        self.commands.reset(self._everyone, self._rng)
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
        if self._started:
            self.commands.step(self._rng)
        observed = self.motion.current().position
        values = observed_laws(self.upper_body.parameters) | actor_values(
            readings.state, self.commands.current(), observed, self._default, torch.from_numpy(self._action)[None],
            torch.from_numpy(readings.torque[self._num_lower :])[None],
        )  # fmt: skip
        present = self._history.scaled(values).float()
        fresh = torch.full((1,), not self._started)
        self._started = True
        found = self._policy(self._history.append(present, fresh)[0].numpy())
        targets, wanted = np.split(found, [len(self._action)])
        seen = observed[0].double().numpy()
        self._modulate(torch.from_numpy(wanted)[None])
        self._action = self._policy.action(targets, seen)
        self.motion.step(self._rng)
        reference = self.motion.current()
        # The arms are sent where the reference will be at the step's end, not where it was observed.
        coming = reference.position[0].double().numpy()
        targets += self._policy.offset(coming) - self._policy.offset(seen)
        if self._raw_arms:
            targets[self._num_lower :] = coming
            self._action = self._policy.action(targets, coming)
        self.targets = targets
        law = pd_law(self._kp, self._kd, targets)
        if not self.upper_body.active:
            return law
        arms = torch.from_numpy(targets[self._num_lower :])[None]
        self.upper_body.send(readings.state, arms, reference.velocity.double())
        return law.with_arms(self.upper_body.newest, self._num_lower)

    def _modulate(self, wanted: torch.Tensor) -> None:
        """Move the laws towards what the policy asks for (1, M), or holds with the raw reference."""
        modulation = self.upper_body.modulation
        if modulation.active:
            if self._raw_arms:
                wanted = modulation.wanted(torch.zeros_like(wanted))
            modulation.approach(self.upper_body.parameters, wanted)


def measured(truth: RobotState, **readings: Any) -> RobotState:
    """`truth` with `readings` in place of what they name, and NaN in place of what is not measured at all."""
    unknown = (
        "base_rotation_w", "torso_pos_w", "torso_linear_velocity_h", "foot_force", "foot_pos_w", "foot_velocity_w",
        "foot_up_w", "foot_forward_w",
    )  # fmt: skip
    blind = {name: torch.full_like(getattr(truth, name), torch.nan) for name in unknown}
    return dataclasses.replace(truth, **blind, **readings)
