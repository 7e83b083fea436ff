"""The example runner beside the package's own loop: the same readings in, the same targets out."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import onnx
import pytest

from cotap.deployment.controller import Controller, command_config, gait_config, robot_of
from cotap.deployment.engines import EngineConfig, make_engine
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.robot import Perturbations, Robot
from cotap.deployment.safety import SafetyConfig
from cotap.deployment.scenario import TimedCommand
from cotap.deployment.trial import start_up
from cotap.envs.upper_body import UpperBodyConfig
from cotap.motions.reference import ReferenceConfig, ReferenceMotion

EXAMPLE = Path(__file__).parents[2] / "examples" / "run_policy.py"
ENGINE = EngineConfig(timestep=0.01, collision="feet")
ASKED = {
    0: TimedCommand(velocity=(0.6, -0.2), yaw_rate=0.5),
    45: TimedCommand(stand=True, height_offset=-0.1),
    135: TimedCommand(velocity=(-0.3, 0.0)),
}
"""Commands, by the step from which they hold."""


@pytest.fixture
def example(monkeypatch) -> ModuleType:
    found = importlib.util.spec_from_file_location("run_policy", EXAMPLE)
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    monkeypatch.setitem(sys.modules, "run_policy", module)  # where dataclasses look for their annotations
    found.loader.exec_module(module)
    return module


@pytest.mark.parametrize("upper_mode", ["residual", "absolute"])
def test_the_runner_is_the_packages_loop(robot, upper_mode, random_policy, example):
    path = random_policy(robot=robot, upper_mode=upper_mode, output_gain=0.3)
    policy = OnnxPolicy(path)
    meta, spec = policy.metadata, robot_of(policy.metadata)
    motion = ReferenceMotion(ReferenceConfig(), spec, 1, meta.control_dt)
    controller = Controller(policy, spec, UpperBodyConfig(), command_config(meta), motion, seed=3)
    give(controller, ASKED[0])
    machine = Robot(make_engine(ENGINE, spec), ENGINE, spec, meta.control_dt, Perturbations())
    start_up(machine, controller, SafetyConfig(), seed=0)  # after which joints sag, and motors have torque
    pose = np.array([j.default_rad for j in spec.joints])
    pose[-len(controller.initial_arms) :] = controller.initial_arms
    runner = example.PolicyRunner(str(path), controller.initial_arms, float(controller.commands.gait.phase), pose)
    assert np.abs(machine.torque()).max() > 0.5
    machine.engine.hold(True)
    moved, rested = 0.0, False
    for k in range(150):
        if k in ASKED:
            asked = ASKED[k]
            give(controller, asked)
        readings = machine.read()
        s = readings.state
        law = controller.step(readings)
        sensors = example.Sensors(
            *(v[0].numpy() for v in (s.joint_pos, s.joint_vel, s.torso_angular_velocity_t, s.projected_gravity_t))
        )
        wanted = example.Command(
            asked.velocity, asked.yaw_rate, asked.stand, meta.nominal_height_m + asked.height_offset
        )
        targets = runner.step(sensors, wanted, motion.current().position[0].numpy())
        np.testing.assert_allclose(targets, controller.targets, rtol=0.0, atol=1e-5, err_msg=f"step {k}")
        machine.act(law, np.zeros((2, 3)))
        moved = max(moved, float(np.abs(machine.engine.qpos[7:] - pose).max()))
        rested = rested or bool(controller.commands.current().stand[0])
    assert gait_config(meta).period_s == runner.meta["gait"]["period_s"]
    assert rested  # and walked before and after
    assert not controller.commands.current().stand[0]
    assert moved > 0.1


def test_what_is_not_finite_ends_the_loop(policy_file, example):
    runner = example.PolicyRunner(str(policy_file))
    still = np.zeros_like(runner.default)
    down = np.array([0.0, 0.0, -1.0])
    runner.step(example.Sensors(runner.default, still, np.zeros(3), down), example.Command(), runner.reference)
    for name in ("joint_pos", "joint_vel", "angular_velocity", "gravity"):
        sensors = example.Sensors(runner.default.copy(), still.copy(), np.zeros(3), down.copy())
        getattr(sensors, name)[0] = np.nan
        with pytest.raises(ValueError, match=f"{name} must be finite"):
            runner.step(sensors, example.Command(), runner.reference)
    assert np.isfinite(runner.action).all()


def give(controller: Controller, asked: TimedCommand) -> None:
    asked.give(controller.commands, controller.metadata.nominal_height_m)


def test_it_needs_numpy_and_onnxruntime_alone(policy_file):
    code = "import sys; sys.modules.update(torch=None, cotap=None); sys.path.insert(0, sys.argv[1]); import run_policy"
    code += "; run_policy.main(sys.argv[2])"
    done = subprocess.run(
        [sys.executable, "-c", code, str(EXAMPLE.parent), str(policy_file)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == len(OnnxPolicy(policy_file).metadata.joints)


@pytest.mark.parametrize("upper_mode", ["residual", "absolute"])
def test_the_loop_is_checked_against_the_file(robot, upper_mode, random_policy, example, tmp_path, capsys):
    path = random_policy(robot=robot, upper_mode=upper_mode, output_gain=0.3)
    example.check(str(path))
    assert capsys.readouterr().out.count("differs from the file's by at most") == 2
    proto = onnx.load(path)
    golden = next(p for p in proto.metadata_props if p.key == "golden")
    content = json.loads(golden.value)
    content["readings"][-1]["joint_pos"] = content["readings"][-1]["joint_pos"][::-1]
    golden.value = json.dumps(content)
    onnx.save(proto, tmp_path / "p.onnx")
    with pytest.raises(SystemExit):
        example.check(str(tmp_path / "p.onnx"))


FAULTS = {
    "history newest first": ("terms for m in self.history", "terms for m in self.history[::-1]"),
    "action without its scale": (") / self.action_scale", ")"),
    "no limit of the command's rate": ("-self.velocity_rate, self.velocity_rate)", "-9.0, 9.0)"),
    "gait half as fast": ('self.dt / self.meta["gait"]', '0.5 * self.dt / self.meta["gait"]'),
    "torque without damping": (" - self.kd * s.joint_vel", ""),
    "reference of the step before": ("self.reference = np.array(arm_reference)", "self.reference = self.reference"),
    "never at rest": ("bool(to_stand and", "bool(0 and to_stand and"),
    "at rest without a stride on the spot": ("self.on_the_spot > 1.0", "self.on_the_spot > -1.0"),
    "no flag": ("float(self.stand)", "0.0"),
    "a phase at rest": ("0.0 if self.stand else np.cos(angle)", "np.cos(angle)"),
    "height at once": ("np.clip(asked_height - self.height, -rate, rate)", "asked_height - self.height"),
    "height ignored": ("nominal if command.height is None else", "nominal if True else"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_the_check_finds_faults_of_a_loop(fault, random_policy, tmp_path):
    right, wrong = FAULTS[fault]
    text = EXAMPLE.read_text(encoding="utf-8")
    assert text.count(right) == 1
    (tmp_path / "mine.py").write_text(text.replace(right, wrong), encoding="utf-8")
    path = str(random_policy(output_gain=0.3))
    for file, status in ((EXAMPLE, 0), (tmp_path / "mine.py", 1)):
        done = subprocess.run([sys.executable, str(file), "--check", path], capture_output=True, text=True)
        assert done.returncode == status, done.stderr


def test_it_refuses_arms_under_another_law(policy_file, example, tmp_path):
    proto = onnx.load(policy_file)
    law = next(p for p in proto.metadata_props if p.key == "law")
    law.value = law.value.replace('"name": "pd"', '"name": "cotap"', 1)
    onnx.save(proto, tmp_path / "p.onnx")
    with pytest.raises(ValueError, match="PD arms only"):
        example.PolicyRunner(str(tmp_path / "p.onnx"))
    done = subprocess.run([sys.executable, str(EXAMPLE), str(tmp_path / "p.onnx")], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("error: this runner drives PD arms only")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("arguments", [[], ["--check"], ["a.onnx", "b.onnx"]])
def test_without_a_file_it_says_how_it_is_used(arguments):
    done = subprocess.run([sys.executable, str(EXAMPLE), *arguments], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("A robot's loop around an exported policy")
