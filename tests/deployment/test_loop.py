"""The loop around a policy: start-up, perturbations, safe stop, scenarios, reports, bad input."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
import re
import tty

import numpy as np
import onnx
import pytest
import torch

from cotap.deploy import main as deploy
from cotap.deployment import keyboard
from cotap.deployment.controller import Controller, Readings, law_config, measured, robot_of
from cotap.deployment.engines import EngineConfig, make_engine
from cotap.deployment.joint_law import JointLaw, damped_law, pd_law
from cotap.deployment.keyboard import Stick
from cotap.deployment.metadata import PolicyError
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.robot import Perturbations, Robot
from cotap.deployment.safety import SafetyConfig, Watchdog
from cotap.deployment.scenario import ArmMotion, Scenario, TimedCommand, load_scenario
from cotap.deployment.trial import Trial, run_trial, start_up, trajectory
from cotap.deployment.trials import report
from cotap.envs.commands import CommandConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.envs.upper_body import UpperBodyConfig
from cotap.motions import MotionLibrary, shipped_library

FAST = EngineConfig(timestep=0.01, collision="feet", cone="pyramidal")
FREE = np.zeros((2, 3))

TRAINED = CommandConfig(
    velocity_x=(-1.0, 1.0), velocity_y=(-0.5, 0.5), yaw_rate=(-0.8, 0.8), height_offset=(-0.2, 0.02)
)


def make_robot(spec, perturbations: Perturbations | None = None) -> Robot:
    return Robot(make_engine(FAST, spec), FAST, spec, 0.02, perturbations or Perturbations())


def make_controller(policy, spec, laws: UpperBodyConfig | None = None, seed: int = 0) -> Controller:
    motion = ArmMotion().reference(spec, 0.02)
    return Controller(policy, spec, laws or UpperBodyConfig(), CommandConfig(), motion, seed)


@pytest.fixture
def default(spec):
    return np.array([j.default_rad for j in spec.joints])


def test_the_controller_sees_nothing_that_a_robot_does_not_measure(policy, spec):
    """Readings hold NaN for the rest, and NaN would spread into every law."""
    laws = UpperBodyConfig()
    laws.left.name = "cotap"
    robot, controller = make_robot(spec), make_controller(policy, spec, laws)
    start_up(robot, controller, SafetyConfig(ramp_s=0.0), 0)
    for _ in range(3):
        readings = robot.read()
        assert torch.isnan(readings.state.torso_pos_w).all()
        assert torch.isnan(readings.state.torso_linear_velocity_h).all()
        law = controller.step(readings)
        assert np.isfinite(law.bias).all()
        assert np.isfinite(law.stiffness).all()
        robot.act(law, FREE)
    laws.torso.model = "support"
    with pytest.raises(ValueError, match="foot contacts"):
        make_controller(policy, spec, laws)


def test_laws_of_joints_are_affine_torques():
    kp, kd = np.array([10.0, 20.0]), np.array([1.0, 2.0])
    law = pd_law(kp, kd, np.array([0.5, -0.5]))
    q, dq = np.array([0.1, 0.2]), np.array([0.3, -0.4])
    np.testing.assert_allclose(law.torque(q, dq), [10.0 * 0.4 - 0.3, -20.0 * 0.7 + 0.8])
    np.testing.assert_allclose(law.ramped(0.25).torque(q, dq), [0.25 * 4.0 - 0.3, -0.25 * 14.0 + 0.8])
    np.testing.assert_allclose(damped_law(kd).torque(q, dq), [-0.3, 0.8])


def test_gains_ramp_while_the_base_is_held(policy, spec):
    robot, controller = make_robot(spec, Perturbations(start_error=0.1)), make_controller(policy, spec)
    robot.start(np.array([j.default_rad for j in spec.joints]), seed=3)
    wrong = robot.engine.qpos.copy()
    torques = []
    act = robot.act
    robot.act = lambda law, force, at_once=False: (torques.append(law.stiffness[0, 0]), act(law, force, at_once))[1]
    start_up(robot, controller, SafetyConfig(ramp_s=1.0, settle_s=0.5), 3)
    assert len(torques) == 75
    assert torques[0] == pytest.approx(150.0 / 50.0)
    assert torques[49:] == pytest.approx([150.0] * 26)
    np.testing.assert_allclose(robot.engine.qpos[:7], wrong[:7], atol=2e-3)  # held as it was, tilt and all
    assert 0.01 < np.abs(wrong[4:6]).max() < 0.06
    joints = np.array([j.default_rad for j in spec.joints])
    assert np.abs(wrong[7:] - joints).max() > 0.08
    assert np.abs(robot.engine.qpos[18:] - joints[11:]).max() < 0.02  # arms brought to the pose, but for gravity
    robot.act(robot.holding(joints), FREE)
    before = robot.engine.qpos[2]
    for _ in range(4):
        robot.act(robot.holding(joints), FREE)
    assert robot.engine.qpos[2] < before - 5e-4  # let go


def test_laws_are_late_by_the_delay_but_a_stop_is_not(spec, default):
    robot = make_robot(spec, Perturbations(delay_steps=(2, 2)))
    robot.start(default, 0)
    laws = [pd_law(np.zeros(19), np.zeros(19), np.zeros(19)) for _ in range(3)]
    marked = [JointLaw(law.bias + i + 1.0, law.stiffness, law.damping) for i, law in enumerate(laws)]
    felt = []
    for law in marked:
        robot.act(law, FREE)
        felt.append(robot.torque()[0])
    assert abs(felt[0]) < 10.0
    assert felt[0] != pytest.approx(1.0)
    assert felt[2] == pytest.approx(1.0)
    robot.act(damped_law(np.zeros(19)), FREE, at_once=True)
    assert robot.torque()[0] == 0.0


def test_delays_are_drawn_from_all_of_their_range(spec, default):
    robot, found = make_robot(spec, Perturbations(delay_steps=(1, 3))), set()
    still = pd_law(np.zeros(19), np.zeros(19), np.zeros(19))
    marked = JointLaw(still.bias + 1.0, still.stiffness, still.damping)
    for seed in range(20):
        robot.start(default, seed)
        late = 0
        robot.act(marked, FREE)
        while robot.torque()[0] != 1.0:
            robot.act(marked, FREE)
            late += 1
        found.add(late)
    assert found == {1, 2, 3}


def test_readings_are_lost_and_noisy_as_configured(spec, default):
    robot = make_robot(spec, Perturbations(drop=0.3, encoder_noise=0.01, velocity_noise=0.5))
    robot.start(default, 0)
    robot.engine.hold(True)
    errors, rates, lost, last = [], [], 0, None
    for _ in range(300):
        readings = robot.read()
        if readings is last:
            lost += 1
        else:
            errors.append(readings.state.joint_pos[0].numpy() - robot.engine.qpos[7:])
            rates.append(readings.state.joint_vel[0].numpy() - robot.engine.qvel[6:])
        last = readings
    assert lost == pytest.approx(90, abs=30)
    assert np.abs(errors).max() == pytest.approx(0.01, rel=0.02)
    assert np.std(errors) == pytest.approx(0.01 / np.sqrt(3.0), rel=0.05)
    assert np.abs(rates).max() == pytest.approx(0.5, rel=0.02)


def test_masses_are_wrong_by_the_share_in_both_directions(spec, default):
    robot = make_robot(spec, Perturbations(mass_error=0.2))
    found = set()
    for seed in range(8):
        robot.start(default, seed)
        found.add(round(float(robot.engine.model.body_mass.sum() / 51.437), 3))
    assert found == {0.8, 1.2}


def readings_of(robot: Robot, **changes) -> Readings:
    readings = robot.read()
    state = measured(readings.state, **{k: v for k, v in changes.items() if k != "torque"})
    return Readings(state, changes.get("torque", readings.torque))


def test_the_watchdog_names_what_it_stops_for(spec, default):
    robot = make_robot(spec)
    robot.start(default, 0)
    law = robot.holding(default)
    limit = robot.torque_limit

    def fresh():
        return Watchdog(SafetyConfig(), spec.joint_names, limit, 0.02)

    assert fresh().of_readings(robot.read()) == ""
    nan = robot.read().state.joint_vel.clone()
    nan[0, 3] = torch.nan
    assert "reading is not finite" in fresh().of_readings(readings_of(robot, joint_vel=nan))
    bad = JointLaw(law.bias * np.nan, law.stiffness, law.damping)
    assert fresh().of_law(law) == ""
    assert "policy's output is not finite" in fresh().of_law(bad)
    down = torch.tensor([[0.9, 0.0, -0.436]], dtype=torch.float64)
    assert "tilted by 1.12 rad" in fresh().of_readings(readings_of(robot, projected_gravity_t=down))
    dog, torque = fresh(), np.zeros(19)
    torque[spec.joint_names.index("left_elbow")] = -limit[-5]
    for _ in range(49):
        assert dog.of_readings(readings_of(robot, torque=torque)) == ""
    assert dog.of_readings(readings_of(robot, torque=0.9 * torque)) == ""  # a breath, and counting starts anew
    for _ in range(49):
        assert dog.of_readings(readings_of(robot, torque=torque)) == ""
    assert "left_elbow is at its torque limit for 1.00 s" in dog.of_readings(readings_of(robot, torque=torque))


def test_a_policy_that_breaks_is_stopped_damped_and_counted(policy, spec):
    class Broken:
        metadata, offset, action = policy.metadata, policy.offset, policy.action
        calls = 0

        def __call__(self, observation):
            self.calls += 1
            targets = policy(observation)
            return targets * np.nan if self.calls > 10 else targets

    robot, controller = make_robot(spec), make_controller(Broken(), spec)
    command = TimedCommand(stand=True)
    trial = run_trial(robot, controller, Scenario(5.0, command=(command,)), SafetyConfig(ramp_s=0.0))
    assert trial.stopped == "the policy's output is not finite"
    assert trial.stopped_at_s == pytest.approx(0.2)
    assert trial.fell
    assert len(trial.rows) == 10 + 50  # and a second of what followed
    assert np.isfinite(np.stack(trial.qpos)).all()
    assert trial.qpos[-1][2] < 0.8  # it sank
    assert np.abs(robot.engine.qvel).max() < 8.0  # and did not thrash


def test_an_encoder_that_breaks_stops_the_robot_under_every_law(policy, spec, monkeypatch):
    """One joint's angle is NaN from the eleventh reading on: before it gets to the law, which could not bear it."""
    laws = UpperBodyConfig()
    laws.left.name, laws.left.damping = "cotap", "critical"
    robot, controller = make_robot(spec), make_controller(policy, spec, laws)
    count, read = itertools.count(), robot.read

    def broken() -> Readings:
        readings = read()
        if next(count) >= 10:
            readings.state.joint_pos[0, spec.joint_names.index("left_elbow")] = torch.nan
        return readings

    monkeypatch.setattr(robot, "read", broken)
    trial = run_trial(robot, controller, Scenario(2.0, command=(TimedCommand(stand=True),)), SafetyConfig(ramp_s=0.0))
    assert trial.stopped == "a reading is not finite"
    assert trial.stopped_at_s == pytest.approx(0.2)
    assert np.isfinite(np.stack(trial.qpos)).all()


