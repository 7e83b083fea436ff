"""Measures, computed from recorded arrays only, per env; then mean, deviation and bootstrap interval over envs."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch

from cotap.evaluation.rollout import Trajectory

HEIGHT_SETTLE_S = 1.5
"""Time that a change of height is given before errors count: 0.2 m at the command's rate, 0.25 m/s, and some [s]."""
STILL_SPEED = 0.1
"""A torso slower than this stands still [m/s]."""


def masked_mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Mean over time (dim 0) of `values` (T, N) where `mask` (T, N); NaN for an env with no such step, (N,)."""
    count = mask.sum(0)
    total = torch.where(mask, values, torch.zeros_like(values)).sum(0)
    return torch.where(count > 0, total / count.clamp_min(1), torch.full_like(total, math.nan))


def moving_average(values: torch.Tensor, steps: int) -> torch.Tensor:
    """Mean of the last `steps` steps at every step (T, ...); of fewer at the beginning."""
    total = values.double().cumsum(0)
    shifted = torch.cat((torch.zeros_like(total[:steps]), total[:-steps])) if steps < len(total) else 0.0
    count = torch.arange(1, len(total) + 1, dtype=torch.float64).clamp_max(steps)
    return ((total - shifted) / count.reshape(-1, *[1] * (values.dim() - 1))).to(values.dtype)


def steps_since_change(values: torch.Tensor) -> torch.Tensor:
    """Steps since `values` (T, N, C) last changed, (T, N); counts from the start of the record."""
    changed = torch.zeros(values.shape[:2], dtype=torch.bool)
    changed[1:] = (values[1:] != values[:-1]).any(-1)
    index = torch.arange(values.shape[0]).unsqueeze(1)
    return index - torch.where(changed, index, torch.zeros_like(index)).cummax(0).values


def settled(trajectory: Trajectory, settle_s: float) -> torch.Tensor:
    """(T, N) bool: on its feet, and under one command for longer than `settle_s`."""
    command = torch.cat((trajectory.command, trajectory.stand.float().unsqueeze(2)), 2)
    return (steps_since_change(command) >= round(settle_s / trajectory.dt)) & trajectory.alive()


def settled_height(t: Trajectory) -> torch.Tensor:
    """(T, N) bool: on its feet, asked to stand, and at one height for `HEIGHT_SETTLE_S`."""
    asked = torch.stack((t.height_command, t.stand.float()), 2)
    return (steps_since_change(asked) >= round(HEIGHT_SETTLE_S / t.dt)) & t.stand & t.alive()


def summarize_slope(
    commanded: torch.Tensor, measured: torch.Tensor, mask: torch.Tensor, seed: int = 0, resamples: int = 1000
) -> dict[str, Any]:
    """Least-squares slope, with intercept, of measured against commanded (T, N) where `mask` (T, N); a bootstrap over
    envs gives its 95 % interval, and `n` counts them. Where nothing was commanded to differ the numbers are null."""
    nothing = {"mean": None, "ci95": None, "n": 0}
    if not mask.any():
        return nothing
    counted = mask.any(0)
    # Any origin will do for a slope; one amid the samples keeps the sums exact. What is not counted may not be finite.
    x, y = (
        (values.double() - values[mask].double().mean()).masked_fill(~mask, 0.0)[:, counted]
        for values in (commanded, measured)
    )
    of_env = torch.stack([v.sum(0) for v in (mask[:, counted].double(), x, y, x * x, x * y)], 1)
    mean, n = float(_slope_of(of_env.sum(0))), len(of_env)
    if math.isnan(mean):
        return nothing
    slopes = _slope_of(bootstrap_draws(n, seed, resamples).double() @ of_env)
    low, high = torch.nanquantile(slopes, torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return {"mean": mean, "ci95": [min(low, mean), max(high, mean)], "n": n}


def _slope_of(sums: torch.Tensor) -> torch.Tensor:
    """Slope (...) by sums (..., 5) over samples of 1, x, y, x^2 and xy; NaN where all x agree."""
    n, x, y, xx, xy = sums.unbind(-1)
    spread = xx - x * x / n
    return torch.where(spread > 1e-9 * n, (xy - x * y / n) / spread, math.nan)


def swings(
    foot_height: torch.Tensor, contact: torch.Tensor, mask: torch.Tensor, min_steps: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean peak height (N,) of the feet over swings of at least `min_steps` that end inside `mask` (T, N) [m], and the
    number of these swings (N,).

    A swing is a stretch without contact; shorter stretches than `min_steps` are chatter. The height is NaN for an env
    with none.
    """
    peak = torch.zeros(foot_height.shape[1:])
    length = torch.zeros(foot_height.shape[1:])
    total, count = torch.zeros_like(peak), torch.zeros_like(peak)
    for height, touching, counted in zip(foot_height, contact, mask, strict=True):
        landed = touching & (length >= min_steps) & counted.unsqueeze(1)
        total += torch.where(landed, peak, torch.zeros_like(peak))
        count += landed.float()
        peak = torch.where(touching, torch.zeros_like(peak), torch.maximum(peak, height))
        length = torch.where(touching, torch.zeros_like(length), length + 1)
    number = count.sum(1)
    return torch.where(number > 0, total.sum(1) / number.clamp_min(1), torch.full_like(number, math.nan)), number


