"""Clips beside generated motion: what is played, how one flows into the other, and what never happens."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from cotap.motions import MotionClip, MotionError, MotionLibrary, shipped_library
from cotap.motions.clip_player import ClipPlayer, root_velocity
from cotap.motions.generator import MotionConfig
from cotap.motions.library import has_shipped_library
from cotap.motions.reference import ClipConfig, ReferenceConfig, ReferenceMotion, load_clips

DT = 0.02


def made_clip(name: str, level: float, frames: int = 51, slope: float = 0.0, root=None) -> MotionClip:
    arms = np.full((frames, 8), level, np.float32) + slope * np.arange(frames, dtype=np.float32)[:, None] / 50.0
    arms[:, 5] = -np.abs(arms[:, 5])
    root = np.zeros((frames, 3), np.float32) if root is None else root
    return MotionClip(name, arms, root, "made", "none")


def everyone(n: int) -> torch.Tensor:
    return torch.ones(n, dtype=torch.bool)


def player(spec, clips, num_envs=4, dt=DT) -> ClipPlayer:
    return ClipPlayer(MotionLibrary(clips, spec), num_envs, dt)


def test_the_player_reads_its_own_clip_between_frames_and_starts_again(spec):
    p = player(spec, [made_clip("a", 0.0, 11, 1.0), made_clip("b", 0.5, 21)], 2)
    p.clip, p._frame = torch.tensor([0, 1]), torch.tensor([2.5, 19.5])
    assert p.current()[:, 0].tolist() == [pytest.approx(2.5 / 50.0), pytest.approx(0.5)]
    over = p.step()
    assert over.tolist() == [False, True]
    assert p._frame.tolist() == [3.5, 0.5]
    p._frame = torch.tensor([10.0, 20.0])  # the very last frames
    assert p.current()[:, 0].tolist() == [pytest.approx(0.2), pytest.approx(0.5)]
    assert p.step().tolist() == [True, True]


def test_another_control_step_plays_at_the_same_speed(spec):
    p = player(spec, [made_clip("a", 0.0, 101, 0.5)], 1, dt=0.03)
    p._frame = torch.zeros(1)
    for _ in range(20):
        p.step()
    assert float(p.current()[0, 0]) == pytest.approx(0.3)


def test_clips_and_places_are_drawn_evenly(spec, rng):
    n = 6000
    p = player(spec, [made_clip("a", 0.0, 11), made_clip("b", 0.5, 101), made_clip("c", 0.2, 51)], n)
    p.draw(everyone(n), rng)
    shares = torch.bincount(p.clip, minlength=3) / n
    torch.testing.assert_close(shares, torch.full((3,), 1 / 3), atol=0.03, rtol=0)
    for i, last in enumerate((10.0, 100.0, 50.0)):
        frames = p._frame[p.clip == i]
        assert float(frames.min()) < 0.05 * last
        assert float(frames.max()) > 0.95 * last
        assert float(frames.mean()) == pytest.approx(last / 2, rel=0.06)
    before = p.clip.clone()
    p.draw(torch.zeros(n, dtype=torch.bool), rng)
    assert torch.equal(p.clip, before)


def test_root_velocity_sideways_by_hand():
    """0.5 m/s to the left of a body that looks along y: along -x."""
    root = torch.stack((-0.01 * torch.arange(5.0), torch.zeros(5), torch.full((5,), 0.5 * torch.pi)), 1)
    torch.testing.assert_close(root_velocity(root), torch.tensor([[0.0, 0.5, 0.0]]).repeat(5, 1), atol=1e-5, rtol=0)


def test_root_velocity_of_a_circle_by_hand():
    """1 m/s on a circle of 2 m: forward at 1 m/s, turning at 0.5 rad/s, nothing sideways."""
    angle = torch.arange(200) / 50.0 * 0.5
    root = torch.stack((2.0 * angle.sin(), 2.0 * (1.0 - angle.cos()), angle), 1)
    v = root_velocity(root)
    torch.testing.assert_close(v[:, 0], torch.ones(200), atol=1e-3, rtol=0)
    torch.testing.assert_close(v[:, 1], torch.zeros(200), atol=6e-3, rtol=0)
    torch.testing.assert_close(v[:, 2], torch.full((200,), 0.5), atol=1e-3, rtol=0)


def play(cfg: ReferenceConfig, spec, num_envs=64, seconds=20.0, seed=0, part=1.0):
    rng = torch.Generator().manual_seed(seed)
    motion = ReferenceMotion(cfg, spec, num_envs, DT)
    motion.share = part
    motion.reset(everyone(num_envs), rng)
    positions, velocities, clips = [motion.current().position], [], []
    for _ in range(round(seconds / DT)):
        motion.step(rng)
        positions.append(motion.current().position)
        velocities.append(motion.current().velocity)
        clips.append(motion._from_clip.clone())
    return torch.stack(positions), torch.stack(velocities), torch.stack(clips)


def swaying(spec, name: str, phase: float) -> MotionClip:
    """All arm joints of `spec` going to and fro over a third of their range, 3 s long."""
    low, high = np.array([spec.joints[i].range_rad for i in spec.indices(spec.upper_joints)]).T
    wave = np.sin(np.linspace(0.0, 2.0 * np.pi, 151) + phase)[:, None]
    arms = 0.5 * (low + high) + (high - low) / 6.0 * wave
    return MotionClip(name, arms.astype(np.float32), np.zeros((151, 3), np.float32), "made", "none")


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_reference_keeps_to_position_and_velocity_limits(any_spec, share, tmp_path):
    path = tmp_path / "own.npz"
    MotionLibrary([swaying(any_spec, "a", 0.0), swaying(any_spec, "b", 1.0)], any_spec).save(path)
    config = ClipConfig(share=share, hold_s=(0.5, 2.0), library=str(path))
    positions, velocities, clips = play(ReferenceConfig(clips=config), any_spec)
    joints = [any_spec.joints[i] for i in any_spec.indices(any_spec.upper_joints)]
    low, high = torch.tensor([j.range_rad for j in joints]).unbind(1)
    speed = torch.tensor([j.velocity_limit_rad_s for j in joints])
    assert (positions >= low - 1e-5).all()
    assert (positions <= high + 1e-5).all()
    step = positions.diff(dim=0)
    assert (step.abs() <= speed * DT + 1e-5).all()
    torch.testing.assert_close(step / DT, velocities, atol=1e-3, rtol=0)
    assert float(clips.float().mean()) == pytest.approx(share, abs=0.06)


@pytest.mark.parametrize("part", [0.0, 0.3])
@pytest.mark.parametrize("clips", [0.0, 1.0])
def test_a_part_of_the_motion_is_asked_for(any_spec, tmp_path, part, clips):
    """Of the same motion, drawn alike; clips that never change, as transitions have a duration of their own."""
    path = tmp_path / "own.npz"
    MotionLibrary([swaying(any_spec, "a", 0.0)], any_spec).save(path)
    cfg = ReferenceConfig(clips=ClipConfig(share=clips, hold_s=(60.0, 60.0), library=str(path)))
    whole, less = (play(cfg, any_spec, 8, 2.0, part=p) for p in (1.0, part))
    default = torch.tensor([any_spec.joints[i].default_rad for i in any_spec.indices(any_spec.upper_joints)])
    torch.testing.assert_close(less[0], default + part * (whole[0] - default), atol=1e-5, rtol=0)
    torch.testing.assert_close(less[1], part * whole[1], atol=1e-3, rtol=0)


def test_transitions_are_slow_and_end_where_they_should(spec, tmp_path):
    """From a still pose to another, 1 rad away: at most the blend's speed, then exactly the new clip."""
    MotionLibrary([made_clip("a", 0.0), made_clip("b", 1.0)], spec).save(tmp_path / "two.npz")
    clips = ClipConfig(share=1.0, library=str(tmp_path / "two.npz"), hold_s=(2.0, 2.0), blend_speed=0.2)
    motion = ReferenceMotion(ReferenceConfig(MotionConfig(), clips), spec, 1, DT)
    rng = torch.Generator().manual_seed(1)
    motion.reset(everyone(1), rng)
    motion.clips.clip[:] = 0
    motion._position = torch.zeros(1, 8)
    motion._remaining_s[:] = 0.0
    previous, fastest = motion.current().position, 0.0
    for _ in range(400):
        motion.step(rng)
        fastest = max(fastest, float((motion.current().position - previous).abs().max()) / DT)
        previous = motion.current().position
        if float(motion._since_s) > 1.9:
            expected = {"a": 0.0, "b": 1.0}[motion.clips.names[int(motion.clips.clip)]]
            assert float(previous[0, 0]) == pytest.approx(expected, abs=1e-5)
    assert 1.5 < fastest <= 0.2 * 9.0 * 1.02


