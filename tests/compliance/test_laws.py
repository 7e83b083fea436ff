"""The laws of the arms: what each torque is made of, and statics in simulation, pelvis fixed."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from cotap.compliance.dynamics import gravity_torque, joint_inertia
from cotap.compliance.interface import Arms, ArmState, LawParameters
from cotap.compliance.laws import LAWS, CoTaPLaw, LawConfig, PDLaw
from cotap.compliance.stiffness import condition_number, resolve_joint_stiffness
from cotap.robots.chains import arm_model


@pytest.fixture
def arms(spec) -> Arms:
    return arm_model(spec)


def a_state(arms: Arms, rng, n=6, moved=0.1, base=None) -> ArmState:
    q = torch.tensor([0.1, 0.3, 0.2, 0.3, 0.1, -0.3, -0.2, 0.3]).reshape(2, 4) + 0.1 * torch.randn(
        n, 2, 4, generator=rng
    )
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=rng))
    turn = turn * torch.det(turn)
    rate, target = torch.randn(n, 2, 4, generator=rng), q + moved * torch.randn(n, 2, 4, generator=rng)
    return ArmState(q, rate, target, arms.chains.pose(q), turn.expand(n, 3, 3), base)


def parameters(n=6, stiffness=300.0, null=25.0, alpha=1.0) -> LawParameters:
    return LawParameters(torch.full((n, 2, 3), stiffness), torch.full((n, 2), null), torch.full((n, 2), alpha))


def test_pd_is_pd(arms, rng):
    state = a_state(arms, rng)
    for law, kp in ((PDLaw(arms), 100.0), (PDLaw(arms, 30.0), 30.0)):
        torque, report = law(state, parameters())
        q, dq = state.position + 0.05, torch.full_like(state.position, 0.7)
        torch.testing.assert_close(torque.at(q, dq), kp * (state.target - q) - 2.0 * dq, atol=1e-4, rtol=1e-5)
        assert report.values == {}


def test_alpha_zero_is_pd_with_gravity(arms, rng):
    state = a_state(arms, rng)
    torque, _ = CoTaPLaw(arms, LawConfig(damping="pd"))(state, parameters(alpha=0.0))
    pd, _ = PDLaw(arms)(state, parameters())
    gravity = gravity_torque(arms.inertias, state.pose, state.to_heading[:, 2])
    q, dq = state.position + 0.05, state.velocity
    torch.testing.assert_close(torque.at(q, dq), pd.at(q, dq) + gravity, atol=2e-3, rtol=1e-4)


def test_alpha_one_is_the_resolved_stiffness_in_the_heading_frame(arms, rng):
    state = a_state(arms, rng)
    p = parameters()
    p.stiffness = torch.tensor([100.0, 300.0, 900.0]).expand(6, 2, 3)
    torque, report = CoTaPLaw(arms, LawConfig())(state, p)
    jacobian = state.to_heading.unsqueeze(1) @ arms.chains.jacobian(state.pose)
    expected = resolve_joint_stiffness(jacobian, p.stiffness, 25.0)
    torch.testing.assert_close(torque.stiffness, expected, rtol=1e-4, atol=1e-3)
    error = state.target - state.position
    torch.testing.assert_close(torque.elastic, (expected @ error.unsqueeze(-1)).squeeze(-1), rtol=1e-3, atol=1e-3)
    assert float(report.values["alpha"].min()) == 1.0
    assert not report.values["projected"].any()


def test_task_error_pushes_the_hand_as_its_own_error_asks(arms, rng):
    """`J#^T K_u dq_err = K_ee (x_target - x)`, at any distance: the hand's force is exact."""
    state = a_state(arms, rng, moved=0.4)
    p = parameters(stiffness=500.0)
    torque, _ = CoTaPLaw(arms, LawConfig(error="task"))(state, p)
    jacobian = state.to_heading.unsqueeze(1) @ arms.chains.jacobian(state.pose)
    force = torch.linalg.pinv(jacobian).transpose(-1, -2) @ torque.elastic.unsqueeze(-1)
    reach = arms.chains.pose(state.target).tip - state.pose.tip
    expected = 500.0 * state.to_heading.unsqueeze(1) @ reach.unsqueeze(-1)
    torch.testing.assert_close(force, expected, rtol=2e-3, atol=0.05)
    joint, _ = CoTaPLaw(arms, LawConfig(error="joint"))(state, p)
    assert float((joint.elastic - torque.elastic).abs().max()) > 1.0


def test_gravity_is_against_the_vertical_wherever_the_torso_points(arms, rng):
    state = a_state(arms, rng)
    torque, _ = CoTaPLaw(arms, LawConfig())(state, parameters())
    expected = gravity_torque(arms.inertias, state.pose, state.to_heading[:, 2])
    torch.testing.assert_close(torque.feedforward, expected)


