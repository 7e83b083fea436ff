"""The punch tour in the loop of deployment: the same tours as in batched MuJoCo, and in another engine."""

from __future__ import annotations

import builtins
import json
import shutil

import numpy as np
import pytest
import torch

from cotap.agents.actors import as_dict
from cotap.deployment import tour as in_engine
from cotap.deployment.tour import evaluate_in_engine
from cotap.envs import HumanoidEnv
from cotap.evaluate import main
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.policy import load_policy
from cotap.evaluation.rollout import acting
from cotap.evaluation.tour.arm_walk import arms_at
from cotap.evaluation.tour.protocol import Tour, _pelvis

SHIPPED_ROBOTS = ["h1", "g1"]


def prepared(checkpoint, law: str = "pd", **fields) -> tuple[Tour, HumanoidEnv]:
    tour = Tour(**{"num_envs": 2, "episode_seconds": 0.8, "waypoints": 2} | fields)
    cfg = load_policy(checkpoint).env_config
    cfg.upper_body, cfg.num_threads = LawOptions(method=law).configure(), 1
    env = HumanoidEnv(tour.configure(cfg))
    tour.prepare(env)
    return tour, env


@pytest.fixture
def checkpoint_of(random_checkpoint, random_policy, monkeypatch):
    """Checkpoints whose export is there already: it takes longer than all else here."""
    monkeypatch.setattr(in_engine, "export_policy", lambda path, onnx: shutil.copy(path.with_suffix(".onnx"), onnx))

    def find(**kind):
        random_policy(**kind)
        return random_checkpoint(**kind)

    return find


@pytest.fixture
def steps(monkeypatch):
    """Every control step: the controller, the law and the forces that the engine is given."""
    seen = []
    act = in_engine.Robot.act
    step = in_engine.Controller.step

    def acting(self, law, hand_force_h, at_once=False, others=()):
        seen[-1] += [law, list(others), {b.name: b.joint for b in self.spec.bodies}]
        return act(self, law, hand_force_h, at_once, others)

    def stepping(self, readings):
        law = step(self, readings)
        seen.append([self, self.targets.copy()])
        return law

    monkeypatch.setattr(in_engine.Robot, "act", acting)
    monkeypatch.setattr(in_engine.Controller, "step", stepping)
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("law", ["pd", "cotap"])
@pytest.mark.parametrize("robot", SHIPPED_ROBOTS)
def test_the_loop_in_mujoco_scores_as_the_batch_does(robot, law, checkpoint_of):
    """The same tours, policy and law; contacts and how stiffness is integrated differ a little."""
    checkpoint = checkpoint_of(robot=robot)
    tour, env = prepared(checkpoint, law)
    batch = tour.evaluate(env, load_policy(checkpoint))
    tour.engine = "mujoco"  # that of deployment
    loop = evaluate_in_engine(tour, checkpoint, env.cfg)
    assert loop.keys() == batch.keys()
    assert batch["num_falls"] == loop["num_falls"] == 0
    for one, other in zip(batch["segments"], loop["segments"], strict=True):
        assert other["position_error"]["mean"] == pytest.approx(one["position_error"]["mean"], abs=0.02)
        assert other["yaw_error"]["mean"] == pytest.approx(one["yaw_error"]["mean"], abs=0.05)
    assert loop["metrics"]["energy"]["mean"] == pytest.approx(batch["metrics"]["energy"]["mean"], rel=0.15)
    assert tour.film.shape == (40, 7 + env.num_actions + 12)


def test_arms_have_the_walk_and_its_gains_whatever_the_policy_asks(checkpoint_of, steps):
    checkpoint = checkpoint_of(output_gain=1.0)
    tour, env = prepared(checkpoint, num_envs=1)
    tour.engine = "mujoco"
    evaluate_in_engine(tour, checkpoint, env.cfg)
    upper = env.action_slices["upper"]
    for k in (0, 1, 20, 26, 39):
        _, targets, law, *_ = steps[k]
        expected, _ = arms_at(tour._targets, 0.02 * (k + 1))
        np.testing.assert_allclose(targets[upper], expected[0], atol=1e-6)
        np.testing.assert_allclose(np.diag(law.stiffness)[upper], tour.stance.arm_kp, rtol=1e-6)
        np.testing.assert_allclose(np.diag(law.damping)[upper], tour.stance.arm_kd, rtol=1e-6)
        np.testing.assert_allclose(
            np.diag(law.stiffness)[: upper.start], [j.kp for j in env.spec.joints[: upper.start]]
        )


def asked(what: in_engine.Controller | HumanoidEnv) -> torch.Tensor:
    """(1, 3) velocity and yaw rate that are commanded now."""
    command = what.commands.current()
    return torch.cat((command.velocity_h, command.yaw_rate[:, None]), 1)