def test_it_feels_the_forces_and_meets_commands_at_their_times(policy, spec):
    commands = (TimedCommand(stand=True), TimedCommand(at=0.1, velocity=(0.6, 0.0)))
    hands = []
    for force in ((), (ForceProfile((0.0, 0.0, -20.0), "left", 0.2),)):
        scenario = Scenario(0.6, command=commands, force=force)
        trial = run_trial(make_robot(spec), make_controller(policy, spec), scenario, SafetyConfig())
        assert not trial.fell
        t = trajectory([trial], 30)
        assert t.stand[:5].all()
        assert not t.stand[5:].any()
        assert t.command[-1, 0].tolist() == pytest.approx([0.6, 0.0, 0.0])
        hands.append(t.hand_offset[:, 0, :, 2])
    moved = hands[1] - hands[0]
    assert moved[:10].abs().max() == 0.0
    assert moved[-1, 0] < -0.01
    assert moved[-1, 1].abs() < 0.2 * moved[-1, 0].abs()  # the torso leans, and no more


@pytest.mark.slow
def test_the_shipped_policy_walks_in_the_loop(shipped_file, spec):
    policy = OnnxPolicy(shipped_file)
    commands = (TimedCommand(stand=True), TimedCommand(at=0.5, velocity=(0.6, 0.0)))
    trial = run_trial(make_robot(spec), make_controller(policy, spec), Scenario(4.0, command=commands), SafetyConfig())
    assert not trial.fell
    # How closely a policy follows is its evaluation's matter; here it walks about as fast as it is asked to.
    assert trajectory([trial], 200).velocity[100:, 0, 0].mean() == pytest.approx(0.6, rel=0.3)


