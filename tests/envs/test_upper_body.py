"""Laws inside the environment: what actuators give, per arm and world, late commands, and going on exactly."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
import torch

from cotap.compliance.laws import LawConfig
from cotap.envs.disturbances import HandForceConfig
from cotap.envs.forces import ForceProfile
from cotap.envs.randomization import RandomizationConfig
from cotap.envs.upper_body import LawSampling, TorsoComplianceConfig, UpperBodyConfig

COTAP = UpperBodyConfig(LawConfig("cotap"), LawConfig("cotap"))
ARMS = slice(11, None)


def fresh(cfg: UpperBodyConfig) -> UpperBodyConfig:
    return copy.deepcopy(cfg)


def drive(env, steps: int, seed: int = 0) -> list[torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    return [env.step(0.3 * torch.randn(env.num_envs, 19, generator=rng))[0]["policy"] for _ in range(steps)]


def actuator_force(env, world: int) -> np.ndarray:
    """Torques that MuJoCo itself gives in this world's present state, from its controls and gains."""
    model = copy.copy(env.sim.model)
    model.actuator_biasprm[:] = env.sim.field("actuator_biasprm")[world].numpy()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = env.sim.qpos[world], env.sim.qvel[world], env.sim.ctrl[world]
    mujoco.mj_forward(model, data)
    return data.actuator_force


@pytest.mark.parametrize("randomized", [True, False])
def test_actuators_give_the_laws_torque(make_env, randomized):
    """The control that is about to be applied, against the torque that the law says, limits included."""
    env = make_env(
        3, upper_body=fresh(COTAP), randomization=RandomizationConfig(enabled=randomized), torque_limit_scale=0.5
    )
    drive(env, 4)
    env._send_to_arms()
    for substep in range(2):
        env.sim.ctrl.copy_(env._drive(substep))
        asked = env._arm_torque(
            env.state.joint_pos[:, ARMS], env.state.joint_vel[:, ARMS], env.targets.arrived(substep)
        )
        limit = 0.5 * torch.tensor([40.0, 40.0, 18.0, 18.0] * 2)
        asked = torch.maximum(torch.minimum(asked, limit), -limit)
        for world in range(3):
            np.testing.assert_allclose(actuator_force(env, world)[ARMS], asked[world], atol=5e-3)


def test_pd_through_the_laws_is_pd_through_the_actuators(make_env):
    """A soft PD law of the robot's own gain takes the other way through the code and ends at the same torques."""
    exact = RandomizationConfig(enabled=False)
    one = make_env(4, randomization=exact)
    soft = LawConfig("soft-pd", soft_gain=100.0)
    other = make_env(4, randomization=exact, upper_body=UpperBodyConfig(soft, soft))
    assert other.upper_body.active
    assert not one.upper_body.active
    drive(one, 10)
    drive(other, 10)
    torch.testing.assert_close(one.sim.qpos, other.sim.qpos, atol=1e-4, rtol=0)


def test_arms_have_laws_of_their_own(make_env):
    """With cotap on the right only, the left arm does what it does under PD for a step, the right does not."""
    exact = RandomizationConfig(enabled=False)
    both, mixed = (
        make_env(2, randomization=exact, upper_body=UpperBodyConfig(LawConfig("pd"), LawConfig(right, alpha=1.0)))
        for right in ("soft-pd", "cotap")
    )
    for env in (both, mixed):
        drive(env, 1)
    a, b = both.upper_body._stiffness[1], mixed.upper_body._stiffness[1]
    torch.testing.assert_close(a[:, 0], 100.0 * torch.eye(4).expand(2, 4, 4))
    torch.testing.assert_close(b[:, 0], a[:, 0])
    torch.testing.assert_close(a[:, 1], 30.0 * torch.eye(4).expand(2, 4, 4))
    assert float((b[:, 1] - a[:, 1]).abs().max()) > 5.0
    assert set(mixed.upper_body.log) == {
        "/law/alpha", "/law/projected", "/law/smallest_eigenvalue", "/law/largest_eigenvalue"
    }  # fmt: skip


def test_parameters_differ_between_worlds_and_change_at_any_step(make_env):
    env = make_env(2, upper_body=fresh(COTAP), randomization=RandomizationConfig(enabled=False))
    env.motions.hold(env.motions.default)
    env.reset()
    env.upper_body.parameters.stiffness[1] = 900.0
    drive(env, 1)
    largest = torch.linalg.eigvalsh(env.upper_body._stiffness[1])[..., -1]
    assert (largest[1] > 1.1 * largest[0]).all()
    env.upper_body.parameters.alpha[:] = 0.0
    drive(env, 1)
    torch.testing.assert_close(env.upper_body._stiffness[1], 100.0 * torch.eye(4).expand(2, 2, 4, 4), atol=1e-2, rtol=0)


