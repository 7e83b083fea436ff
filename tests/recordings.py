"""A recording as small as one can be."""

from __future__ import annotations

import torch

from cotap.evaluation.recording import EVENTS, SCENE, TRAJECTORY, Recording
from cotap.evaluation.rollout import Trajectory

SIZES = {"T": 6, "N": 2, "U": 8, "J": 19, "H": 2, "F": 2, "Q": 26}


def small_recording() -> Recording:
    """Two robots for a tenth of a second; numbers of no meaning, kinds and shapes as they are recorded."""

    def zeros(shape: tuple[str | int, ...], dtype: torch.dtype) -> torch.Tensor:
        return torch.zeros([SIZES.get(d, d) if isinstance(d, str) else d for d in ("T", "N", *shape)], dtype=dtype)

    kinds = {name: torch.bool if name in EVENTS else torch.float32 for name in TRAJECTORY}
    fields = {name: zeros(shape, kinds[name]) for name, shape in TRAJECTORY.items()}
    scene = {name: zeros(shape, torch.float64).numpy() for name, shape in SCENE.items()}
    about = {"robot": "h1", "sides": ["left", "right"], "gait_period_s": 0.8, "changes": [[0, {"k": 300.0}]]}
    return Recording(Trajectory(dt=0.02, **fields), scene, about)