@pytest.mark.parametrize(("field", "value"), [("max_tilt_rad", 0.01), ("min_height", 0.99)])
def test_a_fall_is_what_the_policy_was_trained_to_call_one(field, value, policy, spec):
    """The robot stands well; by a stricter limit it has fallen."""
    terminations = policy.metadata.terminations | {field: value}

    class Strict:
        metadata = dataclasses.replace(policy.metadata, terminations=terminations)
        offset, action = policy.offset, policy.action

        def __call__(self, observation):
            return policy(observation)

    scenario = Scenario(0.4, command=(TimedCommand(stand=True),))
    fell = [
        run_trial(make_robot(spec), make_controller(p, spec), scenario, SafetyConfig(ramp_s=0.0)).fell
        for p in (policy, Strict())
    ]
    assert fell == [False, True]


def test_a_short_trial_is_padded_as_fallen(policy, spec):
    robot, controller = make_robot(spec), make_controller(policy, spec)
    trial = run_trial(robot, controller, Scenario(0.2, command=(TimedCommand(stand=True),)), SafetyConfig(ramp_s=0.0))
    cut = Trial(trial.dt, trial.rows[:5], fell=True)
    cut.rows[-1] = cut.rows[-1] | {"fell": torch.tensor([True])}
    t = trajectory([trial, cut], 10)
    assert t.velocity.shape == (10, 2, 3)
    assert t.alive().tolist() == [[True, k < 4] for k in range(10)]


