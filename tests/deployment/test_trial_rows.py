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
from cotap.envs.scripted_forces import ForceProfile
from cotap.envs.upper_body import UpperBodyConfig

ENGINE = EngineConfig(timestep=0.01, collision="feet", cone="pyramidal")
ARMS = slice(7 + 11, None)
POSE = (0.1, 0.2, 0.0, 0.3, 0.1, -0.2, 0.0, 0.3)


def hands_w(data: mujoco.MjData) -> np.ndarray:
    return np.array([data.site(f"{side}_hand").xpos for side in ("left", "right")])


def askew(robot: Robot) -> None:
    """Turned by 2 rad, leaning by 0.2 rad, arms off the pose."""
    quat = np.array([math.cos(1.0), 0.0, 0.0, math.sin(1.0)])
    lean, turned = np.array([math.cos(0.1), 0.0, math.sin(0.1), 0.0]), np.zeros(4)
    mujoco.mju_mulQuat(turned, quat, lean)
    joints = np.array([j.default_rad for j in robot.spec.joints])
    joints[11:] = np.array(POSE) + 0.3
    robot.place(np.concatenate(([0.0, 0.0, robot.spec.base_height_m + 0.05], turned, joints)), np.zeros(6 + 19))


def yaw_of(data: mujoco.MjData, torso: str) -> np.ndarray:
    """From the world to the heading, (3, 3)."""
    x, y, _ = data.body(torso).xmat.reshape(3, 3)[:, 0]
    cos, sin = np.array([x, y]) / math.hypot(x, y)
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def test_rows_are_of_the_state_after_the_step_and_along_the_heading(policy, spec, monkeypatch):
    """Offsets and forces in the world, turned by the torso's yaw; torques by MuJoCo's gravity and Jacobians."""
    robot = Robot(make_engine(ENGINE, spec), ENGINE, spec, 0.02, Perturbations())
    monkeypatch.setattr(robot, "start", lambda _joints, _seed: askew(robot))
    motion, load = ArmMotion(pose=POSE).reference(spec, 0.02), np.array([8.0, -5.0, -12.0])
    controller = Controller(policy, spec, UpperBodyConfig(), CommandConfig(), motion, 0)
    scenario = Scenario(
        0.2,
        arms=ArmMotion(pose=POSE),
        command=(TimedCommand(stand=True),),
        force=(ForceProfile(tuple(load), "left", 0.0),),
    )
    trial = run_trial(robot, controller, scenario, SafetyConfig(ramp_s=0.0))
    assert len(trial.rows) == len(trial.qpos) == 10
    model, torso = robot.engine.model, spec.torso_body
    for row, qpos in zip(trial.rows, trial.qpos, strict=True):
        now, wanted = mujoco.MjData(model), mujoco.MjData(model)
        now.qpos[:], wanted.qpos[:] = qpos, qpos
        wanted.qpos[ARMS] = POSE
        for data in (now, wanted):
            mujoco.mj_forward(model, data)
        off_w, turn = hands_w(now) - hands_w(wanted), yaw_of(now, torso)
        np.testing.assert_allclose(row["hand_offset"][0], off_w @ turn.T, atol=1e-6)
        np.testing.assert_allclose(row["hand_error"][0], np.linalg.norm(off_w, axis=1), atol=1e-6)
        np.testing.assert_allclose(row["arm_error"][0], qpos[ARMS] - POSE, atol=1e-6)
        np.testing.assert_allclose(row["position"][0], now.body(torso).xpos[:2], atol=1e-6)
        assert float(row["height"]) == pytest.approx(now.body(torso).xpos[2], abs=1e-6)
        felt = np.zeros(model.nv)
        hand, body = now.site("left_hand").xpos, model.body(spec.arms[0].hand_body).id
        mujoco.mj_applyFT(model, now, turn.T @ load, np.zeros(3), hand, body, felt)
        np.testing.assert_allclose(row["arm_static_torque"][0], (now.qfrc_bias - felt)[6 + 11 :], atol=1e-5)
        share = row["torque_share"][0].numpy() * [joint.torque_limit_nm for joint in spec.joints]
        np.testing.assert_allclose(share[11:], row["arm_torque"][0].abs(), atol=1e-9)
        assert share.shape == (19,)
        assert share[:11].any()
        assert now.body(torso).xmat[8] < 0.995
        assert np.abs(off_w).max() > 0.01


def test_forces_on_hands_are_along_the_heading(spec, monkeypatch):
    robot, given = Robot(make_engine(ENGINE, spec), ENGINE, spec, 0.02, Perturbations()), []
    askew(robot)
    turn = yaw_of(robot.engine.data, spec.torso_body)
    monkeypatch.setattr(robot.engine, "advance", lambda _law, _steps, forces: given.extend(forces))
    forces_h = np.array([[8.0, -5.0, -12.0], [0.0, 3.0, 0.0]])
    robot.act(robot.holding(np.zeros(19)), forces_h)
    assert [(force.body, force.point) for force in given] == [(arm.hand_body, arm.hand_point) for arm in spec.arms]
    np.testing.assert_allclose([force.force_w for force in given], forces_h @ turn, atol=1e-9)
