"""Laws inside the environment: what actuators give, per arm and env, late commands, and going on exactly."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from env_tools import NOMINAL, drive, knock_over, mujoco_of, zeros

from cotap.compliance.laws import LAWS, READS, LawConfig, PDLaw
from cotap.envs.actions import ActionConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.envs.upper_body import LawSampling, TorsoComplianceConfig, UpperBodyConfig


def both(law: LawConfig, **fields) -> UpperBodyConfig:
    """Both arms under one law."""
    return UpperBodyConfig(law, copy.copy(law), **fields)


def loaded(profile: ForceProfile) -> ExternalForceConfig:
    return ExternalForceConfig(scripted=profile)


def of_arms(env, values: torch.Tensor) -> torch.Tensor:
    return values[:, env.num_lower :]


@pytest.mark.parametrize("randomized", [True, False])
def test_actuators_give_the_laws_torque(make_env, robot, randomized):
    """The control that is about to be applied, against the torque that the law says, limits included."""
    env = make_env(
        3, robot=robot, upper_body=both(LawConfig("cotap")), randomization=RandomizationConfig(enabled=randomized),
        torque_limit_scale=0.3,
    )  # fmt: skip
    drive(env, 4)
    q, dq = of_arms(env, env.state.joint_pos), of_arms(env, env.state.joint_vel)
    env.actuation.send(
        env.state, env.actuation.current + torch.linspace(-0.6, 0.5, env.num_actions), env.motions.current().velocity
    )
    limit = of_arms(env, env.actuation.torque_limit.unsqueeze(0))
    scales = of_arms(env, env.randomizer.kp_scale), of_arms(env, env.randomizer.kd_scale)
    for substep in range(2):
        env.sim.ctrl.copy_(env.actuation.drive(substep))
        asked = env.upper_body.torque(q, dq, env.actuation.arrived(substep), *scales).clamp(-limit, limit)
        for i in range(3):
            _, data = mujoco_of(env, i)
            np.testing.assert_allclose(data.actuator_force[env.num_lower :], asked[i], atol=5e-3)
    assert (asked.abs() > 0.999 * limit).any()
    assert (asked.abs() < 0.9 * limit).any()


def test_what_is_observed_is_what_the_law_asks(make_env, robot):
    env = make_env(3, robot=robot, upper_body=both(LawConfig("cotap")))
    drive(env, 5)
    q, dq = of_arms(env, env.state.joint_pos), of_arms(env, env.state.joint_vel)
    scales = of_arms(env, env.randomizer.kp_scale), of_arms(env, env.randomizer.kd_scale)
    asked = env.upper_body.torque(q, dq, env.actuation.arrived(1), *scales)
    limit = of_arms(env, env.actuation.torque_limit.unsqueeze(0))
    torch.testing.assert_close(of_arms(env, env.torque), asked.clamp(-limit, limit))


def test_pd_as_a_law_is_pd_through_the_actuators(make_env):
    """A soft PD law of the H1's own gain takes the other way through the code and ends at the same torques."""
    one = make_env(4, randomization=NOMINAL)
    other = make_env(4, randomization=NOMINAL, upper_body=both(LawConfig("soft-pd", soft_gain=100.0)))
    assert other.upper_body.active
    assert not one.upper_body.active
    drive(one, 10)
    drive(other, 10)
    torch.testing.assert_close(one.sim.qpos, other.sim.qpos, atol=1e-4, rtol=0)


