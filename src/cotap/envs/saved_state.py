"""What the environment's future depends on, to save and to go on from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import torch
from tensordict import TensorDict

from cotap.persistence import on_processor, restored
from cotap.sim import Snapshot

if TYPE_CHECKING:
    from cotap.envs.humanoid_env import HumanoidEnv

PARTS = ("commands", "motions", "path", "upper_body", "randomizer", "actuation", "observer", "recorder")
"""Parts of the environment that remember something, the sources of external forces aside."""


def env_state(env: HumanoidEnv) -> dict[str, Any]:
    """All that the environment's future depends on, on the CPU whatever the device."""
    return on_processor({
        "sim": vars(env.sim.snapshot()),
        "parts": {name: part.state_dict() for name, part in _parts(env).items()},
        "episode_length": env.episode_length_buf.clone(),
        "torque": env.torque,
        "observations": dict(env.get_observations().items()),
        "curriculum": env.curriculum.state_dict(),
        "counters": {"samples": env.samples, "num_diverged": env.num_diverged},
        "rng": env.rng.get_state(),
    })  # fmt: skip


def restore_env(env: HumanoidEnv, state: dict[str, Any]) -> TensorDict:
    """Put the environment where `env_state` was taken, and return its observations there.

    Raises:
        ValueError: the state is of another number of envs, or of an environment of another layout.
    """
    env.sim.restore(Snapshot(**state["sim"]))
    for name, part in _parts(env).items():
        part.load_state_dict(state["parts"][name])
    env.episode_length_buf = restored("episode_length", state["episode_length"], env.episode_length_buf)
    env.torque = restored("torque", state["torque"], env.torque)
    env.curriculum.load_state_dict(state["curriculum"])
    env.samples = state["counters"]["samples"]
    env.num_diverged = state["counters"]["num_diverged"]
    if state["rng"].shape == env.rng.get_state().shape:  # of the same kind of device
        env.rng.set_state(state["rng"].cpu())
    present = {k: cast(torch.Tensor, v) for k, v in env.get_observations().items()}
    saved = {k: restored(f"observations.{k}", state["observations"][k], v) for k, v in present.items()}
    return TensorDict(cast(Any, saved), batch_size=[env.num_envs])


def _parts(env: HumanoidEnv) -> dict[str, Any]:
    return {name: getattr(env, name) for name in PARTS} | env.forces.parts
