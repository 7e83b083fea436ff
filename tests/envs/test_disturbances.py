from __future__ import annotations

import math

import pytest
import torch

from cotap.envs.disturbances import Assistance, AssistConfig, HandForceConfig, HandForces, assist_wrench

DT = 0.02
STRONG = torch.full((2, 4), 1e6)
HANDS_H = torch.tensor([[0.3, 0.2, 0.1], [0.3, -0.2, 0.1]])


def forces(num_envs=1, **cfg) -> HandForces:
    return HandForces(HandForceConfig(**{"curriculum_start": 1.0, **cfg}), HANDS_H, num_envs, DT)


def everyone(n) -> torch.Tensor:
    return torch.ones(n, dtype=torch.bool)


def test_draws_follow_ranges_and_shares(rng):
    n = 10_000
    hands = forces(n)
    hands.reset(everyone(n), rng)
    force = hands.current(torch.zeros(n, 2, 3, 4), STRONG)
    for axis, (low, high) in enumerate(((-40, 40), (-40, 40), (-50, 5))):
        values = force[:, :, axis]
        assert low <= float(values.min()) < low + 0.1
        assert high - 0.1 < float(values.max()) <= high
        assert float((values == 0).float().mean()) == pytest.approx(0.25, abs=0.01)
    assert abs(float(torch.corrcoef(force[:, :, 0].T)[0, 1])) < 0.05  # hands differ


def test_forces_of_any_direction_are_even_in_size_and_direction_and_within_their_size(rng):
    n = 20_000
    hands = forces(n, size=40.0, force_x=(100.0, 100.0), zero_probability=1.0)  # by axis: nothing of it counts
    hands.reset(everyone(n), rng)
    force = hands.current(torch.zeros(n, 2, 3, 4), STRONG)
    sizes = force.norm(dim=-1)
    assert 39.9 < float(sizes.max()) <= 40.0 + 1e-4
    for share in (0.25, 0.5, 0.75):
        assert float(sizes.quantile(share)) == pytest.approx(40.0 * share, abs=0.6)
    # The height of a point drawn evenly on a sphere is even in [-1, 1], whatever the axis (Archimedes).
    along = force / sizes.unsqueeze(-1)
    for axis in range(3):
        assert float((along[:, :, axis] < 0.5).float().mean()) == pytest.approx(0.75, abs=0.01)
        assert float((along[:, :, axis] < -0.5).float().mean()) == pytest.approx(0.25, abs=0.01)
    assert abs(float(torch.corrcoef(force[:, :, 0].T)[0, 1])) < 0.05  # hands differ


@pytest.mark.parametrize("size", [0.0, 40.0])
def test_the_draw_that_turns_most_is_taken(rng, size):
    def turn(n, of):
        hands = forces(n, size=size, most_turning_of=of)
        hands.reset(everyone(n), rng)
        left, right = hands.current(torch.zeros(n, 2, 3, 4), STRONG).unbind(1)
        # About the vertical, by hand: x F_y - y F_x, hands at (0.3, +-0.2).
        return (0.3 * (left[:, 1] + right[:, 1]) - 0.2 * (left[:, 0] - right[:, 0])).abs()

    # The greatest of three even draws in a row is distributed as the maximum of three single ones.
    single, taken = turn(60_000, 1).unflatten(0, (-1, 3)).amax(1), turn(20_000, 3)
    for share in (0.1, 0.5, 0.9):
        assert float(taken.quantile(share)) == pytest.approx(float(single.quantile(share)), rel=0.03)
    assert float(taken.mean()) > 1.5 * float(turn(20_000, 1).mean())


def test_forces_hold_for_their_time(rng):
    hands = forces(1, hold_s=(0.1, 0.1), zero_probability=0.0)
    hands.reset(everyone(1), rng)
    seen = []
    for _ in range(21):
        seen.append(float(hands.current(torch.zeros(1, 2, 3, 4), STRONG)[0, 0, 0]))
        hands.step(rng)
    lengths = [seen.count(v) for v in dict.fromkeys(seen)]
    assert all(4 <= n <= 6 for n in lengths[:-1])


