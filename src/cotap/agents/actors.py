"""The networks: per agent an actor and a critic, on observations normalised once for all."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

import torch
from rsl_rl.modules import EmpiricalNormalization
from tensordict import TensorDict
from torch import nn

from cotap.agents.heads import Head, SymmetricHead
from cotap.agents.parity import Parity
from cotap.checks import quoted
from cotap.memory import require_memory
from cotap.reflection import Reflection, Symmetry, join

Observations = dict[str, torch.Tensor]


def as_dict(observations: TensorDict, device: torch.device | str = "cpu") -> Observations:
    """Observation groups as a plain dict on `device`."""
    return {group: cast(torch.Tensor, value).to(device) for group, value in observations.items()}


@dataclass(frozen=True)
class AgentLayout:
    """What the networks must know of an environment; agents learn it from there."""

    observation_widths: dict[str, int]
    obs_groups: dict[str, list[str]]
    """Observation groups that `actor` and `critic` read."""
    action_slices: dict[str, slice]
    """Each agent's share of the action vector."""
    symmetry: Symmetry | None = None
    """Mirror images, for networks that are symmetric by construction; None for plain ones."""

    def to_plain(self) -> dict[str, Any]:
        """As plain data, for checkpoints."""
        return {
            "observation_widths": dict(self.observation_widths),
            "obs_groups": {k: list(v) for k, v in self.obs_groups.items()},
            "action_slices": {k: [v.start, v.stop] for k, v in self.action_slices.items()},
            "symmetry": self.symmetry.to_plain() if self.symmetry else None,
        }

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> AgentLayout:
        """What `to_plain` gave."""
        return cls(
            plain["observation_widths"],
            plain["obs_groups"],
            {name: slice(*bounds) for name, bounds in plain["action_slices"].items()},
            Symmetry.from_plain(plain["symmetry"]) if plain.get("symmetry") else None,
        )

    @property
    def num_actions(self) -> int:
        return sum(s.stop - s.start for s in self.action_slices.values())

    def width(self, reader: str) -> int:
        """Input width of the `actor` or the `critic`."""
        return sum(self.observation_widths[g] for g in self.obs_groups[reader])

    def num_weights(self, hidden: tuple[int, ...]) -> int:
        """Weights of all networks with these hidden layers, without biases and output layers; symmetric ones keep
        half."""
        inputs = [(self.width(reader), *hidden) for reader in ("actor", "critic")]
        weights = sum(a * b for widths in inputs for a, b in pairwise(widths))
        return len(self.action_slices) * weights // (2 if self.symmetry else 1)


class DualActorCritic(nn.Module):
    """Actors and critics of all agents. The joint policy is the product of the agents' diagonal Gaussians.

    Raises:
        ValueError: there is no memory for them.
    """

    def __init__(self, layout: AgentLayout, hidden: tuple[int, ...], initial_std: float) -> None:
        super().__init__()
        require_memory(f"ppo.hidden {quoted(hidden)}", 4 * layout.num_weights(hidden))
        self.layout = layout
        used = {g for groups in layout.obs_groups.values() for g in groups}
        self.normalizers = nn.ModuleDict(
            {g: EmpiricalNormalization(layout.observation_widths[g]) for g in sorted(used)}
        )
        self.parities = nn.ModuleDict()
        if layout.symmetry:
            self.parities.update({g: Parity(layout.symmetry.observations[g]) for g in self.normalizers})
        sizes = {name: s.stop - s.start for name, s in layout.action_slices.items()}
        self.actors = nn.ModuleDict({name: self._actor(name, hidden) for name in sizes})
        self.critics = nn.ModuleDict({name: self._critic(hidden) for name in sizes})
        log_std = float(torch.tensor(initial_std).log())
        self.log_std = nn.ParameterDict({name: torch.full((size,), log_std) for name, size in sizes.items()})

    def _actor(self, name: str, hidden: tuple[int, ...]) -> nn.Module:
        part, symmetry = self.layout.action_slices[name], self.layout.symmetry
        if symmetry is None:
            return Head(self.layout.width("actor"), part.stop - part.start, hidden, 0.01)
        return SymmetricHead(self._input_reflection("actor", symmetry), symmetry.actions.part(part), hidden, 0.01)

    def _critic(self, hidden: tuple[int, ...]) -> nn.Module:
        symmetry = self.layout.symmetry
        if symmetry is None:
            return Head(self.layout.width("critic"), 1, hidden, 1.0)
        unchanged = Reflection(torch.tensor([0]), torch.ones(1))
        return SymmetricHead(self._input_reflection("critic", symmetry), unchanged, hidden, 1.0)

    def _input_reflection(self, reader: str, symmetry: Symmetry) -> Reflection:
        return join([symmetry.observations[g] for g in self.layout.obs_groups[reader]])

    def normalize(self, observations: Observations) -> Observations:
        """What the networks read: every group, normalised by its own running mean and standard deviation, and split
        into its even and its odd part where the networks are symmetric."""
        return {g: self._normalized(g, observations) for g in self.normalizers}

    def _normalized(self, group: str, observations: Observations) -> torch.Tensor:
        value = self.normalizers[group](observations[group])
        return self.parities[group](value) if self.layout.symmetry else value

    def update_normalizers(self, observations: Observations) -> None:
        """Learn from a batch of raw observations, and from their mirror images where the networks are symmetric:
        a mirror image must stay one after normalisation."""
        for group, normalizer in self.normalizers.items():
            value = observations[group]
            if self.layout.symmetry:
                value = torch.cat((value, self.layout.symmetry.observations[group].to(value.device)(value)))
            cast(EmpiricalNormalization, normalizer).update(value)

    def read(self, reader: str, normalized: Observations) -> torch.Tensor:
        """Input (N, width) of the `actor` or `critic`, of what `normalize` returns."""
        groups = self.layout.obs_groups[reader]
        if len(groups) == 1:
            return normalized[groups[0]]
        parts = [normalized[g] for g in groups]
        if self.layout.symmetry:  # all even parts, then all odd ones
            widths = [cast(Parity, self.parities[g]).even.numel() for g in groups]
            halves = [x.tensor_split((width,), 1) for x, width in zip(parts, widths, strict=True)]
            parts = [half for side in zip(*halves, strict=True) for half in side]
        return torch.cat(parts, -1)

    def mean_action(self, normalized: Observations) -> torch.Tensor:
        """Deterministic action (N, A) of the joint policy."""
        x = self.read("actor", normalized)
        return torch.cat([self.actors[name](x) for name in self.layout.action_slices], -1)

    def forward(self, observations: Observations) -> torch.Tensor:
        """Deterministic action (N, A) of raw observations: what is deployed. Needs only what actors read."""
        groups = self.layout.obs_groups["actor"]
        return self.mean_action({g: self._normalized(g, observations) for g in groups})