def test_a_trial_that_diverged_is_padded_as_fallen(policy, policy_file, spec):
    robot, controller = make_robot(spec), make_controller(policy, spec)
    trial = run_trial(robot, controller, Scenario(0.1, command=(TimedCommand(stand=True),)), SafetyConfig(ramp_s=0.0))
    trial.fell = True  # in a step of which there is no row
    assert trajectory([trial], 10).alive()[:, 0].tolist() == [k < 5 for k in range(10)]
    assert _measured([trial], policy, policy_file)["episode_length_fraction"] == pytest.approx(0.5)
    assert _measured([trial], policy, policy_file)["fall_fraction"] == 1.0
    trial.fell = False  # a pilot has had enough
    assert _measured([trial], policy, policy_file)["episode_length_fraction"] == pytest.approx(1.0)
    assert _measured([trial], policy, policy_file)["fall_fraction"] == 0.0


def _measured(trials, policy, path):
    """Means of what `report` says of these trials of a scenario of 0.2 s."""
    content = report(
        trials, path, policy, law_config(policy.metadata), EngineConfig(), Perturbations(), SafetyConfig(),
        Scenario(0.2), 0, 0.0,
    )  # fmt: skip
    return {name: part["mean"] for name, part in content["metrics"].items()}


def test_random_directions_are_drawn_from_the_trials_seed(spec):
    profile = ForceProfile((50.0, 0.0, -5.0), "left", 0.0, random_direction=True)
    drawn = [Scenario(1.0, force=(profile,)).forces(spec, 0.02, seed)[0].amplitude_h[0, 0] for seed in (1, 1, 2)]
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    for force in drawn:
        assert float(force[:2].norm()) == pytest.approx(50.0, rel=1e-5)
        assert float(force[2]) == -5.0


SCENARIO = """
seconds = 1.0
left = "cotap:alpha=0.7,stiffness=500"
right = "pd"
[arms]
pose = [0.1, 0.2, 0.0, 0.3, 0.1, -0.2, 0.0, 0.3]
[[command]]
velocity = [0.4, 0.0]
[[command]]
at = 0.5
stand = true
height_offset = -0.1
[[force]]
hand = "both"
force = [0.0, 0.0, -30.0]
start_s = 0.2
period_s = 4.0
"""


