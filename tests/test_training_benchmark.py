"""What benchmarks.training measures: an environment as at the end of a training, and laws of any robot."""

from __future__ import annotations

import pytest
import torch

from benchmarks.training import (
    Compliance,
    GeneralBlend,
    InverseKinematics,
    LiteralCompliance,
    full_env,
    record,
    reference_model,
)
from cotap.robots import ROBOTS


@pytest.mark.parametrize("stage", ["base", "distill"])
def test_the_environment_is_that_of_the_end_of_a_training(stage):
    env = full_env(2, 1, robot="g1", stage=stage)
    assert env.spec.name == "g1"
    assert env.cfg.assist.share(env.samples) == 0.0
    forces, samples = env.cfg.forces, env.curriculum.samples
    assert forces.pushes.ramp.share(samples) == forces.hand_loads.ramp.share(samples) == 1.0
    assert (env.cfg.upper_body.left.name == "cotap") is (stage == "distill")


def test_what_is_recorded_is_of_the_robot():
    env, model = full_env(2, 1, robot="g1"), reference_model("g1")
    recording = record(env, lambda obs: torch.zeros(len(obs["policy"]), 29), 1, 2)
    assert recording.qpos.shape == (2, 2, model.nq)
    assert recording.torque.shape == (2, 2, model.nu)


@pytest.mark.parametrize("kind", [Compliance, GeneralBlend, InverseKinematics, LiteralCompliance])
@pytest.mark.parametrize("robot", ["h1", "g1"])
def test_laws_are_timed_for_any_robot(kind, robot):
    part = kind(3, 0.0, robot=robot)
    assert part.q.shape == (3, 2, len(ROBOTS[robot]().arms[0].joints))
    part.once()


def test_the_general_blend_is_of_compliance_and_the_gains_of_the_arms():
    compliant, pd = GeneralBlend(3, 0.0, robot="g1").pair
    gains = torch.tensor([40.0] * 4 + [20.0] * 3)
    assert torch.equal(pd, torch.diag(gains).expand(3, 2, 7, 7))
    assert (torch.linalg.eigvalsh(compliant) > 0.0).all()
