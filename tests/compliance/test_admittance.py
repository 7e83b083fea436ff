"""The hand's models against the closed form of a damped oscillator, and references moved by inverse kinematics."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from cotap.compliance.admittance import AdmittanceLaw, StaticShift, VirtualMass
from cotap.compliance.interface import ArmState, LawParameters
from cotap.compliance.laws import LAWS, LawConfig, PDLaw
from cotap.robots.chains import arm_model

DT = 0.02


@pytest.fixture(scope="module")
def arms(spec):
    return arm_model(spec)


def a_state(arms, n=3, **fields) -> ArmState:
    q = torch.tensor([[0.1, 0.3, 0.2, 0.3], [0.1, -0.3, -0.2, 0.3]]).repeat(n, 1, 1)
    pitch = torch.tensor([[0.995, 0.0, 0.0998], [0.0, 1.0, 0.0], [-0.0998, 0.0, 0.995]])
    fields = {"fresh": torch.ones(n, 2, dtype=torch.bool)} | fields
    return ArmState(q, torch.zeros_like(q), q + 0.05, arms.chains.pose(q), pitch.expand(n, 3, 3), dt=DT, **fields)


def parameters(n=3, stiffness=500.0) -> LawParameters:
    return LawParameters(torch.full((n, 2, 3), stiffness), torch.full((n, 2), 25.0), torch.ones(n, 2))


def step_response(t, mass, stiffness, ratio, force):
    """Displacement of a damped oscillator at rest, `t` after a constant force sets in: textbook closed forms."""
    w = np.sqrt(stiffness / mass)
    if ratio < 1.0:
        damped = w * np.sqrt(1 - ratio**2)
        shape = np.exp(-ratio * w * t) * (np.cos(damped * t) + ratio * w / damped * np.sin(damped * t))
    elif ratio == 1.0:
        shape = np.exp(-w * t) * (1.0 + w * t)
    else:
        fast, slow = (-w * (ratio + sign * np.sqrt(ratio**2 - 1)) for sign in (1, -1))
        shape = (fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (fast - slow)
    return force / stiffness * (1.0 - shape)


@pytest.mark.parametrize("ratio", [0.2, 0.7, 1.0, 2.5])
@pytest.mark.parametrize("mass", [0.5, 3.0])
def test_virtual_mass_is_a_damped_oscillator(ratio, mass):
    """Step responses at 50 Hz for three stiffnesses at once, to 1e-3 of the static displacement."""
    stiffness, force = torch.tensor([100.0, 500.0, 1200.0]), torch.tensor([10.0, -30.0, 50.0])
    model, home = VirtualMass(mass, ratio), torch.tensor([0.3, 0.1, -0.2])
    x, v = home, torch.zeros(3)
    for k in range(1, 101):
        x, v = model(x, v, home, home, stiffness, force, DT)
        expected = step_response(k * DT, mass, stiffness.double().numpy(), ratio, force.double().numpy())
        error = (x - home).double().numpy() - expected
        assert np.abs(error / (force / stiffness).numpy()).max() < 1e-3


def test_a_light_hand_in_honey_creeps_to_where_a_force_holds_it():
    """At the ends of what is allowed: `exp(-5 s * w / (2 ratio))` of the way is left, as inertia is none to speak
    of."""
    model, home, force = VirtualMass(0.01, 100.0), torch.zeros(1), torch.tensor([10.0])
    x, v = home, torch.zeros(1)
    for _ in range(250):
        x, v = model(x, v, home, home, torch.tensor([2000.0]), force, DT)
    left = np.exp(-5.0 * np.sqrt(2000.0 / 0.01) / 200.0)
    assert float(x) == pytest.approx(10.0 / 2000.0 * (1.0 - left), rel=1e-3)
    assert float(v) == pytest.approx(10.0 / 2000.0 * left * np.sqrt(2000.0 / 0.01) / 200.0, rel=0.02, abs=1e-9)


def test_a_virtual_mass_is_of_one_kilogram_and_critically_damped_by_default():
    x, _ = VirtualMass()(*torch.zeros(4, 1), torch.tensor([400.0]), torch.tensor([20.0]), 0.05)
    assert float(x) == pytest.approx(float(step_response(0.05, 1.0, 400.0, 1.0, 20.0)), rel=1e-5)


def test_virtual_mass_follows_a_moving_target_as_its_equation_says():
    """Against scipy's integrator, a target that speeds up and a force that changes from step to step."""
    mass, ratio, stiffness = 2.0, 0.6, 300.0
    damping = 2.0 * ratio * np.sqrt(stiffness * mass)
    wanted = 0.3 * torch.sin(torch.arange(51) * 0.1).unsqueeze(1)
    force = 20.0 * torch.cos(torch.arange(50) * 0.3).unsqueeze(1)
    model, x, v = VirtualMass(mass, ratio), wanted[0], torch.zeros(1)
    y = np.array([float(x), 0.0])
    for k in range(50):
        x, v = model(x, v, wanted[k], wanted[k + 1], torch.tensor([stiffness]), force[k], DT)
        start, end, push = float(wanted[k]), float(wanted[k + 1]), float(force[k])
        speed = (end - start) / DT

        def slope(t, y, start=start, speed=speed, push=push):
            spring = stiffness * (start + speed * t - y[0]) + damping * (speed - y[1])
            return [y[1], (spring + push) / mass]

        y = solve_ivp(slope, (0.0, DT), y, rtol=1e-9, atol=1e-12).y[:, -1]
        assert float(x) == pytest.approx(y[0], abs=1e-5)
        assert float(v) == pytest.approx(y[1], abs=1e-4)