def test_a_torso_softer_than_the_hand_is_bounded_and_counted(arms, rng):
    base = torch.zeros(6, 2, 3, 3)
    base[3, 1] = 0.1 * torch.eye(3)
    torque, report = CoTaPLaw(arms, LawConfig())(a_state(arms, rng, base=base), parameters())
    expected = torch.zeros(6, 2)
    expected[3, 1] = 1.0
    assert torch.equal(report.values["projected"], expected)
    assert torch.isfinite(torque.stiffness).all()
    assert float(torch.linalg.eigvalsh(torque.stiffness).min()) > 0.0


def test_damping_is_critical_or_the_pd_laws(arms, rng):
    state = a_state(arms, rng)
    pd, _ = CoTaPLaw(arms, LawConfig(damping="pd"))(state, parameters())
    torch.testing.assert_close(pd.damping, 2.0 * torch.eye(4).expand(6, 2, 4, 4))
    critical, _ = CoTaPLaw(arms, LawConfig())(state, parameters())
    # Critical: M s^2 + D s + K has every root twice, so that M^-1 D / 2 squared is M^-1 K.
    inertia = joint_inertia(arms.inertias, state.pose).double()
    half = 0.5 * torch.linalg.solve(inertia, critical.damping.double())
    torch.testing.assert_close(half @ half, torch.linalg.solve(inertia, critical.stiffness.double()), rtol=1e-3, atol=1)


