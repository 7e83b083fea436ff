"""Pushes of training: what is drawn, when, where it acts, and that its impulse is exact."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from env_tools import NOMINAL, at_point, drive, felt, hold_still, knock_over, mujoco_of, zeros

from cotap.envs.curriculum import RampConfig
from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.pushes import PushConfig, Pushes

DT, MASS, HANDS, LINKS = 0.02, 40.0, 2, 5
BUSY = {"enabled": True, "episode_share": 1.0, "interval_s": (0.3, 0.3)}


def pushes(num_envs: int, dt: float = DT, **cfg) -> Pushes:
    return Pushes(PushConfig(**{**BUSY, **cfg}), HANDS, LINKS, MASS, num_envs, dt)


def everyone(n: int) -> torch.Tensor:
    return torch.ones(n, dtype=torch.bool)


def run(p: Pushes, rng: torch.Generator, steps: int, samples: float = 1e9) -> tuple[torch.Tensor, torch.Tensor]:
    """Forces (T, N, 3) and places (T, N) of control steps, as the environment asks for them."""
    p.reset(everyone(p.place.numel()), rng)
    forces, places = [], []
    for _ in range(steps):
        forces.append(p.current())
        places.append(p.place.clone())
        p.step(samples, rng)
    return torch.stack(forces), torch.stack(places)


def one_push(p: Pushes, rng: torch.Generator, samples: float = 1e9) -> torch.Tensor:
    """Impulse (N, 3) of every env's first push [Ns]."""
    force, _ = run(p, rng, round(0.5 / p._dt), samples)
    return p._dt * force.sum(0)


@pytest.mark.parametrize("dt", [0.02, 0.01, 0.005])
@pytest.mark.parametrize("duration", [(0.05, 0.05), (0.04, 0.12), (0.003, 0.011), (0.02, 0.02), (0.0999, 0.1)])
def test_the_impulse_is_the_one_that_is_drawn(rng, duration, dt):
    """Whatever a push's length is in control steps: one velocity change drawn, one mass, one number."""
    impulse = one_push(pushes(500, dt, velocity=(0.7, 0.7), duration_s=duration), rng).norm(dim=1)
    torch.testing.assert_close(impulse, torch.full((500,), 0.7 * MASS), rtol=2e-5, atol=0.0)


def test_a_push_of_50_ms_by_hand(rng):
    """Two whole control steps and half of a third: 28 Ns over 0.05 s are 560 N."""
    p = pushes(1, velocity=(0.7, 0.7), hand_share=0.0, link_share=0.0, duration_s=(0.05, 0.05))
    size = run(p, rng, 20)[0][:, 0].norm(dim=1)
    assert size[size > 0.0].tolist() == pytest.approx([560.0, 560.0, 280.0], abs=1e-2)
    assert size.nonzero().flatten().tolist() in ([15, 16, 17], [16, 17, 18])  # times are rounded


def test_the_first_push_comes_after_an_interval(rng):
    p = pushes(2000, interval_s=(0.2, 0.4), duration_s=(0.04, 0.04), velocity=(1.0, 1.0))
    force, _ = run(p, rng, 22)
    first = (force.norm(dim=2) > 0.0).float().argmax(0)
    assert int(first.min()) in (10, 11)
    assert int(first.max()) in (20, 21)
    assert float(first.float().mean()) == pytest.approx(15.5, abs=0.2)


def test_one_push_follows_another_after_its_interval(rng):
    p = pushes(50, interval_s=(0.2, 0.2), duration_s=(0.04, 0.04), velocity=(1.0, 1.0))
    on = run(p, rng, 60)[0].norm(dim=2) > 0.0
    begins = (on[1:] & ~on[:-1]).float().sum(0)
    assert ((begins >= 5) & (begins <= 6)).all()
    assert float(on.float().mean()) == pytest.approx(0.2 * 50 / 60, abs=0.03)


def test_pushes_may_come_from_everywhere(rng):
    steep = 0.5 * math.pi
    unit = torch.nn.functional.normalize(one_push(pushes(8000, velocity=(0.5, 1.0), largest_pitch=steep), rng), dim=1)
    pitch = unit[:, 2].clamp(-1.0, 1.0).asin()
    spread = torch.histc(pitch, 4, -steep, steep) / 8000
    assert spread.tolist() == pytest.approx([0.25] * 4, abs=0.02)


