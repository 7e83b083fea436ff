"""Policies from checkpoints, the shipped ones by name."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch

from cotap.agents.actors import AgentLayout, DualActorCritic
from cotap.agents.checkpoint import MALFORMED, CheckpointError, load_checkpoint, require_parts
from cotap.checks import require_one_of, require_positive_int

SHIPPED = {"base": "base.pt"}


def shipped_checkpoint(stage: str = "base") -> Path:
    """Path of the checkpoint that comes with the package. Raises ValueError for an unknown stage."""
    require_one_of("stage", stage, SHIPPED.keys())
    return Path(str(files("cotap").joinpath("checkpoints", SHIPPED[stage])))


@dataclass(frozen=True)
class Policy:
    """A trained policy, in float32, with what it was trained for."""

    model: DualActorCritic
    layout: dict[str, Any]
    config: dict[str, Any]
    stage: str

    @torch.no_grad()
    def __call__(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Deterministic actions (N, A) of raw observations."""
        return self.model(observations)


def load_policy(path: Path | str) -> Policy:
    """Load a checkpoint's networks for use.

    Raises:
        CheckpointError: the file cannot be used.
    """
    content = load_checkpoint(path)
    require_parts(path, content, ("layout", "model", "agents", "config", "kind"))
    layout, weights, agents = content["layout"], content["model"], content["agents"]
    try:
        widths = content["config"]["training"]["ppo"]["hidden"]
        hidden = tuple(require_positive_int(f"ppo.hidden[{i}]", width) for i, width in enumerate(widths))
        model = DualActorCritic(AgentLayout.from_plain(agents), hidden, 1.0)
        model.load_state_dict(weights)
    except MALFORMED as error:
        raise CheckpointError(f"checkpoint {str(path)!r} has networks that do not fit its config: {error}") from error
    model.eval()
    return Policy(model, layout, content["config"], content["kind"])