def tracking_measures(t: Trajectory, gait_period_s: float, settle_s: float = 1.0) -> dict[str, torch.Tensor]:
    """Velocity-tracking measures per env, (N,) each; NaN where an env has nothing to measure.

    Errors are against what was asked, once that has held for `settle_s`. Heights count for robots that are asked to
    stand, which alone are asked for other heights than the nominal, once theirs has held for `HEIGHT_SETTLE_S`. `_gait`
    errors use velocities averaged over a gait period, all of it settled, and so do `stand_drift`, the speed while asked
    to stand, and `still_share`, the share of that time that is slower than `STILL_SPEED` with all feet down. Along a
    path, whose commands change all the time, feet are measured at every step. `stride_rate` is how often each foot
    swings while asked to walk; the gait asks for one swing a period.
    """
    period = round(gait_period_s / t.dt)
    ok = settled(t, settle_s)
    ok_gait = settled(t, settle_s + gait_period_s)
    error = t.velocity - t.command
    moving = ok | (t.alive() & torch.isfinite(t.path_error))  # where a path leads, commands never stay the same
    walking = moving & ~t.stand
    swing_height, num_swings = swings(t.foot_height, t.foot_contact, walking, round(0.1 / t.dt))
    walking_s = walking.sum(0) * t.dt
    contact = t.foot_contact & moving.unsqueeze(2)
    slip = torch.where(contact, t.foot_speed, torch.zeros_like(t.foot_speed)).sum((0, 2)) / contact.sum(
        (0, 2)
    ).clamp_min(1)
    average = moving_average(t.velocity, period)
    error_gait = average - t.command
    ok_stand = steps_since_change(t.stand.unsqueeze(2)) >= round((settle_s + gait_period_s) / t.dt)
    ok_stand = ok_stand & t.stand & t.alive()
    drift = average[..., :2].norm(dim=2)
    still = (drift < STILL_SPEED) & t.foot_contact.all(2)
    return {
        "e_lin": masked_mean(error[..., :2].norm(dim=2), ok),
        "e_lin_gait": masked_mean(error_gait[..., :2].norm(dim=2), ok_gait),
        "e_yaw": masked_mean(error[..., 2].abs(), ok),
        "e_yaw_gait": masked_mean(error_gait[..., 2].abs(), ok_gait),
        "e_height": masked_mean((t.height - t.height_command).abs(), settled_height(t)),
        "e_upper": masked_mean(t.arm_error.norm(dim=2), t.alive()),
        "e_ee": masked_mean(t.hand_error.mean(2), t.alive()),
        "j_upper": masked_mean(t.arm_torque.norm(dim=2), t.alive()),
        "stand_drift": masked_mean(drift, ok_stand),
        "still_share": masked_mean(still.float(), ok_stand),
        "foot_slip": torch.where(contact.any(2).any(0), slip, torch.full_like(slip, math.nan)),
        "swing_height": swing_height,
        "stride_rate": num_swings / t.foot_contact.shape[2] / torch.where(walking_s > 0.0, walking_s, math.nan),
        "e_path": masked_mean(t.path_error, t.alive() & torch.isfinite(t.path_error)),
        "fall_fraction": t.fell.any(0),
        "episode_length_fraction": t.alive().float().mean(0),
    }


