"""Distributed training with `torchrun`: the rank of this process, and what ranks exchange."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from rsl_rl.utils.utils import reduce_gradients_in_buckets
from torch import nn

TIMEOUT_S = 300.0
"""How long a process waits for another that neither answers nor has gone."""
_BUCKET_MB = 32.0


@dataclass(frozen=True)
class Ranks:
    """The rank of this process among all that `torchrun` started; a single process is rank 0 of 1, without exchange.

    Every rank has envs and random numbers of its own; networks, optimisers and normalisers are the same everywhere.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    """Number of this process on its host."""
    local_size: int = 1
    """Processes on this host."""

    @classmethod
    def from_environment(cls) -> Ranks:
        """As `torchrun` says in the environment. Raises ValueError for what it would not say."""
        names = {"rank": "RANK", "size": "WORLD_SIZE", "local_rank": "LOCAL_RANK", "local_size": "LOCAL_WORLD_SIZE"}
        default = cls()
        try:
            values = {field: int(os.environ.get(name, str(getattr(default, field)))) for field, name in names.items()}
        except ValueError as error:
            raise ValueError(f"{', '.join(names.values())} in the environment must be integers: {error}") from error
        ranks = cls(**values)
        if not (0 <= ranks.rank < ranks.size and 0 <= ranks.local_rank < ranks.local_size):
            raise ValueError(f"the environment's {', '.join(names.values())} do not fit together: {ranks}")
        if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True" and os.environ.get(
            "TORCHELASTIC_MAX_RESTARTS", "0"
        ) not in ("", "0"):
            # https://github.com/pytorch/pytorch/issues/135712: restarted ranks look for each other where the lost were.
            raise ValueError(
                "with --max-restarts, torchrun needs TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1 in its environment: "
                "otherwise processes that it restarts do not find each other"
            )
        return ranks

    @property
    def leads(self) -> bool:
        """Whether this process writes the log and the checkpoints."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """Seed of this rank's envs and exploration; rank 0 has `seed` itself."""
        return seed + 1_000_003 * self.rank

    def threads(self, threads: int) -> int:
        """`threads`, or where that is 0 this process' share of the host's CPUs."""
        if threads or self.size == 1:
            return threads
        return max(1, (os.cpu_count() or 1) // self.local_size)

    def device(self, device: str) -> str:
        """`device`, but of several GPUs this process' own."""
        return f"cuda:{self.local_rank}" if self.size > 1 and torch.device(device).type == "cuda" else device

    @contextmanager
    def joined(self, device: str) -> Iterator[None]:
        """Connect with the other ranks: gloo between CPUs, NCCL between GPUs."""
        if self.size == 1:
            yield
            return
        # Optimisers load it, and its functions' defaults keep the group that exists then: gloo's threads would outlive
        # the group, and abort the process when Python ends.
        import torch.distributed.nn.functional

        on_gpus = torch.device(device).type == "cuda"
        if on_gpus:
            torch.cuda.set_device(self.local_rank)
        backend = "cpu:gloo,cuda:nccl" if on_gpus else "gloo"
        timeout = timedelta(seconds=TIMEOUT_S)
        dist.init_process_group(backend, rank=self.rank, world_size=self.size, timeout=timeout)
        try:
            yield
        finally:
            dist.destroy_process_group()

    def same_everywhere(self, module: nn.Module) -> None:
        """Give every rank the weights and buffers of rank 0."""
        if self.size > 1:
            for tensor in module.state_dict().values():
                dist.broadcast(tensor, src=0)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace gradients by their means over ranks."""
        if self.size > 1:
            reduce_gradients_in_buckets(parameters, self.size, _BUCKET_MB)

    def mean(self, value: torch.Tensor) -> torch.Tensor:
        """Mean of `value` (...) over ranks."""
        if self.size == 1:
            return value
        value = value.clone()
        dist.all_reduce(value)
        return value / self.size

    def mean_of(self, scalars: dict[str, float]) -> dict[str, float]:
        """Mean of each number over ranks, which must all have the same names."""
        if self.size == 1:
            return scalars
        means = self.mean(torch.tensor(list(scalars.values()), dtype=torch.float64))
        return dict(zip(scalars, means.tolist(), strict=True))

    def any(self, flag: bool) -> bool:
        """Whether any rank says yes."""
        return bool(self.mean(torch.tensor(float(flag))) > 0.0)

    def standardize(self, value: torch.Tensor) -> torch.Tensor:
        """`value` (M, G), less its mean and over its deviation, taken over all ranks' rows."""
        if self.size == 1:
            return (value - value.mean(0)) / (value.std(0) + 1e-8)
        mean = self.mean(value.mean(0))
        squares = self.mean((value - mean).square().sum(0)) * self.size
        return (value - mean) / ((squares / (self.size * value.shape[0] - 1)).sqrt() + 1e-8)

    def gather(self, make: Callable[[], Any]) -> list[Any]:
        """What `make` gives on ranks 1, 2, ..., at rank 0; elsewhere nothing. Plain data and tensors, on CPUs.

        They travel as checkpoints do, so that no process can make another run code.
        """
        if self.size == 1:
            return []
        buffer = io.BytesIO()
        torch.save(None if self.leads else make(), buffer)
        own = torch.frombuffer(bytearray(buffer.getvalue()), dtype=torch.uint8)
        sizes = [torch.zeros(1, dtype=torch.long) for _ in range(self.size)]
        dist.all_gather(sizes, torch.tensor([own.numel()]))
        longest = int(torch.cat(sizes).max())
        parts = [torch.empty(longest, dtype=torch.uint8) for _ in range(self.size)] if self.leads else None
        dist.gather(nn.functional.pad(own, (0, longest - own.numel())), parts)
        texts = [part[:n].numpy().tobytes() for part, n in zip(parts or [], sizes, strict=False)]
        return [torch.load(io.BytesIO(text), weights_only=True) for text in texts[1:]]
