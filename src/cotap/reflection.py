"""Mirror images as signed permutations: what environments tell agents of their left-right symmetry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch


@dataclass(frozen=True)
class Reflection:
    """`x -> sign * x[..., index]`; its own inverse."""

    index: torch.Tensor
    """(W,) which column is read."""
    sign: torch.Tensor
    """(W,) +1 or -1."""

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """The mirror image of `x` (..., W)."""
        return x.index_select(-1, self.index) * self.sign.to(x.dtype)

    def to(self, device: torch.device | str) -> Reflection:
        """The same on another device."""
        return Reflection(self.index.to(device), self.sign.to(device))

    def part(self, columns: slice) -> Reflection:
        """The reflection of these columns alone, which must hold each other's images."""
        return Reflection(self.index[columns] - columns.start, self.sign[columns])


def join(parts: Sequence[Reflection]) -> Reflection:
    """The reflection of a concatenation."""
    index: list[torch.Tensor] = []
    start = 0
    for part in parts:
        index.append(part.index + start)
        start += part.index.numel()
    return Reflection(torch.cat(index), torch.cat([p.sign for p in parts]))


@dataclass(frozen=True)
class Symmetry:
    """The mirror images of everything that a policy reads and writes."""

    observations: Mapping[str, Reflection]
    actions: Reflection

    def to_plain(self) -> dict[str, Any]:
        """As plain data, for checkpoints."""
        return {
            "observations": {k: _to_lists(v) for k, v in self.observations.items()},
            "actions": _to_lists(self.actions),
        }

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> Symmetry:
        """What `to_plain` gave. Raises ValueError for columns that are not each other's mirror images."""
        return cls({k: _from_lists(v) for k, v in plain["observations"].items()}, _from_lists(plain["actions"]))


def _to_lists(reflection: Reflection) -> list[list[int]]:
    return [reflection.index.tolist(), reflection.sign.int().tolist()]


def _from_lists(lists: list[list[int]]) -> Reflection:
    index, sign = lists
    if sorted(index) != list(range(len(index))) or any(
        index[i] != k or sign[i] != sign[k] for k, i in enumerate(index)
    ):
        raise ValueError("columns that should be mirror images of each other are not")
    return Reflection(torch.tensor(index), torch.tensor(sign, dtype=torch.float32))
