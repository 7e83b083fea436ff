"""Giving a trained policy another observation: what it no longer sees is dropped, what is new is at first ignored."""

from __future__ import annotations

import json
from typing import Any

import torch

from cotap.agents.actors import DualActorCritic, as_dict
from cotap.agents.checkpoint import MALFORMED, CheckpointError, require_layout, same

REFITTED = ("terms", "critic_terms")
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
    return {"policy": seen, "clean": seen, "privileged": privileged}


def take_over(path: str, content: dict[str, Any], model: DualActorCritic, env: Any, other_terms: bool = False) -> bool:
    """Give `model` the weights of a checkpoint, refitted if its observation has other terms and `other_terms` says that
    it may. Returns whether they were.

    Raises:
        CheckpointError: it was trained for something else.
    """
    present, saved = json.loads(json.dumps(env.layout())), content["layout"]
    refits = other_terms and any(not same(saved.get(key), present[key]) for key in REFITTED)
    require_layout(path, saved, {k: v for k, v in present.items() if not (refits and k in REFITTED)})
    try:
        if refits:
            # For the statistics of what is new.
            model.update_normalizers(as_dict(env.get_observations(), next(model.parameters()).device))
        model.load_state_dict(refit(content["model"], saved, model, present) if refits else content["model"])
    except MALFORMED as error:
        raise CheckpointError(f"checkpoint {path!r} has other networks: {error}") from error
    return refits


def refit(
    model: dict[str, torch.Tensor], saved: dict[str, Any], fresh: DualActorCritic, present: dict[str, Any]
) -> dict[str, torch.Tensor]:
    """The state that `fresh` is to have to act as `model` did.

    Columns keep their weights and statistics. A term that has gone counts as being at its mean. A new one has weights
    of zero and the statistics that `fresh` has for it; a critic takes over the weights of a term that its actor
    saw until now.

    Args:
        model: State of the networks that were trained.
        saved: Their environment's layout.
        fresh: New networks, whose normalisers have seen the new observations.
        present: The new environment's layout; it differs from `saved` in `REFITTED` alone.
    """
    before, now = columns(saved), columns(present)
    state = {name: value.clone() for name, value in fresh.state_dict().items()}
    for name, value in model.items():
        part, which, *_ = name.split(".")
        if part == "normalizers":
            old, new = _common(before[which], now[which])
            axis = value.dim() - 1
        elif name.endswith(FIRST_LAYER):
            groups = fresh.layout.obs_groups["actor" if part == "actors" else "critic"]
            old, new = _common(_joined(before, groups), _joined(now, groups))
            axis = 1
            state[name].zero_()
        else:
            state[name].copy_(value)
            continue
        if value.dim() == 0:  # how many samples the statistics are of
            state[name].copy_(value)
        else:
            state[name].index_copy_(axis, torch.tensor(new), value.index_select(axis, torch.tensor(old)))
    return state


def _joined(places: Columns, groups: list[str]) -> list[tuple[str, int]]:
    return [place for group in groups for place in places[group]]


def _common(before: list[tuple[str, int]], now: list[tuple[str, int]]) -> tuple[list[int], list[int]]:
    """Where the columns that both have are in either."""
    where = {place: i for i, place in enumerate(before)}
    both = [(where[place], i) for i, place in enumerate(now) if place in where]
    return [i for i, _ in both], [i for _, i in both]