def test_what_is_asked_for_is_seen_a_step_later_as_in_the_batch(checkpoint_of, monkeypatch):
    checkpoint = checkpoint_of()
    seen: list[torch.Tensor] = []
    step = in_engine.Controller.step

    def stepping(controller, readings):
        law = step(controller, readings)
        seen.append(asked(controller))
        return law

    monkeypatch.setattr(in_engine.Controller, "step", stepping)
    tour, env = prepared(checkpoint, num_envs=1)
    tour.engine = "mujoco"
    evaluate_in_engine(tour, checkpoint, env.cfg)
    expected = []
    obs, policy = tour._begin(env), load_policy(checkpoint)
    act = acting(env, policy, tour.upper_actions)
    for k in range(2):
        expected.append(asked(env))
        tour._ask(env, *tour.pilot.command(k * env.dt, *_pelvis(env), env.state.heading_w))
        obs, *_ = env.step(act(as_dict(obs)))
    assert not expected[0].any()
    assert expected[1].any()
    torch.testing.assert_close(torch.stack(seen[:2]), torch.stack(expected), atol=1e-5, rtol=0)


def test_the_policy_s_upper_actions_can_be_had(checkpoint_of, steps):
    checkpoint = checkpoint_of(output_gain=1.0)
    tour, env = prepared(checkpoint, num_envs=1, upper_actions="policy")
    tour.engine = "mujoco"
    evaluate_in_engine(tour, checkpoint, env.cfg)
    expected, _ = arms_at(tour._targets, 0.02)
    assert np.abs(steps[0][1][env.action_slices["upper"]] - expected[0].numpy()).max() > 1e-3


def test_punches_are_the_batch_s(checkpoint_of, steps):
    checkpoint = checkpoint_of()
    tour, env = prepared(checkpoint)
    tour.engine = "mujoco"
    evaluate_in_engine(tour, checkpoint, env.cfg)
    assert len(steps) == 80
    for run in range(2):
        for k, (*_, forces, joints) in enumerate(steps[40 * run : 40 * run + 40]):
            struck, force_w = env.forces.punches.at(torch.full((2,), 0.02 * k))
            assert len(forces) == (k in (5, 6, 7, 8, 25, 26, 27, 28))
            for force in forces:
                assert joints[force.body] == env.spec.joint_names[struck[run]]
                assert force.point == (0.0, 0.0, 0.0)
                np.testing.assert_allclose(force.force_w, force_w[run])


@pytest.mark.slow
@pytest.mark.parametrize("robot", SHIPPED_ROBOTS)
def test_the_command_runs_it_in_pybullet(robot, random_checkpoint, tmp_path, capsys):
    pytest.importorskip("pybullet")
    out = tmp_path / "tour.json"
    options = ["--engine", "pybullet", "--num-envs", "2", "--episode-seconds", "0.8", "--waypoints", "2"]
    arguments = [*options, "--checkpoint", str(random_checkpoint(robot=robot)), "--threads", "1", "--json", str(out)]
    assert main(["tour", *arguments]) == 0
    result = json.loads(out.read_text())
    assert result["settings"]["engine"] == "pybullet"
    assert result["metrics"]["survival_s"]["mean"] == pytest.approx(0.8)
    assert result["metrics"]["position_error"]["mean"] < 1.5
    assert "tour, pd, arms moving: 0 of 2 envs fell" in capsys.readouterr().out


@pytest.mark.slow
def test_arms_under_cotap_go_the_tour_in_pybullet(checkpoint_of, steps):
    pytest.importorskip("pybullet")
    checkpoint = checkpoint_of(robot="g1")
    tour, env = prepared(checkpoint, "cotap", num_envs=1)
    tour.engine = "pybullet"
    result = evaluate_in_engine(tour, checkpoint, env.cfg)
    assert len(steps) == 40
    assert result["num_falls"] == 0
    assert result["metrics"]["survival_s"]["mean"] == pytest.approx(0.8)
    upper = env.action_slices["upper"]
    lower = np.array([joint.kp for joint in env.spec.joints[: upper.start]])
    for _, targets, law, *_ in steps:
        arms = np.asarray(law.stiffness)[upper, upper]
        np.testing.assert_allclose(arms, arms.T, atol=1e-3)
        assert np.abs(arms - np.diag(np.diag(arms))).max() > 1.0  # where PD's stiffness has zeros
        assert (np.linalg.eigvalsh(arms) > 0.0).all()
        np.testing.assert_allclose(np.diag(law.stiffness)[: upper.start], lower)
        assert np.isfinite(targets).all()


def test_that_pybullet_is_not_installed_is_said(checkpoint_of, monkeypatch, capsys):
    original = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("pybullet"):
            raise ModuleNotFoundError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    arguments = ["--engine", "pybullet", "--num-envs", "1", "--checkpoint", str(checkpoint_of())]
    assert main(["tour", *arguments]) == 2
    assert "pip install -e '.[pybullet]'" in capsys.readouterr().err
