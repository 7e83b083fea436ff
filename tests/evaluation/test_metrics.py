"""Measures on hand-made trajectories."""

import json
import math

import pytest
import torch

from cotap.evaluation.metrics import (
    masked_mean,
    moving_average,
    settled,
    steps_since_change,
    summaries,
    summarize,
    summarize_slope,
    swings,
    tracking_measures,
    tracking_slopes,
    wilson_interval,
)
from cotap.evaluation.report import table
from cotap.evaluation.rollout import Trajectory, idle, record_rollout

DT = 0.02


def trajectory(steps: int = 200, envs: int = 2, **changes: torch.Tensor) -> Trajectory:
    """Everyone walks at exactly the command (0.5, -0.2, 0.3), both feet on the ground; `changes` replace fields."""
    command = torch.tensor([0.5, -0.2, 0.3]).expand(steps, envs, 3).clone()
    fields = {
        "velocity": command.clone(),
        "command": command,
        "stand": torch.zeros(steps, envs, dtype=torch.bool),
        "height": torch.full((steps, envs), 1.0),
        "height_command": torch.full((steps, envs), 1.0),
        "position": torch.zeros(steps, envs, 2),
        "arm_error": torch.zeros(steps, envs, 8),
        "arm_velocity": torch.zeros(steps, envs, 8),
        "arm_torque": torch.zeros(steps, envs, 8),
        "torque_share": torch.zeros(steps, envs, 19),
        "arm_static_torque": torch.zeros(steps, envs, 8),
        "hand_offset": torch.zeros(steps, envs, 2, 3),
        "hand_error": torch.zeros(steps, envs, 2),
        "foot_contact": torch.ones(steps, envs, 2, dtype=torch.bool),
        "foot_speed": torch.zeros(steps, envs, 2),
        "foot_height": torch.zeros(steps, envs, 2),
        "path_error": torch.full((steps, envs), math.nan),
        "fell": torch.zeros(steps, envs, dtype=torch.bool),
        "film": torch.zeros(0, 0),
    }
    return Trajectory(dt=DT, **(fields | changes))


def test_perfect_tracking_has_no_error():
    m = tracking_measures(trajectory(), gait_period_s=0.8)
    for name in ("e_lin", "e_lin_gait", "e_yaw", "e_yaw_gait", "e_upper", "foot_slip", "fall_fraction"):
        assert m[name].tolist() == pytest.approx([0.0, 0.0], abs=1e-6), name
    assert m["episode_length_fraction"].tolist() == [1.0, 1.0]
    for of_standing in ("stand_drift", "e_height"):
        assert m[of_standing].isnan().all()
    assert m["swing_height"].isnan().all()
    assert m["stride_rate"].tolist() == [0.0, 0.0]


def test_constant_errors_by_hand():
    t = trajectory()
    t.velocity[:, 0] += torch.tensor([0.3, -0.4, 0.25])  # norm 0.5
    t.velocity[:, 1, 2] -= 0.1
    t.stand[:], t.height[:, 0] = True, 0.97
    t.arm_error[:, 1, :4] = 0.1  # norm 0.2
    t.arm_torque[:, 0, 0], t.arm_torque[:, 0, 1] = 3.0, 4.0
    t.hand_error[:, 0, 0] = 0.2
    m = tracking_measures(t, 0.8)
    assert m["e_lin"].tolist() == pytest.approx([0.5, 0.0], abs=1e-5)
    assert m["e_lin_gait"].tolist() == pytest.approx([0.5, 0.0], abs=1e-5)
    assert m["e_yaw"].tolist() == pytest.approx([0.25, 0.1], abs=1e-5)
    assert m["e_height"].tolist() == pytest.approx([0.03, 0.0], abs=1e-5)
    assert m["e_upper"].tolist() == pytest.approx([0.0, 0.2], abs=1e-5)
    assert m["j_upper"].tolist() == pytest.approx([5.0, 0.0], abs=1e-5)
    assert m["e_ee"].tolist() == pytest.approx([0.1, 0.0], abs=1e-5)


