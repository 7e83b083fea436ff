"""Saving and loading the tensors that a component carries from step to step."""

from __future__ import annotations

from typing import Any, ClassVar

import torch

from cotap.checks import require_shape


class Stateful:
    """A component whose memory is the tensors named in `STATE`."""

    STATE: ClassVar[tuple[str, ...]] = ()

    def state_dict(self) -> dict[str, Any]:
        """Copies of the tensors in `STATE`, by name."""
        return {name: getattr(self, name).clone() for name in self.STATE}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned. Raises ValueError for another size or a missing name."""
        if state.keys() != set(self.STATE):
            raise ValueError(f"{type(self).__name__} expects state {sorted(self.STATE)}, got {sorted(state)}")
        for name in self.STATE:
            setattr(self, name, restored(f"{type(self).__name__}.{name}", state[name], getattr(self, name)))


def restored(name: str, value: Any, like: torch.Tensor) -> torch.Tensor:
    """A copy of `value`, which was saved where `like` is now, on its device.

    Raises ValueError for another kind, size or type.
    """
    if not isinstance(value, torch.Tensor) or value.dtype != like.dtype:
        kind = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
        raise ValueError(f"{name} must be a tensor of {like.dtype}, got {kind}")
    return require_shape(name, value, tuple(like.shape)).to(like.device, copy=True)


def on_processor(state: Any) -> Any:
    """`state`, dicts and lists of tensors and plain data, with every tensor on the CPU."""
    if isinstance(state, torch.Tensor):
        return state.cpu()
    if isinstance(state, dict):
        return {name: on_processor(value) for name, value in state.items()}
    return [on_processor(value) for value in state] if isinstance(state, list) else state


def uniform(rng: torch.Generator, low: float, high: float, *shape: int) -> torch.Tensor:
    """Uniform random numbers in [low, high) of the given shape, on the generator's device."""
    return torch.rand(*shape, generator=rng, device=rng.device).mul_(high - low).add_(low)
