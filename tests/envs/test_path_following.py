"""Torsos led along paths by a virtual spring: closed forms, a circle, and the environment's commands."""

from __future__ import annotations

import math

import pytest
import torch
from env_tools import drive, zeros

from cotap.envs.path_following import PathConfig, PathFollower, TorsoImpedance

DT = 0.02
ALIGNED = torch.eye(3).unsqueeze(0)


def follow(impedance, x, target, target_velocity, seconds, dt=DT):
    """A torso that does exactly what it is told."""
    path = [x]
    for _ in range(round(seconds / dt)):
        x = x + dt * impedance.step(x, ALIGNED, target, target_velocity)
        path.append(x)
    return torch.stack(path)


def test_first_step_by_hand():
    # Implicit damping: (v + dt/m (K e + D vt)) / (1 + dt D / m), with K e = 20 * 0.1, D vt = 28 * 0.05, dt/m = 0.002.
    impedance = TorsoImpedance(PathConfig(), 1, DT)
    v = impedance.step(torch.tensor([[0.2, 0.0]]), ALIGNED, torch.tensor([[0.3, -0.1]]), torch.tensor([[0.05, 0.0]]))
    torch.testing.assert_close(v, torch.tensor([[0.002 * (2.0 + 1.4) / 1.056, 0.002 * -2.0 / 1.056]]))


def test_follows_the_closed_form_of_a_critically_damped_spring():
    m, k = 10.0, 20.0
    cfg = PathConfig(mass_kg=m, stiffness=k, damping=2 * math.sqrt(k * m), speed_limit=10.0)
    dt = 0.0005
    path = follow(
        TorsoImpedance(cfg, 1, dt), torch.zeros(1, 2), torch.tensor([[0.5, -0.2]]), torch.zeros(1, 2), 4.0, dt
    )
    t = torch.arange(path.shape[0]) * dt
    omega = math.sqrt(k / m)
    expected = 1 - (1 + omega * t) * torch.exp(-omega * t)
    torch.testing.assert_close(path[:, 0, 0], 0.5 * expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(path[:, 0, 1], -0.2 * expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize("damping", [5.0, 28.0, 5000.0])
def test_settles_at_the_target_with_any_damping(damping):
    impedance = TorsoImpedance(PathConfig(stiffness=20.0 + damping, damping=damping), 1, DT)
    path = follow(impedance, torch.zeros(1, 2), torch.tensor([[0.5, -0.2]]), torch.zeros(1, 2), 30.0)
    torch.testing.assert_close(path[-1], torch.tensor([[0.5, -0.2]]), atol=2e-3, rtol=0)


def test_follows_a_moving_target_without_lag():
    impedance = TorsoImpedance(PathConfig(), 1, DT)
    x, target, speed = torch.zeros(1, 2), torch.zeros(1, 2), torch.tensor([[0.4, 0.1]])
    for _ in range(1000):
        target = target + DT * speed
        command = impedance.step(x, ALIGNED, target, speed)
        x = x + DT * command
    torch.testing.assert_close(command, speed, atol=1e-4, rtol=0)
    torch.testing.assert_close(x, target, atol=0.02, rtol=0)


def test_command_is_in_the_heading_frame():
    """A robot that faces the world's y axis has a target at +x on its right: minus y of its own."""
    facing_y = torch.tensor([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    impedance = TorsoImpedance(PathConfig(), 1, DT)
    v = impedance.step(torch.zeros(1, 2), facing_y, torch.tensor([[1.0, 0.0]]), torch.zeros(1, 2))
    assert float(v[0, 1]) < -0.01
    assert abs(float(v[0, 0])) < 1e-8


def test_turning_does_not_turn_the_velocity_in_the_world():
    a, b = (TorsoImpedance(PathConfig(), 1, DT) for _ in range(2))
    zero, target = torch.zeros(1, 2), torch.tensor([[1.0, 0.5]])
    back = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).unsqueeze(0)
    for heading in (ALIGNED, back, ALIGNED):
        straight, turned = a.step(zero, ALIGNED, target, zero), b.step(zero, heading, target, zero)
    torch.testing.assert_close(straight, turned)


def test_speed_is_limited_and_keeps_its_direction():
    impedance = TorsoImpedance(PathConfig(stiffness=1e4, speed_limit=0.6), 1, DT)
    for _ in range(20):
        v = impedance.step(torch.zeros(1, 2), ALIGNED, torch.tensor([[30.0, -40.0]]), torch.zeros(1, 2))
    torch.testing.assert_close(v, torch.tensor([[0.36, -0.48]]))


def test_reset_stops_only_its_envs():
    impedance = TorsoImpedance(PathConfig(), 2, DT)
    args = (torch.zeros(2, 2), torch.eye(3).expand(2, 3, 3), torch.ones(2, 2), torch.zeros(2, 2))
    first = impedance.step(*args)
    impedance.reset(torch.tensor([True, False]))
    second = impedance.step(*args)
    torch.testing.assert_close(second[0], first[0])
    assert (second[1] > first[1]).all()


def test_bad_fields_are_named():
    with pytest.raises(ValueError, match=r"path\.mass_kg must lie in"):
        TorsoImpedance(PathConfig(mass_kg=0.0), 1, DT)


def turned(yaw: float) -> torch.Tensor:
    c, s = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]])