def test_static_shift_is_force_over_stiffness():
    x, v = StaticShift()(*torch.zeros(3, 3), torch.full((3,), 0.5), torch.tensor([100.0, 200.0, 400.0]),
                         torch.tensor([10.0, 0.0, -10.0]), DT)  # fmt: skip
    torch.testing.assert_close(x, torch.tensor([0.6, 0.5, 0.475]))
    torch.testing.assert_close(v, x / DT)


@pytest.mark.parametrize("name", ["facet", "dcc"])
def test_without_a_force_the_sent_targets_are_tracked(arms, name):
    law, pd, state = LAWS[name](arms, LawConfig(name)), PDLaw(arms), a_state(arms)
    for _ in range(20):
        torque, report = law(state, parameters())
    torch.testing.assert_close(torque.elastic, pd(state, parameters())[0].elastic, atol=1e-3, rtol=0)
    assert float(report.values["reference_shift"].max()) < 1e-6


@pytest.mark.parametrize("name", ["facet", "dcc"])
def test_a_held_force_moves_the_tracked_hand_by_force_over_stiffness_in_the_heading_frame(arms, name):
    force = torch.tensor([5.0, -10.0, 20.0]).expand(3, 2, 3)
    law, state = LAWS[name](arms, LawConfig(name)), a_state(arms, hand_force_h=force)
    state = replace(state, fresh=torch.zeros(3, 2, dtype=torch.bool))
    p = parameters()
    p.stiffness = torch.tensor([200.0, 400.0, 800.0]).expand(3, 2, 3)
    for _ in range(300):
        torque, _ = law(state, p)
    target = state.position + torque.elastic / arms.kp
    moved_t = arms.chains.pose(target).tip - arms.chains.pose(state.target).tip
    moved_h = moved_t @ state.to_heading[0].T
    torch.testing.assert_close(moved_h, torch.tensor([0.025, -0.025, 0.025]).expand(3, 2, 3), atol=2e-4, rtol=0)


def test_the_matched_composition_splits_the_compliance(arms):
    """Reference and arm get `C s` and `C (1 - s)`; the paper's composition gives `C` to each."""
    force, p = torch.tensor([0.0, 0.0, 12.0]).expand(3, 2, 3), parameters(stiffness=600.0)
    for name, share, reference, arm in (
        ("cotap+facet", 0.5, 600.0, 600.0),
        ("cotap+facet-matched", 0.25, 2400.0, 800.0),
    ):
        law = LAWS[name](arms, LawConfig(name, reference_share=share))
        state = a_state(arms, hand_force_h=force, fresh=torch.zeros(3, 2, dtype=torch.bool))
        for _ in range(200):
            torque, report = law(state, p)
        torch.testing.assert_close(
            report.values["reference_shift"], torch.full((3, 2), 12.0 / reference), atol=1e-5, rtol=0
        )
        alone, _ = LAWS["cotap"](arms, LawConfig("cotap"))(state, parameters(stiffness=arm))
        torch.testing.assert_close(torque.stiffness, alone.stiffness)


