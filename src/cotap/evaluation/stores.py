"""What energy stores cost: how long an arm waits for the stiffness that it was asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch

from cotap.envs import HumanoidEnv
from cotap.evaluation.metrics import masked_mean, summarize

NEAR = 0.05
"""Share of the stiffness asked for by which the one in force may be off where it counts as reached."""


@dataclass
class StoreRecord:
    """What the stores of N envs of A arms did, a row (N, A) per step; of arms without a store NaN."""

    level: list[torch.Tensor] = field(default_factory=list)
    """[J]."""
    held_back: list[torch.Tensor] = field(default_factory=list)
    """Share of the change that was not let through."""
    ratio: list[torch.Tensor] = field(default_factory=list)
    """Mean joint stiffness in force over the one asked for."""
    stiffness: list[torch.Tensor] = field(default_factory=list)
    """Mean joint stiffness in force [Nm/rad]."""

    def add(self, env: HumanoidEnv) -> None:
        """Note what the step just made did; nothing where no arm has a store."""
        report = env.upper_body.report
        if "store_energy" not in report:
            return
        self.level.append(report["store_energy"].cpu())
        self.held_back.append(report["held_back"].cpu())
        self.ratio.append(report["stiffness_ratio"].cpu())
        self.stiffness.append(env.upper_body.stiffness.diagonal(dim1=-2, dim2=-1).mean(-1).cpu())


def waiting(ratio: torch.Tensor, changed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Steps from each step on until the ratio is near 1, (T, ...), and whether it gets there, before the next change.

    Args:
        ratio: (T, ...) in force over asked for.
        changed: (T, ...) bool: what is asked for is new in that step.
    """
    steps, reached = torch.zeros_like(ratio), torch.zeros_like(changed)
    for t in reversed(range(len(ratio))):
        near = (ratio[t] - 1.0).abs() <= NEAR
        goes_on = ~changed[t + 1] if t + 1 < len(ratio) else torch.zeros_like(near)
        later = torch.where(goes_on, steps[t + 1], 0.0) if t + 1 < len(ratio) else torch.zeros_like(ratio[t])
        steps[t] = torch.where(near, 0.0, 1.0 + later)
        reached[t] = near | (goes_on & reached[min(t + 1, len(ratio) - 1)])
    return steps, reached


def measures(
    record: StoreRecord, changed: torch.Tensor, counted: torch.Tensor, dt: float
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Level, share held back, and the delay of changes that ask for more, each (N,); and which changes (T, N, A) those
    are.

    A delay that the next change ends counts up to there.

    Args:
        record: Of T steps.
        changed: (T, N, A) bool: what is asked for jumped in that step.
        counted: (T, N) bool: the step counts; one that does not ends a delay as a change does.
        dt: [s].
    """
    level, held, ratio, stiffness = (
        torch.stack(x).float() for x in (record.level, record.held_back, record.ratio, record.stiffness)
    )
    asked = stiffness / ratio
    more = torch.zeros_like(changed)
    more[1:] = changed[1:] & (asked[1:] > (1.0 + NEAR) * asked[:-1])
    more = more & counted.unsqueeze(-1)
    steps, reached = waiting(ratio, changed | ~counted.unsqueeze(-1))

    def over_arms(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        mask = mask & values.isfinite()
        return masked_mean(values.movedim(2, 1).flatten(0, 1), mask.movedim(2, 1).flatten(0, 1))

    always = counted.unsqueeze(-1).expand_as(changed)
    return {
        "store_energy": over_arms(level, always),
        "held_back": over_arms(held, always),
        "stiffening_delay_s": over_arms(dt * steps, more),
        "reached_fraction": over_arms(reached.float(), more),
    }, more


def curve(
    record: StoreRecord, ended: torch.Tensor, more: torch.Tensor, dt: float, seconds: float, seed: int
) -> dict[str, Any]:
    """Over time since a change in `more` (T, N, A), until one is `ended` (T, N, A) by the next or by a fall: means of
    what is asked for, in force and left in the store; the ratio of the two with an interval over envs."""
    rows: dict[str, list[Any]] = {name: [] for name in ("time", "asked", "in_force", "store_energy", "ratio", "ci95")}
    ratio, stiffness, level = (torch.stack(x).float() for x in (record.ratio, record.stiffness, record.level))
    running = more
    for k in range(round(seconds / dt)):
        if k:  # one step further, where nothing new is asked for
            running = torch.cat((torch.zeros_like(running[:1]), running[:-1])) & ~ended
        if not running.any():
            break
        rows["time"].append(k * dt)
        rows["asked"].append(float((stiffness / ratio)[running].mean()))
        rows["in_force"].append(float(stiffness[running].mean()))
        rows["store_energy"].append(float(level[running].mean()))
        count = running.sum((0, 2))
        each = torch.where(running, ratio, 0.0).sum((0, 2)) / torch.where(count > 0, count, torch.nan)
        found = summarize(each, seed)
        rows["ratio"].append(found["mean"])
        rows["ci95"].append(found["ci95"] or [found["mean"]] * 2)
    return rows