def test_a_scenario_is_read_and_run(policy_file, tmp_path, spec, capsys):
    path, out = tmp_path / "s.toml", tmp_path / "r.json"
    path.write_text(SCENARIO)
    scenario = load_scenario(path, spec)
    assert scenario.command[1] == TimedCommand(at=0.5, stand=True, height_offset=-0.1)
    assert scenario.force[0] == ForceProfile((0.0, 0.0, -30.0), "both", 0.2, period_s=4.0)
    args = ["--policy", str(policy_file), "--scenario", str(path), "--json", str(out), "--timestep", "0.01",
            "--collision", "feet", "--trials", "2", "--start-error", "0.02", "--drop", "0.05"]  # fmt: skip
    assert deploy(args) == 0
    assert "0 of 2 trials fell" in capsys.readouterr().out
    result = json.loads(out.read_text())
    assert (result["num_trials"], result["num_falls"], result["engine"]) == (2, 0, "mujoco")
    assert result["settings"]["laws"]["left"]["alpha"] == 0.7
    assert result["settings"]["perturbations"]["drop"] == 0.05
    assert result["metrics"]["e_lin"]["mean"] is None or result["metrics"]["e_lin"]["mean"] < 1.0
    assert [t["seconds"] for t in result["trials"]] == pytest.approx([1.0, 1.0])
    assert [t["touched_s"] for t in result["trials"]] == [{}, {}]


def test_what_no_training_had_is_noted(policy_file, tmp_path, capsys):
    path = tmp_path / "s.toml"
    path.write_text("seconds = 0.1\n[[command]]\nvelocity = [4.0, 0.0]\n[[command]]\nat = 0.04\nstand = true\n"
                    "height_offset = 0.02\n[[command]]\nat = 0.08\nstand = true\nheight_offset = -0.4\n")  # fmt: skip
    assert deploy(["--policy", str(policy_file), "--scenario", str(path)]) == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if line.startswith("note: ")]
    assert [note.split(" is beyond")[0] for note in notes] == [
        "note: forward velocity 4 at 0 s",
        "note: height offset -0.4 at 0.08 s",
    ]


def test_the_level_of_the_stores_is_reported(policy_file, tmp_path):
    out = tmp_path / "r.json"
    args = ["--policy", str(policy_file), "--left", "cotap:store_energy=0.5", "--right", "pd", "--passive",
            "--episode-seconds", "0.4", "--json", str(out), "--timestep", "0.01", "--collision", "feet"]  # fmt: skip
    assert deploy(args) == 0
    result = json.loads(out.read_text())
    (trial,) = result["trials"]
    assert 0.0 < trial["lowest_store_energy"] <= 0.5
    assert 0.0 <= trial["held_back"] <= 1.0
    laws = result["settings"]["laws"]
    assert (laws["left"]["passive"], laws["right"]["passive"]) == (True, False)


@pytest.mark.parametrize(("given", "held"), [([], False), (["--left", "cotap:alpha=0.2"], True)])
def test_a_law_that_is_given_is_not_set_by_the_policy(given, held, random_policy, tmp_path):
    out, path = tmp_path / "r.json", random_policy(output_gain=1.0, modulation="stiffness")
    args = ["--policy", str(path), *given, "--episode-seconds", "0.4", "--json", str(out), "--timestep", "0.01"]
    assert deploy(args) == 0
    laws = json.loads(out.read_text())["settings"]["laws"]
    assert laws["modulation"]["held"] == held
    assert laws["left"]["alpha"] == (0.2 if held else 0.4)


