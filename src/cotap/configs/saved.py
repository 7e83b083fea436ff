"""Configs as checkpoints have them, read by a program that may know other rewards."""

from __future__ import annotations

from typing import Any

from cotap.configs.serialization import to_plain
from cotap.envs.config import RewardConfig


def without_unknown_terms(env: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """An environment's config as it was saved, without weights of rewards that only the program of its training knew;
    and those rewards' names. Raises what plain data raise that are no such config."""
    known, unknown, kept = to_plain(RewardConfig()), [], {}
    for agent, weights in env["rewards"].items():
        unknown += [term for term in weights if term not in known[agent]]
        kept[agent] = {term: weight for term, weight in weights.items() if term in known[agent]}
    return env | {"rewards": kept}, unknown