def tracking_slopes(
    t: Trajectory, gait_period_s: float, settle_s: float = 1.0, seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Slopes of measured (gait-averaged) against commanded velocity while walking, and of height while standing, over
    all envs, each with its interval."""
    measured = moving_average(t.velocity, round(gait_period_s / t.dt))
    ok = settled(t, settle_s + gait_period_s) & ~t.stand
    slopes = {
        f"slope_{axis}": summarize_slope(t.command[..., i], measured[..., i], ok, seed)
        for i, axis in enumerate(("x", "y", "yaw"))
    }
    return slopes | {"slope_height": summarize_slope(t.height_command, t.height, settled_height(t), seed)}


def summarize(
    values: torch.Tensor, seed: int = 0, resamples: int = 1000, group: torch.Tensor | None = None
) -> dict[str, Any]:
    """Mean, standard deviation and 95 % interval of the mean over envs, and the number of envs `n` behind them.

    Numbers (N,) get a bootstrap interval, NaN left out; of several in an env, (N, K), the mean is over all of them, and
    an env's stay together in the bootstrap. Events (N,) bool get Wilson's interval, which has a width even where all
    envs agree. Where nothing could be measured the numbers are null, and of one env, or group, there is no interval;
    `reason` says so.

    Args:
        values: Numbers or events of every env.
        seed: Of the bootstrap.
        resamples: Of the bootstrap.
        group: (N,) int; the bootstrap draws groups, not envs, where envs of one group are alike.
    """
    of_env = torch.arange(len(values)).repeat_interleave(values[0].numel() if len(values) else 1)
    values, single = values.flatten(), values.dim() == 1
    finite = torch.isfinite(values)
    counted = values[finite].double()
    n = counted.numel() if single else len(of_env[finite].unique())
    if n == 0:
        return {"mean": None, "std": None, "ci95": None, "n": 0, "reason": "no env had anything to measure"}
    mean, std = float(counted.mean()), float(counted.std()) if counted.numel() > 1 else 0.0
    if values.dtype == torch.bool:
        return {"mean": mean, "std": std, "ci95": list(wilson_interval(mean, n)), "n": n}
    _, member = torch.unique((of_env if group is None else group)[finite], return_inverse=True)
    totals, sizes = torch.bincount(member, counted).float(), torch.bincount(member).float()
    if len(sizes) == 1:
        return {"mean": mean, "std": std, "ci95": None, "n": n, "reason": "one env has no interval"}
    draws = bootstrap_draws(len(sizes), seed, resamples)
    means = (draws @ totals) / (draws @ sizes)
    low, high = torch.quantile(means.double(), torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    # Single precision may put the interval of equal numbers beside them by a rounding.
    return {"mean": mean, "std": std, "ci95": [min(low, mean), max(high, mean)], "n": n}


def summaries(measures: dict[str, torch.Tensor], keep: torch.Tensor, seed: int) -> dict[str, dict[str, Any]]:
    """Every measure, (N,) or (N, K), summed up over the envs in `keep` (N,)."""
    return {name: summarize(values[keep], seed) for name, values in measures.items()}


def outcome(measures: dict[str, torch.Tensor], stood: torch.Tensor, seed: int, per_env: bool) -> dict[str, Any]:
    """What the JSON says of measures, (N,) or (N, K): summed up over all envs and over those that `stood` (N,) to the
    end, and, with `per_env`, env by env."""
    return {
        "metrics": summaries(measures, torch.ones_like(stood), seed),
        "metrics_without_falls": summaries(measures, stood, seed),
        **({"per_env": per_env_figures(measures, stood)} if per_env else {}),
    }


def per_env_figures(measures: dict[str, torch.Tensor], stood: torch.Tensor) -> dict[str, list[float | None]]:
    """Measures (N,) env by env, to six digits, null where an env has none; and whether it `stood` to the end. Measures
    (N, K) are left out."""

    def plain(value: float) -> float | None:
        return float(f"{value:.6g}") if math.isfinite(value) else None

    single = {name: values for name, values in measures.items() if values.dim() == 1}
    return {
        "stood": [float(s) for s in stood.tolist()],
        **{name: [plain(v) for v in values.double().tolist()] for name, values in single.items()},
    }


def wilson_interval(share: float, n: int) -> tuple[float, float]:
    """95 % interval of a share that was seen in `n` trials (Wilson 1927)."""
    z = 1.959964
    center = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(share * (1.0 - share) / n + z * z / (4 * n * n))
    # At a share of 0 or 1 the interval ends there; rounding must not leave it short.
    return (0.0 if share == 0.0 else center - half), (1.0 if share == 1.0 else center + half)


@lru_cache(maxsize=4)
def bootstrap_draws(n: int, seed: int, resamples: int) -> torch.Tensor:
    """How often each of `n` envs, or groups of them, is drawn in each bootstrap sample, (resamples, n)."""
    rng = torch.Generator().manual_seed(seed)
    draws = (torch.randint(0, n, (n,), generator=rng) for _ in range(resamples))
    return torch.stack([torch.bincount(draw, minlength=n) for draw in draws]).float()