@pytest.mark.parametrize("engine", ["mujoco", "pybullet"])
def test_every_robot_is_deployed(robot, engine, random_policy, tmp_path):
    if engine == "pybullet":
        pytest.importorskip("pybullet")
    out = tmp_path / "r.json"
    arguments = [
        "--policy",
        str(random_policy(robot=robot)),
        "--engine",
        engine,
        "--episode-seconds",
        "0.2",
        "--json",
        str(out),
    ]
    assert deploy(arguments) == 0
    result = json.loads(out.read_text())
    assert (result["num_trials"], result["num_falls"], result["stops"]) == (1, 0, {})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seconds = ", "is not TOML"),
        ("seconds = " + 100_000 * "[", "is not TOML"),
        ("[[command]]\nyaw_rate = 5.1", r"command\[0\].yaw_rate must lie in"),
        ("[[command]]\nyaw_rate = -5.1", r"command\[0\].yaw_rate must lie in"),
        ("speed = 1", "has no field 'speed'"),
        ("seconds = -1", "seconds must lie in"),
        ("seconds = 'long'", "seconds must be of type float"),
        ("command = 3", "command must be a list"),
        ("arms = 'up'", "arms must be a table"),
        ("[[command]]\nvelocity = [1.0]", r"command\[0\].velocity must have 2 entries"),
        ("[[command]]\nstand = 1", r"command\[0\].stand must be of type bool"),
        ("[[command]]\nstand = true\nvelocity = [0.1, 0.0]", "stands and moves"),
        ("[[command]]\nat = 0.5", r"command\[0\].at must be 0, .*got 0.5 s"),
        ("[[command]]\n[[command]]\nat = 2\n[[command]]\nat = 1", "before the one ahead"),
        ("[[force]]\nforce = [1, 2, 3]\nhand = 'foot'", "force.hand 'foot' is unknown"),
        ("[arms]\npose = [9, 0, 0, 0, 0, 0, 0, 0]", "left_shoulder_pitch.*must lie in"),
        ("[arms]\nclip = 'moonwalk'", "moonwalk"),
        ("left = 'rubber'", "--left 'rubber' is unknown"),
    ],
)
def test_bad_scenarios_are_named(text, message, policy_file, tmp_path, capsys):
    path = tmp_path / "s.toml"
    path.write_text(text)
    assert deploy(["--policy", str(policy_file), "--scenario", str(path)]) == 2
    assert re.search(message, capsys.readouterr().err)


def test_keys_that_arrive_together_are_all_pressed(monkeypatch):
    other_end, terminal = os.openpty()
    tty.setraw(terminal)
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        os.write(other_end, b"w ")
        assert list(keyboard._pressed()) == ["w", " "]
        assert list(keyboard._pressed()) == []
    os.close(other_end)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trials", "0"], "trials must be a positive integer"),
        (["--scenario", "none.toml"], "'none.toml' does not exist"),
        (["--timestep", "0.003"], "timestep must divide the control step"),
        (["--delay-steps", "2", "1"], "delay_steps must be integers"),
        (["--mass-error", "1.5"], "mass_error must lie in"),
        (["--json", "nowhere/x.json"], "its folder does not exist"),
        (["--keyboard", "--trials", "3"], "--keyboard goes with neither"),
        (["--keyboard"], "needs a terminal"),
        (["--left", "cotap:alpha=2"], "alpha must lie in"),
        (["--engine", "isaac"], "engine 'isaac' is unknown"),
        (["--library", "own.npz"], "--library 'own.npz' does nothing without --motion, which names a clip"),
        (["--motion", "walk", "--library", "none.npz"], "'none.npz' does not exist"),
        (["--left", "pd", "--right", "pd", "--passive"], "--passive is not read by pd"),
    ],
)
def test_bad_options_are_named(arguments, message, policy_file, capsys):
    assert deploy(["--policy", str(policy_file), *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("option", [["--episode-seconds", "5"], ["--motion", "mixture"], ["--library", "own.npz"]])
def test_what_a_scenario_says_itself_is_not_asked_for_beside_it(option, policy_file, tmp_path, capsys):
    (tmp_path / "s.toml").write_text("seconds = 0.1\n")
    assert deploy(["--policy", str(policy_file), "--scenario", str(tmp_path / "s.toml"), *option]) == 2
    assert "do nothing with --scenario" in capsys.readouterr().err


def test_arms_follow_a_clip_of_ones_own(policy_file, spec, tmp_path):
    clip = dataclasses.replace(shipped_library(spec).clips[0], name="mine")
    MotionLibrary([clip], spec).save(tmp_path / "own.npz")
    own = ["--motion", "mine", "--library", str(tmp_path / "own.npz")]
    assert deploy(["--policy", str(policy_file), "--episode-seconds", "0.1", *own]) == 0


def test_a_law_of_a_scenario_reads_its_fields(policy_file, tmp_path, capsys):
    (tmp_path / "s.toml").write_text('seconds = 0.1\nleft = "facet:alpha=0.5"\n')
    assert deploy(["--policy", str(policy_file), "--scenario", str(tmp_path / "s.toml")]) == 2
    assert "facet does not read alpha" in capsys.readouterr().err


def _edited(policy_file, tmp_path, name, value):
    proto = onnx.load(policy_file)
    next(p for p in proto.metadata_props if p.key == name).value = json.dumps(value)
    onnx.save(proto, tmp_path / "other.onnx")
    return tmp_path / "other.onnx"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("robot", "atlas", "for the robot 'atlas'; known: h1, g1"),
        ("joints", [f"joint_{i}" for i in range(19)], "other joints"),
        ("kp", [100.0] * 19, "other kp"),
        ("torque_limit_nm", [300.0] * 19, "other torque_limit_nm"),
        ("torque_limit_nm", [0.0] * 19, "other torque_limit_nm"),
        ("nominal_height_m", 5.0, "other nominal_height_m: 5.0, here"),
        ("commands", {"gait": 1.0}, "no field 'gait'"),
        ("gait", {"period_s": 0.0}, "gait.period_s must lie in"),
        ("terminations", {"max_tilt_rad": "far"}, "max_tilt_rad must be of type float"),
        ("law", {"left": {"name": "jelly"}}, "'jelly' is unknown"),
    ],
)
def test_policies_of_another_robot_are_refused(name, value, message, policy_file, tmp_path, capsys):
    assert deploy(["--policy", str(_edited(policy_file, tmp_path, name, value)), "--episode-seconds", "0.1"]) == 2
    assert message in capsys.readouterr().err


