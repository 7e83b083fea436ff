"""The multilayer perceptrons that actors and critics end in, plain or symmetric by construction."""

from __future__ import annotations

import math
from typing import cast

import torch
from rsl_rl.modules import MLP
from torch import nn
from torch.nn import functional

from cotap.agents.parity import Parity
from cotap.reflection import Reflection


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

    def answer_zero(self) -> None:
        """Set the output layer to zero: until it is trained, the output is zero for every input."""
        last = cast(nn.Linear, self.mlp[-1])
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)


class SymmetricHead(nn.Module):
    """An MLP that answers the mirror image of its input with the mirror image of its output, whatever its weights.

    Its hidden units come in pairs: what one computes of an input, the other computes of the mirror image. So half of
    each weight matrix follows from the other half. The first layer, by far the largest, costs half of a plain one's:
    both units of a pair are sums of the same two products, of the even and the odd part of the input.

    Args:
        inputs: Mirror image of the input, before it is split into its even and its odd part.
        outputs: Mirror image of the output.
        hidden: Widths, even.
        output_gain: Scale of the output layer's initial weights.

    Raises:
        ValueError: a width is odd.
    """

    output_index: torch.Tensor
    output_sign: torch.Tensor

    def __init__(self, inputs: Reflection, outputs: Reflection, hidden: tuple[int, ...], output_gain: float) -> None:
        super().__init__()
        for i, width in enumerate(hidden):
            if width % 2:
                raise ValueError(f"ppo.hidden[{i}] must be even for a symmetric network, got {width}")
        self.parity = Parity(inputs)
        self.register_buffer("output_index", outputs.index, persistent=False)
        self.register_buffer("output_sign", outputs.sign, persistent=False)
        widths = (inputs.index.numel(), *hidden)
        self.weights = nn.ParameterList([torch.empty(n // 2, m) for m, n in zip(widths, hidden, strict=False)])
        self.biases = nn.ParameterList([torch.empty(n // 2) for n in hidden])
        for weight, bias in zip(self.weights, self.biases, strict=True):
            bound = 1.0 / math.sqrt(weight.shape[1])
            nn.init.uniform_(weight, -bound, bound)
            nn.init.uniform_(bias, -bound, bound)
        self.output_weight = nn.Parameter(torch.empty(outputs.index.numel(), hidden[-1] // 2))
        nn.init.orthogonal_(self.output_weight, gain=output_gain)
        self.output_bias = nn.Parameter(torch.zeros(outputs.index.numel()))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(N, inputs), as `Parity` splits them, to (N, outputs), float32."""
        x = functional.silu(self._first_layer(x))
        for weight, bias in zip(self.weights[1:], self.biases[1:], strict=True):
            image = weight.roll(weight.shape[1] // 2, 1)
            x = functional.silu(functional.linear(x, torch.cat((weight, image)), torch.cat((bias, bias))))
        with torch.autocast(x.device.type, enabled=False):
            weight, bias = self.output_weight, self.output_bias
            image = self._mirror_output(weight)
            bias = 0.5 * (bias + self._mirror_output(bias))
            return functional.linear(x.float(), torch.cat((weight, image), 1), bias)

    def answer_zero(self) -> None:
        """Set the output layer to zero: until it is trained, the output is zero for every input."""
        nn.init.zeros_(self.output_weight)
        nn.init.zeros_(self.output_bias)

    def _first_layer(self, x: torch.Tensor) -> torch.Tensor:
        even, odd = self.parity.weights(self.weights[0])
        width = even.shape[1]
        a = functional.linear(x[:, :width], even, self.biases[0])
        b = functional.linear(x[:, width:], odd)
        return torch.cat((a + b, a - b), 1)

    def _mirror_output(self, value: torch.Tensor) -> torch.Tensor:
        sign = self.output_sign
        return value.index_select(0, self.output_index) * (sign.unsqueeze(1) if value.dim() == 2 else sign)