@pytest.mark.parametrize(("hand", "link"), [(0.3, 0.2), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0), (0.4, 0.6)])
def test_places_have_their_shares(rng, hand, link):
    p = pushes(20_000, hand_share=hand, link_share=link)
    run(p, rng, 17)
    count = torch.bincount(p.place, minlength=1 + HANDS + LINKS) / 20_000
    expected = [1.0 - hand - link, *[hand / HANDS] * HANDS, *[link / LINKS] * LINKS]
    assert count.tolist() == pytest.approx(expected, abs=0.015)


def test_impulses_are_of_one_range_wherever_they_act(rng):
    p = pushes(6000, velocity=(0.5, 1.0))
    size = one_push(p, rng).norm(dim=1) / MASS
    for kind in (p.place == 0, (p.place >= 1) & (p.place <= HANDS), p.place > HANDS):
        drawn = size[kind]
        assert 0.5 - 1e-4 <= float(drawn.min()) < 0.525
        assert 0.975 < float(drawn.max()) <= 1.0 + 1e-4
        assert float(drawn.mean()) == pytest.approx(0.75, rel=0.03)


def test_impulses_beside_the_base_may_be_smaller(rng):
    p = pushes(6000, velocity=(1.0, 1.0), beside_base=0.4)
    size = one_push(p, rng).norm(dim=1) / MASS
    torch.testing.assert_close(size, torch.where(p.place == 0, 1.0, 0.4))


def test_directions_are_all_round_and_nearly_level(rng):
    unit = torch.nn.functional.normalize(one_push(pushes(8000, velocity=(0.5, 1.0)), rng), dim=1)
    pitch = unit[:, 2].asin()
    assert 0.49 < float(pitch.abs().max()) <= 0.5 + 1e-3
    assert float(pitch.mean()) == pytest.approx(0.0, abs=0.02)
    yaw = torch.atan2(unit[:, 1], unit[:, 0])
    quarter = torch.histc(yaw, 4, -math.pi, math.pi) / 8000
    assert quarter.tolist() == pytest.approx([0.25] * 4, abs=0.02)


@pytest.mark.parametrize(("samples", "share"), [(0.0, 0.1), (100.0, 0.1), (200.0, 0.55), (300.0, 1.0)])
def test_the_impulse_grows_with_the_samples(rng, samples, share):
    p = pushes(200, velocity=(1.0, 1.0), hand_share=0.0, link_share=0.0, ramp=RampConfig(100.0, 300.0, 0.1))
    impulse = one_push(p, rng, samples).norm(dim=1)
    torch.testing.assert_close(impulse, torch.full((200,), share * MASS), rtol=1e-4, atol=1e-4)


def test_critics_see_what_comes_before_it_comes(rng):
    """What is foretold is what then acts, in the heading frame: here a quarter turn to the left of the world's."""
    p = pushes(300, velocity=(0.4, 0.9), duration_s=(0.04, 0.04), ramp=RampConfig(0.0, 100.0))
    p.reset(everyone(300), rng)
    turned = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).expand(300, 3, 3)
    for _ in range(10):  # of 15 until the push
        p.step(50.0, rng)
    before, total = p.ahead(turned, 50.0), torch.zeros(300, 3)
    near = math.exp(-0.1)
    torch.testing.assert_close(before[:, 0], torch.full((300,), near), rtol=1e-4, atol=0.0)
    for _ in range(9):
        p.step(50.0, rng)
        total += DT * p.current() / MASS
    foretold = before[:, 1:4] / near
    torch.testing.assert_close(foretold, torch.stack((total[:, 1], -total[:, 0], total[:, 2]), 1), rtol=1e-3, atol=1e-5)
    kind = before[:, 4:] / near
    assert torch.equal(kind.argmax(1), p.place.clamp_max(1 + HANDS))
    torch.testing.assert_close(kind.sum(1), torch.ones(300), rtol=1e-4, atol=0.0)