def test_gait_average_removes_what_oscillates_with_the_stride():
    t = trajectory()
    sway = 0.3 * torch.sin(2.0 * math.pi * torch.arange(200) / 40)  # 40 steps: one period of 0.8 s
    t.velocity[:, 0, 0] += sway
    m = tracking_measures(t, 0.8)
    assert m["e_lin_gait"][0] == pytest.approx(0.0, abs=1e-5)
    assert m["e_lin"][0] == pytest.approx(0.3 * 2.0 / math.pi, rel=0.02)


def test_errors_are_taken_only_once_a_command_has_settled():
    t = trajectory()
    t.command[100:, 0, 0] = -0.5
    t.velocity[100:150, 0, 0], t.velocity[150:, 0, 0] = 0.5, -0.5  # follows exactly 1 s late
    assert tracking_measures(t, 0.8, settle_s=1.0)["e_lin"][0] == pytest.approx(0.0, abs=1e-6)
    late = tracking_measures(t, 0.8, settle_s=0.9)["e_lin"][0]
    assert late == pytest.approx(1.0 * 5 / (55 + 55), rel=1e-4)  # 45 steps of settling, twice
    ok = settled(t, 1.0)
    assert ok[:, 0].nonzero().squeeze(1).tolist() == [*range(50, 100), *range(150, 200)]


def test_a_height_has_time_to_change():
    """0.2 m down, reached in 1.4 s and no sooner; from 1.5 s on all that is off counts, whatever velocities do."""
    t = trajectory(envs=2)
    t.stand[:] = True
    t.height_command[100:] = 0.8
    t.height[170:] = 0.8
    t.height[:, 1] -= 0.03
    t.command[100:, :, 0] = 0.1
    assert tracking_measures(t, 0.8)["e_height"].tolist() == pytest.approx([0.0, 0.03], abs=1e-6)


def test_a_robot_that_ignores_its_command_is_seen_to():
    """It is asked to walk at 0.5 m/s and to turn at 0.3 rad/s, or to stand 0.2 m lower, and sways where it is."""
    t = trajectory(envs=3)
    t.velocity.zero_()
    t.command[...] = torch.tensor([0.5, 0.0, 0.3])
    t.command[:, 1, 0] = -0.5
    t.command[:, 2], t.stand[:, 2], t.height_command[:, 2] = 0.0, True, 0.8
    t.velocity[:, 2, 0] = 0.3
    t.foot_contact[::2, :, 0] = False
    m = tracking_measures(t, 0.8)
    expected = {"e_lin": [0.5, 0.5, 0.3], "e_lin_gait": [0.5, 0.5, 0.3], "e_yaw": [0.3, 0.3, 0.0],
                "e_yaw_gait": [0.3, 0.3, 0.0], "e_height": [math.nan, math.nan, 0.2]}  # fmt: skip
    for name, values in expected.items():
        assert m[name].tolist() == pytest.approx(values, abs=1e-5, nan_ok=True), name
    assert tracking_slopes(t, 0.8)["slope_x"]["mean"] == pytest.approx(0.0, abs=1e-6)
    assert float(m["stand_drift"][2]) == pytest.approx(0.3)
    assert float(m["still_share"][2]) == 0.0
    t.velocity.zero_()  # it no longer moves, and steps in place
    assert float(tracking_measures(t, 0.8)["still_share"][2]) == pytest.approx(0.5, abs=0.01)
    assert m["still_share"][:2].isnan().all()


@pytest.mark.parametrize(("share", "error"), [(1.0, 0.0), (0.5, 0.05), (0.0, 0.1), (-1.0, 0.2)])
def test_heights_are_measured_of_those_who_are_asked_to_stand(share, error):
    """One stands 0.2 m lower, one as it is; two walk at nominal height, as they are asked, which is no merit."""
    t = trajectory(envs=4)
    t.stand[:, :2] = True
    t.height_command[:, 0] = 0.8
    t.height[:, 0] = 1.0 - 0.2 * share
    m = tracking_measures(t, 0.8)
    assert float(m["e_height"].nanmean()) == pytest.approx(error, abs=1e-6)
    assert m["e_height"][2:].isnan().all()
    assert tracking_slopes(t, 0.8)["slope_height"]["mean"] == pytest.approx(share, abs=1e-5)


