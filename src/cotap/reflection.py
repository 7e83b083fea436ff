"""Mirror images as signed permutations: what environments tell agents of their left-right symmetry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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

    def to(self, device: str) -> Reflection:
        """The same on another device."""
        return Reflection(self.index.to(device), self.sign.to(device))


@dataclass(frozen=True)
class Symmetry:
    """The mirror images of everything that a policy reads and writes."""

    observations: Mapping[str, Reflection]
    actions: Reflection

    def to(self, device: str) -> Symmetry:
        """The same on another device."""
        return Symmetry({k: v.to(device) for k, v in self.observations.items()}, self.actions.to(device))
