"""Gravity torque, inertia and damping of the arms, against MuJoCo and against closed forms."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from cotap.compliance.dynamics import critical_damping, gravity_torque, joint_inertia
from cotap.robots.chains import arm_chains, arm_inertias
from cotap.rotations import matrix_from_quat


def random_states(spec, count, seed=0):
    """Arm joints, and how the torso stands in the world."""
    rng = np.random.default_rng(seed)
    joints = [spec.joints[i] for i in spec.indices(spec.upper_joints)]
    low, high = np.array([j.range_rad for j in joints]).T
    q = rng.uniform(low, high, (count, len(joints)))
    quat = rng.normal(size=(count, 4))
    return q, quat / np.linalg.norm(quat, axis=1, keepdims=True)


def mujoco_data(spec, model, q, quat):
    data = mujoco.MjData(model)
    data.qpos[3:7] = quat
    data.qpos[[model.joint(n).qposadr[0] for n in spec.upper_joints]] = q
    mujoco.mj_forward(model, data)
    return data


def arm_dofs(model, arm):
    return [model.joint(n).dofadr[0] for n in arm.joints]


def test_gravity_torque_is_mujocos_bias_at_rest(spec, model):
    q, quat = random_states(spec, 50)
    pose = arm_chains(spec).pose(torch.tensor(q, dtype=torch.float32).unflatten(1, (2, 4)))
    up = matrix_from_quat(torch.tensor(quat, dtype=torch.float32)).transpose(1, 2)[:, :, 2]
    torque = gravity_torque(arm_inertias(spec), pose, up)
    for i in range(50):
        data = mujoco_data(spec, model, q[i], quat[i])  # the waist is at zero: the torso stands as the pelvis does
        for a, arm in enumerate(spec.arms):
            np.testing.assert_allclose(torque[i, a], data.qfrc_bias[arm_dofs(model, arm)], atol=2e-5)
    assert float(torque.abs().max()) > 3.0


def test_gravity_torque_in_double_precision_to_a_millionth(spec, model):
    from cotap.compliance.dynamics import LinkInertias
    from cotap.compliance.kinematics import SerialChains

    def exact(value):
        return torch.tensor(value, dtype=torch.float64)

    chains = [spec.chain(arm.hand_body, spec.torso_body) for arm in spec.arms]
    axes = {j.name: j.axis for j in spec.joints}
    arms = SerialChains(
        exact([[b.pos for b in c] for c in chains]), exact([[b.quat for b in c] for c in chains]),
        exact([[axes[b.joint] for b in c] for c in chains]), exact([a.hand_point for a in spec.arms]),
    )  # fmt: skip
    zero = torch.zeros(2, 4, 3, 3, dtype=torch.float64)
    links = LinkInertias(
        exact([[b.mass_kg for b in c] for c in chains]),
        exact([[b.com for b in c] for c in chains]),
        zero,
        zero[..., 0, 0],
    )
    q, quat = random_states(spec, 20, seed=1)
    pose = arms.pose(exact(q).unflatten(1, (2, 4)))
    torque = gravity_torque(links, pose, matrix_from_quat(exact(quat)).transpose(1, 2)[:, :, 2])
    for i in range(20):
        data = mujoco_data(spec, model, q[i], quat[i])
        for a, arm in enumerate(spec.arms):
            np.testing.assert_allclose(torque[i, a], data.qfrc_bias[arm_dofs(model, arm)], atol=1e-6)


def test_inertia_is_mujocos(spec, model):
    q, quat = random_states(spec, 20)
    pose = arm_chains(spec).pose(torch.tensor(q, dtype=torch.float32).unflatten(1, (2, 4)))
    inertia = joint_inertia(arm_inertias(spec), pose)
    full, columns = np.zeros((model.nv, model.nv)), np.eye(model.nv)
    for i in range(20):
        data = mujoco_data(spec, model, q[i], quat[i])
        for row, column in zip(full, columns, strict=True):
            mujoco.mj_mulM(model, data, row, column)
        for a, arm in enumerate(spec.arms):
            dofs = arm_dofs(model, arm)
            np.testing.assert_allclose(inertia[i, a], full[np.ix_(dofs, dofs)], atol=2e-5)


def random_pair(rng, n=4):
    a, b = (torch.randn(n, n, dtype=torch.float64, generator=rng) for _ in range(2))
    eye = torch.eye(n, dtype=torch.float64)
    return a @ a.T + eye, 0.1 * (b @ b.T + eye)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_every_mode_is_damped_as_asked(rng, ratio):
    """Eigenvalues of the first-order system: pairs with the damping ratio that was asked for."""
    for _ in range(10):
        k, m = random_pair(rng)
        d = critical_damping(k, m, ratio)
        inverse = torch.linalg.inv(m)
        zero, eye = torch.zeros_like(k), torch.eye(4, dtype=torch.float64)
        system = torch.cat((torch.cat((zero, eye), 1), torch.cat((-inverse @ k, -inverse @ d), 1)))
        values = torch.linalg.eigvals(system)
        assert float(values.real.max()) < 0.0
        frequencies = torch.linalg.eigvals(inverse @ k).real.sqrt().sort().values
        if ratio < 1.0:
            seen = values.abs().sort().values[::2]
            torch.testing.assert_close(seen, frequencies, rtol=1e-6, atol=1e-8)
            torch.testing.assert_close(-values.real / values.abs(), torch.full((8,), ratio, dtype=torch.float64))
        elif ratio > 1.0:
            expected = torch.cat((frequencies * (2.0 - 3.0**0.5), frequencies * (2.0 + 3.0**0.5))).sort().values
            torch.testing.assert_close((-values.real).sort().values, expected, rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(d, d.T, atol=1e-10, rtol=0)


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-5), (torch.float32, 1e-4)])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 7])
def test_damping_is_critical_where_stiffness_spans_four_decades(rng, n, dtype, atol):
    """`D M^-1 D = 4 K`, by definition; inertia spans two and a half decades."""

    def spd(decades: float) -> torch.Tensor:
        basis = torch.linalg.qr(torch.randn(500, n, n, dtype=torch.float64, generator=rng))[0]
        values = 10.0 ** (decades * torch.rand(500, n, dtype=torch.float64, generator=rng))
        return basis @ torch.diag_embed(values) @ basis.mT

    k, m = spd(4.0), 10**-2.5 * spd(2.5)
    d = critical_damping(k.to(dtype), m.to(dtype)).double()
    error = (0.25 * d @ torch.linalg.inv(m) @ d - k).abs().amax((1, 2)) / k.abs().amax((1, 2))
    assert float(error.max()) < atol


def test_critical_damping_by_hand():
    k, m = torch.diag(torch.tensor([100.0, 25.0])), torch.diag(torch.tensor([1.0, 0.25]))
    torch.testing.assert_close(critical_damping(k, m), torch.diag(torch.tensor([20.0, 5.0])))


@pytest.mark.parametrize("n", [3, 4, 7])
@pytest.mark.parametrize("least", [1e-7, 1e-8, 0.0])
def test_damping_is_finite_where_stiffness_is_next_to_nothing_in_a_direction(rng, n, least):
    """As that of an arm all but straight without the singularity's ratio: in single precision it may be negative."""
    basis = torch.linalg.qr(torch.randn(5000, n, n, dtype=torch.float64, generator=rng))[0]
    values = torch.cat((torch.full((5000, 1), least), torch.rand(5000, n - 1, generator=rng) + 0.1), 1).double()
    k = 300.0 * (basis @ torch.diag_embed(values) @ basis.mT)
    root = 0.2 * torch.randn(5000, n, n, dtype=torch.float64, generator=rng)
    m = root @ root.mT + 0.05 * torch.eye(n)
    d = critical_damping(k.float(), m.float()).double()
    error = (0.25 * d @ torch.linalg.inv(m) @ d - k).abs().amax((1, 2)) / k.abs().amax((1, 2))
    assert float(error.max()) < 0.02