@pytest.mark.parametrize("asked", ["walk", "stand"])
def test_an_env_whose_policy_ignores_what_is_asked(make_env, robot, asked):
    """Asked to walk at 0.5 m/s, to stand 0.1 m lower: recorded is what was asked from the first step on."""
    env = make_env(2, robot=robot, fixed_base=True)
    n, stands = env.num_envs, asked == "stand"
    velocity = torch.tensor([0.0 if stands else 0.5, 0.0]).repeat(n, 1)
    height = torch.full((n,), env.spec.nominal_height_m - 0.1)
    env.commands.override(velocity, torch.zeros(n), torch.full((n,), float(stands)), height)
    t = record_rollout(env, idle(env), 150, progress=False)
    assert torch.equal(t.command[:, :, :2], velocity.expand(150, n, 2))
    assert torch.equal(t.height_command, height.expand(150, n))
    assert (t.stand == stands).all()
    m = tracking_measures(t, env.cfg.gait.period_s)
    assert m["e_lin_gait"].tolist() == pytest.approx([0.0 if stands else 0.5] * n, abs=0.02)
    off = (t.height - height)[-1] if stands else torch.full((n,), math.nan)
    torch.testing.assert_close(m["e_height"], off, atol=0.01, rtol=0, equal_nan=True)
    assert m["still_share"].tolist() == [0.0] * n if stands else m["still_share"].isnan().all()  # feet in the air


def test_measures_end_with_the_fall_and_never_include_what_follows():
    t = trajectory()
    t.fell[120, 0] = True
    t.velocity[120:, 0] = 99.0
    t.arm_error[120:, 0] = 99.0
    m = tracking_measures(t, 0.8)
    assert m["e_lin"][0] == pytest.approx(0.0, abs=1e-6)
    assert m["e_upper"][0] == pytest.approx(0.0, abs=1e-6)
    assert m["fall_fraction"].tolist() == [1.0, 0.0]
    assert m["episode_length_fraction"].tolist() == pytest.approx([0.6, 1.0])


def test_gait_errors_and_slopes_wait_for_an_average_that_holds_nothing_of_the_command_before():
    """A robot that follows 1 s late, at once: right from 1 s on, its average over a stride of 0.8 s from 1.8 s on."""
    t = trajectory(steps=300, envs=3)
    t.command[150:, :, 0] = torch.tensor([-0.5, 0.0, 0.2])
    t.command[150:, :, 2] = torch.tensor([-0.6, 0.0, 0.5])
    t.velocity[200:] = t.command[200:]
    m = tracking_measures(t, 0.8, settle_s=1.0)
    for name in ("e_lin", "e_yaw", "e_lin_gait", "e_yaw_gait"):
        assert m[name].tolist() == pytest.approx([0.0] * 3, abs=1e-6), name
    slopes = tracking_slopes(t, 0.8, settle_s=1.0)
    assert (slopes["slope_x"]["mean"], slopes["slope_yaw"]["mean"]) == pytest.approx((1.0, 1.0), abs=1e-6)
    sooner = tracking_measures(t, 0.8, settle_s=0.9)
    for name in ("e_lin", "e_yaw", "e_lin_gait", "e_yaw_gait"):
        assert (sooner[name] > 1e-4).all(), name
    assert tracking_slopes(t, 0.8, settle_s=0.9)["slope_x"]["mean"] < 0.9999


def test_slopes_are_of_robots_that_are_asked_to_walk_and_have_not_fallen():
    t = trajectory(envs=4)
    t.command[..., 0] = torch.tensor([-0.5, 1.0, 0.5, 0.0])
    t.velocity[..., 0] = torch.tensor([-0.4, 0.8, 9.0, 0.7])
    t.fell[0, 2] = True
    t.stand[:, 3] = True
    assert tracking_slopes(t, 0.8)["slope_x"]["mean"] == pytest.approx(0.8, rel=1e-5)


def test_stand_drift_is_the_mean_velocity_not_the_sway():
    standing = torch.ones(200, 2, dtype=torch.bool)
    t = trajectory(command=torch.zeros(200, 2, 3), stand=standing)
    t.velocity.zero_()
    t.velocity[:, 0, 1] = 0.04
    t.velocity[:, 1, 0] = 0.2 * torch.sin(2.0 * math.pi * torch.arange(200) / 40)
    assert tracking_measures(t, 0.8)["stand_drift"].tolist() == pytest.approx([0.04, 0.0], abs=1e-5)


