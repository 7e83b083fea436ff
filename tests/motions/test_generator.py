from __future__ import annotations

import pytest
import torch

from cotap.motions.generator import KINDS, MotionConfig, MotionGenerator

# Of the H1, typed from the published parameters: limits less 0.1 rad, at most 1.2 rad from 0; half the speed limits.
H1_LOW = (-1.2, -0.24, -1.2, -1.15, -1.2, -1.2, -1.2, -1.15)
H1_HIGH = (1.2, 1.2, 1.2, 1.2, 1.2, 0.24, 1.2, 1.2)
H1_SPEED = (4.5,) * 8


def bounds(spec) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Lowest and highest angles [rad] and largest speeds [rad/s], each (U,), that the default config allows."""
    joints = [j for j in spec.joints if j.name in spec.upper_joints]
    low = [max(j.range_rad[0] + 0.1, j.default_rad - 1.2) for j in joints]
    high = [min(j.range_rad[1] - 0.1, j.default_rad + 1.2) for j in joints]
    return (
        torch.tensor(low),
        torch.tensor(high),
        torch.tensor([min(0.5 * j.velocity_limit_rad_s, 4.5) for j in joints]),
    )


def arm_by_arm(values: torch.Tensor, spec) -> torch.Tensor:
    """(..., U) as (..., A, n)."""
    return values.unflatten(-1, (len(spec.arms), -1))


def only(kind: str, **fields) -> MotionConfig:
    return MotionConfig(**{**{k: float(k == kind) for k in KINDS}, **fields})


def play(cfg, spec, seed=0, num_envs=16, seconds=20.0, dt=0.02):
    """Positions and velocities (T, N, U)."""
    rng = torch.Generator().manual_seed(seed)
    motion = MotionGenerator(cfg, spec, num_envs, dt)
    motion.reset(torch.ones(num_envs, dtype=torch.bool), rng)
    position, velocity = [], []
    for _ in range(round(seconds / dt)):
        now = motion.current()
        position.append(now.position)
        velocity.append(now.velocity)
        motion.step(rng)
    return torch.stack(position), torch.stack(velocity)


def test_bounds_of_the_h1_are_those_published(spec):
    for mine, published in zip(bounds(spec), (H1_LOW, H1_HIGH, H1_SPEED), strict=True):
        torch.testing.assert_close(mine, torch.tensor(published))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_keeps_to_position_and_velocity_limits(any_spec, kind):
    position, velocity = play(only(kind), any_spec)
    low, high, speed = bounds(any_spec)
    assert position.shape[2] == len(any_spec.upper_joints)
    assert (position >= low - 1e-5).all()
    assert (position <= high + 1e-5).all()
    assert (velocity.abs() <= speed + 1e-4).all()
    assert (position.diff(dim=0).abs() / 0.02 <= speed + 1e-3).all()
    assert (velocity.abs().amax() > 0.5) == (kind != "hold")


@pytest.mark.parametrize("kind", KINDS)
def test_velocity_is_the_slope_of_the_position(any_spec, kind):
    dt = 0.001
    position, velocity = play(only(kind), any_spec, num_envs=8, seconds=2.0, dt=dt)
    slope = (position[2:] - position[:-2]) / (2 * dt)
    torch.testing.assert_close(velocity[1:-1], slope, atol=0.06, rtol=0)
    if kind != "hold":
        assert float(velocity.abs().max()) > 1.0


def test_segments_join_without_a_jump(any_spec):
    position, velocity = play(MotionConfig(), any_spec, num_envs=32, dt=0.005)
    assert float(position.diff(dim=0).abs().max()) <= float(bounds(any_spec)[2].max()) * 0.005
    assert float(velocity.diff(dim=0).abs().max()) < 1.5


def test_one_seed_is_one_motion(any_spec):
    a, b, c = (play(MotionConfig(), any_spec, seed=seed, seconds=5.0)[0] for seed in (3, 3, 4))
    assert torch.equal(a, b)
    assert not torch.allclose(a[-1], c[-1])


def test_envs_start_at_different_poses_within_half_the_range(any_spec):
    position, velocity = play(only("hold"), any_spec, num_envs=500, seconds=0.02)
    start = position[0]
    assert float(start.std(0).min()) > 0.05
    low, high, _ = bounds(any_spec)
    default = torch.tensor([j.default_rad for j in any_spec.joints if j.name in any_spec.upper_joints])
    assert (start <= default + 0.5 * (high - default) + 1e-6).all()
    assert (start >= default + 0.5 * (low - default) - 1e-6).all()
    assert not velocity.any()


def test_punches_move_one_arm_and_come_back(any_spec):
    position, _ = play(only("punch"), any_spec, num_envs=32, seconds=0.5, dt=0.01)
    away = arm_by_arm((position - position[0]).abs().amax(0), any_spec).amax(2) > 1e-6
    assert (away.sum(1) == 1).all()
    long, _ = play(only("punch"), any_spec, num_envs=32, seconds=10.0, dt=0.01)
    start = long[0]
    # The arm is where it began, again and again.
    back = ((long - start).abs().amax(2) < 1e-2)[50:].float().mean()
    assert float(back) > 0.05


def test_swings_move_the_shoulders_in_opposition(any_spec):
    position, _ = play(only("swing"), any_spec, seconds=2.0)
    moved = arm_by_arm(position - position[0], any_spec)
    assert not moved[..., 1:].any()
    left, right = moved[:, :, 0, 0], moved[:, :, 1, 0]
    assert (left * right <= 1e-7).all()
    assert float(left.abs().max()) > 0.15


def test_reset_touches_only_its_envs_and_forgets_their_past(any_spec):
    """What an env does after a reset depends on the random numbers only, not on the motion that was interrupted."""
    poses = []
    for kind in ("punch", "wave"):
        rng = torch.Generator().manual_seed(0)
        motion = MotionGenerator(only(kind), any_spec, 2, 0.02)
        motion.reset(torch.tensor([True, True]), rng)
        for _ in range(10):
            motion.step(rng)
        before = motion.current().position.clone()
        motion.reset(torch.tensor([False, True]), torch.Generator().manual_seed(7))
        assert torch.equal(motion.current().position[0], before[0])
        poses.append(motion.current().position[1])
    torch.testing.assert_close(*poses)


def test_state_dict_continues_exactly(any_spec, rng):
    motion = MotionGenerator(MotionConfig(), any_spec, 4, 0.02)
    motion.reset(torch.ones(4, dtype=torch.bool), rng)
    for _ in range(37):
        motion.step(rng)
    saved, random_state = motion.state_dict(), rng.get_state()
    other = MotionGenerator(MotionConfig(), any_spec, 4, 0.02)
    other.load_state_dict(saved)
    futures = []
    for m in (motion, other):
        rng.set_state(random_state)
        for _ in range(300):
            m.step(rng)
        futures.append(m.current().position)
    assert torch.equal(*futures)


def test_weights_may_be_whole_numbers(spec):
    position, _ = play(MotionConfig(hold=1, reach=0, punch=0, wave=0, swing=0), spec, seconds=0.1)
    assert torch.equal(position[0], position[-1])


def test_bad_fields_are_named(spec):
    with pytest.raises(ValueError, match="at least one weight of hold, reach, punch, wave, swing"):
        MotionGenerator(MotionConfig(0, 0, 0, 0, 0), spec, 1, 0.02)
    with pytest.raises(ValueError, match=r"motions\.generator\.punch must lie in"):
        MotionGenerator(MotionConfig(punch=-0.1), spec, 1, 0.02)
