"""The networks: per agent an actor and a critic, on observations normalised once for all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import torch
from rsl_rl.modules import MLP, EmpiricalNormalization
from tensordict import TensorDict
from torch import nn

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

    def to_plain(self) -> dict[str, Any]:
        """As plain data, for checkpoints."""
        return {
            "observation_widths": dict(self.observation_widths),
            "obs_groups": {k: list(v) for k, v in self.obs_groups.items()},
            "action_slices": {k: [v.start, v.stop] for k, v in self.action_slices.items()},
        }

    @property
    def num_actions(self) -> int:
        return sum(s.stop - s.start for s in self.action_slices.values())

    def width(self, reader: str) -> int:
        """Input width of the `actor` or the `critic`."""
        return sum(self.observation_widths[g] for g in self.obs_groups[reader])


class Head(nn.Module):
    """An MLP whose hidden layers may run in bfloat16 and whose output layer runs in float32."""

    def __init__(self, inputs: int, outputs: int, hidden: tuple[int, ...], output_gain: float) -> None:
        super().__init__()
        self.mlp = MLP(inputs, outputs, hidden, "swish")
        last = cast(nn.Linear, self.mlp[-1])
        nn.init.orthogonal_(last.weight, gain=output_gain)
        nn.init.zeros_(last.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(N, inputs) to (N, outputs), float32."""
        for layer in list(self.mlp)[:-1]:
            x = layer(x)
        with torch.autocast(x.device.type, enabled=False):
            return self.mlp[-1](x.float())


class DualActorCritic(nn.Module):
    """Actors and critics of all agents. The joint policy is the product of the agents' diagonal Gaussians."""

    def __init__(self, layout: AgentLayout, hidden: tuple[int, ...], initial_std: float) -> None:
        super().__init__()
        self.layout = layout
        used = {g for groups in layout.obs_groups.values() for g in groups}
        self.normalizers = nn.ModuleDict(
            {g: EmpiricalNormalization(layout.observation_widths[g]) for g in sorted(used)}
        )
        sizes = {name: s.stop - s.start for name, s in layout.action_slices.items()}
        self.actors = nn.ModuleDict(
            {name: Head(layout.width("actor"), size, hidden, 0.01) for name, size in sizes.items()}
        )
        self.critics = nn.ModuleDict({name: Head(layout.width("critic"), 1, hidden, 1.0) for name in sizes})
        log_std = float(torch.tensor(initial_std).log())
        self.log_std = nn.ParameterDict({name: torch.full((size,), log_std) for name, size in sizes.items()})

    def normalize(self, observations: Observations) -> Observations:
        """Every group by its own running mean and standard deviation."""
        return {g: normalizer(observations[g]) for g, normalizer in self.normalizers.items()}

    def update_normalizers(self, observations: Observations) -> None:
        """Learn from a batch of raw observations."""
        for group, normalizer in self.normalizers.items():
            cast(EmpiricalNormalization, normalizer).update(observations[group])

    def read(self, reader: str, normalized: Observations) -> torch.Tensor:
        """Input (N, width) of the `actor` or `critic`."""
        groups = self.layout.obs_groups[reader]
        return normalized[groups[0]] if len(groups) == 1 else torch.cat([normalized[g] for g in groups], -1)

    def mean_action(self, normalized: Observations) -> torch.Tensor:
        """Deterministic action (N, A) of the joint policy."""
        x = self.read("actor", normalized)
        return torch.cat([self.actors[name](x) for name in self.layout.action_slices], -1)

    def forward(self, observations: Observations) -> torch.Tensor:
        """Deterministic action (N, A) of raw observations: what is deployed. Needs only what actors read."""
        groups = self.layout.obs_groups["actor"]
        return self.mean_action({g: self.normalizers[g](observations[g]) for g in groups})