def test_who_stands_still_when_asked_to_is_counted():
    """Asked at 1 s; counted from 2.8 s to the end at 4 s. Env 0 lifts a foot from 3.4 s on; env 1 moves too fast."""
    t = trajectory(envs=3, command=torch.zeros(200, 3, 3))
    t.stand[50:] = True
    t.velocity.zero_()
    t.velocity[:, 1, 1] = 0.11
    t.foot_contact[170:, 0, 1] = False
    m = tracking_measures(t, 0.8)
    assert m["still_share"].tolist() == pytest.approx([0.5, 0.0, 1.0])
    assert m["stand_drift"].tolist() == pytest.approx([0.0, 0.11, 0.0], abs=1e-5)
    assert tracking_measures(trajectory(), 0.8)["still_share"].isnan().all()


def test_slip_counts_only_feet_in_contact():
    t = trajectory()
    t.foot_speed[:, 0, 0], t.foot_speed[:, 0, 1] = 0.1, 5.0
    t.foot_contact[:, 0, 1] = False
    assert tracking_measures(t, 0.8)["foot_slip"][0] == pytest.approx(0.1, rel=1e-4)
    t.foot_contact[:, 0] = False
    t.foot_contact[150, 0, 1] = True  # touches down once
    assert tracking_measures(t, 0.8)["foot_slip"].tolist() == pytest.approx([5.0, 0.0])


def test_swing_height_is_the_mean_of_the_peaks_of_true_swings():
    contact = torch.ones(60, 1, 2, dtype=torch.bool)
    height = torch.zeros(60, 1, 2)
    contact[10:20, 0, 0] = False
    height[10:20, 0, 0] = torch.tensor([0.01, 0.03, 0.05, 0.08, 0.1, 0.1, 0.08, 0.05, 0.03, 0.01])
    contact[30:40, 0, 1] = False
    height[30:40, 0, 1] = 0.06
    contact[45:47, 0, 0] = False  # chatter
    height[45:47, 0, 0] = 0.5
    counted = torch.ones(60, 1, dtype=torch.bool)
    assert swings(height, contact, counted, 5)[0] == pytest.approx(0.08, rel=1e-5)
    for as_long, mean, number in ((10, 0.08, 2), (2, (0.1 + 0.06 + 0.5) / 3.0, 3)):
        peak, count = swings(height, contact, counted, as_long)
        assert float(peak) == pytest.approx(mean, rel=1e-5)
        assert float(count) == number
    peak, count = swings(height, contact, counted, 11)
    assert peak.isnan().all()
    assert float(count) == 0.0
    counted[25:] = False
    assert swings(height, contact, counted, 5)[0] == pytest.approx(0.1, rel=1e-5)


def test_swings_count_once_a_command_to_walk_has_settled():
    """The command holds from 2 s on, env 1 stands: of three swings, at 0.4, 2.4 and 3.4 s, the last one counts."""
    t = trajectory()
    t.command[100:, :, 0] = 0.1
    t.stand[:, 1] = True
    for begin, peak in ((20, 0.3), (120, 0.2), (170, 0.07)):
        t.foot_contact[begin : begin + 10, :, 0] = False
        t.foot_height[begin : begin + 10, :, 0] = peak
    measures = tracking_measures(t, 0.8)
    height, rate = measures["swing_height"], measures["stride_rate"]
    assert float(height[0]) == pytest.approx(0.07)
    assert height[1].isnan()
    assert float(rate[0]) == pytest.approx(0.25)  # one swing of one foot of two in the 2 s that count
    assert rate[1].isnan()


def test_a_command_has_settled_after_a_second_unless_told_otherwise():
    t = trajectory(envs=2)
    t.command[100:, :, 0] = torch.tensor([-0.5, 1.5])
    t.velocity[:, :, 0] = t.command[:, :, 0] * torch.linspace(0.5, 1.0, 200).unsqueeze(1)
    assert tracking_slopes(t, 0.8) == tracking_slopes(t, 0.8, settle_s=1.0) != tracking_slopes(t, 0.8, settle_s=0.98)
    default, told, sooner = (
        tracking_measures(t, 0.8, **k)["e_lin"] for k in ({}, {"settle_s": 1.0}, {"settle_s": 0.98})
    )
    assert torch.equal(default, told)
    assert not torch.equal(default, sooner)