def test_one_seed_is_one_motion_and_state_continues_exactly(any_spec):
    cfg = ReferenceConfig(clips=ClipConfig(hold_s=(0.5, 1.0)))
    assert torch.equal(play(cfg, any_spec, 8, 3.0)[0], play(cfg, any_spec, 8, 3.0)[0])
    assert not torch.equal(play(cfg, any_spec, 8, 3.0)[0], play(cfg, any_spec, 8, 3.0, seed=1)[0])
    rng = torch.Generator().manual_seed(0)
    motion = ReferenceMotion(cfg, any_spec, 8, DT)
    motion.reset(everyone(8), rng)
    for _ in range(33):
        motion.step(rng)
    saved, random_state = motion.state_dict(), rng.get_state()
    other = ReferenceMotion(cfg, any_spec, 8, DT)
    other.load_state_dict(saved)
    futures = []
    for m in (motion, other):
        rng.set_state(random_state)
        for _ in range(100):
            m.step(rng)
        futures.append(m.current().position)
    assert torch.equal(*futures)
    with pytest.raises(ValueError, match=rf"must have shape \(9, {len(any_spec.upper_joints)}\)"):
        ReferenceMotion(cfg, any_spec, 9, DT).load_state_dict(saved)


def test_reset_touches_only_its_envs_and_forgets(any_spec, rng):
    motion = ReferenceMotion(ReferenceConfig(), any_spec, 4, DT)
    motion.reset(everyone(4), rng)
    motion._offset[:] = 5.0
    before = motion.current().position.clone()
    motion.reset(torch.tensor([False, True, False, True]), rng)
    assert torch.equal(motion.current().position[[0, 2]], before[[0, 2]])
    assert not torch.equal(motion.current().position[[1, 3]], before[[1, 3]])
    assert motion._offset[:, 0].tolist() == [5.0, 0.0, 5.0, 0.0]


