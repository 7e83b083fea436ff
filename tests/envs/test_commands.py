from __future__ import annotations

import math

import pytest
import torch

from cotap.envs.commands import CommandConfig, CommandSource, leaning
from cotap.envs.gait import swing_progress

NOMINAL, DT = 1.0205, 0.02
AT_ONCE = {"acceleration": 1000.0, "yaw_acceleration": 1000.0}


def source(num_envs=1, **cfg) -> CommandSource:
    return CommandSource(CommandConfig(**cfg), num_envs, NOMINAL, DT)


def everyone(n) -> torch.Tensor:
    return torch.ones(n, dtype=torch.bool)


def test_draws_follow_ranges_and_shares(rng):
    n = 20_000
    commands = source(n, **AT_ONCE)
    commands.reset(everyone(n), rng)
    assert not commands.current().velocity_h.any()  # from rest
    assert torch.equal(commands.current().height, torch.full((n,), NOMINAL))  # the height starts at nominal
    phase = commands.current().phase
    commands.step(rng)
    c = commands.current()
    walking = c.stand == 0
    assert float(c.stand.mean()) == pytest.approx(0.3, abs=0.015)
    for values, low, high in (
        (c.velocity_h[walking, 0], -1.1, 1.1),
        (c.velocity_h[walking, 1], -0.6, 0.6),
        (c.yaw_rate[walking], -0.9, 0.9),
    ):
        assert low <= float(values.min()) < low + 0.02
        assert high - 0.02 < float(values.max()) <= high
        assert float((values == 0).float().mean()) == pytest.approx(0.2, abs=0.015)
        assert float(values.mean()) == pytest.approx(0.0, abs=0.02)
    assert not c.velocity_h[~walking].any()
    assert not c.yaw_rate[~walking].any()
    assert float((phase[~walking] == 0.5).float().mean()) == pytest.approx(0.5, abs=0.02)
    assert ((phase[~walking] == 0.5) | (phase[~walking] == 0.0)).all()
    assert float(phase[walking].mean()) == pytest.approx(0.5, abs=0.02)


def test_height_is_commanded_in_stance_only_and_approached_at_its_rate(rng):
    n = 4000
    commands = source(n, resample_s=(100.0, 100.0))
    commands.reset(everyone(n), rng)
    heights = [commands.current().height]
    for _ in range(60):
        commands.step(rng)
        heights.append(commands.current().height)
    heights = torch.stack(heights)
    assert float(heights.diff(dim=0).abs().max()) == pytest.approx(0.25 * DT, abs=1e-6)
    # 0.2 m at 0.25 m/s take 0.8 s; after 1.2 s all have arrived.
    stand = commands.current().stand > 0.5
    assert torch.equal(heights[-1], heights[-11])
    assert torch.equal(heights[-1, ~stand], heights[0, ~stand])
    offset = heights[-1, stand] - NOMINAL
    assert -0.2 <= float(offset.min()) < -0.19
    assert float(offset.max()) <= 1e-6
    assert float((offset.abs() < 1e-6).float().mean()) == pytest.approx(0.5, abs=0.06)


def test_commands_are_held_and_then_resampled(rng):
    commands = source(1, resample_s=(0.1, 0.1), stand_probability=0.0, axis_zero_probability=0.0, **AT_ONCE)
    commands.reset(everyone(1), rng)
    commands.step(rng)
    seen = [commands.current().velocity_h[0, 0].item()]
    for _ in range(20):
        commands.step(rng)
        seen.append(commands.current().velocity_h[0, 0].item())
    lengths = [seen.count(v) for v in dict.fromkeys(seen)]
    assert all(4 <= n <= 6 for n in lengths[:-1])
    assert len(lengths) == 5


def test_reset_touches_only_its_worlds(rng):
    commands = source(2, stand_probability=0.0, axis_zero_probability=0.0)
    commands.reset(everyone(2), rng)
    commands.step(rng)
    before = commands.current()
    commands.reset(torch.tensor([False, True]), rng)
    after = commands.current()
    assert torch.equal(before.velocity_h[0], after.velocity_h[0])
    assert before.phase[0] == after.phase[0]
    assert (before.velocity_h[1] != 0.0).all()
    assert (after.velocity_h[1] == 0.0).all()


def test_phase_runs_one_stride_a_period_and_rests_in_stance(rng):
    commands = source(2)
    zero = torch.zeros(2)
    commands.override(torch.zeros(2, 2), zero, torch.tensor([0.0, 1.0]), zero + NOMINAL)
    commands.reset(everyone(2), rng)
    start = commands.current().phase.clone()
    commands.step(rng)
    assert float((commands.current().phase[0] - start[0]).remainder(1.0)) == pytest.approx(0.02 / 0.8, abs=1e-6)
    for _ in range(39):
        commands.step(rng)
    assert float(commands.current().phase[0]) == pytest.approx(float(start[0]), abs=1e-5)
    assert commands.current().phase[1] in (0.0, 0.5)


