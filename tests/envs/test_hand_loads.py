"""Random loads on the hands: what is drawn, for how long, and how much of it arms must bear."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from env_tools import NOMINAL, drive, mujoco_of, zeros

from cotap.envs.curriculum import RampConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.hand_loads import HandLoadConfig, HandLoads
from cotap.robots import h1

DT = 0.02
STRONG = torch.full((2, 4), 1e6)


def loads(num_envs=1, **cfg) -> HandLoads:
    return HandLoads(HandLoadConfig(**{"enabled": True, "episode_share": 1.0, **cfg}), 2, num_envs, DT)


def everyone(n) -> torch.Tensor:
    return torch.ones(n, dtype=torch.bool)


def of(hands: HandLoads, samples: float = 0.0) -> torch.Tensor:
    """Its forces where arms bear anything."""
    return hands.current(torch.zeros(len(hands._loaded), 2, 3, 4), STRONG, samples)


def test_draws_follow_ranges_and_shares(rng):
    n = 10_000
    hands = loads(n)
    hands.reset(everyone(n), rng)
    force = of(hands)
    for axis, (low, high) in enumerate(((-40, 40), (-40, 40), (-50, 5))):
        values = force[:, :, axis]
        assert low <= float(values.min()) < low + 0.1
        assert high - 0.1 < float(values.max()) <= high
        assert float((values == 0).float().mean()) == pytest.approx(0.25, abs=0.01)
    assert abs(float(torch.corrcoef(force[:, :, 0].T)[0, 1])) < 0.05  # hands differ


def test_loads_are_in_proportion_to_mass(make_env, robot):
    env = make_env(200, robot=robot, forces=ExternalForceConfig(HandLoadConfig(enabled=True, episode_share=1.0)))
    largest = 50.0 * env.spec.mass_kg / h1().mass_kg
    assert float(-env.forces.hand_loads._force_h.min()) == pytest.approx(largest, rel=0.02)


def test_loads_hold_for_their_time(rng):
    hands = loads(1, hold_s=(0.1, 0.1), zero_probability=0.0)
    hands.reset(everyone(1), rng)
    seen = []
    for _ in range(21):
        seen.append(float(of(hands)[0, 0, 0]))
        hands.step(rng)
    lengths = [seen.count(v) for v in dict.fromkeys(seen)]
    assert all(4 <= n <= 6 for n in lengths[:-1])


def test_scaled_down_to_what_torques_hold_by_hand():
    hands = loads(1, torque_share=0.8, weak_joint=0.0, ramp=RampConfig(0.0, 100.0))
    hands._force_h[0] = torch.tensor([[30.0, 0.0, -40.0], [10.0, 0.0, 0.0]])
    jacobian = torch.zeros(1, 2, 3, 4)
    jacobian[0, :, 2, 3] = 0.3  # vertical force on 0.3 m of forearm: 12 Nm at the elbow
    jacobian[0, :, 0, 0] = -0.5  # forward force below the shoulder: 15 Nm the other way
    limit = torch.tensor([[40.0, 40.0, 18.0, 9.0]]).repeat(2, 1)
    # The elbow may carry 0.8 * 9 = 7.2 Nm of 12: the whole left force shrinks to 0.6. The right is held as it is.
    expected = torch.tensor([[[18.0, 0.0, -24.0], [10.0, 0.0, 0.0]]])
    torch.testing.assert_close(hands.current(jacobian, limit, 100.0), expected)
    quarter = torch.tensor([[[7.5, 0.0, -10.0], [2.5, 0.0, 0.0]]])
    torch.testing.assert_close(hands.current(jacobian, limit, 25.0), quarter)


def test_a_weak_wrist_does_not_decide():
    hands = loads(1, torque_share=0.8, ramp=RampConfig(0.0, 1.0), weak_joint=0.25)
    hands._force_h[0] = torch.tensor([[0.0, 0.0, -40.0]]).repeat(2, 1)
    jacobian = torch.zeros(1, 2, 3, 2)
    jacobian[0, :, 2, 0], jacobian[0, :, 2, 1] = 0.4, 0.2  # 16 Nm at the elbow, 8 Nm at the wrist
    held = {
        limit: hands.current(jacobian, torch.tensor([[25.0, limit]] * 2), 1.0)[0, 0, 2].item() for limit in (6.24, 6.26)
    }
    assert held[6.24] == pytest.approx(-40.0)  # the elbow could hold 20 Nm
    assert held[6.26] == pytest.approx(-40.0 * 0.8 * 6.26 / 8.0)


def test_never_beyond_the_torque_share(rng):
    n = 2000
    hands = loads(n, torque_share=0.5)
    hands.reset(everyone(n), rng)
    jacobian = torch.randn(n, 2, 3, 4, generator=rng)
    limit = torch.tensor([[40.0, 40.0, 18.0, 18.0]]).repeat(2, 1)
    force = hands.current(jacobian, limit, 0.0)
    share = (torch.einsum("nhij,nhi->nhj", jacobian, force).abs() / limit).amax(-1)
    assert float(share.max()) <= 0.5 + 1e-5
    assert float((share > 0.499).float().mean()) > 0.3  # and no smaller than need be


def test_the_share_grows_with_the_samples(rng):
    hands = loads(3, zero_probability=0.0, ramp=RampConfig(100.0, 300.0, first=0.1))
    hands.reset(everyone(3), rng)
    full = of(hands, 300.0)
    assert full.abs().min() > 0.0
    for samples, share in ((0.0, 0.1), (100.0, 0.1), (200.0, 0.55), (1e9, 1.0)):
        torch.testing.assert_close(of(hands, samples), share * full)


def test_loads_that_are_off_are_zero(rng):
    hands = loads(3, enabled=False)
    hands.reset(everyone(3), rng)
    for _ in range(5):
        hands.step(rng)
    assert not of(hands).any()


def test_loads_of_some_episodes_only(rng):
    n = 4000
    hands = loads(n, episode_share=0.3, zero_probability=0.0)
    hands.reset(everyone(n), rng)
    loaded = of(hands).abs().sum((1, 2)) > 0.0
    assert loaded.float().mean().item() == pytest.approx(0.3, abs=0.03)
    for _ in range(300):  # forces change within an episode, which envs bear them does not
        hands.step(rng)
    assert torch.equal(of(hands).abs().sum((1, 2)) > 0.0, loaded)
    hands.reset(torch.arange(n) < 2000, rng)
    again = of(hands).abs().sum((1, 2)) > 0.0
    assert torch.equal(again[2000:], loaded[2000:])
    assert not torch.equal(again[:2000], loaded[:2000])


def test_critics_see_the_load_that_comes(rng):
    hands = loads(40, hold_s=(0.2, 0.2), zero_probability=0.0, ramp=RampConfig(0.0, 100.0))
    hands.reset(everyone(40), rng)
    for _ in range(4):
        hands.step(rng)
    seen, now = hands.ahead(50.0), of(hands, 50.0)
    near = np.exp(-0.12)
    assert seen[:, 0].tolist() == pytest.approx([near] * 40, rel=1e-4)
    for _ in range(7):
        hands.step(rng)
    then = of(hands, 50.0)
    assert not torch.equal(now, then)
    torch.testing.assert_close(seen[:, 1:] / near, then.flatten(1), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("cfg", [{"enabled": False}, {"episode_share": 0.0}])
def test_where_no_load_comes_critics_see_none(rng, cfg):
    hands = loads(4, **cfg)
    hands.reset(everyone(4), rng)
    hands.step(rng)
    assert not hands.ahead(0.0).any()


def test_reset_touches_only_its_envs(rng):
    hands = loads(2, zero_probability=0.0)
    hands.reset(everyone(2), rng)
    before = of(hands)
    hands.reset(torch.tensor([False, True]), rng)
    assert torch.equal(of(hands)[0], before[0])
    assert not torch.equal(of(hands)[1], before[1])


@pytest.mark.parametrize(
    ("cfg", "match"),
    [
        (HandLoadConfig(force_x=(1.0, -1.0)), "hand_loads.force_x"),
        (HandLoadConfig(torque_share=2.0), "hand_loads.torque_share"),
        (HandLoadConfig(hold_s=(0.0, 1.0)), r"hand_loads.hold_s\[0\]"),
        (HandLoadConfig(ramp=RampConfig(9.0, 5.0)), "hand_loads.ramp.start_samples"),
    ],
)
def test_bad_fields_are_named(cfg, match):
    with pytest.raises(ValueError, match=match):
        cfg.check()


def test_arms_can_hold_what_robots_carry(make_env, robot):
    """Torques by MuJoCo's own Jacobian at the hands: within the share, and at it where the load is cut."""
    share = 0.2
    cfg = HandLoadConfig(enabled=True, episode_share=1.0, zero_probability=0.0, torque_share=share)
    env = make_env(8, robot=robot, randomization=NOMINAL, forces=ExternalForceConfig(hand_loads=cfg))
    drive(env, 5)
    limit = {j.name: share * j.torque_limit_nm for j in env.spec.joints}
    strong = {
        arm.side: [n for n in arm.joints if limit[n] >= 0.25 * max(limit[m] for m in arm.joints)]
        for arm in env.spec.arms
    }
    assert (len(strong["left"]) < len(env.spec.arms[0].joints)) == (robot != "h1")  # the others have weak wrists
    robots = [mujoco_of(env, i) for i in range(8)]
    drawn = env.forces.hand_loads._force_h.clone()
    heading = env.state.heading_w.clone()
    env.step(zeros(env))
    used = []
    for i, (model, data) in enumerate(robots):
        for a, arm in enumerate(env.spec.arms):
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, data.site(f"{arm.side}_hand").xpos, model.body(arm.hand_body).id)
            dofs = [model.joint(name).dofadr[0] for name in strong[arm.side]]
            torque = np.abs(jacobian[:, dofs].T @ env.hand_force_w[i, a].double().numpy())
            used.append((torque / [limit[name] for name in strong[arm.side]]).max())
            force_h = heading[i].T @ env.hand_force_w[i, a]
            cut = float(force_h.norm() / drawn[i, a].norm())
            torch.testing.assert_close(force_h, cut * drawn[i, a], atol=1e-3, rtol=1e-3)
            assert used[-1] == pytest.approx(1.0, abs=2e-3) or cut == pytest.approx(1.0, abs=1e-4)
    assert max(used) <= 1.0 + 2e-3
    assert np.mean(np.array(used) > 0.99) > 0.3