def test_scaled_down_to_what_the_torques_hold_by_hand():
    hands = forces(1, torque_share=0.8)
    hands._force_h[0] = torch.tensor([[30.0, 0.0, -40.0], [10.0, 0.0, 0.0]])
    jacobian = torch.zeros(1, 2, 3, 4)
    jacobian[0, :, 2, 3] = 0.3  # vertical force on 0.3 m of forearm: 12 Nm at the elbow
    jacobian[0, :, 0, 0] = -0.5  # forward force below the shoulder: 15 Nm the other way
    limit = torch.tensor([[40.0, 40.0, 18.0, 9.0]]).repeat(2, 1)
    # The elbow may carry 0.8 * 9 = 7.2 Nm of 12: the whole left force shrinks to 0.6. The right is held as it is.
    expected = torch.tensor([[[18.0, 0.0, -24.0], [10.0, 0.0, 0.0]]])
    torch.testing.assert_close(hands.current(jacobian, limit), expected)
    hands.scale[:] = 0.25
    torch.testing.assert_close(hands.current(jacobian, limit), torch.tensor([[[7.5, 0.0, -10.0], [2.5, 0.0, 0.0]]]))


def test_never_beyond_the_torque_share(rng):
    n = 2000
    hands = forces(n, torque_share=0.5)
    hands.reset(everyone(n), rng)
    jacobian = torch.randn(n, 2, 3, 4, generator=rng)
    limit = torch.tensor([[40.0, 40.0, 18.0, 18.0]]).repeat(2, 1)
    force = hands.current(jacobian, limit)
    share = (torch.einsum("nhij,nhi->nhj", jacobian, force).abs() / limit).amax(-1)
    assert float(share.max()) <= 0.5 + 1e-5
    assert float((share > 0.499).float().mean()) > 0.3  # and no smaller than need be


def test_curriculum_rises_with_lasting_episodes_and_falls_with_falls():
    hands = forces(4, curriculum_start=0.5, curriculum_step=0.1, curriculum_back=0.2)
    lasted = torch.tensor([True, False, False, False])
    fell_early = torch.tensor([False, True, False, False])
    hands.finish_episodes(lasted, fell_early)
    torch.testing.assert_close(hands.scale, torch.tensor([0.6, 0.3, 0.5, 0.5]))
    for _ in range(20):
        hands.finish_episodes(lasted, fell_early)
    torch.testing.assert_close(hands.scale, torch.tensor([1.0, 0.0, 0.5, 0.5]))


def test_disabled_forces_are_zero(rng):
    hands = forces(3, enabled=False)
    hands.reset(everyone(3), rng)
    for _ in range(5):
        hands.step(rng)
    assert not hands.current(torch.ones(3, 2, 3, 4), STRONG).any()


def assistance(num_envs=100, **cfg) -> Assistance:
    return Assistance(AssistConfig(enabled=True, full_samples=0, fade_samples=1000, **cfg), num_envs, 0.02)


def test_assistance_fades_by_e_while_nothing_falls_and_ends():
    a = assistance()
    shares = []
    for i in range(60):
        a.step(torch.zeros(100, dtype=torch.bool), 100.0 * (i + 1))
        shares.append(a.share(100.0 * (i + 1)))
    assert shares[9] == pytest.approx(math.exp(-1.0), abs=1e-5)
    assert shares[19] == pytest.approx(math.exp(-2.0), abs=1e-5)
    assert shares[38] == pytest.approx(math.exp(-3.9), abs=1e-5)
    assert shares[39:] == [0.0] * 21  # below 2 %
    a.step(torch.ones(100, dtype=torch.bool), 1e4)
    assert a.share(1e4) == 0.0  # gone for good


def test_assistance_stays_at_its_fall_rate_and_grows_beyond():
    """One world in 100 falls every second step: 0.25 falls per second and world."""
    now_and_then = [torch.arange(100) < 1, torch.zeros(100, dtype=torch.bool)]
    levels = {}
    for fall_rate in (0.25, 0.1):
        a = assistance(fall_rate=fall_rate)
        a._share, a._fall_rate = torch.tensor(0.5), torch.tensor(0.25)
        for i in range(20):
            a.step(now_and_then[i % 2], 100.0)
        levels[fall_rate] = a.share(100.0)
    assert levels[0.25] == pytest.approx(0.5, abs=0.02)
    assert levels[0.1] == pytest.approx(1.0)  # by e in ten steps, but never beyond 1
    assert levels[0.1] <= 1.0


def test_the_fall_rate_is_averaged_over_a_second():
    a = assistance()
    a.step(torch.arange(100) < 10, 1.0)
    assert float(a._fall_rate) == pytest.approx(0.02 * 0.1 / 0.02)
    for _ in range(50):
        a.step(torch.zeros(100, dtype=torch.bool), 1.0)
    assert float(a._fall_rate) == pytest.approx(0.1 * 0.98**50)


