"""Whether a run is one of the recipe `default`, from nothing: what ships is what one command makes."""

from __future__ import annotations

import json
from typing import Any

from cotap.compare import flat
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES, to_plain

OF_A_RUN = {
    "seed", "threads", "device", "runner.iterations", "runner.save_interval", "runner.save_envs", "env.robot",
    "env.seed", "env.num_threads", "env.backend", "env.motions.clips.library_sha256",
}  # fmt: skip
"""Fields that are a run's own, whatever its recipe."""


def require_default(content: dict[str, Any]) -> None:
    """Raise ValueError naming the fields in which the run of a checkpoint is not one of the recipe `default`.

    A field that came after the run has its default: what the run did.
    """
    asked_for = recipe(content["config"])
    trained, asked = flat(content["config"]["training"]), flat(json.loads(json.dumps(to_plain(asked_for))))
    trained = flat(json.loads(json.dumps(to_plain(type(asked_for)())))) | trained
    changed = {
        name: (trained.get(name), asked.get(name))
        for name in sorted(trained.keys() | asked.keys())
        if name not in OF_A_RUN and trained.get(name) != asked.get(name)
    }
    if changed:
        said = "; ".join(f"{name} is {was!r}, not {should!r}" for name, (was, should) in changed.items())
        raise ValueError(f"the run is not one of the recipe default: {said}")


def recipe(config: dict[str, Any]) -> Any:
    """The recipe `default` of a run's stage, on a base of as many samples as its own."""
    base = BASE_RECIPES["default"](config["training"]["env"]["robot"])
    if config["stage"] == "base":
        return base
    base.train_for(config["base"]["runs"][-1]["samples"])
    return DISTILL_RECIPES["default"](base)
