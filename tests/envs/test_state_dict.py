"""Saved and taken over, an environment goes on bit for bit as if nothing had happened."""

from __future__ import annotations

import copy

import pytest
import torch
from env_tools import NOISY, drive, rollout

from cotap.compliance.laws import LawConfig
from cotap.envs.curriculum import AssistConfig, RampConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.hand_loads import HandLoadConfig
from cotap.envs.observations import ObservationConfig
from cotap.envs.path_following import PathConfig
from cotap.envs.punches import PunchConfig
from cotap.envs.pushes import PushConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.envs.terminations import TerminationConfig
from cotap.envs.upper_body import LawSampling, UpperBodyConfig

FORCES = ExternalForceConfig(
    HandLoadConfig(enabled=True, episode_share=0.7, hold_s=(0.1, 0.2), ramp=RampConfig(0.0, 300.0)),
    PushConfig(enabled=True, interval_s=(0.12, 0.3), ramp=RampConfig(0.0, 300.0, first=0.5)),
    PunchConfig(60.0, 0.04, 0.2),
    ForceProfile((5.0, -3.0, -10.0), "both", 0.1, random_direction=True),
)
FIELDS = {
    "plain": {},
    "noisy": {"observations": NOISY},
    "noisy, critics with history": {"observations": ObservationConfig(critic="history", noise=NOISY.noise)},
    "pushed and loaded": {"forces": FORCES, "assist": AssistConfig(enabled=True, full_samples=100, end_samples=400)},
    "led and lawful": {
        "path": PathConfig(share=0.5),
        "upper_body": UpperBodyConfig(
            LawConfig("facet"), LawConfig("soft-pd"), sampling=LawSampling(True, hold_s=(0.1, 0.2))
        ),
        "observations": ObservationConfig(goals=True, arm_torque="critic"),
        "forces": FORCES,
    },
}


@pytest.mark.parametrize("fields", FIELDS.values(), ids=FIELDS)
def test_a_run_goes_on_exactly_elsewhere(make_env, robot, fields):
    short = TerminationConfig(episode_s=0.5)
    env, other = (make_env(4, robot=robot, seed=s, terminations=short, **copy.deepcopy(fields)) for s in (0, 1))
    rollout(env, 30, scale=1.0)
    saved, torque = copy.deepcopy(env.state_dict()), env.torque.clone()
    assert torque.any()
    assert torch.equal(saved["observations"]["policy"], env.get_observations()["policy"])
    future, ended = rollout(env, 40, seed=1, scale=1.0)
    assert ended.any()
    rollout(other, 7)
    other.load_state_dict(saved)
    assert torch.equal(other.get_observations()["policy"], saved["observations"]["policy"])
    assert torch.equal(other.torque, torque)
    again, ended_again = rollout(other, 40, seed=1, scale=1.0)
    assert torch.equal(again, future)
    assert torch.equal(ended_again, ended)
    assert other.samples == env.samples


def test_what_was_saved_stays_as_it_was(make_env, robot):
    """While the environment goes on, restarts included, and when it is taken over more than once."""
    env = make_env(4, robot=robot, forces=FORCES)
    drive(env, 10)
    saved = env.state_dict()
    future, ended = rollout(env, 60, seed=1, scale=1.0)
    assert ended.any()
    for _ in range(2):
        env.load_state_dict(saved)
        assert torch.equal(rollout(env, 60, seed=1, scale=1.0)[0], future)


def test_saving_changes_nothing(make_env):
    a, b = make_env(2, observations=NOISY), make_env(2, observations=NOISY)
    for _ in range(5):
        a.state_dict()
        assert torch.equal(drive(a, 1)[0], drive(b, 1)[0])


def test_a_state_of_another_size_is_refused(make_env, robot):
    with pytest.raises(ValueError, match="must have shape"):
        make_env(3, robot=robot).load_state_dict(make_env(4, robot=robot).state_dict())


def test_a_state_of_another_robot_is_refused(make_env):
    with pytest.raises(ValueError, match="must have shape"):
        make_env(2).load_state_dict(make_env(2, robot="made-up").state_dict())
