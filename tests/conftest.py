"""What all tests share: one thread, so that results repeat and parallel workers do not crowd each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import pytest
import torch
from robots.made_up import made_up

from cotap.robots import ROBOTS, RobotSpec, h1
from cotap.robots.mjcf import build_model

if TYPE_CHECKING:
    from cotap.envs import HumanoidEnv

torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def made_up_is_known() -> Iterator[None]:
    """The made-up humanoid goes by its name, as every robot."""
    ROBOTS["made-up"] = made_up
    yield
    del ROBOTS["made-up"]


@pytest.fixture
def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def spec() -> RobotSpec:
    return h1()


@pytest.fixture(scope="session")
def model(spec: RobotSpec) -> mujoco.MjModel:
    return build_model(spec)


@pytest.fixture(scope="session", params=[*ROBOTS, "made-up"])
def robot(request: pytest.FixtureRequest) -> str:
    """The name of every robot that ships, and of the made-up one, in turn."""
    return request.param


@pytest.fixture(scope="session")
def any_spec(robot: str) -> RobotSpec:
    return ROBOTS[robot]()


@pytest.fixture(scope="session")
def any_model(any_spec: RobotSpec) -> mujoco.MjModel:
    return build_model(any_spec)


@pytest.fixture
def in_tmp_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where MuJoCo may write its log of a divergence that a test provokes."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def make_env() -> Callable[..., HumanoidEnv]:
    """Builds a small environment; keyword arguments are fields of HumanoidEnvConfig."""
    from cotap.envs import HumanoidEnv, HumanoidEnvConfig

    def make(num_envs: int = 4, **fields: Any) -> HumanoidEnv:
        return HumanoidEnv(HumanoidEnvConfig(num_envs=num_envs, num_threads=1, **fields))

    return make