def test_critical_damping_does_not_hold_back_a_moving_reference(arms, rng):
    state = a_state(arms, rng)
    moving = replace(state, target_velocity=torch.randn(6, 2, 4, generator=rng))
    resting, _ = CoTaPLaw(arms, LawConfig())(state, parameters())
    law, _ = CoTaPLaw(arms, LawConfig())(moving, parameters())
    q, dq = state.position + 0.05, state.velocity
    torch.testing.assert_close(law.at(q, dq), resting.at(q, dq - moving.target_velocity), rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(
        law.at(q, moving.target_velocity), resting.at(q, torch.zeros_like(q)), rtol=1e-4, atol=1e-3
    )
    paper = [CoTaPLaw(arms, LawConfig(damping="pd"))(x, parameters())[0] for x in (state, moving)]
    torch.testing.assert_close(paper[0].at(q, dq), paper[1].at(q, dq))


def with_soft_wrists(arms: Arms) -> Arms:
    """The same arms with gains that differ within each."""
    return replace(arms, kp=arms.kp * torch.tensor([1.0, 0.7, 0.4, 0.1]))


def test_gains_that_differ_give_pd_at_alpha_0_and_what_was_asked_for_at_alpha_1(arms, rng):
    arms, state = with_soft_wrists(arms), a_state(arms, rng)
    pd, _ = CoTaPLaw(arms, LawConfig(damping="pd"))(state, parameters(alpha=0.0))
    torch.testing.assert_close(pd.stiffness, torch.diag_embed(arms.kp).expand(6, 2, 4, 4), rtol=1e-5, atol=1e-3)
    law, _ = CoTaPLaw(arms, LawConfig(condition_threshold=1e6))(state, parameters(alpha=1.0))
    jacobian = (state.to_heading.unsqueeze(1) @ arms.chains.jacobian(state.pose)).double()
    felt = jacobian @ torch.linalg.inv(law.stiffness.double()) @ jacobian.transpose(-1, -2)
    near = condition_number(jacobian) < 20.0
    assert int(near.sum()) > 3
    asked = torch.diag_embed(1.0 / parameters().stiffness).double()
    torch.testing.assert_close(felt[near], asked[near], rtol=1e-3, atol=1e-5)


def test_a_task_error_of_arms_with_different_gains_is_the_hands(arms, rng):
    """A target near by: the joints' error that the law acts on takes the hand all the way."""
    arms, state = with_soft_wrists(arms), a_state(arms, rng)
    state = replace(state, target=state.position + 1e-3 * torch.randn(6, 2, 4, generator=rng))
    law, _ = CoTaPLaw(arms, LawConfig(error="task", condition_threshold=1e6))(state, parameters(alpha=1.0))
    error = torch.linalg.solve(law.stiffness.double(), law.elastic.double())
    jacobian = arms.chains.jacobian(state.pose).double()
    reach = (arms.chains.pose(state.target).tip - state.pose.tip).double()
    near = condition_number(jacobian) < 20.0
    moved = (jacobian @ error.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(moved[near], reach[near], rtol=1e-2, atol=1e-6)


@pytest.mark.parametrize(
    ("field", "value"),
    [("name", "impedance"), ("error", "hand"), ("damping", "none"), ("stiffness", (0.0, 1.0, 1.0)),
     ("null_stiffness", 0.0), ("alpha", 1.5), ("soft_gain", -1.0), ("virtual_mass", 0.0), ("damping_ratio", 0.0),
     ("sensing", "guessed"), ("reference_share", 1.0)],
)  # fmt: skip
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=rf"law\.{field}"):
        LawConfig(**{field: value}).check()


@pytest.mark.parametrize(
    ("field", "low", "high"),
    [("null_stiffness", 0.1, 1e4), ("alpha", 0.0, 1.0), ("condition_threshold", 1.0, 1e9), ("soft_gain", 0.1, 1e4),
     ("rotational_stiffness", 0.0, 1e4), ("characteristic_length", 1e-3, 1e3),
     ("virtual_mass", 0.01, 1e3), ("damping_ratio", 0.01, 100.0), ("reference_share", 0.01, 0.99),
     ("store_energy", 0.0, 1e6), ("store_power", 0.0, 1e6)],
)  # fmt: skip
def test_numbers_may_lie_at_their_bounds_and_not_beyond(field, low, high):
    for bound, beyond in ((low, math.nextafter(low, -1.0)), (high, math.nextafter(high, math.inf))):
        LawConfig(**{field: bound}).check()
        with pytest.raises(ValueError, match=rf"law\.{field} must lie in"):
            LawConfig(**{field: beyond}).check()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_each_axis_has_bounds_on_its_stiffness(axis):
    for bound, beyond in ((1.0, math.nextafter(1.0, 0.0)), (1e5, math.nextafter(1e5, math.inf))):
        each = [bound, bound, bound]
        LawConfig(stiffness=tuple(each)).check()
        each[axis] = beyond
        with pytest.raises(ValueError, match=rf"law\.stiffness\[{axis}\] must lie in"):
            LawConfig(stiffness=tuple(each)).check()


def test_axes_differ_by_no_more_than_the_blend_bears():
    LawConfig(stiffness=(10.0, 3000.0, 300.0)).check()
    with pytest.raises(
        ValueError, match=r"law\.stiffness may be at most 300 times as much .* got \(10\.0, 3001\.0, 10"
    ):
        LawConfig(stiffness=(10.0, 3001.0, 10.0)).check()


def test_only_cotap_has_an_energy_store():
    LawConfig("cotap", passive=True).check()
    with pytest.raises(ValueError, match=r"arm\.passive: facet has no energy store"):
        LawConfig("facet", passive=True).check("arm")


def test_hmc_adds_torques_by_weight(arms, rng):
    state, p = a_state(arms, rng), parameters(stiffness=500.0)
    q, dq = state.position, torch.full_like(state.position, 0.7)
    jacobian = state.to_heading.unsqueeze(1) @ arms.chains.jacobian(state.pose)
    reach = state.to_heading.unsqueeze(1) @ (arms.chains.pose(state.target).tip - state.pose.tip).unsqueeze(-1)
    rate = jacobian @ dq.unsqueeze(-1)
    force = 500.0 * reach - 2.0 * 0.7 * (500.0 * 2.0) ** 0.5 * rate
    impedance = gravity_torque(arms.inertias, state.pose, state.to_heading[:, 2])
    impedance = impedance + (jacobian.transpose(-1, -2) @ force).squeeze(-1)
    pd = 100.0 * (state.target - q) - 2.0 * dq
    for weight in (0.0, 0.3, 1.0):
        p.alpha = torch.full((6, 2), weight)
        torque, _ = LAWS["hmc"](arms, LawConfig("hmc", virtual_mass=2.0, damping_ratio=0.7))(state, p)
        torch.testing.assert_close(torque.at(q, dq), weight * impedance + (1 - weight) * pd, atol=2e-3, rtol=1e-4)
        moved = q + 1e-3
        change = torque.at(moved, dq) - torque.at(q, dq)
        expected = -weight * (jacobian.transpose(-1, -2) @ (500.0 * jacobian)) - (1 - weight) * 100.0 * torch.eye(4)
        torch.testing.assert_close(change, 1e-3 * expected.sum(-1), atol=1e-3, rtol=1e-3)


def test_arms_that_agree_but_for_what_envs_vary_share_a_law():
    one = LawConfig("facet", stiffness=(1.0, 2.0, 3.0), alpha=0.1)
    assert one.kind() == LawConfig("facet").kind()
    for other in (LawConfig("dcc"), LawConfig("facet", virtual_mass=2.0), LawConfig("facet", sensing="estimated")):
        assert one.kind() != other.kind()