def test_the_trained_law_is_the_default(policy):
    law = dict(policy.metadata.law)
    law["right"] = law["right"] | {"name": "cotap", "stiffness": [200.0, 300.0, 400.0]}
    laws = law_config(dataclasses.replace(policy.metadata, law=law))
    assert laws.left.name == "pd"
    assert (laws.right.name, laws.right.stiffness) == ("cotap", (200.0, 300.0, 400.0))
    assert laws.singularity_ratio
    assert laws.torso == UpperBodyConfig().torso
    other = law | {"singularity_ratio": False, "torso": law["torso"] | {"model": "constant"}}
    laws = law_config(dataclasses.replace(policy.metadata, law=other))
    assert (laws.singularity_ratio, laws.torso.model) == (False, "constant")
    weaker = [0.5 * limit for limit in policy.metadata.torque_limit_nm]  # as `torque_limit_scale` makes them
    limited = robot_of(dataclasses.replace(policy.metadata, torque_limit_nm=weaker))
    assert [joint.torque_limit_nm for joint in limited.joints] == weaker
    with pytest.raises(PolicyError, match="h2"):
        robot_of(dataclasses.replace(policy.metadata, robot="h2"))


@pytest.mark.parametrize(
    ("key", "velocity", "yaw_rate", "height", "far"),
    [("w", (0.1, 0.0), 0.0, 0.0, 1.0), ("s", (-0.1, 0.0), 0.0, 0.0, -1.0), ("q", (0.0, 0.1), 0.0, 0.0, 0.5),
     ("e", (0.0, -0.1), 0.0, 0.0, -0.5), ("a", (0.0, 0.0), 0.1, 0.0, 0.8), ("d", (0.0, 0.0), -0.1, 0.0, -0.8),
     ("f", (0.0, 0.0), 0.0, -0.02, -0.2), ("r", (0.0, 0.0), 0.0, 0.02, 0.02)],
)  # fmt: skip
def test_each_key_changes_one_thing_up_to_its_limit(key, velocity, yaw_rate, height, far):
    stick = Stick(TRAINED)
    command = stick.press(key)
    stands = velocity == (0.0, 0.0) and yaw_rate == 0.0
    assert command == TimedCommand(velocity=velocity, yaw_rate=yaw_rate, stand=stands, height_offset=height)
    for _ in range(30):
        command = stick.press(key)
    found = (*command.velocity, command.yaw_rate, command.height_offset)
    assert [x for x in found if x] == ([far] if far else [])
    command.check("key")


