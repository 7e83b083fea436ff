"""Inverse kinematics: reachable and unreachable points, limits, calm at rest, against scipy's bounded least squares."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.optimize import least_squares

from cotap.compliance.inverse_kinematics import ArmIK
from cotap.robots.chains import arm_model

N = 100


@pytest.fixture(scope="module")
def arms(spec):
    return arm_model(spec)


@pytest.fixture
def ik(arms) -> ArmIK:
    return ArmIK(arms.chains, arms.low, arms.high)


@pytest.fixture
def posture(arms, rng) -> torch.Tensor:
    """Bent arms, both sides mirrored, a little different in each world."""
    q = torch.tensor([[0.1, 0.3, 0.2, 0.3], [0.1, -0.3, -0.2, 0.3]])
    return (q + 0.15 * torch.randn(N, 2, 4, generator=rng)).clamp(arms.low, arms.high)


MOST = torch.tensor([0.18, 0.18, 0.4, 0.4]).repeat(2, 1)  # what H1's arm joints turn by in 20 ms


def follow(ik: ArmIK, path: list[torch.Tensor], posture: torch.Tensor, start=None) -> torch.Tensor:
    """Solutions (T, N, 2, 4), each from the one before."""
    out = [posture if start is None else start]
    for tip in path:
        out.append(ik(tip, posture, out[-1], MOST).position)
    return torch.stack(out)


def directions(rng) -> torch.Tensor:
    d = torch.randn(N, 2, 3, generator=rng)
    return d / d.norm(dim=-1, keepdim=True)


def test_a_hand_where_it_should_be_stays(arms, ik, posture):
    solution = ik(arms.chains.pose(posture).tip, posture, posture, MOST)
    torch.testing.assert_close(solution.position, posture, atol=1e-5, rtol=0)
    assert float(solution.error.max()) < 1e-6


def test_reachable_points_are_followed_to_a_millimetre(arms, ik, posture, rng):
    """Hands that swing by joint motion of 0.4 rad at up to 2.5 rad/s; 20 ms per point."""
    swing = 0.4 * torch.sign(torch.randn(N, 2, 4, generator=rng))
    path = [
        arms.chains.pose((posture + swing * math.sin(0.125 * t)).clamp(arms.low, arms.high)).tip for t in range(100)
    ]
    solved = follow(ik, path, posture)[1:]
    errors = torch.stack([(arms.chains.pose(q).tip - p).norm(dim=-1) for q, p in zip(solved, path, strict=True)])
    assert float(errors.max()) < 1e-3
    at_rest = follow(ik, path[-1:] * 20, posture, solved[-1])[-1]
    assert float((arms.chains.pose(at_rest).tip - path[-1]).norm(dim=-1).max()) < 1e-3


def test_no_jump_on_the_way_out_of_reach_and_back(arms, ik, posture, rng):
    """1 cm of the point per step to 1.5 m away, where it rests, and back: joints move little, rest, and come back."""
    start, away = arms.chains.pose(posture).tip, directions(rng)
    out = [start + 0.01 * k * away for k in range(151)]
    solved = follow(ik, out + out[-1:] * 150 + out[::-1] + out[:1] * 200, posture)
    step = (solved[1:] - solved[:-1]).abs()
    assert (step <= MOST + 1e-6).all()
    assert float(step.flatten(1).quantile(0.99, dim=1).mean()) < 0.06
    assert float(step[285:300].max()) < 0.01  # at rest out there
    back = (arms.chains.pose(solved[-1]).tip - start).norm(dim=-1)
    assert float(back.max()) < 1e-3
    assert torch.isfinite(solved).all()
    assert (solved >= arms.low).all()
    assert (solved <= arms.high).all()


def test_out_of_reach_is_as_near_as_the_joints_allow(arms, ik, posture, rng):
    """Against scipy's trust region with bounds, from the same start."""
    start, away = arms.chains.pose(posture).tip, directions(rng)
    wanted = start + 1.2 * away
    ours = follow(ik, [start + 0.012 * k * away for k in range(101)] + [wanted] * 200, posture)[-1]
    ours_m = (arms.chains.pose(ours).tip - wanted).norm(dim=-1)
    for world in range(6):
        for arm in range(2):
            q = posture.clone().double()

            def error(x, world=world, arm=arm, q=q):
                q[world, arm] = torch.tensor(x)
                return (arms.chains.pose(q.float()).tip[world, arm] - wanted[world, arm]).double().numpy()

            bounds = arms.low[arm].double().numpy() - 1e-6, arms.high[arm].double().numpy() + 1e-6
            best = least_squares(error, ours[world, arm].double().numpy(), bounds=bounds, diff_step=1e-3)
            best_m = float(torch.tensor(best.fun).norm())
            assert best_m > 0.05
            assert float(ours_m[world, arm]) < best_m + 2e-3


def test_what_redundancy_leaves_open_goes_to_the_posture(arms, ik, posture):
    """At rest, what is left of the way to the posture moves the hand: nothing is left in the null space."""
    wanted = arms.chains.pose(posture + 0.1).tip
    solved = follow(ik, [wanted] * 400, posture)[-1]
    jacobian = arms.chains.jacobian(arms.chains.pose(solved)).double()
    null = torch.eye(4).double() - torch.linalg.pinv(jacobian) @ jacobian
    inside = ((solved > arms.low + 1e-3) & (solved < arms.high - 1e-3)).all(-1)
    left = (null @ (posture - solved).double().unsqueeze(-1)).squeeze(-1)
    assert int(inside.sum()) > N
    assert float(left[inside].abs().max()) < 5e-3


def test_bad_limits_are_named(arms):
    with pytest.raises(ValueError, match="low must have shape"):
        ArmIK(arms.chains, arms.low[:1], arms.high)
    with pytest.raises(ValueError, match="low must not exceed high"):
        ArmIK(arms.chains, arms.high, arms.low)
    with pytest.raises(ValueError, match="steps must be a positive integer"):
        ArmIK(arms.chains, arms.low, arms.high, 0)
