"""A waist that damps the torso, and gives way to what a blow turns."""

from __future__ import annotations

import pytest
import torch

from cotap.envs.actions import ActionConfig, JointTargets
from cotap.envs.commands import Command, CommandConfig
from cotap.robots.mjcf import build_model


def waist_target(
    spec, yield_s: float, yaw_rate: float, commanded: float = 0.0, lean: float = 0.0, damping_s: float = 0.0
) -> float:
    """Where the waist is sent, robot standing, torso turning about the vertical."""
    commands = CommandConfig(waist_yield_s=yield_s, waist_damping_s=damping_s)
    targets = JointTargets(ActionConfig(), spec, build_model(spec), commands)
    one, none = torch.ones(1), torch.zeros(1, 19)
    command = Command(torch.zeros(1, 2), commanded * one, one, spec.nominal_height_m * one, torch.zeros(1))
    gravity = torch.tensor([[lean, 0.0, -((1.0 - lean**2) ** 0.5)]])
    joints = targets.default.unsqueeze(0)
    sent = targets(none, command, joints, none, gravity, -yaw_rate * gravity, torch.zeros(1, 8))
    return float(sent[0, spec.indices(["torso"])[0]])


@pytest.mark.parametrize(
    ("yaw_rate", "commanded", "expected"),
    [(3.0, 0.0, 0.1), (-3.0, 0.0, -0.1), (0.9, 0.0, 0.0), (3.0, 0.8, 0.06), (0.0, 0.8, 0.0), (40.0, 0.0, 0.5)],
)
def test_the_waist_turns_with_what_turns_the_torso_too_fast(spec, yaw_rate, commanded, expected):
    """0.05 rad per rad/s beyond 1 rad/s, counted from the rate that is asked for, at most 0.5 rad."""
    assert waist_target(spec, 0.05, yaw_rate, commanded) == pytest.approx(expected, abs=1e-5)
    assert waist_target(spec, 0.05, yaw_rate, commanded, lean=0.5) == pytest.approx(expected, abs=1e-5)
    assert waist_target(spec, 0.0, yaw_rate, commanded) == 0.0


@pytest.mark.parametrize(
    ("yaw_rate", "commanded", "expected"),
    [(0.5, 0.0, -0.01), (-0.5, 0.0, 0.01), (0.0, 0.2, 0.0064), (0.8, 0.8, 0.0), (1.0, 0.0, 0.0), (3.0, 0.0, 0.0)],
)
def test_the_waist_damps_a_slowly_turning_torso(spec, yaw_rate, commanded, expected):
    """0.04 rad against each rad/s at rest, half of that at 0.5 rad/s, none from 1 rad/s on."""
    assert waist_target(spec, 0.0, yaw_rate, commanded, damping_s=0.04) == pytest.approx(expected, abs=1e-5)
    assert waist_target(spec, 0.0, yaw_rate, commanded, lean=0.5, damping_s=0.04) == pytest.approx(expected, abs=1e-5)


def test_beyond_that_it_gives_way(spec):
    """0.05 rad for each of two rad/s beyond one, damped or not."""
    assert waist_target(spec, 0.05, 3.0, damping_s=0.04) == pytest.approx(0.1, abs=1e-5)