def test_model_and_tracking_law_have_the_stiffness_commanded_unless_scaled(arms):
    cotap, state = LAWS["cotap"](arms, LawConfig("cotap")), a_state(arms, hand_force_h=torch.full((3, 2, 3), 6.0))
    for scales, reference, arm in (((), 600.0, 600.0), ((2.0, 0.5), 1200.0, 300.0)):
        torque, report = AdmittanceLaw(arms, StaticShift(), cotap, *scales)(state, parameters(stiffness=600.0))
        torch.testing.assert_close(torque.stiffness, cotap(state, parameters(stiffness=arm))[0].stiffness)
        shift = torch.full((3, 2), 6.0 * 3.0**0.5 / reference)
        torch.testing.assert_close(report.values["reference_shift"], shift, atol=1e-5, rtol=0)


def test_envs_that_begin_anew_forget(arms):
    force = torch.tensor([0.0, 0.0, 50.0]).expand(3, 2, 3)
    law, old = LAWS["facet"](arms, LawConfig("facet")), torch.zeros(3, 2, dtype=torch.bool)
    for _ in range(50):
        law(a_state(arms, hand_force_h=force, fresh=old), parameters())
    moved = {k: v.clone() for k, v in law.memory.items()}
    law.memory["position_h"][1] = torch.nan  # as of a world that has diverged
    fresh = torch.tensor([False, True, False]).unsqueeze(1).expand(3, 2)
    state = a_state(arms, fresh=fresh)
    law(state, parameters())
    wanted = arms.chains.pose(state.target).tip @ state.to_heading[0].T
    torch.testing.assert_close(law.memory["position_h"][1], wanted[1], atol=1e-5, rtol=0)
    torch.testing.assert_close(law.memory["offset"][1], torch.zeros(2, 4), atol=1e-5, rtol=0)
    for kept in (0, 2):
        assert float((law.memory["position_h"][kept] - wanted[kept]).norm()) > 0.05
        assert torch.equal(law.memory["wanted_h"][kept], moved["wanted_h"][kept])


def test_references_move_no_faster_than_joints_can(arms):
    """A push of 500 N, at once over stiffness 5 m: the reference starts on its way at the joints' velocity limits."""
    law = AdmittanceLaw(arms, StaticShift(), PDLaw(arms))
    hit = a_state(arms, hand_force_h=torch.tensor([500.0, 0.0, 0.0]).expand(3, 2, 3))
    torque, _ = law(hit, parameters(stiffness=100.0))
    moved = (torque.elastic / arms.kp + hit.position - hit.target).abs()
    assert (moved <= DT * arms.speed + 1e-6).all()
    assert float((moved / (DT * arms.speed)).max()) > 0.99


@pytest.mark.parametrize("name", ["facet", "dcc"])
def test_references_go_on_from_where_they_were_moved_to(arms, name):
    """A shift that takes several steps at the joints' velocity limits gets there, not a step's way and no further."""
    force, old = torch.tensor([0.0, 0.0, 60.0]).expand(3, 2, 3), torch.zeros(3, 2, dtype=torch.bool)
    law, state = LAWS[name](arms, LawConfig(name)), a_state(arms, hand_force_h=force, fresh=old)
    offsets = [torch.zeros_like(state.position)]
    for _ in range(8):
        torque, _ = law(state, parameters(stiffness=300.0))
        offsets.append(state.position + torque.elastic / arms.kp - state.target)
    ways = torch.stack(offsets).diff(dim=0).abs()
    assert (ways <= DT * arms.speed + 1e-5).all()
    assert float((offsets[-1].abs() / (DT * arms.speed)).max()) > 1.3


@pytest.mark.parametrize("fresh", [None, torch.zeros(3, dtype=torch.bool), torch.zeros(3, 1, dtype=torch.bool)])
def test_a_law_that_remembers_must_be_told_which_arms_are_fresh(arms, fresh):
    got = None if fresh is None else tuple(fresh.shape)
    with pytest.raises(
        ValueError, match=re.escape(f"fresh must have shape (3, 2) for a law that remembers, got {got}")
    ):
        LAWS["facet"](arms, LawConfig("facet"))(a_state(arms, fresh=fresh), parameters())
    LAWS["cotap"](arms, LawConfig("cotap"))(a_state(arms, fresh=fresh), parameters())  # remembers nothing
