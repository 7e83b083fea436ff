"""Collects steps into a recording."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from cotap.evaluation.recording import SCENE, Recording
from cotap.evaluation.rollout import STEPPED, Trajectory
from cotap.play.sample import Sample

MAX_SECONDS = 600.0
"""A recording ends by itself after this long, so that a forgotten one does not fill the memory [s]."""


class Recorder:
    """Keeps every step from its making on, and every setting that changed with the time of its change.

    Args:
        dt: Control step [s].
        count: How many robots, from the first on, are kept.
        about: What `Session.describe` returns.
    """

    def __init__(self, dt: float, count: int, about: dict[str, Any]) -> None:
        self._dt, self._count, self._about = dt, count, about
        self._samples: list[Sample] = []
        self._changes: list[dict[str, Any]] = []

    @property
    def seconds(self) -> float:
        """Length so far [s]."""
        return len(self._samples) * self._dt

    @property
    def full(self) -> bool:
        """Whether it has its greatest length."""
        return self.seconds >= MAX_SECONDS

    def append(self, sample: Sample, changes: dict[str, Any]) -> None:
        """Add a step, and the settings that changed just before it."""
        kept = {name: value for name, value in changes.items() if not name.endswith(".drag")}
        if kept:
            self._changes.append({"time": self.seconds, "values": kept})
        self._samples.append({name: np.array(value[: self._count]) for name, value in sample.items()})

    def finish(self) -> Recording:
        """All that was kept. Raises ValueError if there is not one step."""
        if not self._samples:
            raise ValueError("nothing was recorded: no step was made between start and stop")
        stacked = {name: np.stack([s[name] for s in self._samples]) for name in self._samples[0]}
        trajectory = Trajectory(dt=self._dt, **{name: torch.from_numpy(stacked[name]) for name in STEPPED})
        return Recording(trajectory, {n: stacked[n] for n in SCENE}, self._about | {"changes": self._changes})


def samples_of(recording: Recording) -> list[Sample]:
    """A recording's steps, one by one, as the page shows them."""
    t = recording.trajectory
    columns = {name: getattr(t, name).numpy() for name in STEPPED} | recording.scene
    return [{name: value[i] for name, value in columns.items()} for i in range(len(t.fell))]
