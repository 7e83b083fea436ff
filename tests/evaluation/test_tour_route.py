"""Waypoints over a disc, and a pilot who commands robots there and knows when they have arrived."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cotap.envs.commands import CommandConfig
from cotap.evaluation.tour.route import Pilot, draw_waypoints
from cotap.rotations import yaw_of

WIDE = CommandConfig((-9.0, 9.0), (-9.0, 9.0), (-9.0, 9.0))


def heading(yaw: float) -> torch.Tensor:
    c, s = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]])


def pilot(*waypoints: tuple[float, float, float], limits=WIDE, position=(0.0, 0.0), yaw=0.0, speed=math.inf) -> Pilot:
    return Pilot(torch.tensor([waypoints]), 5.0, limits, torch.tensor([position]), torch.tensor([yaw]), speed)


def ask(pilot: Pilot, time_s: float, x: float, y: float, yaw: float) -> tuple[list[float], float, bool]:
    velocity, rate, stand = pilot.command(time_s, torch.tensor([[x, y]]), torch.tensor([yaw]), heading(yaw))
    return velocity[0].tolist(), float(rate[0]), bool(stand[0])


def test_waypoints_are_uniform_over_the_disc_and_the_circle():
    x, y, yaw = draw_waypoints(40000, np.random.default_rng(0)).T
    radius = np.hypot(x - 0.3, y)
    assert radius.max() <= 1.0
    # A disc of radius r holds the share r^2 of the points.
    assert np.quantile(radius, [0.04, 0.25, 0.49, 0.81]) == pytest.approx([0.2, 0.5, 0.7, 0.9], abs=0.01)
    for angle in (np.arctan2(y, x - 0.3), yaw):
        quarters = np.histogram(angle, bins=8, range=(-math.pi, math.pi))[0] / 40000
        assert quarters == pytest.approx(1 / 8, abs=0.006)
    assert abs(np.corrcoef(radius, yaw)[0, 1]) < 0.015


def test_waypoints_are_in_the_frame_of_the_pelvis_at_release():
    """From (2, -1), facing +y: 1 m ahead and 0.5 m to the left is (1.5, 0)."""
    p = pilot((1.0, 0.5, 0.25), position=(2.0, -1.0), yaw=math.pi / 2)
    assert p.waypoints_w[0, 0].tolist() == pytest.approx([1.5, 0.0, math.pi / 2 + 0.25], abs=1e-6)
    # Wherever the robot is by then, and whichever way it faces.
    way, turn = p.error(0, torch.tensor([[1.5, -0.4]]), torch.tensor([math.pi]))
    assert way[0].tolist() == pytest.approx([0.0, 0.4], abs=1e-6)
    assert float(turn) == pytest.approx(0.25 - math.pi / 2)


def test_yaw_errors_go_the_short_way():
    _, turn = pilot((0.0, 0.0, 3.0)).error(0, torch.zeros(1, 2), torch.tensor([-3.0]))
    assert float(turn) == pytest.approx(6.0 - 2.0 * math.pi, abs=1e-5)


def test_commands_are_proportional_in_the_heading_frame():
    """For a robot that faces north, 0.4 m to the north are ahead and 0.4 m to the east to its right."""
    velocity, rate, stand = ask(pilot((0.0, 0.4, 1.0)), 0.0, 0.0, 0.0, math.pi / 2)
    assert velocity == pytest.approx([0.6, 0.0], abs=1e-6)
    assert rate == pytest.approx(1.5 * (1.0 - math.pi / 2), abs=1e-6)
    assert not stand
    assert ask(pilot((0.4, 0.0, 1.0)), 0.0, 0.0, 0.0, math.pi / 2)[0] == pytest.approx([0.0, -0.6], abs=1e-6)


def test_commands_keep_within_the_policy_s_own_limits():
    narrow = CommandConfig((-0.3, 0.8), (-0.2, 0.2), (-0.5, 0.5))
    p = pilot((1.2, 0.5, 2.0), limits=narrow)
    assert ask(p, 0.0, 0.0, 0.0, 0.0) == (pytest.approx([0.8, 0.2]), pytest.approx(0.5), False)
    back = ask(pilot((-0.9, -0.5, -2.0), limits=narrow), 0.0, 0.0, 0.0, 0.0)
    assert back == (pytest.approx([-0.3, -0.2]), pytest.approx(-0.5), False)


def test_commands_keep_their_direction_under_a_limit_of_the_speed():
    """1.5 times (0.8, 0.6) m is 1.5 m/s: a third of it goes under a limit of 0.5 m/s, and the turn is left."""
    slow = pilot((0.8, 0.6, 1.0), speed=0.5)
    assert ask(slow, 0.0, 0.0, 0.0, 0.0) == (pytest.approx([0.4, 0.3]), pytest.approx(1.5), False)
    assert ask(slow, 0.0, 0.6, 0.6, 0.0)[0] == pytest.approx([0.3, 0.0])  # slower than the limit as it is
    assert ask(slow, 0.0, 0.8, 0.6, 1.0) == ([0.0, 0.0], 0.0, True)


def test_a_position_is_reached_under_10_cm_and_left_beyond_20_cm():
    p = pilot((1.0, 0.0, 1.0))
    moving = [any(ask(p, 0.0, x, 0.0, 0.0)[0]) for x in (0.5, 0.85, 0.91, 0.85, 0.81, 0.79, 0.85, 0.95)]
    assert moving == [True, True, False, False, False, True, True, False]


def test_a_yaw_is_reached_under_0_05_rad_and_left_beyond_0_12_rad():
    p = pilot((1.0, 0.0, 1.0))
    turning = [bool(ask(p, 0.0, 0.0, 0.0, yaw)[1]) for yaw in (0.5, 0.9, 0.96, 0.9, 0.89, 0.87, 1.1, 1.04)]
    assert turning == [True, True, False, False, False, True, True, False]


def test_who_has_reached_both_stands_until_the_next_waypoint():
    p = pilot((0.5, 0.0, 0.0), (0.5, 0.15, 0.0))
    assert ask(p, 0.0, 0.45, 0.0, 0.0) == ([0.0, 0.0], 0.0, True)
    assert ask(p, 4.98, 0.45, 0.0, 0.0)[2]
    velocity, rate, stand = ask(p, 5.0, 0.45, 0.0, 0.0)  # within 20 cm, but it is another waypoint
    assert velocity == pytest.approx([0.075, 0.225])
    assert (rate, stand) == (0.0, False)


def test_yaw_of_a_tilted_body_is_that_of_its_forward_axis():
    pitch = torch.tensor([[math.cos(0.3), 0.0, math.sin(0.3)], [0.0, 1.0, 0.0], [-math.sin(0.3), 0.0, math.cos(0.3)]])
    assert float(yaw_of(heading(1.2) @ pitch)) == pytest.approx(1.2)
