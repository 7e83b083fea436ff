"""Joint stiffness from task stiffness, against the paper's general form, algebra and finite differences."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from itertools import permutations

import pytest
import torch

from cotap.compliance import (
    ArmKinematics,
    condition_number,
    modulate_stiffness,
    resolve_joint_stiffness,
    singularity_aware_ratio,
)
from cotap.compliance.fast import blended_stiffness
from cotap.compliance.stiffness import RANK_TOLERANCE, project_compliance
from cotap.robots.chains import arm_chains

DOUBLE = torch.float64


def general_form(jacobian, task_stiffness, null_stiffness, base_compliance=None):
    """`K_u = (J# C_hat J#^T + Y - J# J Y J^T J#^T)^-1` (paper, equation 7), literally."""
    c_hat = torch.linalg.inv(task_stiffness)
    if base_compliance is not None:
        c_hat = c_hat - base_compliance
    n = jacobian.shape[-1]
    y = torch.eye(n, dtype=jacobian.dtype) / null_stiffness[..., None, None]
    j, pinv = jacobian, torch.linalg.pinv(jacobian)
    jt, pinvt = j.transpose(-1, -2), pinv.transpose(-1, -2)
    return torch.linalg.inv(pinv @ c_hat @ pinvt + y - pinv @ j @ y @ jt @ pinvt)


def random_jacobians(rng, count, rows=3, joints=4, largest_condition=20.0):
    """Random singular vectors, condition numbers up to `largest_condition`, sizes around those of arms."""
    u, _ = torch.linalg.qr(torch.randn(count, rows, rows, dtype=DOUBLE, generator=rng))
    v, _ = torch.linalg.qr(torch.randn(count, joints, joints, dtype=DOUBLE, generator=rng))
    condition = torch.exp(torch.rand(count, 1, dtype=DOUBLE, generator=rng) * math.log(largest_condition))
    values = condition ** -torch.rand(count, rows, dtype=DOUBLE, generator=rng)
    values[:, 0], values[:, -1] = 1.0, 1.0 / condition[:, 0]
    return 0.6 * (u * values.unsqueeze(-2)) @ v[:, :, :rows].transpose(-1, -2)


def random_task(rng, count, rows=3):
    a = torch.randn(count, rows, rows, dtype=DOUBLE, generator=rng)
    scale = 100.0 * torch.exp(2.3 * torch.rand(count, 1, 1, dtype=DOUBLE, generator=rng))
    return scale * (a @ a.transpose(-1, -2) + 0.5 * torch.eye(rows, dtype=DOUBLE))


@pytest.mark.parametrize(("rows", "joints"), [(3, 4), (3, 7), (6, 7), (6, 6), (6, 8), (2, 3)])
def test_against_the_general_form(rng, rows, joints):
    """10,000 cases for H1's arm; both arms coupled are (6, 8)."""
    count = 10_000 if (rows, joints) == (3, 4) else 1000
    j, k = random_jacobians(rng, count, rows, joints), random_task(rng, count, rows)
    null = 10.0 + 90.0 * torch.rand(count, dtype=DOUBLE, generator=rng)
    mine, theirs = resolve_joint_stiffness(j, k, null), general_form(j, k, null)
    error = (mine - theirs).flatten(1).norm(dim=1) / theirs.flatten(1).norm(dim=1)
    assert float(error.max()) < 1e-9
    # The hand is as compliant as asked.
    felt = j @ torch.linalg.inv(mine) @ j.transpose(-1, -2)
    wanted = torch.linalg.inv(k)
    assert float(((felt - wanted).flatten(1).norm(dim=1) / wanted.flatten(1).norm(dim=1)).max()) < 1e-9


def test_null_space_is_exactly_as_stiff_as_asked(rng):
    j, k = random_jacobians(rng, 500), random_task(rng, 500)
    null = torch.linalg.svd(j).Vh[:, 3:]
    stiffness = resolve_joint_stiffness(j, k, 37.0)
    torch.testing.assert_close(
        (stiffness @ null.transpose(1, 2)).squeeze(2), 37.0 * null.squeeze(1), rtol=1e-9, atol=1e-9
    )


def test_a_moving_base_takes_its_share(rng):
    """The arm in series with the base is as compliant as asked."""
    j = random_jacobians(rng, 200)
    k = torch.tensor([200.0, 300.0, 400.0], dtype=DOUBLE).expand(200, 3)
    base = torch.tensor([1e-3, 5e-4, 2e-4], dtype=DOUBLE)
    stiffness = resolve_joint_stiffness(j, k, 25.0, base.expand(200, 3))
    arm = j @ torch.linalg.inv(stiffness) @ j.transpose(-1, -2)
    torch.testing.assert_close(arm + torch.diag(base), torch.diag_embed(1.0 / k), rtol=1e-9, atol=1e-12)
    matrix = resolve_joint_stiffness(j, k, 25.0, torch.diag(base).expand(200, 3, 3))
    torch.testing.assert_close(matrix, stiffness)


