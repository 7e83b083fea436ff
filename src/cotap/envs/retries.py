"""Second tries: a world that fell goes on from a moment before, so that learning sees more of what is hard.

Falls of a policy that walks well are rare, and with them what can be learnt about falling. A restart throws away how
the robot came to fall; taken back by a second, it gets there again and may do better, as in curricula of starting
states (Florensa et al. 2017; resets to promising states, Ecoffet et al. 2021).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import torch

from cotap.checks import require_range
from cotap.envs.persistence import restored
from cotap.envs.upper_body import UpperBody

KEPT = 4
"""Past states that are kept, `RetryConfig.every_s` apart; which of them but the newest is gone back to is drawn."""


@dataclass
class RetryConfig:
    """How often a robot that fell tries again."""

    share: float = 0.0
    """Share of the falls after which a world goes on from a state before them, instead of from a fresh start. Falls are
    counted all the same, so that more are shown than robots fall from fresh starts."""
    every_s: float = 0.5
    """Time between states that can be gone back to: falls are gone back by one to four times this [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_range("retries.share", self.share, 0.0, 1.0)
        require_range("retries.every_s", self.every_s, 0.02, 10.0)


class Retries:
    """Keeps the last states of all worlds, and says who goes back to which.

    Args:
        cfg: How often.
        num_envs: Number of worlds.
        dt: Control step [s].
    """

    def __init__(self, cfg: RetryConfig, num_envs: int, dt: float) -> None:
        cfg.check()
        self._share, self._every = cfg.share, max(round(cfg.every_s / dt), 1)
        self._step = 0
        self._begun = torch.zeros(num_envs, dtype=torch.long)
        """Step in which a world was last put where it did not get by itself."""
        self._past: deque[tuple[int, dict[str, Any]]] = deque(maxlen=KEPT)

    def draw(self, fell: torch.Tensor, done: torch.Tensor, rng: torch.Generator) -> tuple[torch.Tensor, dict[str, Any]]:
        """After a step: the worlds that go back (n,), and the state of all worlds that they go back to.

        No world goes back beyond its start, nor beyond where it went back to before.

        Args:
            fell: (N,) who fell.
            done: (N,) whose episode ended, falls included.
            rng: Random numbers.
        """
        self._step += 1
        nobody = torch.zeros(0, dtype=torch.long, device=fell.device), {}
        begun = self._begun
        self._begun = torch.where(done, self._step, begun)
        if len(self._past) < KEPT or not fell.any():
            return nobody
        age = int(torch.randint(KEPT - 1, (1,), generator=rng, device=rng.device))
        taken_at, state = self._past[age]
        tries = fell & (taken_at > begun) & (torch.rand(fell.shape, generator=rng, device=rng.device) < self._share)
        return tries.nonzero().squeeze(1), state

    def due(self) -> bool:
        """Whether the present state is to be kept."""
        return self._step % self._every == 0

    def keep(self, state: dict[str, Any]) -> None:
        """Keep what all worlds are in now."""
        self._past.append((self._step, state))

    def state_dict(self) -> dict[str, Any]:
        """All that draws depend on."""
        return {"step": self._step, "begun": self._begun.clone(), "past": [list(p) for p in self._past]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned; of an empty one, keep nothing of before. Raises ValueError for another
        number of worlds."""
        self._past.clear()
        if state:
            self._begun = restored("retries.begun", state["begun"], self._begun)
            self._step = state["step"]
            self._past = deque(((step, past) for step, past in state["past"]), maxlen=KEPT)


def take_over(present: Any, past: Any, ids: torch.Tensor, num_envs: int) -> None:
    """Overwrite worlds `ids` of all tensors of `num_envs` worlds in `present`, nested dicts and lists, with those of
    `past`. Worlds come first, but second in `UpperBody.PAIRED`."""
    if isinstance(present, torch.Tensor):
        if present.ndim and len(present) == num_envs:
            present[ids] = past.to(present)[ids]
    elif isinstance(present, dict):
        for name, value in present.items():
            if name in UpperBody.PAIRED:
                value[:, ids] = past[name].to(value)[:, ids]
            else:
                take_over(value, past[name], ids, num_envs)
    elif isinstance(present, list):
        for value, old in zip(present, past, strict=True):
            take_over(value, old, ids, num_envs)
