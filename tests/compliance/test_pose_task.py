"""Hands whose orientation is as stiff as asked, too: against the library's general functions and closed forms."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from cotap.compliance.interface import Arms, ArmState, LawParameters
from cotap.compliance.laws import CoTaPLaw, LawConfig
from cotap.compliance.pose_task import blended_pose_stiffness, pose_jacobian
from cotap.compliance.spd import modulate_stiffness
from cotap.compliance.stiffness import condition_number, resolve_joint_stiffness
from cotap.robots import ROBOTS
from cotap.robots.chains import arm_model
from cotap.robots.mjcf import build_model

STIFFNESS, TURNING, LENGTH = torch.tensor([200.0, 300.0, 500.0]).double(), 15.0, 0.2
CFG = LawConfig(name="cotap", rotational_stiffness=TURNING, characteristic_length=LENGTH, condition_threshold=1e6)


@pytest.fixture
def arms() -> Arms:
    return arm_model(ROBOTS["g1"](), torch.float64)


def poses(arms: Arms, rng: torch.Generator, n: int = 40) -> torch.Tensor:
    """Joint angles (n, 2, 7) within limits [rad]."""
    q = arms.low + (arms.high - arms.low) * torch.rand(n, *arms.low.shape, generator=rng, dtype=torch.float64)
    return 0.5 * q


def state_of(arms: Arms, q: torch.Tensor, target: torch.Tensor | None = None) -> ArmState:
    turn = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]).double()
    turn = turn @ torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.96, -0.28], [0.0, 0.28, 0.96]]).double()
    return ArmState(
        q, torch.zeros_like(q), q if target is None else target, arms.chains.pose(q), turn.expand(len(q), 3, 3)
    )


def parameters(n: int, alpha: float) -> LawParameters:
    full = torch.full((n, 2), 1.0).double()
    return LawParameters(STIFFNESS.expand(n, 2, 3), 40.0 * full, alpha * full)


def test_the_jacobian_is_mujocos(arms, rng):
    spec = ROBOTS["g1"]()
    model = build_model(spec)
    data = mujoco.MjData(model)
    q = poses(arms, rng, 3)
    jacobian = pose_jacobian(arms.chains.pose(q), torch.eye(3).double().expand(3, 3, 3))
    for i in range(3):
        for a, arm in enumerate(spec.arms):
            for name, angle in zip(arm.joints, q[i, a], strict=True):
                data.joint(name).qpos = float(angle)
        mujoco.mj_forward(model, data)
        for a, arm in enumerate(spec.arms):
            linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            point = data.site(f"{arm.side}_hand").xpos
            mujoco.mj_jac(model, data, linear, angular, point, model.body(arm.hand_body).id)
            dofs = [model.joint(name).dofadr[0] for name in arm.joints]
            turned = data.body(spec.torso_body).xmat.reshape(3, 3).T
            expected = np.concatenate((turned @ linear[:, dofs], turned @ angular[:, dofs]))
            np.testing.assert_allclose(jacobian[i, a].numpy(), expected, atol=1e-6)


def test_the_hand_feels_as_stiff_as_asked_in_position_and_orientation(arms, rng):
    state = state_of(arms, poses(arms, rng))
    jacobian = pose_jacobian(state.pose, state.to_heading)
    torque, report = CoTaPLaw(arms, CFG)(state, parameters(40, 1.0))
    felt = jacobian @ torch.linalg.inv(torque.stiffness) @ jacobian.transpose(-1, -2)
    exact = condition_number(jacobian, LENGTH) < 20.0  # nothing is damped there
    assert exact.float().mean() > 0.5
    expected = torch.diag(1.0 / torch.cat((STIFFNESS, torch.full((3,), TURNING).double()))).expand_as(felt)
    torch.testing.assert_close(felt[exact], expected[exact], rtol=1e-6, atol=1e-9)
    assert float(report.values["alpha"].min()) == 1.0


def test_one_gain_is_the_librarys_blend(arms, rng):
    q = poses(arms, rng)
    alike = replace(arms, kp=torch.full_like(arms.kp, 60.0))
    state = state_of(arms, q)
    jacobian = pose_jacobian(state.pose, state.to_heading)
    torque, _ = CoTaPLaw(alike, CFG)(state, parameters(40, 0.4))
    task = torch.cat((STIFFNESS, torch.full((3,), TURNING).double())).expand(40, 2, 6)
    whole = resolve_joint_stiffness(jacobian, task, 40.0, characteristic_length=LENGTH)
    expected = modulate_stiffness(whole, 60.0 * torch.eye(7).double().expand_as(whole), 0.4)
    torch.testing.assert_close(torque.stiffness, expected, rtol=1e-6, atol=1e-6)


def test_without_compliance_it_is_pd_and_a_singular_arm_goes_back_to_it(arms, rng):
    state = state_of(arms, poses(arms, rng))
    gains = torch.diag_embed(arms.kp).expand(40, 2, 7, 7)
    torque, _ = CoTaPLaw(arms, CFG)(state, parameters(40, 0.0))
    torch.testing.assert_close(torque.stiffness, gains, rtol=1e-6, atol=1e-6)
    jacobian = pose_jacobian(state.pose, state.to_heading)
    jacobian[..., 5, :] = jacobian[..., 4, :]  # rank 5
    blend = blended_pose_stiffness(
        jacobian, STIFFNESS.expand(40, 2, 3), TURNING, torch.full((40, 2), 40.0).double(),
        arms.kp.expand(40, 2, 7), torch.ones(40, 2).double(), 10.0, LENGTH,
    )  # fmt: skip
    torch.testing.assert_close(blend.stiffness, gains, rtol=1e-3, atol=0.05)


def test_the_ratio_follows_the_condition_number(arms, rng):
    state = state_of(arms, poses(arms, rng))
    condition = condition_number(pose_jacobian(state.pose, state.to_heading), LENGTH)
    _, report = CoTaPLaw(arms, replace(CFG, condition_threshold=10.0))(state, parameters(40, 0.8))
    expected = 0.8 / (1.0 + (condition - 10.0).clamp_min(0.0))
    torch.testing.assert_close(report.values["alpha"], expected, rtol=1e-6, atol=1e-9)


def test_the_energy_store_takes_it_too(arms, rng):
    q = poses(arms, rng)
    law = LawConfig(name="cotap", rotational_stiffness=TURNING, passive=True)
    from cotap.compliance.laws import LAWS

    state = replace(state_of(arms, q, q + 0.1), fresh=torch.ones(40, 2, dtype=torch.bool))
    torque, report = LAWS["cotap"](arms, law)(state, parameters(40, 1.0))
    assert torch.isfinite(torque.elastic).all()
    assert "store_energy" in report.values


def test_arms_and_errors_that_cannot_are_named():
    with pytest.raises(ValueError, match="at least 6 joints, got 4"):
        CoTaPLaw(arm_model(ROBOTS["h1"]()), CFG)
    with pytest.raises(ValueError, match="goes with error 'joint', got error 'task'"):
        replace(CFG, error="task").check()
    with pytest.raises(ValueError, match="characteristic_length"):
        replace(CFG, characteristic_length=0.0).check()