def test_critics_see_what_is_left_of_a_push(rng):
    p = pushes(1, velocity=(0.5, 0.5), duration_s=(0.1, 0.1), hand_share=0.0, link_share=0.0)
    upright = torch.eye(3).unsqueeze(0)
    run(p, rng, 15)
    sizes = []
    for _ in range(8):
        seen = p.ahead(upright, 1e9)[0]
        sizes.append((round(seen[0].item(), 3), round(seen[1:4].norm().item(), 3)))
        p.step(1e9, rng)
    on = [size for near, size in sizes if near == 1.0]
    assert on[-4:] == pytest.approx([0.4, 0.3, 0.2, 0.1], abs=2e-3)
    assert sizes[-1][0] == pytest.approx(math.exp(-0.18), abs=0.02)  # the next comes 0.3 s after this one


def test_where_no_push_comes_critics_see_none(rng):
    p = pushes(5, episode_share=0.0)
    run(p, rng, 3)
    assert not p.ahead(torch.eye(3).expand(5, 3, 3), 1e9).any()


def test_pushes_of_some_episodes_only(rng):
    p = pushes(4000, episode_share=0.3, velocity=(1.0, 1.0))
    pushed = run(p, rng, 60)[0].norm(dim=2).amax(0) > 0.0
    assert float(pushed.float().mean()) == pytest.approx(0.3, abs=0.03)


def test_a_push_ends_with_its_episode(rng):
    p = pushes(2, velocity=(1.0, 1.0), duration_s=(0.1, 0.1))
    run(p, rng, 17)
    assert (p.current().norm(dim=1) > 0.0).all()
    p.reset(torch.tensor([True, False]), rng)
    assert (p.current().norm(dim=1) > 0.0).tolist() == [False, True]


def test_pushes_that_are_off_draw_nothing(rng):
    p = pushes(3, enabled=False)
    before = rng.get_state()
    assert not run(p, rng, 40)[0].any()
    assert torch.equal(rng.get_state(), before)


def test_they_go_on_exactly(rng):
    a, b = (pushes(6, interval_s=(0.12, 0.3), duration_s=(0.04, 0.12)) for _ in range(2))
    run(a, rng, 9)
    b.load_state_dict(a.state_dict())
    state = rng.get_state()
    futures = []
    for p in (a, b):
        rng.set_state(state)
        rows = []
        for _ in range(40):
            rows.append(torch.cat((p.current(), p.place[:, None]), 1))
            p.step(0.0, rng)
        futures.append(torch.stack(rows))
    assert torch.equal(*futures)


@pytest.mark.parametrize(
    ("field", "value"),
    [("velocity", (1.0, 0.0)), ("velocity", (-1.0, 0.0)), ("duration_s", (0.0, 0.1)), ("interval_s", (0.01, 1.0)),
     ("episode_share", 1.1), ("hand_share", -0.1), ("link_share", 0.8), ("largest_pitch", 1.6),
     ("ramp", RampConfig(1.0, 0.0))],
)  # fmt: skip
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=rf"pushes\.{field}"):
        PushConfig(**{field: value}).check()


@pytest.mark.parametrize(("hand", "link"), [(0.8, 0.2), (0.9, 0.1)])
def test_shares_that_leave_nothing_are_allowed_however_they_round(hand, link):
    PushConfig(hand_share=hand, link_share=link).check()


def pushed_env(make_env, robot: str, num_envs: int, **cfg):
    forces = ExternalForceConfig(pushes=PushConfig(**{**BUSY, **cfg}))
    return make_env(num_envs, robot=robot, randomization=NOMINAL, forces=forces)


def test_pushes_act_where_they_say(make_env, robot):
    """Every place in turn against MuJoCo's map from a force at a point to joint torques."""
    env = pushed_env(make_env, robot, 1, velocity=(1.0, 1.0))
    spec, source = env.spec, env.forces.pushes
    drive(env, 2)
    model, data = mujoco_of(env, 0)
    hands = len(spec.arms)
    assert len(env.forces._place_bodies) == 1 + hands + len(spec.bodies)
    for place in range(1 + hands + len(spec.bodies)):
        source.place[:], source._left_s[:] = place, 1.0
        source.force_w[:] = torch.tensor([100.0, -60.0, 20.0])
        env.forces.apply(env.sim.xfrc, env.state, torch.zeros(1), 0.0)
        if place == 0:
            body, point = spec.base_body, data.body(spec.base_body).xipos
        elif place <= hands:
            arm = spec.arms[place - 1]
            body, point = arm.hand_body, data.site(f"{arm.side}_hand").xpos
        else:
            body = spec.bodies[place - 1 - hands].name
            point = data.body(body).xipos
        expected = at_point(model, data, body, point, [100.0, -60.0, 20.0])
        np.testing.assert_allclose(felt(model, data, env.sim.xfrc[0]), expected, atol=2e-3, err_msg=body)
        told = [[100.0, -60.0, 20.0] if place == 1 + a else [0.0] * 3 for a in range(hands)]
        assert env.hand_force_w[0].tolist() == told  # a push on a hand is a force on that hand


