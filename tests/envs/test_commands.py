"""Commands: what is drawn, how it is approached, and how it is overridden."""

from __future__ import annotations

import math

import pytest
import torch

from cotap.envs.commands import CommandConfig, CommandSource
from cotap.envs.gait_phase import GaitConfig

NOMINAL, DT = 1.0205, 0.02
AT_ONCE = {"acceleration": 1000.0, "yaw_acceleration": 1000.0}


def source(num_envs=1, **cfg) -> CommandSource:
    return CommandSource(CommandConfig(**cfg), GaitConfig(), num_envs, NOMINAL, DT)


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
    assert float(c.stand.mean()) == pytest.approx(0.25, abs=0.015)
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


def test_height_is_commanded_in_stance_and_approached_slowly(rng):
    n = 4000
    commands = source(n, resample_s=(100.0, 100.0))
    commands.reset(everyone(n), rng)
    heights = [commands.current().height]
    for _ in range(60):
        commands.step(rng)
        heights.append(commands.current().height)
    heights = torch.stack(heights)
    assert float(heights.diff(dim=0).abs().max()) == pytest.approx(0.25 * DT, abs=1e-6)
    # 0.22 m at 0.25 m/s take 0.88 s; after 1.2 s all have arrived.
    stand = commands.current().stand > 0.5
    assert torch.equal(heights[-1], heights[-11])
    assert torch.equal(heights[-1, ~stand], heights[0, ~stand])
    offset = heights[-1, stand] - NOMINAL
    assert -0.22 - 1e-6 <= float(offset.min()) < -0.21
    assert 0.015 < float(offset.max()) <= 0.02 + 1e-6
    assert float(offset.mean()) == pytest.approx(-0.1, abs=0.01)  # uniform


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


def test_reset_touches_only_its_envs(rng):
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


def test_a_robot_told_to_stand_slows_down_and_walks_on_the_spot_for_a_stride(rng):
    """From 0.3 m/s at 1.5 m/s^2: 0.2 s, a stride, then on to double support; a new command sets it going from there."""
    commands = source(1)
    walk = (torch.tensor([[0.3, 0.0]]), torch.zeros(1), torch.zeros(1), torch.tensor([NOMINAL]))
    commands.override(*walk)
    commands.reset(everyone(1), rng)
    for _ in range(30):
        commands.step(rng)
    commands.gait.phase = torch.tensor([0.12])
    commands.override(torch.zeros(1, 2), torch.zeros(1), torch.ones(1), torch.tensor([NOMINAL]))
    phases, stands, speeds = [], [], []
    for _ in range(70):
        commands.step(rng)
        c = commands.current()
        phases.append(float(c.phase))
        stands.append(float(c.stand))
        speeds.append(float(c.velocity_h[0, 0]))
    assert speeds[8] == pytest.approx(0.03)
    assert speeds[9] == pytest.approx(0.0, abs=1e-6)
    # A stride of 0.8 s is 40 control steps, and ends at 1.345 or 1.37; from 0.12 to 1.5, where both feet are down, are
    # 55.2: the 56th.
    assert stands == [0.0] * 55 + [1.0] * 15
    assert phases[54] == pytest.approx(0.12 + 15 * 0.02 / 0.8, abs=1e-5)
    assert phases[55:] == [0.5] * 15
    commands.override(*walk)
    commands.step(rng)
    assert float(commands.current().stand) == 0.0
    assert float(commands.current().phase) == pytest.approx(0.525)


def test_what_is_asked_is_known_before_it_is_reached(rng):
    commands = source(2, stand_probability=0.0, axis_zero_probability=0.0)
    commands.reset(everyone(2), rng)
    asked = commands.asked_velocity.clone()
    assert (asked != 0.0).all()
    assert not commands.asked_to_stand.any()
    assert not commands.current().velocity_h.any()
    for _ in range(50):
        commands.step(rng)
    now = commands.current()
    torch.testing.assert_close(torch.cat((now.velocity_h, now.yaw_rate[:, None]), 1), asked)
    commands.override(torch.zeros(2, 2), torch.zeros(2), torch.ones(2), torch.full((2,), NOMINAL))
    assert commands.asked_to_stand.all()
    assert not commands.current().stand.any()  # they still have to slow down


def test_what_current_returned_never_changes(rng):
    commands = source(2)
    commands.reset(everyone(2), rng)
    before = commands.current()
    copies = [value.clone() for value in vars(before).values()]
    for _ in range(30):
        commands.step(rng)
    commands.reset(everyone(2), rng)
    for value, copy in zip(vars(before).values(), copies, strict=True):
        assert torch.equal(value, copy)


@pytest.mark.parametrize("stand", [0.0, 1.0])
def test_override_holds_through_resets_and_steps(rng, stand):
    commands = source(1, resample_s=(0.02, 0.02))
    walk = 1.0 - stand
    commands.override(
        walk * torch.tensor([[0.3, -0.2]]), walk * torch.tensor([0.4]), torch.tensor([stand > 0.5]), torch.tensor([0.9])
    )
    commands.reset(everyone(1), rng)
    for _ in range(40):
        commands.step(rng)
    c = commands.current()
    assert c.velocity_h.tolist() == [[pytest.approx(walk * 0.3), pytest.approx(walk * -0.2)]]
    assert float(c.yaw_rate) == pytest.approx(walk * 0.4)
    assert float(c.stand) == stand
    assert float(c.height) == pytest.approx(0.9)


def test_set_velocity_makes_its_envs_walk_at_once(rng):
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
    with pytest.raises(ValueError, match=r"GaitPhase\.phase must have shape"):
        source(5).load_state_dict(saved)


@pytest.mark.parametrize(
    ("field", "value"),
    [("acceleration", 0.0), ("yaw_acceleration", math.inf), ("velocity_x", (1.0, -1.0)),
     ("stand_probability", 1.5), ("resample_s", (0.0, 1.0)), ("height_rate", 0.0),
     ("yaw_rate", (math.nan, 1.0))],
)  # fmt: skip
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=f"commands.{field}"):
        source(**{field: value})
