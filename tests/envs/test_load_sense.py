"""Loads are sensed, and robots lean against them."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from cotap.agents.actors import as_dict
from cotap.envs import H1Env, H1EnvConfig, h1_env, load_sense
from cotap.envs.commands import BRACE_TILT_RAD
from cotap.envs.forces import ForceProfile
from cotap.envs.load_sense import (
    COM_HEIGHT_M,
    LARGEST_TILT,
    LEAST_TILT,
    MEAN_S,
    TILT_S,
    LoadSense,
    TiltEstimate,
    load_features,
    load_reflection,
    load_tilt,
)
from cotap.evaluation.policy import load_policy, shipped_checkpoint
from cotap.evaluation.protocols import VelocityTracking
from cotap.evaluation.rollout import record_rollout
from cotap.robots import ROBOTS

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
import fit_load_sense

WEIGHT_N = 500.0


@pytest.fixture(scope="module")
def env() -> H1Env:
    cfg = H1EnvConfig(num_envs=4, num_threads=1)
    cfg.commands.lean_into_loads = True
    env = H1Env(cfg)
    env.reset()
    return env


def upright(env: H1Env, yaw_rad: list[float]):
    """Torsos above the same point, upright, turned to the left [rad]."""
    n = len(yaw_rad)
    yaw = torch.tensor(yaw_rad)
    rotation = torch.zeros(n, 3, 3)
    rotation[:, 0, 0] = rotation[:, 1, 1] = yaw.cos()
    rotation[:, 1, 0], rotation[:, 0, 1], rotation[:, 2, 2] = yaw.sin(), -yaw.sin(), 1.0
    return dataclasses.replace(
        env.state, torso_pos_w=torch.tensor([[1.0, 2.0, 1.0]]).expand(n, -1), torso_rotation_w=rotation,
        projected_gravity_t=torch.tensor([[0.0, 0.0, -1.0]]).expand(n, -1), torso_angular_velocity_t=torch.zeros(n, 3),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("yaw", "point", "force", "way"),
    [(0.0, (1.0, 2.0, 1.2), (10.0, 0.0, 0.0), (1.2 * 10.0, 0.0)),  # pushed forward at 1.2 m
     (0.0, (1.0, 2.0, 1.2), (0.0, -10.0, 0.0), (0.0, -1.2 * 10.0)),  # pushed to the right
     (0.0, (1.3, 2.0, 1.2), (0.0, 0.0, -10.0), (0.3 * 10.0, 0.0)),  # a weight held in front
     (0.0, (1.0, 2.4, 1.2), (0.0, 0.0, -10.0), (0.0, 0.4 * 10.0)),  # a weight held on the left
     (0.5 * math.pi, (1.0, 2.0, 1.2), (10.0, 0.0, 0.0), (0.0, -1.2 * 10.0)),  # facing y, pushed to its right
     (0.0, (1.0, 2.0, 1.2), (1e3, 0.0, 0.0), (LARGEST_TILT * WEIGHT_N * COM_HEIGHT_M, 0.0))],  # more than it may lean
)  # fmt: skip
def test_the_tilt_is_the_moment_over_weight_and_height(env, yaw, point, force, way):
    points, forces = torch.tensor([[point, (5.0, 5.0, 5.0)]]), torch.tensor([[force, (0.0, 0.0, 0.0)]])
    tilt = load_tilt(upright(env, [yaw]), points, forces, WEIGHT_N)
    expected = torch.tensor([way]) / (WEIGHT_N * COM_HEIGHT_M)
    torch.testing.assert_close(tilt, expected, atol=1e-6, rtol=1e-5)


def test_a_robot_that_leans_as_much_against_its_load_feels_upright(env):
    """Leaning back by the tilt of a load that pushes forward, gravity points to -x in the torso frame."""
    sense = LoadSense(env.spec, 2, 0.02)
    sense.tilt = torch.tensor([[math.tan(0.1) + LEAST_TILT, 0.0], [0.0, -LEAST_TILT]])
    back = torch.tensor([[-math.sin(0.1), 0.0, -math.cos(0.1)]]).expand(2, -1)
    felt = sense.felt(dataclasses.replace(upright(env, [0.0, 0.0]), projected_gravity_t=back)).projected_gravity_t
    torch.testing.assert_close(felt[0], torch.tensor([0.0, 0.0, -1.0]), atol=1e-3, rtol=0.0)
    torch.testing.assert_close(felt[1], back[1])
    torch.testing.assert_close(felt.norm(dim=1), torch.ones(2))


def test_of_the_mirror_image_the_mirror_image_is_told(env):
    reflection = load_reflection(env.spec)
    model, x = TiltEstimate(reflection), torch.randn(8, 2 * reflection.index.numel())
    told = model(x)
    assert told.std() > 0.0
    torch.testing.assert_close(model(model.reflection(x)), told * torch.tensor([1.0, -1.0]))


def test_features_are_reflected_term_by_term(env):
    """Left and right torques change places, what rolls and turns its sign, and half a stride passes."""
    spec, n = env.spec, 1
    left, right, roll = (spec.joint_names.index(f"{name}") for name in ("left_knee", "right_knee", "left_hip_roll"))
    torque = torch.zeros(n, env.num_actions)
    torque[0, left], torque[0, roll] = 10.0, 5.0
    command = dataclasses.replace(
        env.commands.current(), velocity_h=torch.zeros(n, 2), yaw_rate=torch.zeros(n), stand=torch.zeros(n),
        height=torch.ones(n), phase=torch.full((n,), 0.2),
    )  # fmt: skip
    default = torch.tensor([j.default_rad for j in spec.joints])
    state = dataclasses.replace(upright(env, [0.0]), joint_pos=default.unsqueeze(0), joint_vel=torch.zeros(n, 19))
    x = load_features(state, command, default, torque)
    mirrored = load_reflection(spec)(x)
    torques = mirrored[0, 9 + 2 * 19 : 9 + 3 * 19]
    assert torques[right] == pytest.approx(0.2)
    assert torques[spec.joint_names.index("right_hip_roll")] == pytest.approx(-0.1)
    assert torques[left] == 0.0
    later = load_features(state, dataclasses.replace(command, phase=torch.full((n,), 0.7)), default, 0.0 * torque)
    torch.testing.assert_close(mirrored[0, -3:], later[0, -3:])


def test_a_restarted_world_has_no_memory(env):
    sense, zero = LoadSense(env.spec, 4, 0.02), torch.zeros(4, env.num_actions)
    torque = torch.full((4, env.num_actions), 20.0)
    command = env.commands.current()
    for _ in range(5):
        sense.step(env.state, command, torque)
    assert (sense.tilt.norm(dim=1) > 0.0).all()
    sense.reset(torch.tensor([True, False, False, False]))
    assert sense.tilt[0].tolist() == [0.0, 0.0]
    read = sense.remember(env.state, command, zero)
    present, mean = read.split(read.shape[1] // 2, 1)
    torch.testing.assert_close(present[0], mean[0])
    assert (present[1:] != mean[1:]).any(1).all()


def test_what_is_told_and_what_is_read_are_low_passed(env, monkeypatch):
    """Against closed forms: after k steps of a constant, `1 - exp(-k dt / T)` of it."""
    dt, steps = 0.02, 6
    sense, command = LoadSense(env.spec, 4, dt), env.commands.current()
    calm, busy = torch.zeros(4, env.num_actions), torch.full((4, env.num_actions), 50.0)
    told = torch.tensor([[0.1, -0.05]]).expand(4, -1)
    monkeypatch.setattr(sense, "model", lambda _: told)
    sense.step(env.state, command, calm)  # the mean begins here
    sense.tilt = torch.zeros(4, 2)
    for _ in range(steps):
        sense.step(env.state, command, busy)
    torch.testing.assert_close(sense.tilt, told * (1.0 - math.exp(-steps * dt / TILT_S)))
    read = sense.remember(env.state, command, busy)
    torques = slice(9 + 2 * 19, 9 + 3 * 19)
    present, mean = (x[:, torques] for x in read.split(read.shape[1] // 2, 1))
    torch.testing.assert_close(mean, present * (1.0 - math.exp(-(steps + 1) * dt / MEAN_S)))
    monkeypatch.setattr(sense, "model", lambda _: 100.0 * told)
    for _ in range(100):
        sense.step(env.state, command, busy)
    torch.testing.assert_close(sense.tilt, LARGEST_TILT * told.sign())


def test_a_robot_braces_itself_from_one_tilt_on_until_well_below_it(env, monkeypatch):
    sense, command, torque = LoadSense(env.spec, 4, 0.02, 0.05), env.commands.current(), torch.zeros(4, env.num_actions)
    monkeypatch.setattr(sense, "model", lambda _: told)
    told, braced = torch.zeros(4, 2), []
    for size in (0.04, 0.06, 0.04, 0.027, 0.04):
        told = size * torch.tensor([[1.0, 0.0], [0.0, -1.0], [0.6, 0.8], [0.0, 0.0]])
        for _ in range(100):  # whatever is told is low-passed
            sense.step(env.state, command, torque)
        braced.append(sense.braces.tolist())
    no, yes = [False] * 4, [True, True, True, False]
    assert braced == [no, yes, yes, no, no]
    sense.braces = torch.ones(4, dtype=torch.bool)
    sense.reset(torch.tensor([True, False, False, False]))
    assert sense.braces.tolist() == [False, True, True, True]
    never = LoadSense(env.spec, 4, 0.02)
    monkeypatch.setattr(never, "model", lambda _: torch.full((4, 2), LARGEST_TILT))
    for _ in range(100):
        never.step(env.state, command, torque)
    assert not never.braces.any()


def test_who_is_not_awake_senses_nothing(env, monkeypatch):
    sense, command = LoadSense(env.spec, 4, 0.02, 0.05), env.commands.current()
    monkeypatch.setattr(sense, "model", lambda _: torch.full((4, 2), 0.1))
    sense.awake = torch.tensor([True, False, True, True])
    for _ in range(100):
        sense.step(env.state, command, torch.zeros(4, env.num_actions))
    assert sense.tilt[1].tolist() == [0.0, 0.0]
    torch.testing.assert_close(sense.tilt[[0, 2, 3]], torch.full((3, 2), 0.1))
    assert sense.braces.tolist() == [True, False, True, True]


def test_robots_that_are_pulled_at_brace_themselves(monkeypatch):
    """Told to walk, one of two stops, since its load sense says so."""
    cfg = H1EnvConfig(num_envs=2, num_threads=1)
    cfg.commands.lean_into_loads, cfg.commands.brace_tilt_rad = True, 0.03
    env = H1Env(cfg)
    env.commands.override(torch.tensor([[0.5, 0.0]] * 2), torch.zeros(2), torch.zeros(2), torch.ones(2))
    env.reset()
    sense = env.load_sense
    assert sense is not None
    assert sense._brace_rad == 0.03
    monkeypatch.setattr(sense, "step", lambda *_: setattr(sense, "braces", torch.tensor([True, False])))
    for _ in range(10):
        env.step(torch.zeros(2, env.num_actions))
    torch.testing.assert_close(env.commands.current().velocity_h[:, 0], torch.tensor([0.0, 0.3]))


def test_what_a_diverged_world_says_does_not_outlast_it(env):
    sense, command = LoadSense(env.spec, 4, 0.02), env.commands.current()
    bad = env.state.joint_vel.clone()
    bad[1] = math.nan
    sense.step(dataclasses.replace(env.state, joint_vel=bad), command, torch.zeros(4, env.num_actions))
    sense.reset(torch.tensor([False, True, False, False]))
    sense.step(env.state, command, torch.zeros(4, env.num_actions))
    assert sense.tilt.isfinite().all()


def test_policy_and_joint_targets_see_the_tilted_vertical_and_rewards_the_true_one(env, monkeypatch):
    env.reset()
    tilt = torch.tensor([[0.1, -0.05]]).expand(4, -1)
    monkeypatch.setattr(env.load_sense, "step", lambda *_: setattr(env.load_sense, "tilt", tilt.clone()))
    observations, *_ = env.step(torch.zeros(4, env.num_actions))
    true = env.state.projected_gravity_t
    torch.testing.assert_close(env.record.state.projected_gravity_t, true)
    felt = env.felt.projected_gravity_t
    assert ((felt - true)[:, 0] > 0.08).all()
    assert ((felt - true)[:, 1] < -0.03).all()
    newest = 3 * 5 + 4 * 3  # after five steps of angular velocity, the fifth of gravity
    torch.testing.assert_close(observations["policy"][:, newest : newest + 3], felt)
    sent = env.target_from_action(torch.zeros(4, env.num_actions))
    env.load_sense.tilt = torch.zeros(4, 2)
    assert (env.target_from_action(torch.zeros(4, env.num_actions)) != sent).any()


def test_all_that_keeps_balance_goes_by_the_tilted_vertical(monkeypatch):
    cfg = H1EnvConfig(num_envs=2, num_threads=1)
    cfg.commands.lean_into_loads = cfg.commands.step_timing = cfg.commands.foresee_falls = True
    env = H1Env(cfg)
    env.reset()
    sense, timing, foresight = env.load_sense, env.step_timing, env.foresight
    assert sense is not None
    assert timing is not None
    assert foresight is not None
    tilt = torch.tensor([[0.1, 0.0], [0.0, 0.1]])
    seen, real_lean, real_timing, real_foresight = {}, h1_env.leaning, timing.step, foresight.lean
    monkeypatch.setattr(sense, "step", lambda *_: setattr(sense, "tilt", tilt.clone()))
    monkeypatch.setattr(h1_env, "leaning", lambda g, w: seen.setdefault("lean", g) is None or real_lean(g, w))
    monkeypatch.setattr(
        timing, "step", lambda s, *rest: seen.update(timing=s.projected_gravity_t) or real_timing(s, *rest)
    )
    monkeypatch.setattr(
        foresight, "lean", lambda x, s, c: seen.update(foresight=s.projected_gravity_t) or real_foresight(x, s, c)
    )
    env.step(torch.zeros(2, env.num_actions))
    assert seen.keys() == {"lean", "timing", "foresight"}
    for gravity in seen.values():
        torch.testing.assert_close(gravity, env.felt.projected_gravity_t)
        assert (gravity != env.state.projected_gravity_t).any(1).all()


def test_rewards_go_by_the_vertical_that_the_true_loads_ask_for():
    """Both hands are pushed forward by 12 N at a metre or so; what the robot makes of it does not matter."""
    tilts = {}
    for leans in (True, False):
        cfg = H1EnvConfig(num_envs=2, num_threads=1)
        cfg.commands.lean_into_loads, cfg.hand_forces.enabled = leans, False
        cfg.force = ForceProfile(force=(12.0, 0.0, 0.0), start_s=0.0, hand="both")
        env = H1Env(cfg)
        env.reset()
        env.step(torch.zeros(2, env.num_actions))
        tilts[leans] = env.record.load_tilt
    height = env.state.hand_pos_w[:, :, 2].mean(1)
    torch.testing.assert_close(tilts[True][:, 0], 24.0 * height / (env.weight_n * COM_HEIGHT_M), rtol=0.02, atol=0.0)
    assert (tilts[True][:, 1].abs() < 0.003).all()
    assert not tilts[False].any()


def test_an_environment_that_restarts_senses_anew(env):
    env.load_sense.tilt = torch.full((4, 2), 0.1)
    env.reset()
    assert env.load_sense.tilt.tolist() == [[0.0, 0.0]] * 4
    assert env.load_sense._fresh.all()


def test_it_goes_on_exactly_where_it_was_saved(env):
    env.reset()
    action = torch.zeros(4, env.num_actions)
    for _ in range(5):
        env.step(action)
    saved = env.state_dict()
    expected = [env.step(action)[0]["policy"].clone() for _ in range(3)]
    env.load_state_dict(saved)
    for present in expected:
        torch.testing.assert_close(env.step(action)[0]["policy"], present, rtol=0.0, atol=0.0)
    del saved["parts"]["load_sense"]["braces"]  # of a run before robots braced themselves
    env.load_sense.braces = torch.ones(4, dtype=torch.bool)
    env.load_state_dict(saved)
    assert not env.load_sense.braces.any()
    del saved["parts"]["load_sense"]  # of a run before there was such a thing
    env.load_state_dict(saved)


def test_without_it_the_vertical_is_the_true_one() -> None:
    env = H1Env(H1EnvConfig(num_envs=1, num_threads=1))
    assert env.load_sense is None
    assert env.felt is env.state


def test_weights_of_another_robot_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = ROBOTS["h1"]()
    monkeypatch.setattr(load_sense, "load_reflection", lambda _: load_reflection(spec).part(slice(0, 6)))
    with pytest.raises(ValueError, match="load sense was fitted for another robot than 'h1'"):
        LoadSense(spec, 1, 0.02)


@pytest.mark.parametrize(("force", "axis"), [((12.0, 0.0, 0.0), 0), ((0.0, 12.0, 0.0), 1)])
def test_the_shipped_weights_tell_where_a_standing_robot_is_pushed(force, axis) -> None:
    """Both hands pushed alike, both ways: the tilt that is told lies within two fifths of the true one."""
    policy = load_policy(shipped_checkpoint("base"))
    told = {}
    for sign in (1.0, -1.0):
        cfg = VelocityTracking(num_envs=16, stand_probability=1.0, randomize=False).configure(policy.env_config)
        cfg.commands.lean_into_loads, cfg.num_threads = True, 1
        loads = cfg.hand_forces
        loads.enabled = True
        loads.force_x, loads.force_y, loads.force_z = ((sign * f, sign * f) for f in force)
        env = H1Env(cfg)
        observations = env.reset()
        tilts = []
        for i in range(150):
            observations, *_ = env.step(policy(as_dict(observations)))
            if i >= 75:
                assert env.load_sense is not None
                tilts.append(env.load_sense.tilt.mean(0))
        told[sign] = torch.stack(tilts).mean(0)
    true = 2.0 * 12.0 * 1.1 / (env.weight_n * COM_HEIGHT_M)  # hands are about 1.1 m up
    difference = 0.5 * (told[1.0] - told[-1.0])
    assert difference[axis] == pytest.approx(true, rel=0.4)
    assert abs(difference[1 - axis]) < 0.3 * true


def test_recordings_and_weights_are_written_and_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """End to end, tiny: what robots lean by is in the recording, and `LoadSense` takes the weights."""
    recording, weights = tmp_path / "loads.npz", tmp_path / "weights.npz"
    for lean in ("truth", "sense"):
        arguments = ["", "collect", "--num-envs", "8", "--seconds", "1", "--lean", lean, "--stiffness", "300",
                     "--output", str(recording)]  # fmt: skip
        monkeypatch.setattr(sys, "argv", arguments)
        assert fit_load_sense.main() == 0
        assert "falls in 1 s of 8 worlds" in capsys.readouterr().out
    with np.load(recording) as file:
        assert file["seen"].shape == (13 * 8, 2 * (12 + 3 * 19))
        assert file["tilt"].shape == (13 * 8, 2)
        assert np.abs(file["tilt"]).max() > 0.001
        assert file["world"].max() == 7
    monkeypatch.setattr(sys, "argv", ["", "fit", str(recording), "--steps", "5", "--output", str(weights)])
    assert fit_load_sense.main() == 0
    with np.load(weights) as fitted:
        model = TiltEstimate(load_reflection(ROBOTS["h1"]()))
        model.net.load_state_dict({k: torch.tensor(fitted[k].astype(np.float32)) for k in fitted.files})


def test_bad_input_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    for arguments, message in (
        (["collect", "--output", "no/such/loads.npz"], "its folder does not exist"),
        (["collect", "--output", str(tmp_path / "x.npz"), "--seconds", "0"], "--seconds must lie in"),
        (["collect", "--output", str(tmp_path / "x.npz"), "--checkpoint", "nobody"], "nobody"),
        (["fit", str(tmp_path / "none.npz"), "--output", str(tmp_path / "x.npz")], "none.npz"),
    ):
        monkeypatch.setattr(sys, "argv", ["", *arguments])
        assert fit_load_sense.main() == 2
        assert message in capsys.readouterr().err


@pytest.mark.slow
def test_robots_that_sense_loads_are_dragged_less() -> None:
    """The shipped base under loads of up to 40 N per axis on both hands, with and without sensing them."""
    policy = load_policy(shipped_checkpoint("base"))
    falls, speed = {}, {}
    for senses in (True, False):
        cfg = VelocityTracking(num_envs=256, hand_force=40.0, stand_probability=1.0, seed=5).configure(
            policy.env_config
        )
        cfg.commands.lean_into_loads, cfg.commands.brace_tilt_rad = senses, BRACE_TILT_RAD * senses
        record = record_rollout(H1Env(cfg), policy, 600, progress=False)
        falls[senses] = int(record.fell.any(0).sum())
        speed[senses] = float(record.velocity[..., :2].norm(dim=2)[record.alive()].mean())
    assert falls[True] < falls[False]
    assert speed[True] < 0.75 * speed[False]


@pytest.mark.slow
def test_walking_robots_that_brace_themselves_fall_less() -> None:
    """The shipped base under loads of up to 30 N per axis on both hands, leaning against them."""
    policy = load_policy(shipped_checkpoint("base"))
    falls = {}
    for tilt in (0.0, BRACE_TILT_RAD):
        protocol = VelocityTracking(num_envs=256, hand_force=30.0, stand_probability=0.0, seed=5)
        cfg = protocol.configure(policy.env_config)
        cfg.commands.lean_into_loads, cfg.commands.brace_tilt_rad = True, tilt
        record = record_rollout(H1Env(cfg), policy, 600, progress=False)
        falls[tilt] = int(record.fell.any(0).sum())
    assert falls[BRACE_TILT_RAD] < 0.8 * falls[0.0], falls