def test_parameters_are_drawn_per_world_arm_and_axis_and_drawn_again(make_env):
    cfg = fresh(COTAP)
    cfg.sampling = LawSampling(enabled=True, hold_s=(0.1, 0.2))
    env = make_env(300, upper_body=cfg)
    p = env.upper_body.parameters
    assert 80.0 <= float(p.stiffness.min()) < 90.0
    assert 1050.0 < float(p.stiffness.max()) <= 1200.0
    # Log-uniform: half lie below the geometric mean of the ends.
    assert float((p.stiffness < (80.0 * 1200.0) ** 0.5).float().mean()) == pytest.approx(0.5, abs=0.05)
    assert float(p.null_stiffness.min()) >= 24.0
    assert float(p.null_stiffness.max()) <= 56.0
    assert float(p.alpha.mean()) == pytest.approx(0.5, abs=0.05)
    before = p.alpha.clone()
    for _ in range(4):
        env.step(torch.zeros(300, 19))
    assert torch.equal(p.alpha, before)
    for _ in range(8):
        env.step(torch.zeros(300, 19))
    assert (p.alpha != before).all()


def test_a_share_of_the_draws_is_all_compliance(make_env):
    cfg = fresh(COTAP)
    cfg.sampling = LawSampling(enabled=True, alpha=(0.2, 0.9), full_alpha=0.25)
    alpha = make_env(1000, upper_body=cfg).upper_body.parameters.alpha
    assert float((alpha == 0.9).float().mean()) == pytest.approx(0.25, abs=0.03)
    assert float(alpha.min()) >= 0.2
    assert float(alpha[alpha < 0.9].mean()) == pytest.approx(0.55, abs=0.02)


def test_a_late_command_is_mixed_with_the_one_before(make_env):
    env = make_env(2, upper_body=fresh(COTAP))
    drive(env, 3)
    q, dq = env.state.joint_pos[:, ARMS] + 0.05, env.state.joint_vel[:, ARMS]
    ones = torch.ones(2, 8)
    new, old, half = (env.upper_body.torque(q, dq, torch.full((2,), share), ones, ones) for share in (1.0, 0.0, 0.5))
    assert float((new - old).abs().max()) > 0.05
    torch.testing.assert_close(half, 0.5 * (new + old), atol=1e-4, rtol=1e-4)


def test_gain_errors_scale_elastic_torque_and_damping_but_not_gravity(make_env):
    env = make_env(2, upper_body=fresh(COTAP), randomization=RandomizationConfig(enabled=False))
    drive(env, 3)
    q, dq, now = env.state.joint_pos[:, ARMS], env.state.joint_vel[:, ARMS], torch.ones(2)
    ones = torch.ones(2, 8)
    plain = env.upper_body.torque(q, dq, now, ones, ones)
    gravity = env.upper_body._feedforward[1].flatten(1)
    viscous = -(env.upper_body.newest.damping @ dq.reshape(2, 2, 4, 1)).flatten(1)
    elastic = plain - gravity - viscous
    scaled = env.upper_body.torque(q, dq, now, 1.1 * ones, 0.9 * ones)
    torch.testing.assert_close(scaled, gravity + 1.1 * elastic + 0.9 * viscous, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("name", ["facet", "cotap+facet-matched", "dcc"])
@pytest.mark.parametrize("sensing", ["privileged", "estimated"])
def test_a_run_of_laws_that_remember_goes_on_exactly(make_env, name, sensing):
    """Virtual masses, moved targets and what hands have felt are part of the state, the first step included."""

    def make():
        arms = UpperBodyConfig(LawConfig(name, sensing=sensing), LawConfig("facet", virtual_mass=2.0))
        return make_env(3, upper_body=arms, force=ForceProfile((20.0, 0.0, -20.0), "both", start_s=0.06))

    env = make()
    drive(env, 8)
    saved = copy.deepcopy(env.state_dict())
    expected = drive(env, 6, seed=1)
    other = make()
    other.load_state_dict(saved)
    for mine, theirs in zip(drive(other, 6, seed=1), expected, strict=True):
        assert torch.equal(mine, theirs)
    with pytest.raises(ValueError, match="remember 0 states, got"):
        make_env(3, upper_body=fresh(COTAP)).load_state_dict(saved)


def test_a_restarted_world_has_a_hand_that_felt_nothing(make_env):
    """The virtual mass of the world that fell starts over; the other's stays where its load has put it."""
    facet = LawConfig("facet", stiffness=(500.0, 500.0, 500.0))
    cfg = UpperBodyConfig(facet, copy.copy(facet))
    load = ForceProfile((0.0, 0.0, -20.0), "left", start_s=0.02)
    env = make_env(2, upper_body=cfg, force=load, hand_forces=HandForceConfig(enabled=False))
    env.motions.hold(env.motions.default)
    for _ in range(25):
        env.step(torch.zeros(2, 19))
    law = next(iter(env.upper_body._laws.values()))[0]
    shift = (law.memory["position_h"] - law.memory["wanted_h"]).norm(dim=-1)
    assert shift[0].tolist() == pytest.approx([0.035, 0.0], abs=0.01)
    env.sim.qpos[1, 3:7] = torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0])  # on its side
    env.step(torch.zeros(2, 19))
    assert env.upper_body.sensors.privileged[1].abs().max() == 0.0
    env.step(torch.zeros(2, 19))
    shift = (law.memory["position_h"] - law.memory["wanted_h"]).norm(dim=-1)
    assert float(shift[1].max()) < 1e-6
    assert float(shift[0, 0]) > 0.02