def test_height_is_commanded_in_stance_and_speed_while_walking():
    stick = Stick(TRAINED)
    for key in "fff":
        stick.press(key)
    assert stick.press("r").height_offset == -0.04
    assert stick.press("w") == TimedCommand(velocity=(0.1, 0.0))
    assert stick.press("q") == TimedCommand(velocity=(0.1, 0.1))
    assert stick.press("f") == TimedCommand(stand=True, height_offset=-0.02)
    assert stick.press("?") == TimedCommand(stand=True, height_offset=-0.02)


@pytest.mark.parametrize(
    ("fields", "fits"),
    [({"delay_steps": (0, 0)}, True), ({"delay_steps": (50, 50)}, True), ({"delay_steps": (0, 51)}, False),
     ({"delay_steps": (-1, 0)}, False), ({"delay_steps": (2, 1)}, False), ({"delay_steps": (0.0, 1)}, False),
     ({"delay_steps": (0, 1.0)}, False), ({"drop": 0.99}, True), ({"drop": 0.991}, False),
     ({"encoder_noise": 1.001}, False), ({"velocity_noise": 100.1}, False), ({"mass_error": 0.901}, False),
     ({"start_error": 0.5}, True), ({"start_error": 0.501}, False), ({"start_error": -0.001}, False)],
)  # fmt: skip
def test_perturbations_have_bounds(fields, fits):
    if fits:
        Perturbations(**fields).check()
    else:
        with pytest.raises(ValueError, match=next(iter(fields))):
            Perturbations(**fields).check()


@pytest.mark.parametrize(
    ("field", "low", "high"),
    [("ramp_s", 0.0, 60.0), ("settle_s", 0.0, 60.0), ("max_tilt", 0.1, 3.2), ("saturation_s", 0.02, 1e6)],
)
def test_limits_of_safety_have_bounds(field, low, high):
    for bound, beyond in ((low, math.nextafter(low, -1.0)), (high, math.nextafter(high, math.inf))):
        SafetyConfig(**{field: bound}).check()
        with pytest.raises(ValueError, match=f"{field} must lie in"):
            SafetyConfig(**{field: beyond}).check()


@pytest.mark.parametrize(("settle_s", "fits"), [(0.0, True), (0.5, True), (2.0, False)])
def test_settling_without_a_ramp_is_refused(settle_s, fits):
    """The default is no wish of anyone's."""
    safety = SafetyConfig(ramp_s=0.0, settle_s=settle_s)
    if fits:
        safety.check()
    else:
        with pytest.raises(ValueError, match="settle_s does nothing while ramp_s is 0"):
            safety.check()


@pytest.mark.parametrize(("ramp_s", "held"), [(0.0, []), (0.001, [True, False])])
def test_a_ramp_of_no_step_still_settles(ramp_s, held, policy, spec, monkeypatch):
    robot, seen = make_robot(spec), []
    monkeypatch.setattr(robot.engine, "hold", seen.append)
    start_up(robot, make_controller(policy, spec), SafetyConfig(ramp_s=ramp_s, settle_s=0.04), 0)
    assert seen == held


def test_keys_build_up_commands():
    stick = Stick(TRAINED)
    for key in "wwwa":
        command = stick.press(key)
    assert (command.velocity, command.yaw_rate, command.stand) == ((0.3, 0.0), 0.1, False)
    for _ in range(20):
        command = stick.press("s")
    assert command.velocity == (-1.0, 0.0)
    command = stick.press("f")
    assert (command.stand, command.height_offset, command.velocity) == (True, -0.02, (0.0, 0.0))
    command = stick.press(" ")
    assert command == TimedCommand(stand=True)
    command.check("key")
    assert not stick.ended
    stick.press("x")
    assert stick.ended