def test_a_torso_that_obeys_follows_a_circle(rng):
    """Path: 0.5 m/s forward, turning at 0.25 rad/s, from where and whither the torso stands."""
    follower = PathFollower(PathConfig(share=1.0), 1, DT)
    x, yaw = torch.tensor([[3.0, -2.0]]), 1.0
    follower.reset(torch.ones(1, dtype=torch.bool), x, turned(yaw), rng)
    assert follower.active.tolist() == [True]
    for _ in range(1000):
        velocity, yaw_rate = follower.step(x, turned(yaw), torch.tensor([[0.5, 0.0, 0.25]]))
        x = x + DT * (turned(yaw)[:, :2, :2] @ velocity.unsqueeze(2)).squeeze(2)
        yaw += DT * float(yaw_rate)
    assert yaw == pytest.approx(1.0 + 20.0 * 0.25, abs=0.02)
    center = torch.tensor([[3.0 - 2.0 * math.sin(1.0), -2.0 + 2.0 * math.cos(1.0)]])
    assert float((x - center).norm()) == pytest.approx(2.0, abs=0.08)
    assert float((x - follower.target_w).norm()) < 0.08


def test_a_path_waits_for_a_torso_that_does_not_follow(rng):
    follower = PathFollower(PathConfig(share=1.0, leash_m=0.5), 1, DT)
    still = torch.zeros(1, 2)
    follower.reset(torch.ones(1, dtype=torch.bool), still, ALIGNED, rng)
    for _ in range(500):
        velocity, yaw_rate = follower.step(still, ALIGNED, torch.tensor([[3.0, 0.0, 2.0]]))
    assert 0.5 <= float(follower.target_w.norm()) < 0.57
    assert float(velocity.norm()) <= 1.0 + 1e-5
    assert abs(float(yaw_rate)) <= 0.9


def test_share_decides_how_many_envs_are_led(rng):
    n = 4000
    follower = PathFollower(PathConfig(share=0.3), n, DT)
    follower.reset(torch.ones(n, dtype=torch.bool), torch.zeros(n, 2), ALIGNED.expand(n, 3, 3), rng)
    assert float(follower.active.float().mean()) == pytest.approx(0.3, abs=0.03)


def test_path_state_continues_exactly(rng):
    a, b = (PathFollower(PathConfig(share=1.0), 1, DT) for _ in range(2))
    a.reset(torch.ones(1, dtype=torch.bool), torch.ones(1, 2), ALIGNED, rng)
    go = torch.tensor([[0.5, 0.1, 0.2]])
    for _ in range(10):
        a.step(torch.ones(1, 2), ALIGNED, go)
    b.load_state_dict(a.state_dict())
    for f, g in zip(a.step(torch.ones(1, 2), ALIGNED, go), b.step(torch.ones(1, 2), ALIGNED, go), strict=True):
        assert torch.equal(f, g)


def test_paths_command_the_envs_that_they_lead(make_env, robot):
    """Those walk towards the target; the others follow what they drew."""
    env = make_env(16, robot=robot, path=PathConfig(share=0.5))
    active = env.path.active
    assert 0 < int(active.sum()) < 16
    assert not env.commands.current().stand[active].any()
    torch.testing.assert_close(env.path.target_w, env.state.torso_pos_w[:, :2])
    env.path.target_w = env.path.target_w + env.state.heading_w[:, :2, 0]  # a metre ahead
    drive(env, 5, scale=0.0)
    c = env.commands.current()
    assert (c.velocity_h[active, 0] > 0.01).all()
    assert not c.stand[active].any()
    assert (env.commands.asked_velocity[active, :2] == c.velocity_h[active]).all()
    assert env.commands.asked_to_stand[~active].any() or (c.velocity_h[~active, 0] < 0.0).any()


def test_a_path_begins_anew_with_its_episode(make_env, robot):
    env = make_env(2, robot=robot, path=PathConfig(share=1.0))
    env.path.target_w = env.path.target_w + 5.0
    env.sim.qpos[1, 3:7] = torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0])
    _, _, done, _ = env.step(zeros(env))
    assert done.tolist() == [False, True]
    torch.testing.assert_close(env.path.target_w[1], env.state.torso_pos_w[1, :2])
    assert float((env.path.target_w[0] - env.state.torso_pos_w[0, :2]).norm()) > 5.0
    assert not env.path.impedance._velocity_w[1].any()


def test_no_paths_no_commands_of_theirs(make_env):
    env = make_env(4)
    drive(env, 3)
    assert not env.path.active.any()