def test_pd_beside_a_law_is_pd_with_gains_of_each_joint(make_env, robot):
    """One arm under a law makes the other's PD a law too, with its own gains: it moves as under the actuators."""
    small = ActionConfig(lower_scale=0.25)  # legs that swing far shake the arms
    fields = {"robot": robot, "randomization": NOMINAL, "fixed_base": True, "actions": small}
    plain, mixed = (
        make_env(2, upper_body=UpperBodyConfig(right=right), **fields)
        for right in (LawConfig("pd"), LawConfig("soft-pd"))
    )
    drive(plain, 10)
    drive(mixed, 10)
    joints = torch.tensor(plain.spec.indices(plain.spec.arms[0].joints))
    others = torch.tensor(plain.spec.indices(plain.spec.arms[1].joints))
    moved = (plain.state.joint_pos - mixed.state.joint_pos).abs()
    assert float(moved[:, joints].max()) < 8e-3
    assert float(moved[:, others].max()) > 2e-2
    kp = torch.tensor([plain.spec.joint(name).kp for name in plain.spec.arms[0].joints])
    torch.testing.assert_close(mixed.upper_body.stiffness[:, 0], torch.diag(kp).expand(2, -1, -1))


def test_arms_have_laws_of_their_own(make_env):
    """With cotap on the right only, the left arm does what it does under PD for a step, the right does not."""
    soft, mixed = (
        make_env(2, randomization=NOMINAL, upper_body=UpperBodyConfig(LawConfig("pd"), LawConfig(right, alpha=1.0)))
        for right in ("soft-pd", "cotap")
    )
    for env in (soft, mixed):
        drive(env, 1)
    a, b = soft.upper_body.stiffness, mixed.upper_body.stiffness
    torch.testing.assert_close(a[:, 0], 100.0 * torch.eye(4).expand(2, 4, 4))
    torch.testing.assert_close(b[:, 0], a[:, 0])
    torch.testing.assert_close(a[:, 1], 30.0 * torch.eye(4).expand(2, 4, 4))
    assert float((b[:, 1] - a[:, 1]).abs().max()) > 5.0
    assert set(mixed.upper_body.log) == {
        "/law/alpha", "/law/projected", "/law/smallest_eigenvalue", "/law/largest_eigenvalue"
    }  # fmt: skip


class Anchored(PDLaw):
    """PD as a spring that rests at the target: the same torque, said with another anchor."""

    def __init__(self, arms, _config):
        super().__init__(arms)

    def __call__(self, arms, parameters):
        answer, report = super().__call__(arms, parameters)
        rest = answer.anchor + torch.linalg.solve(answer.stiffness, answer.elastic)
        return replace(answer, anchor=rest, elastic=torch.zeros_like(answer.elastic)), report


def test_each_arms_law_has_an_anchor_of_its_own(make_env, monkeypatch):
    monkeypatch.setitem(LAWS, "anchored", Anchored)
    monkeypatch.setitem(READS, "anchored", READS["pd"])
    torques = []
    for left in ("pd", "anchored"):
        env = make_env(2, randomization=NOMINAL, upper_body=UpperBodyConfig(LawConfig(left), LawConfig("soft-pd")))
        drive(env, 3)
        torques.append(env.torque)
    torch.testing.assert_close(*torques, rtol=1e-4, atol=1e-3)


def test_parameters_differ_between_envs_and_may_change(make_env):
    env = make_env(2, upper_body=both(LawConfig("cotap")), randomization=NOMINAL)
    env.motions.hold(env.motions.default)
    env.reset()
    env.upper_body.parameters.stiffness[1] = 900.0
    drive(env, 1)
    largest = torch.linalg.eigvalsh(env.upper_body.stiffness)[..., -1]
    assert (largest[1] > 1.1 * largest[0]).all()
    env.upper_body.parameters.alpha[:] = 0.0
    drive(env, 1)
    torch.testing.assert_close(env.upper_body.stiffness, 100.0 * torch.eye(4).expand(2, 2, 4, 4), atol=1e-2, rtol=0)