def test_a_push_on_a_hand_has_its_moment(make_env, robot):
    """The hand is no centre of mass: without a moment, joint torques would be others."""
    env = pushed_env(make_env, robot, 1, hand_share=1.0, link_share=0.0)
    source = env.forces.pushes
    drive(env, 2)
    source.place[:], source._left_s[:], source.force_w[:] = 1, 1.0, torch.tensor([0.0, 0.0, -50.0])
    env.forces.apply(env.sim.xfrc, env.state, torch.zeros(1), 0.0)
    body = env.sim.model.body(env.spec.arms[0].hand_body).id
    assert env.sim.xfrc[0, body, 2] == -50.0
    assert float(env.sim.xfrc[0, body, 3:].norm()) > 0.2


def test_impulses_reach_the_simulation_whole(make_env, robot):
    """Sum of force times time over the steps that are simulated, at every place, against what was drawn."""
    env = pushed_env(make_env, robot, 12, velocity=(0.5, 0.5), duration_s=(0.04, 0.12), interval_s=(0.14, 0.14))
    hold_still(env)
    impulse = torch.zeros(12, 3, dtype=torch.float64)
    for _ in range(14):  # the first push begins after 0.14 s and is over before the second
        _, _, done, _ = env.step(zeros(env))
        assert not done.any()
        impulse += env.dt * env.sim.xfrc[:, :, :3].sum(1)
    expected = torch.full((12,), 0.5 * env.spec.mass_kg, dtype=torch.float64)
    torch.testing.assert_close(impulse.norm(dim=1), expected, rtol=1e-4, atol=0.0)


def test_a_push_gives_the_robot_its_velocity(make_env, robot):
    """In the air, of a push of 0.5 m/s on the base: the momentum beside that of a twin that is not pushed."""
    env, twin = (
        pushed_env(make_env, robot, 3, enabled=e, velocity=(0.5, 0.5), hand_share=0.0, link_share=0.0,
                   duration_s=(0.05, 0.05), interval_s=(0.14, 0.14)) for e in (True, False)
    )  # fmt: skip
    hold_still(env)
    hold_still(twin)
    env.reset()
    env.sim.qpos[:, 2] += 1.0
    twin.load_state_dict(env.state_dict())
    for _ in range(12):
        env.step(zeros(env))
        twin.step(zeros(twin))
    for i in range(3):
        momentum = []
        for e in (env, twin):
            model, data = mujoco_of(e, i)
            mujoco.mj_subtreeVel(model, data)
            momentum.append(data.subtree_linvel[1] * model.body_subtreemass[1])
        change = (momentum[0] - momentum[1]) / env.spec.mass_kg
        assert np.linalg.norm(change) == pytest.approx(0.5, rel=0.02)
        direction = env.forces.pushes.force_w[i].double().numpy()
        np.testing.assert_allclose(change, 0.5 * direction / np.linalg.norm(direction), atol=0.02)


def test_a_push_does_not_outlive_a_fall(make_env, robot):
    env = pushed_env(make_env, robot, 2, duration_s=(0.12, 0.12), interval_s=(0.12, 0.12), velocity=(0.3, 0.3),
                     hand_share=0.0, link_share=0.0)  # fmt: skip
    drive(env, 8)
    assert (env.sim.xfrc.abs().amax((1, 2)) > 0.0).all()
    knock_over(env, 1)
    env.step(zeros(env))
    env.step(zeros(env))
    assert (env.sim.xfrc.abs().amax((1, 2)) > 0.0).tolist() == [True, False]
