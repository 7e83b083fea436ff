"""Courses of waypoints, steering, and who is counted as having arrived."""

from __future__ import annotations

import math

import pytest
import torch

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import main
from cotap.evaluation.course import Course, steer
from cotap.evaluation.punches import PunchWalk
from cotap.evaluation.rollout import idle, record_rollout


def heading(yaw: float) -> torch.Tensor:
    c, s = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]])


def test_steering_turns_to_what_is_behind_and_walks_to_what_is_ahead():
    velocity, turning = steer(torch.tensor([[2.0, 0.0], [0.0, 1.0], [-1.0, -0.1], [1.0, -0.1]]), 0.7)
    assert velocity[:, 0].tolist() == pytest.approx([0.7, 0.0, 0.0, 0.7], abs=0.01)
    assert velocity[:, 1].tolist() == [0.0] * 4
    assert turning.tolist() == pytest.approx([0.0, 0.8, -0.8, -0.1495], abs=1e-3)


def test_a_course_is_laid_out_from_where_the_robot_stands(rng):
    course = Course(3, 1.5, 0.0, 0.3, 1, rng)
    position = torch.tensor([[4.0, -2.0]])
    course.start(position, heading(math.pi / 2))  # facing +y
    ahead = course.step(position, heading(math.pi / 2))
    assert ahead[0].tolist() == pytest.approx([1.5, 0.0], abs=1e-5)
    # Having turned to face -x, the next waypoint is to the right.
    assert course.step(position, heading(math.pi))[0].tolist() == pytest.approx([0.0, -1.5], abs=1e-5)
    for y in (-0.7, 0.8, 2.4):
        course.step(torch.tensor([[4.0, y]]), heading(math.pi / 2))
    assert course.reached.tolist() == [3]


def test_legs_have_their_length_and_turns_their_limit(rng):
    course = Course(12, 1.5, 1.0, 0.3, 200, rng)
    course.start(torch.zeros(200, 2), torch.eye(3).expand(200, 3, 3))
    legs = torch.cat((torch.zeros(200, 1, 2), course._points_w), 1).diff(dim=1)
    torch.testing.assert_close(legs.norm(dim=2), torch.full((200, 12), 1.5))
    turn = torch.atan2(legs[..., 1], legs[..., 0]).diff(dim=1)
    assert float(torch.atan2(turn.sin(), turn.cos()).abs().max()) <= 1.0 + 1e-4


def test_who_has_fallen_reaches_no_more(rng):
    course = Course(2, 1.0, 0.0, 0.3, 2, rng)
    eye = torch.eye(3).expand(2, 3, 3)
    course.start(torch.zeros(2, 2), eye)
    course.leave(torch.tensor([True, False]))
    course.step(torch.tensor([[1.0, 0.0], [1.0, 0.0]]), eye)
    assert course.reached.tolist() == [0, 1]


def run(robot, **fields):
    protocol = PunchWalk(num_envs=4, randomize=False, **fields)
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig(robot, num_threads=1)))
    protocol.prepare(env)
    steps = round(protocol.seconds / env.dt)
    t = record_rollout(env, idle(env), steps, progress=False, before_step=protocol.before_step)
    return t, protocol.measure(t, env)


def test_who_falls_has_not_completed(robot):
    t, result = run(robot, force_size=600.0, waypoints=2, leg=0.1, turn=0.0, radius=10.0, episode_seconds=4.0)
    fell = t.fell.any(0)  # nobody steers the legs
    assert fell.any()
    assert result["completion_rate"] == pytest.approx(float((~fell).float().mean()))
    assert result["metrics"]["seconds_upright"]["mean"] < 4.0


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--mode", "stance"], "punches are for walking"), (["--waypoints", "0"], "waypoints"), (["--leg", "0"], "leg"),
     (["--force-size", "-1"], "punches.force_n")],
)  # fmt: skip
def test_bad_options_are_named(options, message, capsys):
    assert main(["punches", *options]) == 2
    assert message in capsys.readouterr().err
