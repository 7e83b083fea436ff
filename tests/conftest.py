"""What all tests share: one thread, so that results repeat and parallel workers do not crowd each other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch

from cotap.envs import H1Env, H1EnvConfig
from cotap.robots import RobotSpec, h1
from cotap.robots.mjcf import build_model

torch.set_num_threads(1)


@pytest.fixture
def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def spec() -> RobotSpec:
    return h1()


@pytest.fixture(scope="session")
def model(spec: RobotSpec) -> mujoco.MjModel:
    return build_model(spec)


@pytest.fixture
def in_tmp_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where MuJoCo may write its log of a divergence that a test provokes."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def make_env() -> Callable[..., H1Env]:
    """Builds a small environment; keyword arguments are fields of H1EnvConfig."""

    def make(num_envs: int = 4, **fields: Any) -> H1Env:
        return H1Env(H1EnvConfig(num_envs=num_envs, num_threads=1, **fields))

    return make