def test_hands_feel_the_forces_of_the_step_before_in_the_heading_frame(make_env):
    load = ForceProfile((5.0, -10.0, 15.0), "right", start_s=0.02)
    env = make_env(2, upper_body=fresh(COTAP), force=load, hand_forces=HandForceConfig(enabled=False))
    felt = []
    for _ in range(3):
        env.step(torch.zeros(2, 19))
        felt.append(env.upper_body.sensors.privileged.clone())
    assert felt[0].abs().max() == 0.0
    for later in felt[1:]:
        assert later[:, 0].abs().max() == 0.0
        torch.testing.assert_close(later[:, 1], torch.tensor([5.0, -10.0, 15.0]).expand(2, 3), atol=0.3, rtol=0)


@pytest.mark.parametrize("name", ["facet", "cotap"])
def test_forces_are_estimated_from_arm_torques(make_env, name):
    """Held loads, pelvis fixed, no torque sensor but the motors' own: within 5 % once arms are at rest."""
    law = LawConfig(name, sensing="estimated", stiffness=(800.0, 800.0, 800.0))
    env = make_env(
        2, upper_body=UpperBodyConfig(law, copy.copy(law)), fixed_base=True,
        randomization=RandomizationConfig(enabled=False),
        force=ForceProfile((6.0, -4.0, -10.0), "left", start_s=0.0), hand_forces=HandForceConfig(enabled=False),
    )  # fmt: skip
    env.motions.hold(env.motions.default + torch.tensor([0.0, 0.2, 0.0, 0.3, 0.0, -0.2, 0.0, 0.3]))
    env.reset()
    for _ in range(150):
        env.step(torch.zeros(2, 19))
    expected = torch.tensor([[6.0, -4.0, -10.0], [0.0, 0.0, 0.0]]).expand(2, 2, 3)
    torch.testing.assert_close(env.upper_body.sensors.estimated, expected, atol=0.6, rtol=0)


@pytest.mark.parametrize("torso", ["none", "constant", "support"])
def test_a_run_goes_on_exactly(make_env, torso):
    cfg = fresh(COTAP)
    cfg.torso = TorsoComplianceConfig(torso)
    env = make_env(3, upper_body=cfg)
    env.upper_body.parameters.alpha[:] = torch.rand(3, 2, generator=torch.Generator().manual_seed(0))
    drive(env, 6)
    saved = copy.deepcopy(env.state_dict())
    expected = drive(env, 6, seed=1)
    other = make_env(3, upper_body=fresh(cfg))
    other.load_state_dict(saved)
    for mine, theirs in zip(drive(other, 6, seed=1), expected, strict=True):
        assert torch.equal(mine, theirs)


def test_a_restarted_world_shows_no_torque_of_its_life_before(make_env):
    env = make_env(2, upper_body=fresh(COTAP), hand_forces=HandForceConfig(enabled=False))
    drive(env, 3)
    env.sim.qpos[1, 3:7] = torch.tensor([0.5**0.5, 0.5**0.5, 0.0, 0.0])  # on its side
    env.step(torch.zeros(2, 19))
    assert env.upper_body.fresh.tolist() == [False, True]
    torque = env.joint_torque(env.state)[1, ARMS]
    assert float(torque.abs().max()) < 1e-3  # targets are where the joints are
    drive(env, 1)
    assert env.upper_body.fresh.tolist() == [False, False]


def test_an_infeasible_stiffness_is_counted_in_the_log(make_env):
    cfg = fresh(COTAP)
    cfg.torso = TorsoComplianceConfig("constant", (100.0, 1e5, 1e5, 1e5, 1e5, 1e5))  # softer along x than the hands
    env = make_env(2, upper_body=cfg)
    *_, extras = env.step(torch.zeros(2, 19))
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
    ],
)
def test_bad_fields_are_named(make_env, cfg, message):
    with pytest.raises(ValueError, match=message):
        make_env(1, upper_body=cfg)
