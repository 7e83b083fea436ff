"""The layout of observations, their history and their noise, by hand."""

from __future__ import annotations

import pytest
import torch

from cotap.envs.observations import (
    NoiseConfig,
    ObservationConfig,
    ObservationHistory,
    actor_terms,
    critic_terms,
    noise_amplitude,
)

# The paper's table: name, width, scale.
PAPER = (
    ("torso_angular_velocity", 3, 0.25), ("projected_gravity", 3, 1.0), ("command_velocity", 2, 1.0),
    ("command_yaw_rate", 1, 1.0), ("command_stand", 1, 1.0), ("command_height", 1, 2.0),
    ("reference_arm_position", 8, 1.0), ("joint_position", 19, 1.0), ("joint_velocity", 19, 0.05),
    ("last_action", 19, 1.0), ("sin_phase", 1, 1.0), ("cos_phase", 1, 1.0), ("arm_torque", 8, 1.0),
)  # fmt: skip
TERMS = (("a", 2, 1.0), ("b", 1, 10.0))


def test_terms_are_the_papers():
    terms = actor_terms(19, 8)
    assert terms == PAPER
    assert sum(width for _, width, _ in terms) == 86
    assert sum(width for _, width, _ in critic_terms(2)) == 13
    assert 5 * 86 + 13 == 443
    assert [s for _, _, s in critic_terms(2)] == [1.0, 2.0, 0.1]


def test_terms_have_the_robots_sizes(any_spec):
    joints, upper, arms = len(any_spec.joints), len(any_spec.upper_joints), len(any_spec.arms)
    widths = {name: width for name, width, _ in actor_terms(joints, upper, num_goals=5 * arms)}
    assert sum(widths.values()) == 13 + 3 * joints + 2 * upper + 5 * arms
    assert widths["last_action"] == joints
    assert widths["arm_torque"] == upper
    assert "arm_torque" not in [name for name, _, _ in actor_terms(joints, upper, arm_torque=False)]
    assert sum(width for _, width, _ in critic_terms(arms, upper)) == 7 + upper + 3 * arms


def test_history_is_term_by_term_and_oldest_first():
    history = ObservationHistory(TERMS, 1, 3)
    no_one = torch.tensor([False])
    for t in (1.0, 2.0, 3.0, 4.0):
        buffer = history.append(torch.tensor([[t, 10 + t, 100 + t]]), no_one)
    # a at three times, then b at three times.
    assert buffer.tolist() == [[2, 12, 3, 13, 4, 14, 102, 103, 104]]


def test_a_restart_fills_the_history_of_its_env_only():
    history = ObservationHistory(TERMS, 2, 3)
    for t in (1.0, 2.0, 3.0):
        history.append(torch.full((2, 3), t), torch.tensor([False, False]))
    buffer = history.append(torch.tensor([[7.0, 8.0, 9.0], [4.0, 4.0, 4.0]]), torch.tensor([True, False]))
    assert buffer.tolist() == [[7, 8, 7, 8, 7, 8, 9, 9, 9], [2, 2, 3, 3, 4, 4, 2, 3, 4]]


def test_buffers_handed_out_never_change():
    history = ObservationHistory(TERMS, 2, 3)
    first = history.append(torch.ones(2, 3), torch.tensor([True, True]))
    copy = first.clone()
    history.append(torch.zeros(2, 3), torch.tensor([False, True]))
    assert torch.equal(first, copy)


def test_one_step_of_history_is_the_present():
    history = ObservationHistory(TERMS, 1, 1)
    history.append(torch.ones(1, 3), torch.tensor([True]))
    assert history.append(torch.tensor([[5.0, 6.0, 7.0]]), torch.tensor([False])).tolist() == [[5, 6, 7]]


def test_noise_is_scaled_like_the_observation():
    cfg = NoiseConfig(enabled=True, angular_velocity=0.2, gravity=0.05, joint_position=0.01, joint_velocity=1.0)
    amplitude = noise_amplitude(actor_terms(19, 8), cfg)
    expected = torch.zeros(86)
    expected[:3] = 0.05  # 0.2 rad/s times 0.25
    expected[3:6] = 0.05
    expected[19:38] = 0.01
    expected[38:57] = 0.05  # 1 rad/s times 0.05
    torch.testing.assert_close(amplitude, expected)


@pytest.mark.parametrize(
    ("cfg", "match"),
    [
        (ObservationConfig(history=0), "observations.history"),
        (ObservationConfig(critic="all"), "observations.critic"),
        (ObservationConfig(arm_torque="nobody"), "observations.arm_torque"),
        (ObservationConfig(noise=NoiseConfig(gravity=-1.0)), "observations.noise.gravity"),
    ],
)
def test_bad_fields_are_named(cfg, match):
    with pytest.raises(ValueError, match=match):
        cfg.check()
