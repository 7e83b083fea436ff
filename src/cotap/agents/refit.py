"""Giving a trained policy another observation: what it no longer sees is dropped, what is new is at first ignored.
Actions that it did not have are zero at first."""

from __future__ import annotations

import json
from collections.abc import Collection
from typing import Any

import torch

from cotap.agents.actors import DualActorCritic, as_dict
from cotap.agents.checkpoint import MALFORMED, CheckpointError, load_weights, require_layout, same
from cotap.checks import quoted, reason_of

REFITTED = ("terms", "critic_terms", "modulation")
"""What two layouts may differ in for `refit` to go from one to the other."""
FIRST_LAYER = ("weights.0", "mlp.0.weight")
"""How the weights that an observation meets are called, in symmetric and plain networks."""

Columns = dict[str, list[tuple[str, int]]]


def columns(layout: dict[str, Any]) -> Columns:
    """What every column of each group's observation is: its term, and its place there from the newest step back."""
    steps = layout["history"]
    seen = [
        (name, age * width + i)
        for name, width, _ in layout["terms"]
        for age in reversed(range(steps))
        for i in range(width)
    ]
    privileged = [(name, i) for name, width, _ in layout["critic_terms"] for i in range(width)]
    present = [(name, i) for name, width, _ in layout["terms"] for i in range(width)]
    return {"policy": seen, "clean": seen, "present": present, "privileged": privileged}


def take_over(
    path: str, content: dict[str, Any], model: DualActorCritic, env: Any, other: Collection[str] = ()
) -> bool:
    """Give `model` the weights of a checkpoint. They are refitted if its layout differs in an entry that `other` names,
    which is a part of `REFITTED`. Returns whether they were refitted.

    Raises:
        CheckpointError: it was trained for something else.
    """
    present, saved = json.loads(json.dumps(env.layout())), content["layout"]
    refits = any(not same(saved.get(key), present.get(key)) for key in other)
    require_layout(path, saved, {k: v for k, v in present.items() if k not in other})
    agents = content.get("agents")
    if isinstance(agents, dict) and not same(agents.get("obs_groups"), model.layout.obs_groups):
        raise CheckpointError(
            f"checkpoint {path!r} has networks that read the observations {quoted(agents.get('obs_groups'))}, not "
            f"{model.layout.obs_groups}: --env.observations.critic and --env.observations.noise.enabled choose them"
        )
    try:
        if refits:
            # For the statistics of what is new.
            model.update_normalizers(as_dict(env.get_observations(), next(model.parameters()).device))
        load_weights(model, refit(content["model"], saved, model, present) if refits else content["model"])
    except MALFORMED as error:
        raise CheckpointError(f"checkpoint {path!r} has other networks: {reason_of(error)}") from error
    return refits


def spread(model: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """`model` with a standard deviation of one for observations that never varied, as forces that were off: it acts as
    before, and does not see hundreds of deviations once they do vary."""
    return {
        name: torch.where(value == 0.0, 1.0, value) if name.endswith(("_std", "_var")) else value
        for name, value in model.items()
    }


def refit(
    model: dict[str, torch.Tensor], saved: dict[str, Any], fresh: DualActorCritic, present: dict[str, Any]
) -> dict[str, torch.Tensor]:
    """The state that `fresh` is to have to act as `model` did.

    Columns keep their weights and statistics. A term that has gone counts as being at its mean. A new one has weights
    of zero and the statistics that `fresh` has for it, but a standard deviation of one at least: terms are scaled to be
    of that order, and what envs have alike at first, as laws that actions set, has no spread yet. A critic takes over
    weights and statistics of a term that its actor saw until now. New actions come after those that `model` has: their
    outputs are zero, and they are explored as `fresh` explores them.

    Args:
        model: State of the networks that were trained.
        saved: Their environment's layout.
        fresh: New networks, whose normalisers have seen the new observations.
        present: The new environment's layout; it differs from `saved` in `REFITTED` alone.
    """
    before, now = columns(saved), columns(present)
    state = {name: value.clone() for name, value in fresh.state_dict().items()}
    for name, value in state.items():
        part, which, *_ = name.split(".")
        if part == "normalizers" and value.dim():
            if name.endswith(("_std", "_var")):
                value.clamp_min_(1.0)
            # A term that a critic sees from now on comes from what its actor saw; its own columns have the last word.
            for group in sorted(before, key=lambda group: group == which):
                if (old := model.get(name.replace(which, group, 1))) is not None:
                    _take(value, old, before[group], now[which])
        elif name.endswith(FIRST_LAYER):
            groups = fresh.layout.obs_groups["actor" if part == "actors" else "critic"]
            _take(value.zero_(), model[name], _joined(before, groups), _joined(now, groups))
        elif part in ("actors", "log_std") and len(model[name]) != len(value):
            _extend(value.zero_() if part == "actors" else value, model[name], _new_actions(saved, present))
        else:
            value.copy_(model[name])
    return state


def _new_actions(saved: dict[str, Any], present: dict[str, Any]) -> int:
    """How many more actions there are now."""
    before, now = (len(layout.get("modulation", {}).get("targets", [])) for layout in (saved, present))
    return now - before


def _extend(value: torch.Tensor, old: torch.Tensor, new: int) -> None:
    """Put `old` before the `new` rows that `value` has more. Raises ValueError if it has another number more."""
    if len(old) + new != len(value):
        raise ValueError(f"{len(value)} actions for {len(old)} and {new} new ones")
    value[: len(old)] = old


def _joined(places: Columns, groups: list[str]) -> list[tuple[str, int]]:
    return [place for group in groups for place in places[group]]


def _take(
    value: torch.Tensor, old: torch.Tensor, before: list[tuple[str, int]], now: list[tuple[str, int]]
) -> None:  # fmt: skip
    """Copy the columns, `now` and `before`, that both have. Raises ValueError if there are not as many as there are
    places."""
    if (value.shape[-1], old.shape[-1]) != (len(now), len(before)):
        raise ValueError(f"{old.shape[-1]} columns for {len(before)} places")
    where = {place: i for i, place in enumerate(before)}
    both = [(where[place], i) for i, place in enumerate(now) if place in where]
    mine, others = torch.tensor([i for _, i in both]), torch.tensor([i for i, _ in both])
    if both:
        value.index_copy_(-1, mine, old.index_select(-1, others))
