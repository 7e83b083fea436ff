"""A robot's loop around an exported policy, with numpy (2 or later) and onnxruntime alone.

`python examples/run_policy.py policy.onnx` runs it for a second on sensors that always say the same: a robot at rest
in its default pose. A robot puts its own sensors and motors in their place, and calls `step` every `control_dt`.
`--check` takes the readings that the file has with it through the loop, and compares its targets and last observation
with the file's.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnxruntime


@dataclass
class Sensors:
    """J joints in the order of the metadata's `joints`; torso vectors in the torso link's frame."""

    joint_pos: np.ndarray  # (J,) [rad]
    joint_vel: np.ndarray  # (J,) [rad/s]
    angular_velocity: np.ndarray  # (3,) of the torso [rad/s]
    gravity: np.ndarray  # (3,) unit vector that points down


@dataclass
class Command:
    """What is asked for; the loop approaches it at the rates of training."""

    velocity: tuple[float, float] = (0.0, 0.0)  # forward and leftward [m/s]
    yaw_rate: float = 0.0  # to the left [rad/s]
    stand: bool = True
    height: float | None = None  # of the torso link above the ground [m], for robots that stand; None for nominal


class PolicyRunner:
    """Sensors, command and arm reference in, joint targets out; motors do `kp (target - q) - kd dq`, clipped.

    Args:
        path: What `cotap export` wrote, of a policy with PD arms.
        arm_reference: (U,) where the arms' reference begins [rad]; None for the default pose.
        phase: Where the gait begins, in [0, 1).
        held: (J,) where the motors hold the joints before the first step [rad]; None for motors without torque.
    """

    def __init__(
        self, path: str, arm_reference: np.ndarray | None = None, phase: float = 0.0, held: np.ndarray | None = None
    ) -> None:
        self.session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        self.meta = meta = {k: json.loads(v) for k, v in self.session.get_modelmeta().custom_metadata_map.items()}
        if any(meta["law"][side]["name"] != "pd" for side in ("left", "right")):
            raise ValueError("this runner drives PD arms only, and this policy's are under another law")
        arrays = ("default_pose_rad", "kp", "kd", "torque_limit_nm")
        self.default, self.kp, self.kd, self.limit = (np.array(meta[name]) for name in arrays)
        self.action_scale = np.array(meta["action"]["scale_rad"])
        self.dt, rates = meta["control_dt"], meta["commands"]
        # Single precision, as in training, so that the gait comes to rest in the same step.
        self.velocity, self.height = np.zeros(3, np.float32), np.float32(meta["nominal_height_m"])
        self.velocity_rate = self.dt * np.array(
            [rates["acceleration"], rates["acceleration"], rates["yaw_acceleration"]], np.float32
        )
        self.phase, self.stand, self.on_the_spot = np.float32(phase), True, np.float32(0.0)
        (num_arms,) = (width for name, width, _ in meta["observation"]["terms"] if name == "reference_arm_position")
        self.reference = self.default[-num_arms:] if arm_reference is None else np.array(arm_reference)
        self.action = np.zeros(len(self.default))
        self.targets = held
        self.observation = np.zeros(0, np.float32)
        self.history: list[dict[str, np.ndarray]] = []

    def step(self, sensors: Sensors, command: Command, arm_reference: np.ndarray) -> np.ndarray:
        """Joint targets (J,) [rad] for the coming control step, at whose end the arms are to be at `arm_reference`
        (U,) [rad]. Raises ValueError for what is not finite: motors must then only damp, and the loop begin anew."""
        _require_finite(**vars(sensors), velocity=command.velocity, reference=arm_reference)
        if not self.history:
            self.stand = command.stand  # the robot begins at rest, and with what it is asked for
        else:
            self.follow(command)
        present = self.observe(sensors)
        self.history = [*(self.history or [present] * self.meta["observation"]["history"])[1:], present]
        terms = [name for name, _, _ in self.meta["observation"]["terms"]]
        self.observation = np.concatenate([m[name] for name in terms for m in self.history]).astype(np.float32)
        (targets,) = self.session.run(None, {"observation": self.observation[None]})
        _require_finite(targets=targets)
        self.action = (np.asarray(targets)[0] - self.offset(self.reference)) / self.action_scale
        self.reference = np.array(arm_reference)
        self.targets = sent = self.offset(self.reference) + self.action_scale * self.action
        return sent

    def follow(self, command: Command) -> None:
        """Let the command approach what is asked for, and the gait go on; it rests with both feet down, after
        a stride on the spot."""
        asked = np.array([*command.velocity, command.yaw_rate], np.float32)
        self.velocity = self.velocity + np.clip(asked - self.velocity, -self.velocity_rate, self.velocity_rate)
        nominal = self.meta["nominal_height_m"]
        asked_height = np.float32(nominal if command.height is None else command.height)
        rate = self.meta["commands"]["height_rate"] * self.dt
        self.height = self.height + np.clip(asked_height - self.height, -rate, rate)
        to_stand = command.stand and not self.velocity.any()
        if self.stand and to_stand:
            return
        share = np.float32(self.dt / self.meta["gait"]["period_s"])  # of a stride
        self.on_the_spot = self.on_the_spot + share if to_stand else np.float32(0.0)
        half_strides = 2.0 * (self.phase + share)
        landed = np.floor(half_strides + 1e-4)
        both_down = landed > np.floor(2.0 * self.phase + 1e-4)
        self.stand = bool(to_stand and both_down and self.on_the_spot > 1.0 - 1e-4)
        self.phase = (0.5 * (landed if self.stand else half_strides)) % np.float32(1.0)

    def observe(self, s: Sensors) -> dict[str, np.ndarray]:
        """One step of the observation, every term times its scale."""
        arms, angle = slice(-len(self.reference), None), 2.0 * np.pi * self.phase
        torque = np.zeros(len(self.default))
        if self.targets is not None:
            torque = np.clip(self.kp * (self.targets - s.joint_pos) - self.kd * s.joint_vel, -self.limit, self.limit)
        values = {
            "torso_angular_velocity": s.angular_velocity,
            "projected_gravity": s.gravity,
            "command_velocity": self.velocity[:2],
            "command_yaw_rate": self.velocity[2:],
            "command_stand": float(self.stand),
            "command_height": self.height,
            "reference_arm_position": self.reference,
            "joint_position": s.joint_pos - self.default,
            "joint_velocity": s.joint_vel,
            "last_action": self.action,
            "sin_phase": 0.0 if self.stand else np.sin(angle),
            "cos_phase": 0.0 if self.stand else np.cos(angle),
            "arm_torque": torque[arms],
        }
        return {name: scale * np.atleast_1d(values[name]) for name, _, scale in self.meta["observation"]["terms"]}

    def offset(self, reference: np.ndarray) -> np.ndarray:
        """What scaled actions are added to (J,) [rad]."""
        if self.meta["action"]["upper_mode"] == "absolute":
            return self.default
        return np.concatenate((self.default[: -len(reference)], reference))


def _require_finite(**values: Any) -> None:
    for name, value in values.items():
        if not np.isfinite(value).all():
            raise ValueError(f"{name} must be finite, got {value}")


def check(path: str) -> None:
    """Compare the targets of every step, and the last observation, with the file's; exit with 1 where they differ."""
    runner = PolicyRunner(path)
    golden = runner.meta["golden"]
    runner.phase, worst = np.float32(golden["phase"]), {"joint_targets": 0.0}
    for r in golden["readings"]:
        sensors = Sensors(*(np.array(r[name]) for name in ("joint_pos", "joint_vel", "angular_velocity", "gravity")))
        targets = runner.step(sensors, Command(**r["command"]), np.array(r["arm_reference"]))
        worst["joint_targets"] = max(worst["joint_targets"], float(np.abs(targets - r["joint_targets"]).max()))
    worst["observation"] = float(np.abs(runner.observation - golden["observation"]).max())
    # A gain of hundreds turns what rounding does to targets into torque that is observed.
    for name, difference in worst.items():
        print(f"{name}: differs from the file's by at most {difference:.1e}")
    if not (worst["observation"] <= 1e-4 and worst["joint_targets"] <= 1e-5):
        sys.exit(1)


def main(path: str) -> None:
    """Run for a second on a robot that never moves, and show where its joints are sent."""
    runner = PolicyRunner(path)
    still = Sensors(runner.default, np.zeros_like(runner.default), np.zeros(3), np.array([0.0, 0.0, -1.0]))
    for _ in range(round(1.0 / runner.dt)):
        targets = runner.step(still, Command(), runner.reference)
    for name, target in zip(runner.meta["joints"], targets, strict=True):
        print(f"{name:24s}{target:8.3f} rad")


if __name__ == "__main__":
    try:
        match sys.argv[1:]:
            case ["--check", path]:
                check(path)
            case [path] if path != "--check":
                main(path)
            case _:
                sys.exit(__doc__)
    except ValueError as error:
        sys.exit(f"error: {error}")
