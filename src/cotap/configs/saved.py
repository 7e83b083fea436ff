"""Configs as checkpoints have them, read by a program that may know other rewards."""

from __future__ import annotations

from typing import Any

from cotap.configs.serialization import to_plain
from cotap.envs.config import RewardConfig


def without_unknown_terms(env: Any) -> tuple[Any, list[str]]:
    """An environment's config as it was saved, without weights of rewards that only the program of its training knew;
    and those rewards' names. What is malformed is left to whoever reads it."""
    known, unknown = to_plain(RewardConfig()), []
    rewards = env.get("rewards") if isinstance(env, dict) else None
    if not isinstance(rewards, dict):
        return env, unknown
    kept = dict(rewards)
    for agent, terms in known.items():
        if isinstance(weights := rewards.get(agent), dict):
            unknown += [str(term) for term in weights if term not in terms]
            kept[agent] = {term: weight for term, weight in weights.items() if term in terms}
    return env | {"rewards": kept}, unknown
