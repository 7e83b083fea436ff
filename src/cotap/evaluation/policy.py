"""Policies from checkpoints, the shipped ones by name."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch

from cotap.agents.actors import AgentLayout, DualActorCritic
from cotap.agents.checkpoint import (
    MALFORMED,
    CheckpointError,
    load_checkpoint,
    load_weights,
    require_layout,
    require_parts,
)
from cotap.checks import quoted, reason_of, require_one_of, require_positive_int
from cotap.configs import from_plain
from cotap.configs.saved import without_unknown_terms
from cotap.envs import HumanoidEnvConfig
from cotap.robots import ROBOTS

CHECKPOINTS = ("h1-base", "h1-cotap", "g1-base", "g1-cotap")
"""Names under which policies are shipped: robot and stage."""


def checkpoint_path(name: str) -> Path:
    """Where the package has, or would have, the checkpoint of this name. Raises ValueError for an unknown one."""
    require_one_of("checkpoint", name, CHECKPOINTS)
    return Path(str(files("cotap").joinpath("checkpoints", f"{name}.pt")))


def shipped_names() -> list[str]:
    """The checkpoints that come with this package."""
    return [name for name in CHECKPOINTS if checkpoint_path(name).is_file()]


def shipped_checkpoint(name: str = "h1-base") -> Path:
    """Path of a checkpoint that comes with the package. Raises ValueError for one that does not."""
    path = checkpoint_path(name)
    if not path.is_file():
        raise ValueError(f"checkpoint {name!r} is not shipped; shipped are: {', '.join(shipped_names())}")
    return path


def shipped_policy(robot: str, stages: tuple[str, ...] = ("cotap", "base")) -> Path:
    """Path of what ships of a robot, of the first of `stages` of which there is something. Raises ValueError for an
    unknown robot, and where there is nothing."""
    require_one_of("robot", robot, ROBOTS)
    shipped = shipped_names()
    for name in (f"{robot}-{stage}" for stage in stages):
        if name in shipped:
            return shipped_checkpoint(name)
    wanted = "base policy" if stages == ("base",) else "policy"
    raise ValueError(f"no {wanted} of robot {robot!r} is shipped; shipped are: {', '.join(shipped) or 'none'}")


def find_policy(checkpoint: str, robot: str) -> Path:
    """The file of a policy: as `find_checkpoint` of `checkpoint`, or, if that is empty, what ships of `robot`, which by
    default is that of an environment.

    Raises:
        ValueError: there is none, or `checkpoint` is of another robot than `robot`.
    """
    if not checkpoint:
        return shipped_policy(robot or HumanoidEnvConfig.robot)
    path = find_checkpoint(checkpoint)
    if robot:
        require_robot(checkpoint, load_policy(path).env_config.robot, robot)
    return path


def require_robot(checkpoint: str, own: str, robot: str) -> None:
    """Raise ValueError unless a checkpoint's `own` robot is the one that was asked for."""
    if own != robot:
        raise ValueError(f"checkpoint {checkpoint!r} is of robot {own!r}, not of {robot!r} (--robot)")


def find_checkpoint(given: str) -> Path:
    """The file that is meant by a path or by the name of a shipped one. Raises ValueError for a name not shipped."""
    path = Path(given)
    if given in CHECKPOINTS:
        return shipped_checkpoint(given)
    if not path.exists() and path.name == given and not path.suffix:
        raise ValueError(f"checkpoint {quoted(given)} does not exist; shipped are: {', '.join(shipped_names())}")
    return path


@dataclass(frozen=True)
class Policy:
    """A trained policy, in float32, with what it was trained for."""

    model: DualActorCritic
    layout: dict[str, Any]
    stage: str
    _env_config: HumanoidEnvConfig

    @property
    def env_config(self) -> HumanoidEnvConfig:
        """The environment that it was trained in, simulated by whatever there is here; a copy, free to be changed."""
        return copy.deepcopy(self._env_config)

    def to(self, device: torch.device | str) -> Policy:
        """The same policy, its networks moved to `device`."""
        self.model.to(device)
        return self

    @torch.no_grad()
    def __call__(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Deterministic actions (N, A) of raw observations."""
        return self.model(observations)


def load_policy(path: Path | str) -> Policy:
    """Load a checkpoint's networks for use, and the environment's config.

    Raises:
        CheckpointError: the file cannot be used.
    """
    content = load_checkpoint(path)
    require_parts(path, content, ("layout", "model", "agents", "config", "kind"))
    env_config = _env_config_of(path, content)
    layout, weights, agents = content["layout"], content["model"], content["agents"]
    try:
        widths = content["config"]["training"]["ppo"]["hidden"]
        hidden = tuple(require_positive_int(f"ppo.hidden[{i}]", width) for i, width in enumerate(widths))
        networks = AgentLayout.from_plain(agents)
        _require_fitting(networks, layout)
        if networks.num_weights(hidden) > sum(value.numel() for value in weights.values()):
            raise ValueError(f"ppo.hidden {quoted(hidden)} takes more weights than there are")
        model = DualActorCritic(networks, hidden, 1.0)
        load_weights(model, weights)
    except MALFORMED as error:
        raise CheckpointError(
            f"checkpoint {str(path)!r} has networks that do not fit its config: {reason_of(error)}"
        ) from error
    model.eval()
    return Policy(model, layout, content["kind"], env_config)


def require_acting(path: Path | str, policy: Policy, layout: dict[str, Any]) -> None:
    """Raise CheckpointError unless `policy`, from `path`, can act in an environment of this layout; what only critics
    see may differ."""
    require_layout(path, policy.layout, {key: value for key, value in layout.items() if key != "critic_terms"})


def _require_fitting(networks: AgentLayout, layout: dict[str, Any]) -> None:
    """Raise ValueError unless actors read the observation that `layout` tells of, and move its joints in order, and
    perhaps its laws."""
    width = layout["history"] * sum(width for _, width, _ in layout["terms"])
    if networks.obs_groups["actor"] != ["policy"] or networks.width("actor") != width:
        raise ValueError(f"actors do not read the layout's observation of {width} numbers alone")
    parts = networks.action_slices.values()
    count = len(layout["joints"]) + len(layout.get("modulation", {}).get("targets", []))
    if [*(s.start for s in parts), count] != [0, *(s.stop for s in parts)]:
        raise ValueError(
            f"actions of {networks.action_slices} are not those of {len(layout['joints'])} joints in order"
        )


def _env_config_of(path: Path | str, content: dict[str, Any]) -> HumanoidEnvConfig:
    try:
        env, _ = without_unknown_terms(content["config"]["training"]["env"])  # evaluations use no reward weights
        cfg = from_plain(HumanoidEnvConfig, env)
        cfg.backend = "auto"  # the one it was trained on may not be installed here
        cfg.check()
    except MALFORMED as error:
        raise CheckpointError(
            f"checkpoint {str(path)!r} has no usable environment config: {reason_of(error)}"
        ) from error
    return cfg