def test_parameters_are_drawn_and_drawn_again(make_env, robot):
    """Each env, arm and axis by itself."""
    cfg = both(LawConfig("facet"), sampling=LawSampling(enabled=True, hold_s=(0.1, 0.2)))
    env = make_env(300, robot=robot, upper_body=cfg)
    p = env.upper_body.parameters
    assert 80.0 <= float(p.stiffness.min()) < 90.0
    assert 1050.0 < float(p.stiffness.max()) <= 1200.0
    # Log-uniform: half lie below the geometric mean of the ends.
    assert float((p.stiffness < (80.0 * 1200.0) ** 0.5).float().mean()) == pytest.approx(0.5, abs=0.05)
    assert float(p.null_stiffness.min()) >= 24.0
    assert float(p.null_stiffness.max()) <= 56.0
    assert float(p.alpha.mean()) == pytest.approx(0.5, abs=0.05)
    assert float(torch.corrcoef(p.stiffness.flatten(1).T).triu(1).abs().max()) < 0.25
    before = p.alpha.clone()
    for _ in range(4):
        env.step(zeros(env))
    assert torch.equal(p.alpha, before)
    for _ in range(8):
        env.step(zeros(env))
    assert (p.alpha != before).all()


def test_a_share_of_the_draws_is_all_compliance(make_env):
    cfg = both(LawConfig("cotap"), sampling=LawSampling(enabled=True, alpha=(0.2, 0.9), full_alpha=0.25))
    alpha = make_env(1000, upper_body=cfg).upper_body.parameters.alpha
    assert float((alpha == 0.9).float().mean()) == pytest.approx(0.25, abs=0.03)
    assert float(alpha.min()) >= 0.2
    assert float(alpha[alpha < 0.9].mean()) == pytest.approx(0.55, abs=0.02)


def test_a_late_command_is_mixed_with_the_one_before(make_env, robot):
    """With the law of one step ago, and with no trace of that of two steps ago."""
    env = make_env(2, robot=robot, upper_body=both(LawConfig("cotap")))
    laws = []
    for k in range(3):
        drive(env, 1, seed=k)
        laws.append(env.upper_body.newest)
    q, dq = of_arms(env, env.state.joint_pos) + 0.05, of_arms(env, env.state.joint_vel)
    ones = torch.ones_like(q)
    joints = [env.reader.arm_joints(torch.nn.functional.pad(x, (env.num_lower, 0))) for x in (q, dq, ones, ones)]
    oldest, old, new = (law.at(*joints).flatten(1) for law in laws)
    for share in (1.0, 0.75, 0.5, 0.0):
        mixed = env.upper_body.torque(q, dq, torch.full((2,), share), ones, ones)
        torch.testing.assert_close(mixed, share * new + (1.0 - share) * old, atol=1e-4, rtol=1e-4)
    assert float((new - old).abs().max()) > 0.05
    assert float((oldest - old).abs().max()) > 0.05


