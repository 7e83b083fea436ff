"""What a trial records of its robot, against MuJoCo's own positions at the recorded states."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from cotap.deployment.controller import Controller
from cotap.deployment.engines import EngineConfig, make_engine
from cotap.deployment.robot import Perturbations, Robot
from cotap.deployment.safety import SafetyConfig
from cotap.deployment.scenario import ArmMotion, Scenario, TimedCommand
from cotap.deployment.trial import run_trial
from cotap.envs.commands import CommandConfig
from cotap.envs.upper_body import UpperBodyConfig

ENGINE = EngineConfig(timestep=0.01, collision="feet", cone="pyramidal")
ARMS = slice(7 + 11, None)
POSE = (0.1, 0.2, 0.0, 0.3, 0.1, -0.2, 0.0, 0.3)


def hands_w(data: mujoco.MjData) -> np.ndarray:
    return np.array([data.site(f"{side}_hand").xpos for side in ("left", "right")])


def test_rows_are_of_the_state_after_the_step_and_hands_along_the_heading(policy, spec):
    """A robot that starts askew, arms off their pose: offsets in the world, turned back by the torso's yaw."""
    robot = Robot(make_engine(ENGINE, spec), ENGINE, spec, 0.02, Perturbations(start_error=0.5))
    motion = ArmMotion(pose=POSE).reference(spec, 0.02)
    controller = Controller(policy, spec, UpperBodyConfig(), CommandConfig(), motion, 0)
    scenario = Scenario(0.2, arms=ArmMotion(pose=POSE), command=(TimedCommand(stand=True),))
    trial = run_trial(robot, controller, scenario, SafetyConfig(ramp_s=0.0), seed=7)
    assert len(trial.rows) == len(trial.qpos) == 10
    model, torso = robot.engine.model, spec.torso_body
    for row, qpos in zip(trial.rows, trial.qpos, strict=True):
        now, wanted = mujoco.MjData(model), mujoco.MjData(model)
        now.qpos[:], wanted.qpos[:] = qpos, qpos
        wanted.qpos[ARMS] = POSE
        for data in (now, wanted):
            mujoco.mj_kinematics(model, data)
        x_axis = now.body(torso).xmat.reshape(3, 3)[:, 0]
        yaw = math.atan2(x_axis[1], x_axis[0])
        turn = np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        off_w = hands_w(now) - hands_w(wanted)
        np.testing.assert_allclose(row["hand_offset"][0], off_w @ turn.T, atol=1e-6)
        np.testing.assert_allclose(row["hand_error"][0], np.linalg.norm(off_w, axis=1), atol=1e-6)
        np.testing.assert_allclose(row["arm_error"][0], qpos[ARMS] - POSE, atol=1e-6)
        np.testing.assert_allclose(row["position"][0], now.body(torso).xpos[:2], atol=1e-6)
        assert float(row["height"]) == pytest.approx(now.body(torso).xpos[2], abs=1e-6)
        assert now.body(torso).xmat[8] < 0.995
        assert np.abs(off_w).max() > 0.01
