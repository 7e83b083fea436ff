"""A device that is none: tensors that say they are on it, refuse to meet those that are not, and compute all the same.

Where there is no GPU, code that forgets where its tensors belong goes unnoticed: everything is on the
CPU. Within `elsewhere()`, whatever is made on `DEVICE` holds its numbers on the CPU, says that it is on
`DEVICE`, and makes every operation fail that mixes it with a tensor (of one dimension or more) on the CPU,
except copies from one to the other, as GPUs do; turning it into an array fails as it does there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from cotap.envs import humanoid_env
from cotap.sim import BatchSimulation, Simulation, batch_of

DEVICE = "meta"
"""A kind that every torch knows by name; that its tensors hold nothing is of no account here."""
_HERE = torch.device("cpu")
_COPIES = (torch.ops.aten.copy_.default, torch.ops.aten._to_copy.default)


class Elsewhere(torch.Tensor):
    """A tensor on `DEVICE`; `held` has its numbers, on the CPU."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> Elsewhere:
        out = torch.Tensor._make_wrapper_subclass(  # pyright: ignore[reportAttributeAccessIssue]
            cls, held.shape, strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype,
            device=torch.device(DEVICE),
        )  # fmt: skip
        out.held = held
        return out

    def __repr__(self, **_: Any) -> str:
        return f"Elsewhere({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """`func` on the real tensors; its results are where the device says that was asked for, or else the arguments."""
    tensors: list[torch.Tensor] = []
    _each(tensors.append, (args, kwargs))
    there = {id(t.held): t for t in tensors if isinstance(t, Elsewhere)}
    if there and func not in _COPIES:
        for t in tensors:
            if not isinstance(t, Elsewhere) and t.dim() > 0:
                raise RuntimeError(f"{func}: a tensor {tuple(t.shape)} is on the CPU, others on {DEVICE}")
    goes = bool(there)
    if func is torch.ops.aten.copy_.default:
        goes = isinstance(args[0], Elsewhere)
    if kwargs.get("device") is not None:
        goes = kwargs["device"] == torch.device(DEVICE)
        kwargs = kwargs | {"device": _HERE}
    args, kwargs = _each(lambda t: t.held if isinstance(t, Elsewhere) else t, (args, kwargs))
    out = func(*args, **kwargs)
    return _each(lambda t: there[id(t)] if id(t) in there else Elsewhere(t), out) if goes else out


def _each(do: Callable[[torch.Tensor], Any], value: Any) -> Any:
    """`value`, nested lists, tuples and dicts, with what `do` makes of every tensor in its place."""
    if isinstance(value, torch.Tensor):
        return do(value)
    if isinstance(value, (list, tuple)):
        return type(value)([_each(do, v) for v in value])  # pyright: ignore[reportCallIssue]
    if isinstance(value, dict):
        return {k: _each(do, v) for k, v in value.items()}
    return value


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _FromData(TorchFunctionMode):
    """What makes tensors of plain data does so before any operation can be seen."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") is not None:
            made = func(*args, **(kwargs | {"device": "cpu"}))
            return made.to(kwargs["device"])
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__) and isinstance(args[0], Elsewhere):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            args = (args[0], tuple(map(_as_index, index)), *args[2:])
        if func is torch.Tensor.tolist and isinstance(args[0], Elsewhere):
            return args[0].held.tolist()
        return func(*args, **kwargs)


def _as_index(part: Any) -> Any:
    """Lists of numbers become indices wherever the tensor is."""
    return Elsewhere(torch.tensor(list(part))) if isinstance(part, (list, tuple)) else part


class _Generator(torch.Generator):
    """Random numbers for any device, `DEVICE` among them."""

    def __new__(cls, device: torch.device | str = "cpu") -> _Generator:
        out = super().__new__(cls)
        out.place = torch.device(device)
        return out

    def __init__(self, device: torch.device | str = "cpu") -> None:
        """All is done in `__new__`."""

    @property
    def device(self) -> torch.device:
        return self.place


def _autocast(device_type: str, *args: Any, **kwargs: Any) -> Any:
    return torch.amp.autocast_mode.autocast("cpu" if device_type == DEVICE else device_type, *args, **kwargs)


class _Simulation(BatchSimulation):
    """MuJoCo's envs, seen as tensors on `DEVICE` that share its memory."""

    def __init__(self, *args: Any) -> None:
        super().__init__(batch_of("mujoco"), *args)
        self.device = DEVICE
        for name in ("qpos", "qvel", "ctrl", "xfrc", "sensors"):
            setattr(self, name, Elsewhere(getattr(self, name)))
        self._fields = {name: Elsewhere(value) for name, value in self._fields.items()}

    def _clear(self, mask: torch.Tensor) -> None:
        super()._clear(mask.cpu())

    def _forward(self, mask: torch.Tensor) -> None:
        super()._forward(mask.cpu())

    def _read_state(self) -> torch.Tensor:
        return Elsewhere(super()._read_state())


def _make_simulation(backend: str, *args: Any) -> Simulation:  # noqa: ARG001
    return _Simulation(*args)


@contextmanager
def elsewhere(patch: Callable[..., None]) -> Iterator[None]:
    """Have `DEVICE` for a while, and environments simulate on it. `patch` is `monkeypatch.setattr`."""
    patch(torch, "Generator", _Generator)
    patch(torch, "autocast", _autocast)
    patch(humanoid_env, "make_simulation", _make_simulation)
    with _FromData(), _Operations():
        yield