def test_gain_errors_leave_gravity_torques_alone(make_env, robot):
    """They scale the elastic torque and the damping."""
    env = make_env(2, robot=robot, upper_body=both(LawConfig("cotap")), randomization=NOMINAL)
    drive(env, 3)
    q, dq, now = of_arms(env, env.state.joint_pos), of_arms(env, env.state.joint_vel), torch.ones(2)
    ones, law = torch.ones_like(q), env.upper_body.newest
    plain = env.upper_body.torque(q, dq, now, ones, ones)
    rates = env.reader.arm_joints(env.state.joint_vel).unsqueeze(-1)
    gravity, viscous = law.feedforward.flatten(1), -(law.damping @ rates).flatten(1)
    elastic = plain - gravity - viscous
    scaled = env.upper_body.torque(q, dq, now, 1.1 * ones, 0.9 * ones)
    torch.testing.assert_close(scaled, gravity + 1.1 * elastic + 0.9 * viscous, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(("name", "sensing"), [("facet", "estimated"), ("facet", "privileged"), ("dcc", "estimated")])
def test_laws_that_remember_go_on_exactly(make_env, robot, name, sensing):
    """Virtual masses, moved targets and what hands have felt are part of the state, the first step included."""

    def make():
        arms = UpperBodyConfig(LawConfig(name, sensing=sensing), LawConfig("facet", virtual_mass=2.0))
        load = loaded(ForceProfile((20.0, 0.0, -20.0), "both", start_s=0.06))
        return make_env(3, robot=robot, upper_body=arms, forces=load)

    env = make()
    drive(env, 8)
    saved = copy.deepcopy(env.state_dict())
    expected = drive(env, 6, seed=1)
    other = make()
    other.load_state_dict(saved)
    for mine, theirs in zip(drive(other, 6, seed=1), expected, strict=True):
        assert torch.equal(mine, theirs)
    with pytest.raises(ValueError, match="remember 0 states, got"):
        make_env(3, robot=robot, upper_body=both(LawConfig("soft-pd"))).load_state_dict(saved)


def test_cotap_and_facet_matched_go_on_exactly(make_env):
    cfg = both(LawConfig("cotap+facet-matched", sensing="estimated"))
    env, other = (make_env(3, upper_body=copy.deepcopy(cfg), seed=s) for s in (0, 1))
    drive(env, 5)
    other.load_state_dict(env.state_dict())
    assert torch.equal(drive(env, 5)[-1], drive(other, 5)[-1])


def test_a_restarted_env_has_a_hand_that_felt_nothing(make_env, robot):
    """The virtual mass of the env that fell starts over; the other's stays where its load has put it."""
    cfg = both(LawConfig("facet", stiffness=(500.0, 500.0, 500.0)))
    load = loaded(ForceProfile((0.0, 0.0, -20.0), "left", start_s=0.02))
    env = make_env(2, robot=robot, upper_body=cfg, forces=load)
    env.motions.hold(env.motions.default)
    for _ in range(25):
        env.step(zeros(env))
    law = next(iter(env.upper_body._laws.values()))[0]

    def shift() -> torch.Tensor:
        return (law.memory["position_h"] - law.memory["wanted_h"]).norm(dim=-1)

    assert shift()[0].tolist() == pytest.approx([0.035, 0.0], abs=0.01)
    knock_over(env, 1)
    env.step(zeros(env))
    assert env.upper_body.sensors.privileged[1].abs().max() == 0.0
    env.step(zeros(env))
    assert float(shift()[1].max()) < 1e-6
    assert float(shift()[0, 0]) > 0.02


def test_hands_feel_the_last_step_in_the_heading_frame(make_env, robot):
    load = loaded(ForceProfile((5.0, -10.0, 15.0), "right", start_s=0.02))
    env = make_env(2, robot=robot, upper_body=both(LawConfig("cotap")), forces=load)
    felt = []
    for _ in range(3):
        env.step(zeros(env))
        felt.append(env.upper_body.sensors.privileged.clone())
    assert felt[0].abs().max() == 0.0
    for later in felt[1:]:
        assert later[:, 0].abs().max() == 0.0
        torch.testing.assert_close(later[:, 1], torch.tensor([5.0, -10.0, 15.0]).expand(2, 3), atol=0.3, rtol=0)


@pytest.mark.parametrize("name", ["facet", "cotap"])
def test_forces_are_estimated_from_arm_torques(make_env, name):
    """Held loads, base fixed, no torque sensor but the motors' own: within 5 % once arms are at rest."""
    law = LawConfig(name, sensing="estimated", stiffness=(800.0, 800.0, 800.0))
    load = loaded(ForceProfile((6.0, -4.0, -10.0), "left", start_s=0.0))
    env = make_env(2, upper_body=both(law), fixed_base=True, randomization=NOMINAL, forces=load)
    env.motions.hold(env.motions.default + torch.tensor([0.0, 0.2, 0.0, 0.3, 0.0, -0.2, 0.0, 0.3]))
    env.reset()
    for _ in range(150):
        env.step(zeros(env))
    expected = torch.tensor([[6.0, -4.0, -10.0], [0.0, 0.0, 0.0]]).expand(2, 2, 3)
    torch.testing.assert_close(env.upper_body.sensors.estimated, expected, atol=0.6, rtol=0)


def test_forces_are_estimated_on_arms_of_any_length(make_env):
    """Seven joints with rotors and friction of their own, on a torso that the waist carries."""
    law = LawConfig("facet", sensing="estimated", stiffness=(800.0, 800.0, 800.0))
    load = loaded(ForceProfile((3.0, -2.0, -5.0), "left", start_s=0.0))
    env = make_env(
        2, robot="made-up", upper_body=both(law), fixed_base=True, randomization=NOMINAL, forces=load,
        torque_limit_scale=3.0,
    )  # fmt: skip
    env.motions.hold(env.motions.default)
    env.reset()
    for _ in range(150):
        env.step(zeros(env))
    expected = torch.tensor([[3.0, -2.0, -5.0], [0.0, 0.0, 0.0]]).expand(2, 2, 3)
    torch.testing.assert_close(env.upper_body.sensors.estimated, expected, atol=0.5, rtol=0)


@pytest.mark.parametrize("torso", ["none", "constant", "support"])
def test_a_run_goes_on_exactly(make_env, robot, torso):
    cfg = both(LawConfig("cotap"), torso=TorsoComplianceConfig(torso))
    env = make_env(3, robot=robot, upper_body=copy.deepcopy(cfg))
    env.upper_body.parameters.alpha[:] = torch.rand(3, 2, generator=torch.Generator().manual_seed(0))
    drive(env, 6)
    saved = copy.deepcopy(env.state_dict())
    expected = drive(env, 6, seed=1)
    other = make_env(3, robot=robot, upper_body=copy.deepcopy(cfg))
    other.load_state_dict(saved)
    for mine, theirs in zip(drive(other, 6, seed=1), expected, strict=True):
        assert torch.equal(mine, theirs)


def test_a_restarted_env_has_no_law_from_before(make_env, robot):
    env = make_env(2, robot=robot, upper_body=both(LawConfig("cotap")))
    drive(env, 3)
    knock_over(env, 1)
    env.step(zeros(env))
    assert env.upper_body.fresh.tolist() == [[False] * 2, [True] * 2]
    assert not env.torque[1].any()
    drive(env, 1)
    assert env.upper_body.fresh.tolist() == [[False] * 2] * 2
    for name in env.upper_body.PAIRED:
        before, newest = getattr(env.upper_body, name)
        assert torch.equal(before[1], newest[1])
    assert not torch.equal(*env.upper_body._anchor[:, 0])


def test_an_infeasible_stiffness_is_counted_in_the_log(make_env):
    # Softer along x than the hands.
    cfg = both(LawConfig("cotap"), torso=TorsoComplianceConfig("constant", (100.0, 1e5, 1e5, 1e5, 1e5, 1e5)))
    env = make_env(2, upper_body=cfg)
    *_, extras = env.step(zeros(env))
    assert float(extras["log"]["/law/projected"]) == 1.0
    assert torch.isfinite(env.state.joint_pos).all()


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        (UpperBodyConfig(LawConfig("jazz")), "upper_body.left.name 'jazz' is unknown"),
        (UpperBodyConfig(right=LawConfig(alpha=-1.0)), "upper_body.right.alpha"),
        (UpperBodyConfig(torso=TorsoComplianceConfig("soft")), "upper_body.torso.model 'soft' is unknown"),
        (
            UpperBodyConfig(torso=TorsoComplianceConfig(stiffness=(0.0, 1, 1, 1, 1, 1))),
            r"upper_body.torso.stiffness\[0\]",
        ),
        (UpperBodyConfig(sampling=LawSampling(alpha=(0.0, 2.0))), r"upper_body.sampling.alpha\[1\]"),
    ],
)
def test_bad_fields_are_named(make_env, cfg, message):
    with pytest.raises(ValueError, match=message):
        make_env(1, upper_body=cfg)