def h1_poses(spec, rng, count):
    joints = [spec.joints[i] for i in spec.indices(spec.upper_joints)]
    low, high = torch.tensor([j.range_rad for j in joints]).unbind(1)
    q = low + (high - low) * torch.rand(count, 8, generator=rng)
    straight = q[: count // 20].clone()
    straight[:, [3, 7]] = math.atan2(0.1343 + 0.198, 0.0185)  # shoulder, elbow and hand in one line
    folded = q[: count // 20].clone()
    folded[:, [3, 7]] = -1.25
    return torch.cat((q, straight, folded)).unflatten(1, (2, 4))


def test_positive_definite_at_every_pose_in_single_precision(spec, rng):
    chains = arm_chains(spec)
    j = chains.jacobian(chains.pose(h1_poses(spec, rng, 46_000)))  # 101,200 arms
    count = j.shape[0]
    task = torch.exp(torch.empty(count, 2, 3).uniform_(math.log(80.0), math.log(1200.0), generator=rng))
    null, alpha = torch.full((count, 2), 25.0), torch.rand(count, 2, generator=rng)
    stiffness = resolve_joint_stiffness(j, task, null)
    assert stiffness.dtype == torch.float32
    smallest = torch.linalg.eigvalsh(stiffness.double()).amin(-1)
    assert float(smallest.min()) > 0.0
    pd = torch.full((count, 2), 100.0)
    blend = blended_stiffness(j, task, null, pd, alpha).stiffness
    assert torch.isfinite(blend).all()
    assert float(torch.linalg.eigvalsh(blend.double()).min()) > 0.0
    # Towards a singularity the blend tends to PD.
    condition = condition_number(j.double())
    away = (blend - 100.0 * torch.eye(4)).flatten(2).norm(dim=2)
    for bound, allowed in ((50.0, 40.0), (200.0, 15.0), (1000.0, 5.0)):
        far = condition > bound
        assert int(far.sum()) > 20
        assert float(away[far].max()) < allowed


def test_the_fast_blend_is_the_slow_one(spec, rng):
    chains = arm_chains(spec)
    j = chains.jacobian(chains.pose(h1_poses(spec, rng, 4000)))
    count = j.shape[0]
    task = torch.exp(torch.empty(count, 2, 3).uniform_(math.log(80.0), math.log(1200.0), generator=rng))
    null = torch.empty(count, 2).uniform_(15.0, 60.0, generator=rng)
    pd, alpha = torch.full((count, 2), 100.0), torch.rand(count, 2, generator=rng)
    fast = blended_stiffness(j, task, null, pd, alpha)
    jd, eye = j.double(), torch.eye(4, dtype=DOUBLE)
    ratio = singularity_aware_ratio(alpha.double(), jd)
    slow = modulate_stiffness(
        resolve_joint_stiffness(jd, task.double(), null.double()), (100.0 * eye).expand(count, 2, 4, 4), ratio
    )
    near = condition_number(jd) < 50.0
    torch.testing.assert_close(fast.ratio.double()[near], ratio[near], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(fast.stiffness.double()[near], slow[near], rtol=1e-4, atol=1e-3)
    values = torch.linalg.eigvalsh(slow)
    torch.testing.assert_close(fast.eigenvalue_range.double()[near], values[..., [0, -1]][near], rtol=1e-4, atol=1e-3)
    identity = fast.pseudo_inverse.double() @ jd + fast.null_projector.double()
    torch.testing.assert_close(identity[near], eye.expand_as(identity)[near], rtol=0, atol=1e-4)
    full = blended_stiffness(j, torch.diag_embed(task), null, pd, alpha).stiffness
    torch.testing.assert_close(full[near], fast.stiffness[near], rtol=1e-4, atol=1e-3)
    known = blended_stiffness(j, task, null, pd, torch.ones_like(alpha)).stiffness.double()
    close = condition_number(jd) < 10.0
    resolved = resolve_joint_stiffness(jd, task.double(), null.double())
    torch.testing.assert_close(known[close], resolved[close], rtol=1e-5, atol=1e-3)


def test_null_stiffness_may_differ_between_joints():
    """One row, two joints, by hand: `J' = J / sqrt(k)` is (1/sqrt 20, 1/sqrt 5), which has length 1/2."""
    j, task = torch.tensor([[1.0, 1.0]], dtype=DOUBLE), torch.tensor([300.0], dtype=DOUBLE)
    stiffness = resolve_joint_stiffness(j, task, torch.tensor([20.0, 5.0], dtype=DOUBLE))
    torch.testing.assert_close(stiffness, torch.tensor([[316.0, 296.0], [296.0, 301.0]], dtype=DOUBLE))
    apart = resolve_joint_stiffness(torch.tensor([[1.0, 0.0]], dtype=DOUBLE), task, torch.tensor([20.0, 5.0]).double())
    torch.testing.assert_close(apart, torch.diag(torch.tensor([300.0, 5.0], dtype=DOUBLE)))


def test_the_hand_is_as_stiff_as_asked_whatever_the_null_stiffness(rng):
    j = torch.randn(200, 3, 7, dtype=DOUBLE, generator=rng)
    null = torch.exp(torch.randn(200, 7, dtype=DOUBLE, generator=rng)) * 20.0
    task = torch.exp(torch.randn(200, 3, dtype=DOUBLE, generator=rng)) * 300.0
    stiffness = resolve_joint_stiffness(j, task, null)
    felt = j @ torch.linalg.inv(stiffness) @ j.transpose(-1, -2)
    torch.testing.assert_close(felt, torch.diag_embed(1.0 / task), rtol=1e-8, atol=1e-10)
    assert (torch.linalg.eigvalsh(stiffness) > 0.0).all()
    same = torch.full((200, 7), 25.0, dtype=DOUBLE)
    torch.testing.assert_close(resolve_joint_stiffness(j, task, same), resolve_joint_stiffness(j, task, 25.0))
    with pytest.raises(ValueError, match="null_stiffness must be positive, got -1"):
        resolve_joint_stiffness(j, task, torch.where(null == null[0, 0], -1.0, null))
    with pytest.raises(ValueError, match=r"null_stiffness must be one number or, as jacobian, have shape \(200,\)"):
        resolve_joint_stiffness(j, task, null[:, :6])


@pytest.mark.parametrize("joints", [4, 7])
def test_the_fast_blend_of_different_gains_is_the_geodesic_from_pd(joints: int, rng):
    j = torch.randn(300, 2, 3, joints, generator=rng)
    task = torch.exp(torch.empty(300, 2, 3).uniform_(math.log(80.0), math.log(1200.0), generator=rng))
    gains = torch.tensor([100.0, 60.0, 40.0, 20.0, 20.0, 10.0, 4.0])[:joints].expand(300, 2, joints)
    null, alpha = torch.empty(300, 2).uniform_(15.0, 60.0, generator=rng), torch.rand(300, 2, generator=rng)
    fast = blended_stiffness(j, task, null, gains, alpha, 10.0)
    each = (null.unsqueeze(-1) * gains / 100.0).double()
    goal = resolve_joint_stiffness(j.double(), task.double(), each)
    ratio = singularity_aware_ratio(alpha.double(), j.double())
    root = gains.double().sqrt()
    between = goal / root.unsqueeze(-1) / root.unsqueeze(-2)
    values, vectors = torch.linalg.eigh(between)
    power = (vectors * values.pow(ratio.unsqueeze(-1)).unsqueeze(-2)) @ vectors.transpose(-1, -2)
    slow = root.unsqueeze(-1) * power * root.unsqueeze(-2)
    near = condition_number(j.double()) < 30.0
    torch.testing.assert_close(fast.stiffness.double()[near], slow[near], rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(fast.ratio.double(), ratio, rtol=1e-5, atol=1e-6)
    relative = 100.0 * torch.linalg.eigvalsh(power)[..., [0, -1]]
    torch.testing.assert_close(fast.eigenvalue_range.double()[near], relative[near], rtol=1e-4, atol=1e-3)
    inverse, projector = fast.pseudo_inverse.double()[near], fast.null_projector.double()[near]
    eye, known = torch.eye(3, dtype=DOUBLE), j.double()[near]
    torch.testing.assert_close(known @ inverse, eye.expand(len(known), 3, 3), rtol=0, atol=1e-4)
    eye = torch.eye(joints, dtype=DOUBLE).expand_as(projector)
    torch.testing.assert_close(inverse @ known + projector, eye, rtol=0, atol=1e-4)
    # The log-Euclidean blend has the same ends and is near in between.
    literal = modulate_stiffness(goal, torch.diag_embed(gains.double()), ratio)
    apart = (literal - slow).norm(dim=(-1, -2)) / slow.norm(dim=(-1, -2))
    assert 1e-4 < float(apart.median()) < 0.3
    alike = blended_stiffness(j, task, null, torch.full_like(gains, 50.0), alpha)
    known = blended_stiffness(j, task, null, torch.full_like(null, 50.0), alpha)
    torch.testing.assert_close(alike.stiffness, known.stiffness, rtol=1e-5, atol=1e-4)


def test_without_the_ratio_it_is_the_papers_law_up_to_a_straight_arm(rng):
    """Equation 7 with the exact pseudo-inverse at alpha 1; the damped law adds stiffness where rank is nearly lost."""
    j = random_jacobians(rng, 4000, largest_condition=1e3)
    j = j[condition_number(j) > 60.0]
    assert len(j) > 500
    task, null, pd = torch.full((len(j), 3), 300.0), torch.full((len(j),), 40.0), torch.full((len(j),), 100.0)
    blend = blended_stiffness(j.float(), task, null, pd, torch.ones(len(j)), math.inf)
    exact = j.float().double()
    inverse = torch.linalg.pinv(exact)
    eye = torch.eye(4, dtype=DOUBLE)
    literal = exact.mT @ (300.0 * exact) + 40.0 * (eye - inverse @ exact)
    torch.testing.assert_close(blend.stiffness.double(), literal, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(blend.ratio, torch.ones(len(j)))
    damped = blended_stiffness(j.float(), task, null, pd, torch.ones(len(j)), 1e9).stiffness.double()
    assert float(torch.linalg.eigvalsh(damped - literal)[:, -1].min()) > 1.0
    straight = torch.tensor([[0.0, 0.3, 0.0, 0.1], [0.2, 0.0, 0.4, 0.0], [0.0, 0.0, 0.0, 0.0]])
    stiffness = blended_stiffness(straight, task[0], null[0], pd[0], torch.tensor(1.0), math.inf)
    assert torch.isfinite(stiffness.stiffness).all()
    assert torch.isfinite(stiffness.pseudo_inverse).all()


@pytest.mark.parametrize("joints", [4, 7])
@pytest.mark.parametrize("smallest", [0.0, 1e-8, 1e-7, 1e-6, 3.3e-6, 4e-6, 1e-5, 1e-4])
def test_without_a_direction_to_move_in_it_is_pd(joints: int, smallest: float, rng):
    """Where rank is lost, to rounding or wholly, whatever the stiffness of each direction and alpha."""
    u, s, v = torch.linalg.svd(torch.randn(2000, 3, joints, dtype=DOUBLE, generator=rng), full_matrices=False)
    s[:, 2] = smallest * s[:, 0]
    j, alpha = u @ torch.diag_embed(s) @ v, torch.rand(2000, dtype=DOUBLE, generator=rng)
    task = torch.exp(torch.empty(2000, 3).double().uniform_(math.log(80.0), math.log(1200.0), generator=rng))
    null, pd = torch.full_like(alpha, 40.0), torch.full_like(alpha, 100.0)
    blend = blended_stiffness(j, task, null, pd, alpha)
    torch.testing.assert_close(blend.stiffness, (100.0 * torch.eye(joints)).double().expand_as(blend.stiffness),
                               rtol=0.0, atol=1.0)  # fmt: skip
    paper = blended_stiffness(j, task, null, pd, alpha, math.inf)
    values = torch.linalg.eigvalsh(paper.stiffness)  # the paper's law asks for next to nothing there
    assert (values[:, 0] > -1e-6 * values[:, -1]).all()
    assert torch.isfinite(paper.pseudo_inverse).all()


@pytest.mark.parametrize("cond", [10.0, 1e2, 1e3, 1e4, 1e5, 3e5])
@pytest.mark.parametrize(("apart", "rtol"), [(15.0, 4e-3), (100.0, 1e-2), (300.0, 0.1)])
def test_directions_of_very_different_stiffness_near_a_singularity(apart: float, rtol: float, cond: float, rng):
    """What the blend asks for lies between what compliance and PD do: rounding leaves it positive."""
    u, s, v = torch.linalg.svd(torch.randn(2000, 3, 4, dtype=DOUBLE, generator=rng), full_matrices=False)
    s[:, 2] = s[:, 0] / cond
    j, one = u @ torch.diag_embed(s) @ v, torch.ones(2000, dtype=DOUBLE)
    for axis in range(3):
        task = torch.full((2000, 3), 80.0, dtype=DOUBLE)
        task[:, axis] *= apart
        values = torch.linalg.eigvalsh(blended_stiffness(j, task, 40.0 * one, 100.0 * one, one).stiffness)
        assert float(values.min()) > 0.0
        if cond >= 1e4:
            torch.testing.assert_close(values, torch.full_like(values, 100.0), rtol=rtol, atol=0.0)


@pytest.mark.parametrize("apart", [0.0, 2e-7, 1e-5, 0.03])
def test_the_fast_blend_is_as_exact_where_eigenvalues_nearly_coincide(apart: float):
    """Of a Jacobian that is diagonal, so is the blend: `pd^(1-a) k^a` joint by joint."""
    own = torch.tensor([1.0, 1.0 + apart, 1.0 + 3.0 * apart], dtype=DOUBLE)
    j = torch.cat((torch.diag(own), torch.zeros(3, 1, dtype=DOUBLE)), 1)
    task, null, pd, alpha = (torch.tensor(x, dtype=DOUBLE) for x in ((200.0,) * 3, 30.0, 100.0, 0.4))
    blend = blended_stiffness(j, task, null, pd, alpha).stiffness
    expected = 100.0**0.6 * torch.cat((200.0 * own.square(), null.reshape(1))).pow(0.4)
    torch.testing.assert_close(blend, torch.diag(expected), rtol=1e-11, atol=1e-9)


def test_condition_number_and_ratio_by_hand():
    j = torch.tensor([[2.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    assert float(condition_number(j)) == pytest.approx(20.0)
    assert float(singularity_aware_ratio(0.8, j)) == pytest.approx(0.8 / 11.0)
    assert float(singularity_aware_ratio(0.8, j, threshold=25.0)) == pytest.approx(0.8)
    lost = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert math.isinf(float(condition_number(lost)))
    assert float(singularity_aware_ratio(1.0, lost)) == 0.0


def test_gradients_against_finite_differences(rng):
    j = random_jacobians(rng, 1, largest_condition=5.0)[0].requires_grad_()
    k = torch.tensor([2.0, 3.0, 4.0], dtype=DOUBLE, requires_grad=True)
    null = torch.tensor(1.5, dtype=DOUBLE, requires_grad=True)
    assert torch.autograd.gradcheck(resolve_joint_stiffness, (j, k, null))
    assert torch.autograd.gradcheck(lambda x: singularity_aware_ratio(0.7, x, threshold=1.5), j)
    assert torch.autograd.gradgradcheck(resolve_joint_stiffness, (j, k, null))


def test_the_derivative_of_the_damped_projector_by_hand():
    """With J = diag(a, b), b < 0.02 a, the second joint has k11 = 300 b^2 + 40 (1 - b^2 / (0.02 a)^2)."""
    j = torch.tensor([[1.0, 0.0], [0.0, 0.01]], dtype=DOUBLE, requires_grad=True)
    k11 = resolve_joint_stiffness(j, torch.full((2,), 300.0, dtype=DOUBLE), 40.0)[1, 1]
    assert float(k11.detach()) == pytest.approx(300.0 * 1e-4 + 40.0 * 0.75)
    (gradient,) = torch.autograd.grad(k11, j)
    expected = torch.tensor([[20.0, 0.0], [0.0, 600.0 * 0.01 - 80.0 * 0.01 / 0.02**2]], dtype=DOUBLE)
    torch.testing.assert_close(gradient, expected)


def test_forward_derivatives_of_any_order_by_hand():
    """Forward over forward: of 20 / x, 0.7 / (x - 1), 300 x^2 + 40 (1 - x^2 / 0.02^2) where damped, and x^0.5."""
    one, task = torch.tensor(1.0, dtype=DOUBLE), torch.full((2,), 300.0, dtype=DOUBLE)

    def diagonal(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return torch.diag(torch.stack((a, b)))

    for function, at, derivatives in (
        (lambda x: condition_number(diagonal(20.0 * one, x)), 4.0, (5.0, -1.25, 0.625, -0.46875)),
        (lambda x: singularity_aware_ratio(0.7, diagonal(x, one), 2.0), 4.0, (0.7 / 3, -0.7 / 9, 1.4 / 27, -4.2 / 81)),
        (lambda x: resolve_joint_stiffness(diagonal(one, x), task, 40.0)[1, 1], 0.01, (30.03, -1994.0, -199400.0, 0.0)),
        (
            lambda x: modulate_stiffness(x.expand(1, 1), torch.ones_like(x).expand(1, 1), 0.5),
            4.0,
            (2, 1 / 4, -1 / 32, 3 / 256),
        ),
    ):
        for expected in derivatives:
            assert float(function(torch.tensor(at, dtype=DOUBLE))) == pytest.approx(expected, rel=1e-9, abs=1e-6)
            function = _slope(function)


def _slope(function: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda x: torch.func.jvp(function, (x,), (torch.ones_like(x),))[1]


def test_gradients_at_straight_and_nearly_straight_arms(spec, rng):
    chains = arm_chains(spec, DOUBLE)
    q = 0.1 * torch.randn(1, 2, 4, dtype=DOUBLE, generator=rng)
    q[..., 3] = math.atan2(0.1343 + 0.198, 0.0185) + torch.tensor([0.0, 0.005], dtype=DOUBLE)
    j = chains.jacobian(chains.pose(q))
    assert float(condition_number(j).min()) > 1.0 / RANK_TOLERANCE
    task = torch.tensor([300.0, 200.0, 100.0], dtype=DOUBLE).expand(1, 2, 3)

    def stiffness(angles: torch.Tensor) -> torch.Tensor:
        return resolve_joint_stiffness(chains.jacobian(chains.pose(angles)), task, 40.0)

    assert torch.autograd.gradcheck(stiffness, q.requires_grad_(), eps=1e-6, atol=1e-3, rtol=1e-5)
    assert torch.autograd.gradcheck(lambda m: resolve_joint_stiffness(m, task, 40.0), j.detach().requires_grad_())


def test_equal_singular_values_have_second_derivatives_where_they_do_not_matter():
    j = 0.5 * torch.eye(3, 4, dtype=DOUBLE).requires_grad_()
    k = torch.tensor([300.0, 200.0, 100.0], dtype=DOUBLE)
    assert torch.autograd.gradgradcheck(lambda m: 1e-3 * resolve_joint_stiffness(m, k, 25.0), j)
    assert not torch.autograd.functional.hessian(lambda m: singularity_aware_ratio(0.7, m), j).any()


def six_rows(rng) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A pose's Jacobian, of condition number 8 for a length of 0.5 m; the same in mm; task stiffness in SI units."""
    u, _ = torch.linalg.qr(torch.randn(6, 6, dtype=DOUBLE, generator=rng))
    v, _ = torch.linalg.qr(torch.randn(7, 7, dtype=DOUBLE, generator=rng))
    j = (u * torch.tensor([1.6, 1.2, 0.9, 0.6, 0.3, 0.2], dtype=DOUBLE)) @ v[:, :6].T
    j[3:] /= 0.5
    in_mm = torch.cat((1000.0 * j[:3], j[3:]))
    return j, in_mm, torch.tensor([500.0, 400.0, 300.0, 20.0, 30.0, 10.0], dtype=DOUBLE)


def test_six_rows_do_not_depend_on_the_unit_of_length(rng):
    j, in_mm, task = six_rows(rng)
    assert float(condition_number(j, 0.5)) == pytest.approx(8.0)
    assert float(condition_number(in_mm, 500.0)) == pytest.approx(8.0)
    assert float(condition_number(in_mm)) > 100.0
    ratios = [singularity_aware_ratio(0.7, a, 4.0, b) for a, b in ((j, 0.5), (in_mm, 500.0))]
    assert [float(r) for r in ratios] == pytest.approx([0.7 / 5.0] * 2)
    for weaker in (1.0, 0.01):  # the second one is damped
        j, in_mm = (torch.cat((weaker * m[:1], m[1:])) for m in (j, in_mm))
        k = resolve_joint_stiffness(j, task, 25.0, characteristic_length=0.5)
        scale = torch.tensor(3 * [1e-3] + 3 * [1e3], dtype=DOUBLE)  # N/mm and N mm/rad
        k_mm = resolve_joint_stiffness(in_mm, scale * task, 25e3, characteristic_length=500.0)
        torch.testing.assert_close(k_mm / 1e3, k, rtol=1e-9, atol=1e-9)
        base = torch.diag(1e-4 / task)
        torch.testing.assert_close(
            resolve_joint_stiffness(in_mm, scale * task, 25e3, base / scale, 500.0) / 1e3,
            resolve_joint_stiffness(j, task, 25.0, base, 0.5), rtol=1e-9, atol=1e-9,
        )  # fmt: skip
        if weaker == 1.0:
            felt = j @ torch.linalg.inv(k) @ j.T
            torch.testing.assert_close(felt, torch.diag(1.0 / task), rtol=1e-9, atol=1e-12)


def test_the_length_matters_for_six_rows_alone_and_is_one_by_default(rng):
    j, _, task = six_rows(rng)
    torch.testing.assert_close(condition_number(j), condition_number(j, 1.0))
    torch.testing.assert_close(
        resolve_joint_stiffness(j, task, 25.0), resolve_joint_stiffness(j, task, 25.0, None, 1.0)
    )
    assert torch.equal(condition_number(j[:3], 0.1), condition_number(j[:3]))
    for length in (0.0, -1.0, math.nan):
        for function in (
            lambda length: condition_number(j, length),
            lambda length: singularity_aware_ratio(0.5, j, characteristic_length=length),
            lambda length: resolve_joint_stiffness(j, task, 25.0, characteristic_length=length),
        ):
            with pytest.raises(ValueError, match="characteristic_length must be"):
                function(length)


def test_rank_is_lost_in_any_order_of_rows(rng):
    for factor in torch.randn(20, 3, 2, dtype=DOUBLE, generator=rng):
        j = (factor @ torch.randn(2, 4, dtype=DOUBLE, generator=rng)).float()
        for order in permutations(range(3)):
            assert math.isinf(float(condition_number(j[list(order)])))


def law_of_an_arm(jacobian: torch.Tensor, task: torch.Tensor, alpha: float) -> torch.Tensor:
    """Through all functions of the library."""
    k = resolve_joint_stiffness(jacobian, task, 25.0, 1e-4 * torch.ones_like(task))
    pd = (100.0 * torch.eye(k.shape[-1])).expand_as(k)
    return modulate_stiffness(k, pd, singularity_aware_ratio(alpha, jacobian))


def test_autocast_changes_nothing(rng):
    j, task = random_jacobians(rng, 5).float(), torch.full((5, 3), 300.0)
    kinematics, q = ArmKinematics(), torch.randn(5, 8, generator=rng)
    with torch.autocast("cpu", torch.bfloat16):
        inside = law_of_an_arm(j, task, 0.7), kinematics.jacobian(q), kinematics.hand_position(q)
    outside = law_of_an_arm(j, task, 0.7), kinematics.jacobian(q), kinematics.hand_position(q)
    assert all(torch.equal(a, b) for a, b in zip(inside, outside, strict=True))


def test_compiled_and_mapped_functions_are_the_plain_ones(rng):
    j, task = random_jacobians(rng, 5).float().requires_grad_(), torch.full((5, 3), 300.0)
    compiled = torch.compile(law_of_an_arm, fullgraph=True, backend="eager")
    for alpha in (0.7, 0.3):
        expected = law_of_an_arm(j, task, alpha)
        torch.testing.assert_close(compiled(j, task, alpha), expected)
    plain, traced = (torch.autograd.grad(f(j, task, 0.7).sum(), j)[0] for f in (law_of_an_arm, compiled))
    torch.testing.assert_close(traced, plain)
    mapped = torch.vmap(law_of_an_arm, in_dims=(0, 0, None))
    torch.testing.assert_close(mapped(j, task, 0.7), law_of_an_arm(j, task, 0.7))
    pose, stiffness = torch.cat((j, j), 1)[:1].detach(), torch.full((1, 6), 300.0)
    wide = torch.cat((pose, torch.eye(6).expand(1, 6, 6)), -1)
    six = torch.compile(resolve_joint_stiffness, fullgraph=True, backend="eager")
    for length in (0.5, 0.3):
        torch.testing.assert_close(
            six(wide, stiffness, 25.0, None, length), resolve_joint_stiffness(wide, stiffness, 25.0, None, length)
        )


def test_hessians_forward_over_reverse_are_those_of_finite_differences(rng):
    j, task = random_jacobians(rng, 1, largest_condition=5.0)[0], torch.tensor([3.0, 4.0, 5.0], dtype=DOUBLE)

    def total(m: torch.Tensor) -> torch.Tensor:
        k = resolve_joint_stiffness(m, task, 2.0)
        pd = torch.eye(4, dtype=DOUBLE)
        return modulate_stiffness(k, pd, singularity_aware_ratio(0.7, m, threshold=1.5)).square().sum()

    hessian = torch.func.hessian(total)(j)
    step = 1e-5 * torch.eye(12, dtype=DOUBLE).unflatten(1, (3, 4))
    gradient = torch.func.grad(total)
    differences = torch.stack([(gradient(j + h) - gradient(j - h)) / 2e-5 for h in step]).reshape(3, 4, 3, 4)
    torch.testing.assert_close(hessian, differences, rtol=1e-6, atol=1e-6)


def test_projection_raises_eigenvalues_to_the_floor_and_says_where():
    c = torch.diag_embed(torch.tensor([[1e-3, 2e-3, 3e-3], [-1e-3, 2e-3, 3e-3]], dtype=DOUBLE))
    out, changed = project_compliance(c, 1e-4)
    assert changed.tolist() == [False, True]
    assert torch.equal(out[0], c[0])
    torch.testing.assert_close(out[1], torch.diag(torch.tensor([1e-4, 2e-3, 3e-3], dtype=DOUBLE)))


def test_matrices_and_diagonals_are_told_apart_by_their_dimensions(rng):
    """A batch of three diagonals of three is no matrix."""
    j = random_jacobians(rng, 3)
    rows = torch.tensor([[100.0, 200.0, 300.0], [400.0, 500.0, 600.0], [700.0, 800.0, 900.0]], dtype=DOUBLE)
    each = torch.stack([resolve_joint_stiffness(a, b, 25.0) for a, b in zip(j, rows, strict=True)])
    torch.testing.assert_close(resolve_joint_stiffness(j, rows, 25.0), each)


J = torch.eye(3, 4)
K = torch.full((3,), 300.0)
J5, K5 = J.expand(5, 3, 4), K.expand(5, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.ones(4), K, 25.0), r"jacobian must have shape \(\.\.\., m, n\), got \(4,\)"),
        ((torch.ones(4, 3), K, 25.0), "a task of 4 dimensions needs at least 4 joints, the jacobian has 3"),
        ((torch.full((3, 4), math.nan), K, 25.0), "jacobian must be finite"),
        (
            (torch.ones(3, 4, dtype=torch.int64), K, 25.0),
            "jacobian must hold float32 or float64 numbers, got torch.int64",
        ),
        (
            (J, torch.tensor([300.0, -1.0, 300.0]), 25.0),
            "task_stiffness must be positive definite, got an eigenvalue of -1",
        ),
        ((J, torch.tensor([300.0, 0.0, 300.0]), 25.0), "task_stiffness must be positive definite"),
        ((J, torch.tensor([300.0, math.inf, 300.0]), 25.0), "task_stiffness must be finite"),
        ((J, torch.ones(2), 25.0), r"task_stiffness must have shape \(3,\), a diagonal, or \(3, 3\), got \(2,\)"),
        ((J5, K5[:4], 25.0), r"task_stiffness must have shape \(5, 3\), a diagonal, or \(5, 3, 3\), got \(4, 3\)"),
        ((J5, K, 25.0), r"task_stiffness must have shape \(5, 3\), .* got \(3,\)"),
        (
            (J, K.double(), 25.0),
            "task_stiffness must have the dtype .* of jacobian, torch.float32 on cpu, got torch.flo",
        ),
        (
            (J, K.long(), 25.0),
            "task_stiffness must have the dtype .* of jacobian, torch.float32 on cpu, got torch.int64",
        ),
        ((J5, K5, torch.ones(4)), r"null_stiffness must .* have shape \(5,\), got \(4,\)"),
        ((J5, K5, torch.ones(5, 1)), r"null_stiffness must .* have shape \(5,\), got \(5, 1\)"),
        ((J5, K5, 25.0, K5[:4]), r"base_compliance must have shape \(5, 3\), .* got \(4, 3\)"),
        ((J.numpy(), K, 25.0), "jacobian must be a tensor, got ndarray"),
        ((J, torch.triu(torch.ones(3, 3)), 25.0), "task_stiffness must be symmetric"),
        ((J, K, 0.0), "null_stiffness must be positive, got 0"),
        ((J, K, math.nan), "null_stiffness must be a finite number, got nan"),
        ((J, K, 25.0, torch.tensor([1e-3, 1e-2, 1e-3])), "task_stiffness is more than the base allows"),
        ((J, K, 25.0, torch.tensor([1e-3, -1e-2, 1e-3])), "base_compliance must not be negative"),
        ((J, K, 25.0, 1.0 / K), "task_stiffness is more than the base allows"),
        (
            (J5[:2], K5[:2], 25.0, torch.tensor([[1e-3, 1e-3, 1e-3], [1e-9, -1e-10, 1e-9]])),
            "base_compliance must not be negative, got an eigenvalue of -1e-10",
        ),
        ((J, torch.tensor([300.0, 1e-5, 300.0]), 25.0), "task_stiffness must be positive definite"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        resolve_joint_stiffness(*arguments)


def test_bad_ratios_are_named():
    for alpha in (-0.1, 1.5, math.nan):
        with pytest.raises(ValueError, match="alpha must"):
            singularity_aware_ratio(alpha, J)
    with pytest.raises(ValueError, match="threshold must be at least 1"):
        singularity_aware_ratio(0.5, J, threshold=0.5)


def test_arm_kinematics_agrees_with_the_chains_of_rollouts(spec, rng):
    q = h1_poses(spec, rng, 200)
    kinematics = ArmKinematics(dtype=DOUBLE)
    chains = arm_chains(spec)
    pose = chains.pose(q)
    torch.testing.assert_close(kinematics.hand_position(q), pose.tip.double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(kinematics.jacobian(q.flatten(1)), chains.jacobian(pose).double(), atol=1e-6, rtol=0)
    assert ArmKinematics(spec).jacobian(q).dtype == torch.float32
    one = q[:1].double().requires_grad_()
    assert torch.autograd.gradcheck(kinematics.hand_position, one)
    for function in (kinematics.hand_position, kinematics.jacobian):
        assert torch.autograd.gradgradcheck(function, one)
        compiled = torch.compile(function, fullgraph=True, backend="eager")
        torch.testing.assert_close(compiled(one.detach()), function(one.detach()))
    for dtype in (torch.int32, torch.bfloat16):
        with pytest.raises(ValueError, match=f"dtype must be torch.float32 or torch.float64, got {dtype}"):
            ArmKinematics(spec, dtype)
    with pytest.raises(ValueError, match=r"q must hold float32 or float64 numbers, got torch\.int64"):
        kinematics.jacobian(torch.zeros(3, 8, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"q must have shape \(N, 2, 4\) or \(N, 8\), got \(3, 7\)"):
        kinematics.jacobian(torch.zeros(3, 7))
    with pytest.raises(ValueError, match="q must be finite"):
        kinematics.jacobian(torch.full((1, 8), math.nan))


def test_importing_compliance_loads_no_simulator():
    heavy = "('mujoco', 'matplotlib', 'scipy', 'rsl_rl')"
    code = f"import sys, cotap.compliance; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
