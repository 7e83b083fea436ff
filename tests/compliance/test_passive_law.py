"""CoTaP with an energy store: an arm with exact energy accounts, whatever is commanded and however it is pulled."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from cotap.compliance.dynamics import gravity_torque, joint_inertia
from cotap.compliance.interface import Arms, ArmState, LawParameters
from cotap.compliance.laws import LAWS, CoTaPLaw, LawConfig
from cotap.compliance.passive_law import PassiveCoTaPLaw, held_spring
from cotap.robots.chains import arm_model

DT, SUBSTEPS = 0.02, 5
HOME = torch.tensor([0.1, 0.3, 0.2, 0.3, 0.1, -0.3, -0.2, 0.3]).reshape(2, 4)


@pytest.fixture
def arms(spec) -> Arms:
    return arm_model(spec).to(torch.float64)


def parameters(n, stiffness=300.0, null=25.0, alpha=1.0) -> LawParameters:
    shape = torch.full((n, 2), 1.0, dtype=torch.float64)
    return LawParameters((stiffness * shape).unsqueeze(-1).repeat(1, 1, 3), null * shape, alpha * shape)


def pulled(arms, law, n, steps, command, rng):
    """Energy drawn (T, N, 2) [J] from arms of constant inertia by torques that swing and brake them, and reports.

    Integrated by the midpoint rule, which neither makes nor loses energy. `command` changes the parameters.
    """
    q = HOME.double().expand(n, 2, 4).clone()
    dq, h = torch.zeros_like(q), DT / SUBSTEPS
    mass = joint_inertia(arms.inertias, arms.chains.pose(q))
    upright = torch.eye(3, dtype=q.dtype).expand(n, 3, 3)
    fresh, drawn, target = torch.ones(n, 2, dtype=torch.bool), torch.zeros(n, 2, dtype=q.dtype), q.clone()
    p, rows = parameters(n), []
    for step in range(steps):
        command(step, p, q - target, dq)
        state = ArmState(q, dq, target, arms.chains.pose(q), upright, fresh=fresh, dt=DT)
        torque, report = law(state, p)
        fresh = torch.zeros_like(fresh)
        weight = gravity_torque(arms.inertias, state.pose, upright[:, 2])
        push = 3.0 * torch.randn(n, 2, 4, generator=rng, dtype=q.dtype) if step % 60 < 12 else -0.5 * dq
        constant = torque.feedforward - weight + torque.elastic + push  # gravity is not simulated
        solve = torch.linalg.inv(2.0 * mass / h + torque.damping + 0.5 * h * torque.stiffness)
        for _ in range(SUBSTEPS):
            now = constant - _apply(torque.stiffness, q - torque.anchor) + 2.0 / h * _apply(mass, dq)
            middle = _apply(solve, now)
            drawn = drawn - h * (push * middle).sum(-1)
            q, dq = q + h * middle, 2.0 * middle - dq
        rows.append((drawn, *(report.values.get(name, 0.0 * drawn) for name in ("store_energy", "held_back"))))
    return [torch.stack(column) for column in zip(*rows, strict=True)]


def _apply(matrix, vector):
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def at_random(rng):
    """Stiffness and alpha jump all the time."""

    def command(step, p, x, dq):
        del step, x, dq
        p.stiffness[:] = 80.0 * 15.0 ** torch.rand(p.stiffness.shape, generator=rng, dtype=torch.float64)
        p.alpha[:] = torch.rand(p.alpha.shape, generator=rng, dtype=torch.float64)

    return command


def knowing(step, p, x, dq):
    """Stiff on the way back, soft on the way out."""
    del step
    p.stiffness[:] = torch.where((x * dq).sum(-1, keepdim=True) < 0.0, 1200.0, 80.0)


def constant(step, p, x, dq):
    """Only the pose changes the joint stiffness."""
    del step, p, x, dq


@pytest.mark.parametrize("error", ["joint", "task"])
@pytest.mark.parametrize("damping", ["pd", "critical"])
def test_no_more_is_drawn_than_the_store_had_at_first(arms, error, damping, rng):
    if damping == "pd":  # a weak one, so that it does not make up for what is injected
        arms = replace(arms, kd=0.02 * arms.kd)
    cfg = LawConfig("cotap", error=error, damping=damping, passive=True, store_energy=0.5, store_power=1e3)
    most = {}
    for command in (at_random(rng), knowing, constant):
        law = LAWS["cotap"](arms, cfg)
        drawn, level, held_back = pulled(arms, law, 4, 90, command, rng)
        assert float(drawn.max()) <= 0.5 + 1e-9
        assert float(level.min()) >= 0.0
        assert float(level.max()) <= 0.5
        assert 0.0 <= float(held_back.min()) <= float(held_back.max()) <= 1.0
        most[command] = float(held_back.max())
    assert most[knowing] > 0.5
    if damping == "pd":
        free, _, _ = pulled(arms, CoTaPLaw(arms, cfg), 4, 90, knowing, rng)
        assert float(free.max()) > 2.0


def test_a_spring_moves_its_rest_first_and_then_changes_its_stiffness(rng):
    """As far as the energy goes, by a fine search along the line, and with every joule accounted for."""
    count = 300
    root = torch.randn(2, count, 4, 4, generator=rng, dtype=torch.float64)
    old, new = 30.0 * root @ root.transpose(-1, -2) + 5.0 * torch.eye(4, dtype=torch.float64)
    before, error = 0.1 * torch.randn(2, count, 4, generator=rng, dtype=torch.float64)

    def energy(k, e):
        return 0.5 * torch.einsum("...i,...ij,...j", e, k, e)

    asked = energy(new, error) - energy(old, before)
    room = asked.abs() * torch.rand(count, generator=rng, dtype=torch.float64)
    room[::5] = 0.0
    keep = asked > room
    old, new, before, error, room = (x[keep] for x in (old, new, before, error, room))
    k, e, share, spent = held_spring(old, new, before, error, room)
    torch.testing.assert_close(spent, energy(k, e) - energy(old, before))
    assert (spent <= room + 1e-12).all()
    parts = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64).reshape(-1, 1, 1)
    line = before + parts * (error - before)
    within = energy(old, line) - energy(old, before) <= room
    most = (parts.squeeze(-1) * within).amax(0)
    part = ((e - before) * (error - before)).sum(-1) / (error - before).square().sum(-1)
    torch.testing.assert_close(e, before + part.unsqueeze(-1) * (error - before))
    torch.testing.assert_close(part, most, atol=1e-3, rtol=0)
    assert 0.2 < float((part < 0.999).double().mean()) < 0.9
    stopped = (part > 0.999) & (share < 0.999)
    assert stopped.any()
    torch.testing.assert_close(spent[stopped], room[stopped], rtol=1e-6, atol=1e-9)


def test_power_of_a_single_change_is_limited(arms, rng):
    law = PassiveCoTaPLaw(arms, LawConfig("cotap", passive=True, store_energy=50.0, store_power=3.0))
    _, level, held_back = pulled(arms, law, 4, 100, knowing, rng)
    assert float((level[:-1] - level[1:]).max()) <= 3.0 * DT + 1e-9
    assert float(held_back.max()) > 0.3


def test_a_store_that_can_pay_changes_nothing(arms, rng):
    cfg = LawConfig("cotap", passive=True, store_energy=1e6, store_power=1e6)
    state = rng.get_state()
    drawn, level, held_back = pulled(arms, PassiveCoTaPLaw(arms, cfg), 4, 50, knowing, rng)
    rng.set_state(state)
    plain, _, _ = pulled(arms, CoTaPLaw(arms, cfg), 4, 50, knowing, rng)
    assert torch.equal(drawn, plain)
    assert float(held_back.max()) == 0.0
    assert float(level.min()) < 1e6


@pytest.mark.parametrize("error", ["joint", "task"])
def test_where_no_change_is_commanded_the_store_as_it_is_by_default_changes_nothing(arms, error, rng):
    """Not a bit of it, though the pose changes the stiffness at every step."""
    cfg, state = LawConfig("cotap", error=error, passive=True), rng.get_state()
    drawn, level, held_back = pulled(arms, PassiveCoTaPLaw(arms, cfg), 4, 90, constant, rng)
    rng.set_state(state)
    plain, _, _ = pulled(arms, CoTaPLaw(arms, cfg), 4, 90, constant, rng)
    assert torch.equal(drawn, plain)
    assert float(held_back.max()) == 0.0
    assert float(level.min()) < 2.0
    assert float(drawn.abs().max()) > 0.1


def test_a_moving_reference_fills_no_store_by_damping_that_does_not_act(arms):
    """Critical damping acts on the rate at which joints leave their reference: following it dissipates nothing."""
    cfg = LawConfig("cotap", passive=True, store_energy=1.0)
    law = PassiveCoTaPLaw(arms, cfg)
    n, q = 2, HOME.double().expand(2, 2, 4)
    upright, rate = torch.eye(3, dtype=q.dtype).expand(n, 3, 3), torch.full_like(q, 0.5)
    for step in range(20):
        state = ArmState(
            q + step * DT * rate, rate, q + (step + 1) * DT * rate, arms.chains.pose(q), upright,
            target_velocity=rate, fresh=torch.full((n, 2), step == 0), dt=DT,
        )  # fmt: skip
        law(state, parameters(n))
        if step == 0:
            law.memory["store"] = torch.full_like(law.memory["store"], 0.25)
    torch.testing.assert_close(law.memory["store"], torch.full((n, 2, 1), 0.25, dtype=torch.float64))
    # Of joints that stay behind it does: 4 joints, 0.01 rad in a step.
    late = replace(state, position=state.position + DT * rate - 0.01)
    _, report = law(late, parameters(n))
    dissipated = 1e-4 * law.memory["damping"].sum(-1) / DT
    torch.testing.assert_close(
        report.values["store_energy"], (0.25 + 0.9 * dissipated).clamp_max(1.0), rtol=0.02, atol=0
    )


def test_arms_that_begin_anew_have_a_full_store_and_what_they_ask_for(arms, rng):
    law = PassiveCoTaPLaw(arms, LawConfig("cotap", passive=True, store_energy=0.1))
    pulled(arms, law, 3, 60, at_random(rng), rng)
    assert float(law.memory["store"].min()) < 0.1
    q = HOME.double().expand(3, 2, 4)
    fresh = torch.tensor([True, False, True]).unsqueeze(1).expand(3, 2)
    upright = torch.eye(3, dtype=q.dtype).expand(3, 3, 3)
    state = ArmState(q, 0.0 * q, q + 0.5, arms.chains.pose(q), upright, fresh=fresh, dt=DT)
    torque, report = law(state, parameters(3, 1200.0))
    plain, _ = CoTaPLaw(arms, LawConfig())(state, parameters(3, 1200.0))
    assert report.values["store_energy"][[0, 2]].tolist() == [[0.1, 0.1]] * 2
    assert report.values["held_back"][[0, 2]].tolist() == [[0.0, 0.0]] * 2
    assert float(report.values["held_back"][1].min()) > 0.0
    torch.testing.assert_close(torque.stiffness[[0, 2]], plain.stiffness[[0, 2]])


def at_rest(arms, n, fresh=False, away=0.3) -> ArmState:
    q = HOME.double().expand(n, 2, 4)
    upright = torch.eye(3, dtype=q.dtype).expand(n, 3, 3)
    begun = torch.full((n, 2), fresh)
    return ArmState(q, 0.0 * q, q + away, arms.chains.pose(q), upright, fresh=begun, dt=DT)


@pytest.mark.parametrize("error", ["joint", "task"])
def test_a_change_that_is_not_a_number_is_not_made_and_empties_the_store(arms, error):
    law = PassiveCoTaPLaw(arms, LawConfig("cotap", error=error, passive=True))
    before, _ = law(at_rest(arms, 3, fresh=True), parameters(3))
    broken = parameters(3)
    broken.stiffness[1, 0] = torch.nan
    for _ in range(2):
        torque, report = law(at_rest(arms, 3), broken)
        assert torch.equal(torque.stiffness, before.stiffness)
        torch.testing.assert_close(torque.elastic, before.elastic, rtol=1e-14, atol=1e-14)
        assert report.values["store_energy"].tolist() == [[2.0, 2.0], [0.0, 2.0], [2.0, 2.0]]
        assert report.values["held_back"].tolist() == [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]
    softer, _ = CoTaPLaw(arms, LawConfig("cotap", error=error))(at_rest(arms, 3), parameters(3, 250.0))
    torque, report = law(at_rest(arms, 3), parameters(3, 250.0))
    torch.testing.assert_close(torque.stiffness, softer.stiffness)  # which fills the store
    assert 0.0 < float(report.values["store_energy"][1, 0]) <= 2.0


def test_an_arm_that_begins_with_what_is_not_a_number_takes_the_next_command_with_an_empty_store(arms):
    law, broken = PassiveCoTaPLaw(arms, LawConfig("cotap", passive=True)), parameters(2)
    broken.stiffness[0, 1] = torch.nan
    law(at_rest(arms, 2, fresh=True), broken)
    torque, report = law(at_rest(arms, 2), parameters(2))
    plain, _ = CoTaPLaw(arms, LawConfig("cotap"))(at_rest(arms, 2), parameters(2))
    assert torch.equal(torque.stiffness, plain.stiffness)
    assert report.values["store_energy"].tolist() == [[2.0, 0.0], [2.0, 2.0]]
    _, report = law(at_rest(arms, 2, away=0.05), parameters(2, 1200.0))
    assert float(report.values["held_back"][0, 1]) > 0.9
    assert float(report.values["held_back"][1, 1]) < 0.8


class Switching:
    """Laws of the joint and of the task error in turns, each for seven steps."""

    def __init__(self, arms, carried, **fields) -> None:
        configs = [LawConfig("cotap", error=error, passive=True, **fields) for error in ("joint", "task")]
        self.laws, self.carried, self.step = [PassiveCoTaPLaw(arms, cfg) for cfg in configs], carried, 0

    def __call__(self, state, p):
        before, now = (self.laws[step // 7 % 2] for step in (self.step - 1, self.step))
        if now is not before and self.step:
            for env, arm in torch.cartesian_prod(torch.arange(len(state.position)), torch.arange(2)).tolist():
                assert now.take_over(env, arm, before.memory, state.position)
            if not self.carried:
                state = replace(state, fresh=torch.ones_like(state.fresh))
        self.step += 1
        return now(state, p)


def test_switching_between_passive_laws_draws_no_more_than_one_of_them(arms, rng):
    """And much more where every one of them begins with a full store."""
    arms = replace(arms, kd=0.02 * arms.kd)
    fields = {"damping": "pd", "store_energy": 0.3, "store_power": 1e3}
    drawn, level, _ = pulled(arms, Switching(arms, carried=True, **fields), 4, 90, knowing, rng)
    assert float(drawn.max()) <= 0.3 + 1e-9
    assert float(level.min()) >= 0.0
    refilled, _, _ = pulled(arms, Switching(arms, carried=False, **fields), 4, 90, knowing, rng)
    assert float(refilled.max()) > 1.0


def test_a_law_without_a_store_leaves_an_empty_one(arms):
    law = PassiveCoTaPLaw(arms, LawConfig("cotap", passive=True))
    state = at_rest(arms, 2)
    for arm in range(2):
        law.take_over(1, arm, {}, state.position)
    fresh = torch.tensor([[True, True], [False, False]])
    torque, report = law(replace(state, fresh=fresh), parameters(2))
    plain, _ = CoTaPLaw(arms, LawConfig("cotap"))(state, parameters(2))
    assert torch.equal(torque.stiffness, plain.stiffness)
    assert report.values["store_energy"].tolist() == [[2.0, 2.0], [0.0, 0.0]]


def test_an_arm_whose_stiffness_is_not_positive_definite_keeps_it_and_stops_no_other():
    old = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    old[1, 0, 0] = -1e-9
    new, error, room = 2.0 * torch.eye(4).double().repeat(3, 1, 1), torch.full((3, 4), 0.1).double(), torch.ones(3)
    stiffness, _, share, injected = held_spring(old, new, error, error, room)
    assert torch.equal(stiffness[1], old[1])
    assert torch.equal(stiffness[[0, 2]], new[[0, 2]])
    assert share.tolist() == [1.0, 0.0, 1.0]
    torch.testing.assert_close(injected, torch.tensor([0.02, 0.0, 0.02], dtype=torch.float64))