def test_a_store_is_an_arms_own_logged_and_saved(make_env):
    """Of the passive arms alone; the other arm's law has none."""
    laws = UpperBodyConfig(LawConfig("cotap", passive=True, store_energy=0.05), LawConfig("cotap"))
    env, other = (make_env(3, upper_body=laws, seed=seed) for seed in (0, 1))
    env.upper_body.parameters.stiffness[0, 0] = 1200.0
    drive(env, 3)
    env.upper_body.parameters.stiffness[0, 0] = 100.0
    drive(env, 20, scale=2.0)
    env.upper_body.parameters.stiffness[0, 0] = 1200.0
    drive(env, 3, scale=2.0)
    report = env.upper_body.report
    assert report["store_energy"][:, 1].isnan().all()
    assert report["store_energy"][:, 0].isfinite().all()
    assert float(report["held_back"][0, 0]) > 0.0
    assert float(env.upper_body.log["/law/store_energy"]) == pytest.approx(float(report["store_energy"][:, 0].mean()))
    assert float(env.upper_body.log["/law/held_back"]) == pytest.approx(float(report["held_back"][:, 0].mean()))
    other.load_state_dict(copy.deepcopy(env.state_dict()))
    futures = [torch.stack(drive(e, 20, seed=5)) for e in (env, other)]
    assert torch.equal(*futures)
    levels = [e.upper_body.report["store_energy"][:, 0] for e in (env, other)]
    assert torch.equal(*levels)
    env.set_law(0, 0, LawConfig("cotap"))
    assert env.upper_body.report == {}


