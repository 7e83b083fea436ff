"""A robot in an engine: what its sensors say, when laws reach its motors, and what is wrong with either."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cotap.checks import require_range
from cotap.deployment.controller import Readings, measured
from cotap.deployment.engines import Engine, EngineConfig, EngineState, PointForce
from cotap.deployment.joint_law import JointLaw, pd_law
from cotap.envs.state import RobotState, StateReader
from cotap.robots import RobotSpec

START_LIFT_M = 0.01
"""How much higher than standing a robot starts, as in training, so that no foot is in the floor [m]."""


@dataclass
class Perturbations:
    """Errors of timing, sensors, masses and first pose, as real robots have them. Drawn anew for every trial."""

    delay_steps: tuple[int, int] = (0, 0)
    """Least and most control steps that laws are late."""
    drop: float = 0.0
    """Chance that a reading is lost. The one before takes its place."""
    encoder_noise: float = 0.0
    """Most noise on joint positions, uniform [rad]."""
    velocity_noise: float = 0.0
    """Most noise on joint velocities, uniform [rad/s]."""
    mass_error: float = 0.0
    """Share by which all masses are off, up or down."""
    start_error: float = 0.0
    """Largest error of the first pose [rad]. Of joints, and of the base about x and y."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        low, high = self.delay_steps
        if not (isinstance(low, int) and isinstance(high, int) and 0 <= low <= high <= 50):
            raise ValueError(f"delay_steps must be integers with 0 <= low <= high <= 50, got {self.delay_steps}")
        require_range("drop", self.drop, 0.0, 0.99)
        require_range("encoder_noise", self.encoder_noise, 0.0, 1.0)
        require_range("velocity_noise", self.velocity_noise, 0.0, 100.0)
        require_range("mass_error", self.mass_error, 0.0, 0.9)
        require_range("start_error", self.start_error, 0.0, 0.5)


class Robot:
    """One robot, as its controller meets it.

    Args:
        engine: Where it lives.
        engine_cfg: As the engine was made.
        spec: The robot.
        control_dt: Control step [s].
        perturbations: What is wrong.

    Raises:
        ValueError: the control step is not a multiple of the physics step.
    """

    def __init__(
        self, engine: Engine, engine_cfg: EngineConfig, spec: RobotSpec, control_dt: float, perturbations: Perturbations
    ) -> None:
        perturbations.check()
        self.steps = round(control_dt / engine_cfg.timestep)
        if self.steps < 1 or abs(self.steps * engine_cfg.timestep - control_dt) > 1e-9:
            raise ValueError(f"timestep must divide the control step of {control_dt} s, got {engine_cfg.timestep} s")
        self.engine, self.spec, self.cfg = engine, spec, perturbations
        self.torque_limit = engine_cfg.torque_limit_scale * np.array([j.torque_limit_nm for j in spec.joints])
        self._kp, self._kd = np.array([j.kp for j in spec.joints]), np.array([j.kd for j in spec.joints])
        self._source = EngineState(engine)
        self._reader = StateReader(spec, self._source, torch.float64)
        self._rng = np.random.default_rng()
        self._queue: deque[JointLaw] = deque()
        self._last_reading: Readings | None = None
        self._truth: RobotState | None = None  # read once per control step

    def start(self, joints: np.ndarray, seed: int) -> None:
        """Stand at `joints` (J,) [rad], but for the perturbations, motors holding it there."""
        self._rng = rng = np.random.default_rng(seed)
        error = self.cfg.start_error * rng.uniform(-1.0, 1.0, len(joints) + 2)
        roll, pitch = 0.5 * error[:2]
        tilt = np.array([np.cos(roll) * np.cos(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.sin(pitch),
                         np.sin(roll) * np.sin(pitch)])  # fmt: skip
        position = np.array([0.0, 0.0, self.spec.base_height_m + START_LIFT_M])
        mass_scale = 1.0 + self.cfg.mass_error * rng.choice([-1.0, 1.0])
        low, high = self.cfg.delay_steps
        delay = int(rng.integers(low, high + 1))
        self.place(np.concatenate((position, tilt, joints + error[2:])), np.zeros(6 + len(joints)), mass_scale, delay)

    def place(self, qpos: np.ndarray, qvel: np.ndarray, mass_scale: float = 1.0, delay: int = 0) -> None:
        """Put the robot into a state, motors holding its joints there, with laws that arrive `delay` steps late."""
        self.engine.reset(qpos, qvel, mass_scale)
        self._truth = None
        self._queue = deque([self.holding(qpos[7:])] * (1 + delay))
        self._last_reading = None

    def holding(self, joints: np.ndarray) -> JointLaw:
        """PD control that holds `joints` (J,)."""
        return pd_law(self._kp, self._kd, joints)

    @property
    def damping(self) -> np.ndarray:
        """(J,) [Nms/rad]."""
        return self._kd

    def truth(self) -> RobotState:
        """The state as it is: for measures and for forces, never for the controller."""
        if self._truth is None:
            self._truth = self._reader.read()
        return self._truth

    def torque(self) -> np.ndarray:
        """(J,) what the motors give now, limits included [Nm]."""
        torque = self._queue[0].torque(self.engine.qpos[7:], self.engine.qvel[6:])
        return np.clip(torque, -self.torque_limit, self.torque_limit)

    def read(self) -> Readings:
        """What the sensors say."""
        truth = self.truth()
        q = truth.joint_pos + self._noise(self.cfg.encoder_noise, truth.joint_pos)
        dq = truth.joint_vel + self._noise(self.cfg.velocity_noise, truth.joint_vel)
        noisy = self.cfg.encoder_noise > 0.0
        arms = self._reader.arm_chains.pose(self._reader.arm_joints(q)) if noisy else truth.arms
        readings = Readings(measured(truth, joint_pos=q, joint_vel=dq, arms=arms), self.torque())
        if self._last_reading is not None and self._rng.random() < self.cfg.drop:
            return self._last_reading
        self._last_reading = readings
        return readings

    def act(
        self, law: JointLaw, hand_force_h: np.ndarray, at_once: bool = False, others: Sequence[PointForce] = ()
    ) -> None:
        """Let a control step pass.

        Args:
            law: For the motors, which it reaches with the robot's delay.
            hand_force_h: (A, 3) forces on the hands, heading frame [N].
            at_once: The law comes from the motor drivers themselves, as in a stop, and is not late.
            others: Forces elsewhere.
        """
        delay = len(self._queue) - 1
        self._queue = deque([law] * (1 + delay)) if at_once else self._queue
        self._queue.append(law)
        self._queue.popleft()
        heading = self.truth().heading_w[0].numpy()
        hands = zip(self.spec.arms, hand_force_h @ heading.T, strict=True)
        forces = [PointForce(arm.hand_body, arm.hand_point, force) for arm, force in hands if force.any()]
        self.engine.advance(self._queue[0], self.steps, [*forces, *others])
        self._truth = None

    def _noise(self, width: float, like: torch.Tensor) -> torch.Tensor:
        return (
            torch.from_numpy(self._rng.uniform(-width, width, tuple(like.shape))) if width else torch.zeros_like(like)
        )
