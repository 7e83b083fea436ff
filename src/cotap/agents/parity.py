"""Even and odd parts: inputs of networks that are symmetric by construction."""

from __future__ import annotations

import torch
from torch import nn

from cotap.reflection import Reflection


class Parity(nn.Module):
    """Splits what has a mirror image into its even part, which mirroring keeps, and its odd part, which it negates.

    A column and the one that it is read from give half of their sum and half of their difference. A column that is its
    own image is even, one that is its own image's negative is odd. So there are as many columns as before.

    Args:
        reflection: The mirror image of the input.
    """

    even: torch.Tensor
    odd: torch.Tensor
    index: torch.Tensor
    sign: torch.Tensor
    scale: torch.Tensor

    def __init__(self, reflection: Reflection) -> None:
        super().__init__()
        index, sign = reflection.index, reflection.sign
        own = torch.arange(index.numel(), device=index.device)
        first, fixed = index > own, index == own
        for name, value in (
            ("even", (first | (fixed & (sign > 0.0))).nonzero().squeeze(1)),
            ("odd", (first | (fixed & (sign < 0.0))).nonzero().squeeze(1)),
            ("index", index),
            ("sign", sign),
            ("scale", torch.where(fixed, 0.5, 1.0)),
        ):
            self.register_buffer(name, value, persistent=False)

    @property
    def _mirror(self) -> Reflection:
        return Reflection(self.index, self.sign)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(N, inputs) to (N, inputs): the even part, then the odd one."""
        image = self._mirror(x)
        parts = (x + image).index_select(1, self.even), (x - image).index_select(1, self.odd)
        return 0.5 * torch.cat(parts, 1)

    def weights(self, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """For weights (U, inputs) of whole inputs, those (U, E) of the even part and (U, O) of the odd one."""
        weight = weight * self.scale
        image = self._mirror(weight)
        return (weight + image).index_select(1, self.even), (weight - image).index_select(1, self.odd)
