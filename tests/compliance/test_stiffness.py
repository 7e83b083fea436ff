"""Joint stiffness from task stiffness, against the paper's general form, algebra and finite differences."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
import torch

from cotap.compliance import (
    ArmKinematics,
    condition_number,
    modulate_stiffness,
    resolve_joint_stiffness,
    singularity_aware_ratio,
)
from cotap.compliance.fast import blended_stiffness, eigenvalues_3x3, inverse_3x3
from cotap.compliance.stiffness import project_compliance
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


def test_closed_forms_of_three_by_three(rng):
    a = torch.randn(500, 3, 3, dtype=DOUBLE, generator=rng)
    a = a @ a.transpose(-1, -2)
    a[:3] = torch.diag_embed(torch.tensor([[1.0, 1.0, 1.0], [2.0, 2.0, 5.0], [0.0, 3.0, 3.0]], dtype=DOUBLE))
    torch.testing.assert_close(eigenvalues_3x3(a), torch.linalg.eigvalsh(a), rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(
        inverse_3x3(a[3:]) @ a[3:], torch.eye(3, dtype=DOUBLE).expand(497, 3, 3), atol=1e-6, rtol=0
    )


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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.ones(4), K, 25.0), r"jacobian must have shape \(\.\.\., m, n\), got \(4,\)"),
        ((torch.ones(4, 3), K, 25.0), "a task of 4 dimensions needs at least 4 joints, the jacobian has 3"),
        ((torch.full((3, 4), math.nan), K, 25.0), "jacobian must be finite"),
        ((torch.ones(3, 4, dtype=torch.int64), K, 25.0), "floating point"),
        (
            (J, torch.tensor([300.0, -1.0, 300.0]), 25.0),
            "task_stiffness must be positive definite, got an eigenvalue of -1",
        ),
        ((J, torch.tensor([300.0, 0.0, 300.0]), 25.0), "task_stiffness must be positive definite"),
        ((J, torch.tensor([300.0, math.inf, 300.0]), 25.0), "task_stiffness must be finite"),
        ((J, torch.ones(2), 25.0), r"task_stiffness must have 1 dimensions"),
        ((J, torch.triu(torch.ones(3, 3)), 25.0), "task_stiffness must be symmetric"),
        ((J, K, 0.0), "null_stiffness must be positive, got 0"),
        ((J, K, math.nan), "null_stiffness must be finite"),
        ((J, K, 25.0, torch.tensor([1e-3, 1e-2, 1e-3])), "task_stiffness is more than the base allows"),
        ((J, K, 25.0, torch.tensor([1e-3, -1e-2, 1e-3])), "base_compliance must not be negative"),
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