def test_slopes_are_those_of_least_squares():
    rng = torch.Generator().manual_seed(0)
    commanded = 3.0 + torch.linspace(-1, 1, 500).reshape(50, 10)
    measured = 0.9 * commanded + 0.05 + 0.1 * torch.randn(50, 10, generator=rng)
    import numpy as np

    mask = torch.rand(50, 10, generator=rng) < 0.7
    mask[:, 3] = False
    expected = np.polyfit(commanded[mask].numpy(), measured[mask].numpy(), 1)[0]
    got = summarize_slope(commanded, measured, mask)
    assert got["mean"] == pytest.approx(expected, rel=1e-4)
    assert got["n"] == 9
    lost = measured.masked_fill(~mask, math.nan)  # as of robots whose simulation diverged
    assert summarize_slope(commanded.masked_fill(~mask, math.nan), lost, mask) == got
    nothing = {"mean": None, "ci95": None, "n": 0}
    assert summarize_slope(commanded[:1], measured[:1], torch.arange(10).unsqueeze(0) == 4) == nothing
    assert summarize_slope(torch.ones(50, 10), measured, mask) == nothing
    assert summarize_slope(commanded, measured, torch.zeros(50, 10, dtype=torch.bool)) == nothing
    t = trajectory(envs=3)
    t.command[..., 0] = torch.tensor([-1.0, 0.0, 1.0])
    t.velocity[..., 0] = 0.8 * t.command[..., 0]
    assert tracking_slopes(t, 0.8)["slope_x"]["mean"] == pytest.approx(0.8, rel=1e-4)


def test_the_interval_of_a_slope_is_as_wide_as_slopes_differ_between_samples_of_envs():
    """What an env adds of its own, not the noise of its steps, decides; 95 % of intervals hold the slope."""
    rng = torch.Generator().manual_seed(2)
    slopes, held, widths = [], 0, []
    for _ in range(200):
        commanded = torch.empty(1, 60).uniform_(-1.0, 1.0, generator=rng).repeat(40, 1)
        of_env = 0.2 * torch.randn(1, 60, generator=rng)
        measured = 0.9 * commanded + of_env + 0.05 * torch.randn(40, 60, generator=rng)
        got = summarize_slope(commanded, measured, torch.ones(40, 60, dtype=torch.bool), resamples=400)
        low, high = got["ci95"]
        slopes.append(got["mean"])
        widths.append(high - low)
        held += low <= 0.9 <= high
    assert sum(widths) / 200 == pytest.approx(3.92 * float(torch.tensor(slopes).std()), rel=0.15)
    assert 0.89 <= held / 200 <= 0.99


def test_moving_average_against_a_plain_loop():
    x = torch.randn(50, 3, generator=torch.Generator().manual_seed(1))
    expected = torch.stack([x[max(0, i - 6) : i + 1].mean(0) for i in range(50)])
    assert torch.allclose(moving_average(x, 7), expected, atol=1e-5)
    so_far = torch.stack([x[: i + 1].mean(0) for i in range(50)])
    for longer in (50, 80):
        assert torch.allclose(moving_average(x, longer), so_far, atol=1e-5)


def test_steps_since_change():
    x = torch.tensor([1.0, 1.0, 2.0, 2.0, 2.0, 1.0]).reshape(6, 1, 1)
    assert steps_since_change(x).squeeze().tolist() == [0, 1, 0, 1, 2, 0]


def test_masked_mean_is_nan_where_nothing_was_measured():
    mask = torch.tensor([[True, False], [True, False]])
    result = masked_mean(torch.tensor([[1.0, 5.0], [3.0, 5.0]]), mask)
    assert result[0] == 2.0
    assert result[1].isnan()


def test_summary_interval_covers_the_mean_at_its_stated_rate():
    rng = torch.Generator().manual_seed(0)
    hits = 0
    for trial in range(100):
        low, high = summarize(torch.randn(80, generator=rng) + 1.0, seed=trial, resamples=300)["ci95"]
        hits += low <= 1.0 <= high
    assert 87 <= hits <= 100
    s = summarize(torch.tensor([1.0, 3.0, math.nan]))
    assert (s["mean"], s["std"]) == (2.0, pytest.approx(math.sqrt(2.0)))


