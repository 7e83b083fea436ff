"""Small networks that judge a state, fitted by scripts and shipped as weights beside this file."""

from __future__ import annotations

import io
from importlib import resources
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import nn

from cotap.files import write_arrays
from cotap.robots import RobotSpec


def perceptron(*widths: int) -> nn.Sequential:
    """Linear layers of these widths, ELU between them."""
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += (nn.Linear(before, after), nn.ELU())
    return nn.Sequential(*layers[:-1])


def load_shipped(net: nn.Module, file: str, what: str, spec: RobotSpec) -> None:
    """Give `net` the shipped weights.

    Args:
        net: The network.
        file: Name of the weights' file.
        what: What was fitted, for the error.
        spec: The robot.

    Raises:
        ValueError: the weights are for another number of joints.
    """
    stored = resources.files("cotap.envs").joinpath(file).read_bytes()
    with np.load(io.BytesIO(stored), allow_pickle=False) as weights:
        state = {k: torch.tensor(weights[k].astype(np.float32)) for k in weights.files}
    try:
        net.load_state_dict(state, assign=True)
    except RuntimeError as error:
        raise ValueError(f"{what} was fitted for another robot than {spec.name!r}: {error}") from error


def save_weights(net: nn.Module, path: Path) -> None:
    """Write weights as they are shipped, in half precision, whole or not at all."""
    write_arrays(path, {k: v.half().numpy() for k, v in net.state_dict().items()})