def test_held_out_clips_are_never_played_and_named_ones_are(spec):
    names = load_clips(ClipConfig(), spec).names()
    assert not {"dance_b", "dance_b_mirrored", "kick", "kick_mirrored"} & set(names)
    assert len(names) == 36
    assert load_clips(ClipConfig(only=("kick", "punch")), spec).names() == ["kick", "punch"]
    with pytest.raises(MotionError, match=r"no clip is called 'moonwalk'; clips: .*walk"):
        load_clips(ClipConfig(only=("moonwalk",)), spec)
    with pytest.raises(MotionError, match="leaves no clip"):
        load_clips(ClipConfig(held_out=tuple(shipped_library(spec).names())), spec)


def test_root_velocity_is_that_of_envs_that_play_clips(spec):
    clips = ClipConfig(share=1.0, only=("run",), velocity_share=1.0, acceleration=1e6)
    motion = ReferenceMotion(ReferenceConfig(clips=clips), spec, 2, DT)
    rng = torch.Generator().manual_seed(0)
    motion.reset(everyone(2), rng)
    motion._from_clip = torch.tensor([True, False])
    v = motion.root_velocity()
    assert float(v[0, 0]) > 2.0
    assert not v[1].any()
    nothing = ReferenceMotion(ReferenceConfig(clips=ClipConfig(share=0.0)), spec, 2, DT)
    assert not nothing.root_velocity().any()


def test_a_robot_without_a_library_follows_the_generator_unless_clips_are_asked_for(spec):
    stranger = replace(spec, name="stranger")
    assert has_shipped_library(spec)
    assert not has_shipped_library(stranger)
    assert ReferenceMotion(ReferenceConfig(), stranger, 2, DT).clips is None
    alone = play(ReferenceConfig(clips=ClipConfig(share=0.0)), spec, 8, 2.0)[0]
    assert torch.equal(play(ReferenceConfig(), stranger, 8, 2.0)[0], alone)
    for clips, message in (
        (ClipConfig(only=("walk",)), "no motion library is shipped for robot 'stranger'"),
        (ClipConfig(library="nowhere.npz"), "does not exist"),
    ):
        with pytest.raises(MotionError, match=message):
            ReferenceMotion(ReferenceConfig(clips=clips), stranger, 2, DT)


@pytest.mark.parametrize(
    ("field", "value"),
    [("share", 1.5), ("share", math.nan), ("hold_s", (3.0, 1.0)), ("blend_s", 0.0), ("blend_speed", 0.0)],
)
def test_bad_fields_are_named(spec, field, value):
    with pytest.raises(ValueError, match=rf"clips\.{field}"):
        ReferenceMotion(ReferenceConfig(clips=ClipConfig(**{field: value})), spec, 2, DT)


def test_ten_thousand_clips_are_one_copy_of_the_data(spec):
    clips = [made_clip(f"c{i}", 0.001 * (i % 100), 20) for i in range(10_000)]
    p = player(spec, clips, 8)
    assert p._frames.numel() == 10_000 * 20 * 8
    assert p._frames.untyped_storage().nbytes() == 10_000 * 20 * 8 * 4
    p.draw(everyone(8), torch.Generator().manual_seed(0))
    expected = 0.001 * (p.clip % 100)
    torch.testing.assert_close(p.current()[:, 0], expected.float())