def test_summary_interval_is_of_95_percent():
    """Of many equal numbers the mean is normal: 1.96 standard errors to either side; of 90 % it were 1.645."""
    values = torch.randn(400, generator=torch.Generator().manual_seed(3)).double()
    mean, error = float(values.mean()), float(values.std()) / math.sqrt(400)
    low, high = summarize(values, resamples=20_000)["ci95"]
    assert (mean - low) / error == pytest.approx(1.96, abs=0.06)
    assert (high - mean) / error == pytest.approx(1.96, abs=0.06)


def test_an_interval_is_of_a_thousand_resamples_by_one_seed_unless_told_otherwise():
    values = torch.randn(20, generator=torch.Generator().manual_seed(4))
    assert summarize(values) == summarize(values, 0, 1000)
    for other in ((1, 1000), (0, 999)):
        assert summarize(values) != summarize(values, *other)


def test_of_several_figures_in_an_env_the_mean_is_over_all_and_the_interval_over_envs():
    """A ratio of sums: its standard error is that of `sum_i - ratio count_i`, over `sqrt(n)` times the mean count."""
    rng = torch.Generator().manual_seed(5)
    values = torch.randn(500, 4, generator=rng) + 3.0 * torch.randn(500, 1, generator=rng) + 5.0
    values[torch.arange(4) >= torch.randint(1, 5, (500, 1), generator=rng)] = math.nan
    counts, totals = values.isfinite().sum(1), values.nansum(1)
    ratio = float(totals.sum() / counts.sum())
    error = float((totals - ratio * counts).std()) / float(counts.float().mean()) / math.sqrt(500)
    s = summarize(values, resamples=20_000)
    assert (s["mean"], s["n"]) == (pytest.approx(ratio, abs=1e-5), 500)
    assert [(x - ratio) / error for x in s["ci95"]] == pytest.approx([-1.96, 1.96], abs=0.08)
    single = values[:, :1]
    assert summarize(single) == summarize(single[:, 0])
    assert summarize(torch.full((3, 2), math.nan))["reason"]


def test_events_get_wilsons_interval():
    """Against published values: 0 of 10 is 0 to 0.278, 81 of 263 is 0.255 to 0.366."""
    none = summarize(torch.zeros(10, dtype=torch.bool))
    assert (none["mean"], none["n"]) == (0.0, 10)
    assert none["ci95"] == pytest.approx([0.0, 0.2775], abs=1e-3)
    assert summarize(torch.arange(263) < 81)["ci95"] == pytest.approx([0.2553, 0.3662], abs=1e-3)
    for n in range(1, 100):  # not beside them by a rounding
        assert wilson_interval(0.0, n)[0] == 0.0
        assert wilson_interval(1.0, n)[1] == 1.0


def test_summary_counts_who_was_measured():
    assert summarize(torch.tensor([1.0, 3.0, math.nan]))["n"] == 2
    keep = torch.tensor([True, False, True])
    assert summaries({"x": torch.tensor([1.0, 50.0, 3.0])}, keep, 0)["x"]["mean"] == 2.0


def test_what_cannot_be_measured_is_null_with_a_reason():
    s = summarize(torch.tensor([math.nan]))
    assert (s["mean"], s["std"], s["ci95"], s["n"]) == (None, None, None, 0)
    assert s["reason"]
    result = {
        "protocol": "p",
        "method": "m",
        "arms": "held",
        "num_falls": 0,
        "num_envs": 1,
        "seconds": 1.0,
        "metrics": {"e_lin": s},
    }
    assert "no env" in table(result)
    assert "p, m, arms held: 0 of 1 envs fell" in table(result)
    json.dumps(s, allow_nan=False)


def test_path_error_is_of_envs_that_follow_a_path():
    t = trajectory()
    t.path_error[:, 0] = 0.2
    t.path_error[100:, 0] = 0.4
    m = tracking_measures(t, 0.8)
    assert m["e_path"][0] == pytest.approx(0.3)
    assert m["e_path"][1].isnan()
    t.path_error[150:, 0], t.fell[150, 0] = 9.0, True  # where it lies says nothing of how it walked
    t.path_error[:100, 0] = math.nan
    assert tracking_measures(t, 0.8)["e_path"][0] == pytest.approx(0.4)