def test_velocities_are_approached_at_their_rates(rng):
    commands = source(1, acceleration=1.0, yaw_acceleration=2.0)
    commands.override(torch.tensor([[0.5, -0.1]]), torch.tensor([0.8]), torch.zeros(1), torch.tensor([NOMINAL]))
    commands.reset(everyone(1), rng)
    for _ in range(10):
        commands.step(rng)
    c = commands.current()
    assert c.velocity_h.tolist() == [[pytest.approx(0.2), pytest.approx(-0.1)]]
    assert float(c.yaw_rate) == pytest.approx(0.4)
    for _ in range(20):
        commands.step(rng)
    assert commands.current().velocity_h.tolist() == [[pytest.approx(0.5), pytest.approx(-0.1)]]


def test_a_robot_told_to_stand_slows_down_and_ends_its_step(rng):
    """From 0.3 m/s at 1.5 m/s^2: 0.2 s, then on to the next double support; a new command sets it going from there."""
    commands = source(1)
    walk = (torch.tensor([[0.3, 0.0]]), torch.zeros(1), torch.zeros(1), torch.tensor([NOMINAL]))
    commands.override(*walk)
    commands.reset(everyone(1), rng)
    for _ in range(30):
        commands.step(rng)
    commands._phase = torch.tensor([0.12])
    commands.override(torch.zeros(1, 2), torch.zeros(1), torch.ones(1), torch.tensor([NOMINAL]))
    phases, stands, speeds = [], [], []
    for _ in range(30):
        commands.step(rng)
        c = commands.current()
        phases.append(float(c.phase))
        stands.append(float(c.stand))
        speeds.append(float(c.velocity_h[0, 0]))
    assert speeds[8] == pytest.approx(0.03)
    assert speeds[9] == pytest.approx(0.0, abs=1e-6)
    # 0.38 of a stride of 0.8 s is 15.2 control steps: the sixteenth reaches double support.
    assert stands == [0.0] * 15 + [1.0] * 15
    assert phases[14] == pytest.approx(0.12 + 15 * 0.02 / 0.8)
    assert phases[15:] == [0.5] * 15
    commands.override(*walk)
    commands.step(rng)
    assert float(commands.current().stand) == 0.0
    assert float(commands.current().phase) == pytest.approx(0.525)


def test_a_standing_robot_that_leans_steps_until_it_is_steady(rng):
    commands = source(1, stand_probability=1.0, height_offset=(-0.2, -0.2), steady_rad=0.4)
    commands.override(torch.zeros(1, 2), torch.zeros(1), torch.ones(1), torch.tensor([NOMINAL - 0.2]))
    commands.reset(everyone(1), rng)
    for _ in range(60):
        commands.step(rng, torch.tensor([0.39]))
    assert float(commands.current().stand) == 1.0
    assert float(commands.current().height) == pytest.approx(NOMINAL - 0.2)
    start = float(commands.current().phase)
    stands = []
    for i in range(60):
        commands.step(rng, torch.tensor([0.41 if i < 25 else 0.1]))
        stands.append(float(commands.current().stand))
    # Half a stride is 20 steps: at the first double support it still leans, at the second it is steady.
    assert stands[:38] == [0.0] * 38
    assert stands[42:] == [1.0] * 18
    assert float(commands.current().phase) == start
    walking = source(1)
    walking.override(torch.zeros(1, 2), torch.zeros(1), torch.zeros(1), torch.tensor([NOMINAL]))
    walking.reset(everyone(1), rng)
    walking.step(rng, torch.tensor([9.0]))
    assert float(walking.current().stand) == 0.0


def test_a_robot_that_braces_itself_stops_and_stands_and_then_goes_on(rng):
    """Beside one that does not: both were told to walk, at 0.9 m/s that take 0.6 s to lose."""
    commands = source(2, resample_s=(100.0, 100.0))
    velocity, turn = torch.tensor([[0.9, 0.0]] * 2), torch.tensor([0.6, 0.6])
    commands.override(velocity, turn, torch.zeros(2), torch.full((2,), NOMINAL))
    commands.reset(everyone(2), rng)
    for _ in range(100):
        commands.step(rng)
    torch.testing.assert_close(commands.current().velocity_h, velocity)
    braces, seen = torch.tensor([True, False]), []
    for _ in range(60):
        commands.step(rng, braces=braces)
        seen.append(commands.current())
    assert float(seen[14].velocity_h[0, 0]) == pytest.approx(0.9 - 15 * 1.5 * DT, abs=1e-5)
    stood = torch.stack([c.stand for c in seen])
    assert not stood[:30].any()  # it slows down and ends its step first
    assert stood[-1].tolist() == [1.0, 0.0]
    assert float(seen[-1].phase[0]) in (0.0, 0.5)
    assert seen[-1].velocity_h[0].tolist() == [0.0, 0.0]
    assert seen[-1].yaw_rate[0] == 0.0
    torch.testing.assert_close(seen[-1].velocity_h[1], velocity[1])
    assert not commands.told_to_stand.any()  # that is what was drawn
    commands.step(rng, lean=torch.tensor([math.inf, 0.0]), braces=braces)
    assert commands.current().stand[0] == 0.0  # it still steps for its balance
    for _ in range(40):
        commands.step(rng, braces=torch.tensor([False, False]))
    torch.testing.assert_close(commands.current().velocity_h, velocity)
    assert commands.current().stand.tolist() == [0.0, 0.0]