def test_assistance_is_full_at_first_ends_at_last_and_can_be_off():
    a = Assistance(AssistConfig(enabled=True, full_samples=500, fade_samples=1000, end_samples=2000), 100, 0.02)
    a.step(torch.zeros(100, dtype=torch.bool), 500.0)
    assert a.share(500.0) == 1.0
    a.step(torch.zeros(100, dtype=torch.bool), 600.0)
    assert a.share(600.0) == pytest.approx(math.exp(-0.1))
    assert a.share(2000.0) == 0.0
    assert Assistance(AssistConfig(), 100, 0.02).share(0.0) == 0.0


def wrench(up, rate=(0, 0, 0), velocity=(0, 0), yaw_rate=0.0, height=0.0, climb=0.0):
    """Force and torque on a base of 500 N whose errors are these."""
    cfg = AssistConfig(
        enabled=True, upright_stiffness=400.0, upright_damping=40.0, yaw_gain=50.0, velocity_gain=300.0,
        force_limit=150.0, weight_share=0.25, height_stiffness=2000.0, height_damping=200.0,
    )  # fmt: skip
    row = (torch.tensor([x], dtype=torch.float32) for x in (up, rate, velocity, yaw_rate, height, climb))
    force, torque = assist_wrench(cfg, 500.0, *row)
    return [pytest.approx(x, abs=1e-4) for x in force[0].tolist()], [
        pytest.approx(x, abs=1e-4) for x in torque[0].tolist()
    ]


TILT = 0.2
FORWARD, LEFTWARD, UP = (
    (math.sin(TILT), 0.0, math.cos(TILT)),
    (0.0, math.sin(TILT), math.cos(TILT)),
    (0.0, 0.0, 1.0),
)


@pytest.mark.parametrize(
    ("errors", "force", "torque"),
    [
        ({"up": UP}, [0, 0, 125], [0, 0, 0]),
        # Leaning forward (about +y) is undone about -y, leaning left (about -x) about +x.
        ({"up": FORWARD}, [0, 0, 125], [0, -400 * math.sin(TILT), 0]),
        ({"up": LEFTWARD}, [0, 0, 125], [400 * math.sin(TILT), 0, 0]),
        ({"up": UP, "rate": (0.5, -0.25, 3.0)}, [0, 0, 125], [-20, 10, 0]),  # rolling is damped, turning is not
        ({"up": UP, "yaw_rate": 0.3}, [0, 0, 125], [0, 0, 15]),
        ({"up": UP, "velocity": (0.1, -0.2)}, [30, -60, 125], [0, 0, 0]),
        ({"up": UP, "velocity": (3.0, 4.0)}, [90, 120, 125], [0, 0, 0]),  # no more than 150 N
        ({"up": UP, "height": 0.05, "climb": 0.1}, [0, 0, 205], [0, 0, 0]),
        ({"up": UP, "height": -0.05, "climb": 0.1}, [0, 0, 5], [0, 0, 0]),
        ({"up": UP, "height": -1.0}, [0, 0, 0], [0, 0, 0]),  # never pushes down
        ({"up": UP, "height": 1.0}, [0, 0, 500], [0, 0, 0]),  # never more than the weight
    ],
)
def test_assist_wrench_by_hand(errors, force, torque):
    assert (force, torque) == wrench(**errors)


@pytest.mark.parametrize(
    ("cfg", "match"),
    [
        (HandForceConfig(force_x=(1.0, -1.0)), "hand_forces.force_x"),
        (HandForceConfig(torque_share=2.0), "hand_forces.torque_share"),
        (HandForceConfig(most_turning_of=0), "hand_forces.most_turning_of"),
        (HandForceConfig(hold_s=(0.0, 1.0)), r"hand_forces.hold_s\[0\]"),
        (AssistConfig(full_samples=9.0, end_samples=5.0), "assist.full_samples"),
        (AssistConfig(velocity_gain=math.nan), "assist.velocity_gain"),
    ],
)
def test_bad_fields_are_named(cfg, match):
    with pytest.raises(ValueError, match=match):
        cfg.check()


def test_loads_of_some_episodes_only(rng):
    hands = forces(4000, episode_share=0.3, curriculum_start=0.5, zero_probability=0.0)
    hands.reset(everyone(4000), rng)
    jacobian, limit = torch.zeros(4000, 2, 3, 4), STRONG
    loaded = hands.current(jacobian, limit).abs().sum((1, 2)) > 0.0
    assert loaded.float().mean().item() == pytest.approx(0.3, abs=0.03)
    for _ in range(300):  # forces change within an episode, which worlds bear them does not
        hands.step(rng)
    assert torch.equal(hands.current(jacobian, limit).abs().sum((1, 2)) > 0.0, loaded)
    hands.finish_episodes(everyone(4000), ~everyone(4000))
    assert torch.equal(hands.scale > 0.5, loaded), "what bears no load proves nothing"
