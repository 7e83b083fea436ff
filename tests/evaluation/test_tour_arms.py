"""The arms' random walk: how far, within what limits, where hands may not go, and how targets are approached."""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch

from cotap.evaluation.tour.arm_walk import ArmWalk, arms_at
from cotap.evaluation.tour.stance import tour_stance


def rngs(count: int, seed: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng((seed, run)) for run in range(count)]


def hands_of(spec, model, arms: torch.Tensor) -> np.ndarray:
    """Hand points (A, 3) in the torso frame, by MuJoCo, for arm joints (U,)."""
    data = mujoco.MjData(model)
    for name, value in zip(spec.upper_joints, arms.tolist(), strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_forward(model, data)
    torso = data.body(spec.torso_body)
    points = [data.site(f"{arm.side}_hand").xpos for arm in spec.arms]
    return np.array([torso.xmat.reshape(3, 3).T @ (p - torso.xpos) for p in points])


def test_it_begins_in_the_stance_and_the_right_arm_is_the_mirror_image(any_spec, any_model):
    stance = tour_stance(any_spec)
    targets = ArmWalk(any_spec, stance).draw(12, rngs(3))
    assert targets.shape == (3, 13, len(any_spec.upper_joints))
    torch.testing.assert_close(targets[:, 0], stance.angles[any_spec.indices(any_spec.upper_joints)].expand(3, -1))
    for pose in targets[:, 1:].flatten(0, 1)[::7]:
        left, right = hands_of(any_spec, any_model, pose)
        np.testing.assert_allclose(left * [1.0, -1.0, 1.0], right, atol=2e-3)


def test_targets_are_within_limits_in_front_and_below_the_chin(any_spec, any_model):
    stance = tour_stance(any_spec)
    walk = ArmWalk(any_spec, stance)
    targets = walk.draw(40, rngs(4))
    low, high = torch.tensor([any_spec.joint(name).range_rad for name in any_spec.upper_joints]).unbind(1)
    assert (targets >= low - 1e-6).all()
    assert (targets <= high + 1e-6).all()
    front = hands_of(any_spec, any_model, targets[0, 0])[:, 0].min()
    for pose in targets[:, 1:].flatten(0, 1)[::5]:
        hands = hands_of(any_spec, any_model, pose)
        assert hands[:, 0].min() >= front - 1e-5
        assert hands[:, 2].max() <= stance.chin_height_m + 1e-5


def test_poses_behind_the_stance_or_above_the_chin_are_not_allowed(any_spec, any_model):
    stance = tour_stance(any_spec)
    walk = ArmWalk(any_spec, stance)
    left = stance.angles[any_spec.indices(any_spec.arms[0].joints)].double()
    moved = left + torch.from_numpy(np.random.default_rng(1).uniform(-1.5, 1.5, (60, len(left))))
    hands = np.array([hands_of(any_spec, any_model, pose) for pose in walk.both(moved)])
    front = hands_of(any_spec, any_model, walk.both(left))[:, 0].min()
    expected = (hands[..., 0] >= front).all(1) & (hands[..., 2] <= stance.chin_height_m).all(1)
    assert walk.allowed(moved).tolist() == expected.tolist()
    assert 5 < expected.sum() < 55


def test_between_targets_lies_a_walk_of_25_uniform_steps(any_spec):
    """Where nothing is in the way: variance 25 x 0.06^2 / 3 per joint, at most 1.5 rad."""
    stance = dataclasses.replace(tour_stance(any_spec), chin_height_m=10.0)
    walk = ArmWalk(any_spec, stance)
    walk._front_m, walk._low, walk._high = -10.0, walk._low - 10.0, walk._high + 10.0
    targets = walk.draw(3, rngs(3000))[..., : len(any_spec.arms[0].joints)]
    step = targets[:, 1] - targets[:, 0]
    assert step.std(0).tolist() == pytest.approx([0.06 * math.sqrt(25 / 3)] * step.shape[1], rel=0.05)
    assert float(step.mean(0).abs().max()) < 0.012
    assert float(step.abs().max()) <= 1.5
    # One walk goes on where the one before ended, by itself.
    far = targets[:, 3] - targets[:, 0]
    assert far.std(0).tolist() == pytest.approx([0.06 * math.sqrt(25.0)] * far.shape[1], rel=0.05)


def test_a_walk_goes_along_a_limit_rather_than_beyond_it(any_spec):
    """Every step is clipped, not the end of the walk alone: from a limit, ten steps out and five in end five in."""
    walk = ArmWalk(any_spec, tour_stance(any_spec))
    walk._front_m, walk._chin_m = -10.0, 10.0
    steps = torch.zeros(1, 1, 15, len(walk._high), dtype=torch.float64)
    steps[:, :, :10], steps[:, :, 10:] = 0.06, -0.06
    torch.testing.assert_close(walk._next(walk._high[None], steps), walk._high[None] - 0.3)


def test_the_first_walk_that_is_allowed_counts_and_if_none_is_the_target_is_kept(any_spec):
    walk = ArmWalk(any_spec, tour_stance(any_spec))
    present = walk._start[None]
    ways = torch.zeros(1, 8, 1, present.shape[1], dtype=torch.float64)
    ways[0, :, 0, 0] = torch.tensor([0.3, 0.2, -0.2, -0.1, 0.4, -0.3, 0.3, 0.2])  # shoulder pitch
    back, forward = (walk.allowed(present + way) for way in (ways[:, 0, 0], ways[:, 2, 0]))
    assert (bool(back), bool(forward)) == (False, True)
    torch.testing.assert_close(walk._next(present, ways), present + ways[:, 2, 0])
    torch.testing.assert_close(walk._next(present, ways.abs()), present)


def test_a_run_has_its_walk_whatever_others_there_are(any_spec):
    walk = ArmWalk(any_spec, tour_stance(any_spec))
    assert torch.equal(walk.draw(5, rngs(4))[2], walk.draw(5, [np.random.default_rng((0, 2))])[0])


def test_targets_are_approached_linearly_over_half_a_second():
    targets = torch.tensor([[[0.0, 1.0], [0.5, 1.0], [0.5, -1.0]]])
    by_hand = {
        0.0: ([0.0, 1.0], [1.0, 0.0]), 0.25: ([0.25, 1.0], [1.0, 0.0]), 0.5: ([0.5, 1.0], [1.0, 0.0]),
        0.52: ([0.5, 0.92], [0.0, -4.0]), 1.0: ([0.5, -1.0], [0.0, -4.0]), 1.3: ([0.5, -1.0], [0.0, -4.0]),
    }  # fmt: skip
    for time_s, (position, velocity) in by_hand.items():
        at, rate = arms_at(targets, time_s)
        assert at[0].tolist() == pytest.approx(position, abs=1e-6)
        assert rate[0].tolist() == pytest.approx(velocity, abs=1e-6)
