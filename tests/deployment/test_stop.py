"""A robot that stops itself: for what, and what its motors do from that control step on."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from cotap.deployment.controller import Controller, Readings, measured
from cotap.deployment.engines import EngineConfig, make_engine
from cotap.deployment.joint_law import JointLaw, pd_law
from cotap.deployment.robot import Perturbations, Robot
from cotap.deployment.safety import SafetyConfig, Watchdog
from cotap.deployment.scenario import ArmMotion, Scenario, TimedCommand
from cotap.deployment.trial import Trial, run_trial
from cotap.envs.commands import CommandConfig
from cotap.envs.upper_body import UpperBodyConfig

ENGINE = EngineConfig(timestep=0.01, collision="feet", cone="pyramidal")
STANDS = Scenario(0.5, command=(TimedCommand(stand=True),))
AT = 10
"""The control step in which something breaks."""


def make_robot(spec, delay: int = 0) -> Robot:
    return Robot(make_engine(ENGINE, spec), ENGINE, spec, 0.02, Perturbations(delay_steps=(delay, delay)))


def a_reading(spec, **changes: torch.Tensor) -> Readings:
    """Of a robot that stands, but for what changes."""
    robot = make_robot(spec)
    robot.start(np.array([j.default_rad for j in spec.joints]), 0)
    readings = robot.read()
    torque = changes.pop("torque", None)
    return Readings(measured(readings.state, **changes), readings.torque if torque is None else torque.numpy())


def run(policy, spec, monkeypatch, delay: int, breaks: str) -> tuple[Trial, list[JointLaw], list[JointLaw]]:
    """A trial in which something breaks; the laws that were asked for, and those that motors had."""
    robot = make_robot(spec, delay)
    controller = Controller(
        policy, spec, UpperBodyConfig(), CommandConfig(), ArmMotion().reference(spec, robot.steps * ENGINE.timestep), 0
    )
    count, read, step, advance = itertools.count(), robot.read, controller.step, robot.engine.advance
    asked, had = [], []

    def broken_read() -> Readings:
        readings = read()
        if next(count) < AT:
            return readings
        if breaks == "encoder":
            readings.state.joint_pos[0, 3] = torch.nan
        if breaks == "tilt":
            readings.state.projected_gravity_t[0] = torch.tensor([0.9, 0.0, -0.436])
        return readings

    def broken_step(readings: Readings) -> JointLaw:
        law = step(readings)
        if breaks == "policy" and len(asked) >= AT:
            law = JointLaw(law.bias * np.nan, law.stiffness, law.damping)
        asked.append(law)
        return law

    def watched(law: JointLaw, *rest) -> None:
        had.append(law)
        advance(law, *rest)

    monkeypatch.setattr(robot, "read", broken_read)
    monkeypatch.setattr(controller, "step", broken_step)
    monkeypatch.setattr(robot.engine, "advance", watched)
    return run_trial(robot, controller, STANDS, SafetyConfig(ramp_s=0.0)), asked, had


@pytest.mark.parametrize("delay", [0, 5])
@pytest.mark.parametrize("breaks", ["policy", "encoder", "tilt"])
def test_a_stopped_robots_motors_only_damp_from_that_step_on(policy, spec, monkeypatch, delay, breaks):
    """However late its laws are: what is still on the way never arrives, nor does what stopped it."""
    trial, asked, had = run(policy, spec, monkeypatch, delay, breaks)
    assert trial.stopped_at_s == pytest.approx(AT * 0.02)
    for k in range(delay, AT):
        assert had[k] is asked[k - delay]
    assert len(had) > AT + 10
    kd = np.diag([j.kd for j in spec.joints])
    for law in had[AT:]:
        np.testing.assert_array_equal(law.bias, 0.0)
        np.testing.assert_array_equal(law.stiffness, 0.0)
        np.testing.assert_array_equal(law.damping, kd)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize(
    "reading", ["joint_pos", "joint_vel", "projected_gravity_t", "torso_angular_velocity_t", "torque"]
)
def test_no_reading_that_is_not_finite_passes(spec, reading, value):
    sound = a_reading(spec)
    dog = Watchdog(SafetyConfig(), spec.joint_names, np.full(19, 1e3), 0.02)
    assert dog.of_readings(sound) == ""
    own = torch.from_numpy(sound.torque) if reading == "torque" else getattr(sound.state, reading)
    bad = own.clone()
    bad.view(-1)[-1] = value
    assert dog.of_readings(a_reading(spec, **{reading: bad})) == "a reading is not finite"


@pytest.mark.parametrize("part", ["bias", "stiffness", "damping"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_no_law_that_is_not_finite_passes(spec, part, value):
    dog = Watchdog(SafetyConfig(), spec.joint_names, np.full(19, 1e3), 0.02)
    law = pd_law(np.ones(19), np.ones(19), np.zeros(19))
    assert dog.of_law(law) == ""
    getattr(law, part)[-1] = value
    assert dog.of_law(law) == "the policy's output is not finite"


@pytest.mark.parametrize("lean", [(1, 0), (-1, 0), (0, 1), (0, -1)])
def test_a_tilt_to_any_side_stops_beyond_its_limit(spec, lean):
    dog = Watchdog(SafetyConfig(max_tilt=0.7), spec.joint_names, np.full(19, 1e3), 0.02)
    for tilt, said in ((0.69, ""), (0.71, "the torso is tilted by 0.71 rad"), (3.0, "the torso is tilted by 3.00 rad")):
        x, y = np.sin(tilt) * np.array(lean)
        down = torch.tensor([[x, y, -np.cos(tilt)]])
        assert dog.of_readings(a_reading(spec, projected_gravity_t=down)) == said


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_at_its_limit_for_long_enough_stops(spec, sign):
    """0.1 s are five control steps of 20 ms; a joint just below its limit is not at it, nor do joints take turns."""
    limit = np.linspace(50.0, 230.0, 19)
    dog = Watchdog(SafetyConfig(saturation_s=0.1), spec.joint_names, limit, 0.02)

    def said(joint: int, share: float) -> str:
        torque = torch.zeros(19, dtype=torch.float64)
        torque[joint] = sign * share * limit[joint]
        return dog.of_readings(a_reading(spec, torque=torque))

    assert [said(7, 0.998) for _ in range(8)] == [""] * 8
    assert [said(k % 2, 1.0) for k in range(8)] == [""] * 8
    assert said(2, 0.0) == ""
    assert [said(2, 1.0) for _ in range(5)] == [*[""] * 4, f"{spec.joint_names[2]} is at its torque limit for 0.10 s"]
