from __future__ import annotations

import pytest
import torch

from cotap.envs.motions import KINDS, MotionConfig, MotionGenerator

ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
# Typed from the published parameters: limits less 0.1 rad, at most 1.2 rad from 0; half the speed limits.
LOW = {"left": (-1.2, -0.24, -1.2, -1.15), "right": (-1.2, -1.2, -1.2, -1.15)}
HIGH = {"left": (1.2, 1.2, 1.2, 1.2), "right": (1.2, 0.24, 1.2, 1.2)}
SPEED = (4.5, 4.5, 10.0, 10.0)


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


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_keeps_to_position_and_velocity_limits(spec, kind):
    position, velocity = play(only(kind), spec)
    low, high = (torch.tensor(b["left"] + b["right"]) for b in (LOW, HIGH))
    assert (position >= low - 1e-5).all()
    assert (position <= high + 1e-5).all()
    assert (velocity.abs() <= torch.tensor(SPEED * 2) + 1e-4).all()
    assert (position.diff(dim=0).abs() / 0.02 <= torch.tensor(SPEED * 2) + 1e-3).all()
    assert (velocity.abs().amax() > 0.5) == (kind != "hold")


@pytest.mark.parametrize("kind", KINDS)
def test_velocity_is_the_slope_of_the_position(spec, kind):
    dt = 0.001
    position, velocity = play(only(kind), spec, num_envs=8, seconds=4.0, dt=dt)
    slope = (position[2:] - position[:-2]) / (2 * dt)
    torch.testing.assert_close(velocity[1:-1], slope, atol=0.06, rtol=0)
    if kind != "hold":
        assert float(velocity.abs().max()) > 1.0


def test_segments_join_without_a_jump(spec):
    position, velocity = play(MotionConfig(), spec, num_envs=32, dt=0.005)
    assert float(position.diff(dim=0).abs().max()) <= 10.0 * 0.005
    assert float(velocity.diff(dim=0).abs().max()) < 1.5


def test_one_seed_is_one_motion(spec):
    a, b, c = (play(MotionConfig(), spec, seed=seed, seconds=5.0)[0] for seed in (3, 3, 4))
    assert torch.equal(a, b)
    assert not torch.allclose(a[-1], c[-1])


def test_worlds_start_at_different_poses_within_half_the_range(spec):
    position, velocity = play(only("hold"), spec, num_envs=500, seconds=0.02)
    start = position[0]
    assert float(start.std(0).min()) > 0.05
    half = 0.5 * torch.tensor(HIGH["left"] + HIGH["right"])
    assert (start <= half + 1e-6).all()
    assert not velocity.any()


def test_punches_move_one_arm_and_come_back(spec):
    position, _ = play(only("punch"), spec, num_envs=32, seconds=0.5, dt=0.01)
    away = (position - position[0]).abs().amax(0).unflatten(1, (2, 4)).amax(2) > 1e-6
    assert (away.sum(1) == 1).all()
    long, _ = play(only("punch"), spec, num_envs=32, seconds=10.0, dt=0.01)
    start = long[0]
    # The arm is where it began, again and again.
    back = ((long - start).abs().amax(2) < 1e-2)[50:].float().mean()
    assert float(back) > 0.05


def test_swings_move_the_shoulders_in_opposition(spec):
    position, _ = play(only("swing"), spec, seconds=2.0)
    moved = (position - position[0]).unflatten(2, (2, 4))
    assert not moved[..., 1:].any()
    left, right = moved[:, :, 0, 0], moved[:, :, 1, 0]
    assert (left * right <= 1e-7).all()
    assert float(left.abs().max()) > 0.15


def test_reset_touches_only_its_worlds_and_forgets_their_past(spec):
    """What a world does after a reset depends on the random numbers only, not on the motion that was interrupted."""
    poses = []
    for kind in ("punch", "wave"):
        rng = torch.Generator().manual_seed(0)
        motion = MotionGenerator(only(kind), spec, 2, 0.02)
        motion.reset(torch.tensor([True, True]), rng)
        for _ in range(10):
            motion.step(rng)
        before = motion.current().position.clone()
        motion.reset(torch.tensor([False, True]), torch.Generator().manual_seed(7))
        assert torch.equal(motion.current().position[0], before[0])
        poses.append(motion.current().position[1])
    torch.testing.assert_close(*poses)


def test_state_dict_continues_exactly(spec, rng):
    motion = MotionGenerator(MotionConfig(), spec, 4, 0.02)
    motion.reset(torch.ones(4, dtype=torch.bool), rng)
    for _ in range(37):
        motion.step(rng)
    saved, random_state = motion.state_dict(), rng.get_state()
    other = MotionGenerator(MotionConfig(), spec, 4, 0.02)
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
    with pytest.raises(ValueError, match=r"motions\.punch must lie in"):
        MotionGenerator(MotionConfig(punch=-0.1), spec, 1, 0.02)
