"""Guidance of a new policy by a frozen one (paper, section III-D): a KL penalty that fades to nothing."""

from __future__ import annotations

import copy
import hashlib
import math
from dataclasses import dataclass
from typing import Any, cast

import torch

from cotap.agents.actors import DualActorCritic, Observations
from cotap.agents.heads import Head, SymmetricHead
from cotap.agents.losses import gaussian_kl
from cotap.checks import require_one_of, require_range


@dataclass
class DistillationConfig:
    """How strongly, how long and whom the frozen policy guides."""

    beta: float = 0.1
    """Weight of `KL(new || base)` at the start."""
    end_samples: float = 5e6
    """Samples in which the weight falls linearly to zero."""
    agents: tuple[str, ...] = ("lower",)
    """Agents that are guided."""
    anew: tuple[str, ...] = ()
    """Agents whose actions begin at zero, all else as the base has it."""
    new_std: float = 0.6
    """Standard deviation at the start of actions that begin anew: those of `anew`, and those that the base lacks."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("distillation.beta", self.beta, 0.0, 1e3)
        require_range("distillation.end_samples", self.end_samples, 1.0, 1e15)
        require_range("distillation.new_std", self.new_std, 1e-8, 1e6)
        for field in ("agents", "anew"):
            for name in getattr(self, field):
                require_one_of(f"distillation.{field}", name, ("lower", "upper"))


class Guide:
    """A frozen policy, and how much it still has to say.

    Args:
        base: The policy; copied, and never changed.
        cfg: Weight and schedule.
    """

    def __init__(self, base: DualActorCritic, cfg: DistillationConfig) -> None:
        cfg.check()
        self.cfg = cfg
        self.model = copy.deepcopy(base).eval()
        for parameter in self.model.parameters():
            parameter.requires_grad_(False)
        self._fingerprint = self.fingerprint()

    @torch.no_grad()
    def start(self, model: DualActorCritic) -> None:
        """Give `model` the base's weights, but for outputs and exploration of agents that begin anew."""
        model.load_state_dict(self.model.state_dict())
        for name in self.cfg.anew:
            cast(Head | SymmetricHead, model.actors[name]).answer_zero()
            model.log_std[name].fill_(math.log(self.cfg.new_std))

    def fingerprint(self) -> str:
        """SHA-256 of the frozen policy's bytes, tensor by tensor in the order of their names."""
        digest = hashlib.sha256()
        for name, value in sorted(self.model.state_dict().items()):
            digest.update(name.encode())
            digest.update(value.detach().cpu().numpy().tobytes())
        return digest.hexdigest()

    def verify(self) -> None:
        """Raise RuntimeError if the frozen policy is no longer what it was."""
        if self.fingerprint() != self._fingerprint:
            raise RuntimeError("the frozen base policy has changed during training")

    def beta(self, samples: float) -> float:
        """Weight of the penalty after so many samples."""
        return self.cfg.beta * max(0.0, 1.0 - samples / self.cfg.end_samples)

    @torch.no_grad()
    def mean_action(self, observations: Observations) -> torch.Tensor:
        """What the frozen policy would do (N, A), for raw observations."""
        return self.model(observations)

    def kl(self, name: str, mean: torch.Tensor, log_std: torch.Tensor, base_mean: torch.Tensor) -> torch.Tensor:
        """Mean `KL(new || base)` of one agent's actions [nat], analytic for diagonal Gaussians. A `log_std` that is not
        learned counts as the base's: what it adds could not be changed."""
        base_std = self.model.log_std[name]
        return gaussian_kl(mean, log_std if log_std.requires_grad else base_std, base_mean, base_std).mean()

    def state_dict(self) -> dict[str, Any]:
        """The frozen policy's weights, so that a run goes on without the file it began from."""
        return self.model.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned."""
        self.model.load_state_dict(state)
        self._fingerprint = self.fingerprint()