def test_a_store_is_carried_from_law_to_law_and_never_refilled_by_it(make_env):
    passive = LawConfig("cotap", passive=True, store_energy=1.0)
    env = make_env(2, upper_body=both(passive))
    drive(env, 2)
    (law,) = env.upper_body._remembering()
    law.memory["store"][:] = 0.25
    before = env.upper_body.stiffness[0, 0].clone()
    env.set_law(0, 0, replace(passive, error="task"))
    env.upper_body.parameters.stiffness[:] = 1200.0  # more than is left could pay
    env.actuation.send(env.state, env.actuation.current + 0.8, env.motions.current().velocity)
    report = env.upper_body.report
    assert float(report["store_energy"].max()) < 0.25
    assert float(report["held_back"].min()) > 0.2
    assert not torch.equal(env.upper_body.stiffness[0, 0], before)
    env.set_law(0, 0, LawConfig("pd"))
    drive(env, 1)
    env.set_law(0, 0, passive)
    drive(env, 1)
    assert float(env.upper_body.report["store_energy"][0, 0]) == 0.0
    env.reset()
    drive(env, 1)
    assert float(env.upper_body.report["store_energy"].min()) > 0.9
    env.reset()
    env.set_law(0, 0, LawConfig("pd"))
    env.set_law(0, 0, passive)  # before the first command: nothing moved under another law
    drive(env, 1)
    assert float(env.upper_body.report["store_energy"].min()) > 0.9


def test_a_default_store_changes_nothing_where_nothing_is_commanded(make_env, robot):
    """To the last bit, while arms follow their motions and hands are pushed: only the pose changes the stiffness."""
    push = ForceProfile((5.0, -5.0, -10.0), "both", 0.1, 0.3)
    runs = []
    for passive in (False, True):
        laws = both(LawConfig("cotap", passive=passive))
        env = make_env(4, robot=robot, upper_body=laws, forces=loaded(push), fixed_base=True)
        runs.append(drive(env, 30))
    assert float(env.upper_body.report["store_energy"].min()) < 2.0  # the pose does change it
    for plain, held in zip(*runs, strict=True):
        assert torch.equal(plain, held)