def test_bracing_without_sensing_is_refused():
    with pytest.raises(ValueError, match=r"brace_tilt_rad is 0\.04.*lean_into_loads"):
        CommandConfig(brace_tilt_rad=0.04).check()
    CommandConfig(brace_tilt_rad=0.04, lean_into_loads=True).check()


@pytest.mark.parametrize("rest", [0.0, 0.5])
def test_balance_is_caught_with_the_foot_that_the_turn_carries_forward(rng, rest):
    commands = source(4, steady_rad=0.2)
    commands.override(torch.zeros(4, 2), torch.zeros(4), torch.ones(4), torch.full((4,), NOMINAL))
    commands.reset(everyone(4), rng)
    commands._phase[:] = rest
    lean = torch.tensor([0.3, 0.3, 0.1, 0.3])
    commands.step(rng, lean, torch.tensor([-1.5, 1.5, -1.5, -0.5]))  # to the right, the left, steady, hardly turned
    swings = []
    for _ in range(10):
        swings.append(swing_progress(commands.current().phase, 2) > 0.0)
        commands.step(rng, lean, torch.tensor([1.5, -1.5, 1.5, 1.5]))  # too late to choose again
    left, right = torch.stack(swings).any(0).unbind(1)
    assert left.tolist() == [True, False, False, rest == 0.5]
    assert right.tolist() == [False, True, False, rest == 0.0]


def test_leaning_by_hand():
    upright, forward = torch.tensor([[0.0, 0.0, -1.0]]), torch.tensor([[0.1, 0.0, -math.sqrt(0.99)]])
    still = torch.zeros(1, 3)
    assert float(leaning(upright, still)) == 0.0
    assert float(leaning(forward, still)) == pytest.approx(0.1)
    # Pitching forward (about +y) at 0.2 rad/s: 0.06 rad further in 0.3 s; backward undoes as much.
    assert float(leaning(forward, torch.tensor([[0.0, 0.2, 0.0]]))) == pytest.approx(0.16, abs=1e-3)
    assert float(leaning(forward, torch.tensor([[0.0, -0.2, 0.0]]))) == pytest.approx(0.04, abs=1e-3)
    assert float(leaning(upright, torch.tensor([[0.0, 0.0, 5.0]]))) == 0.0


def test_override_holds_through_resets_and_steps(rng):
    commands = source(1, resample_s=(0.02, 0.02))
    commands.override(torch.tensor([[0.3, -0.2]]), torch.tensor([0.4]), torch.tensor([True]), torch.tensor([0.9]))
    commands.reset(everyone(1), rng)
    for _ in range(40):
        commands.step(rng)
    c = commands.current()
    assert c.velocity_h.tolist() == [[pytest.approx(0.3), pytest.approx(-0.2)]]
    assert float(c.yaw_rate) == pytest.approx(0.4)
    assert float(c.stand) == 1.0
    assert float(c.height) == pytest.approx(0.9)


def test_set_velocity_makes_its_worlds_walk_at_once(rng):
    commands = source(2, stand_probability=1.0)
    commands.reset(everyone(2), rng)
    velocity, turn = torch.tensor([[0.5, 0.1], [9.0, 9.0]]), torch.tensor([-0.3, 9.0])
    commands.set_velocity(velocity, turn, torch.tensor([True, False]))
    c = commands.current()
    assert c.velocity_h.tolist() == [[pytest.approx(0.5), pytest.approx(0.1)], [0.0, 0.0]]
    assert c.yaw_rate.tolist() == [pytest.approx(-0.3), 0.0]
    assert c.stand.tolist() == [0.0, 1.0]
    commands.step(rng)
    assert commands.current().velocity_h[0].tolist() == [pytest.approx(0.5), pytest.approx(0.1)]


def test_state_dict_continues_exactly(rng):
    commands = source(4)
    commands.reset(everyone(4), rng)
    commands.step(rng)
    saved, random_state = commands.state_dict(), rng.get_state()
    other = source(4)
    other.load_state_dict(saved)
    futures = []
    for c in (commands, other):
        rng.set_state(random_state)
        for _ in range(500):
            c.step(rng)
        now = c.current()
        futures.append(torch.cat((now.velocity_h, now.height[:, None], now.phase[:, None]), 1))
    assert torch.equal(*futures)
    with pytest.raises(ValueError, match=r"CommandSource\._target must have shape"):
        source(5).load_state_dict(saved)


@pytest.mark.parametrize(
    ("field", "value"),
    [("acceleration", 0.0), ("yaw_acceleration", math.inf), ("velocity_x", (1.0, -1.0)),
     ("stand_probability", 1.5), ("gait_period_s", 0.0), ("resample_s", (0.0, 1.0)),
     ("yaw_rate", (math.nan, 1.0))],
)  # fmt: skip
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=f"commands.{field}"):
        source(**{field: value})
