"""What tests of the environment share: driving it, reading its observations, and MuJoCo's word for what it does."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator

import mujoco
import numpy as np
import torch

from cotap.envs import HumanoidEnv
from cotap.envs.observations import NoiseConfig, ObservationConfig
from cotap.envs.randomization import RandomizationConfig
from cotap.motions.generator import MotionConfig
from cotap.motions.reference import ClipConfig, ReferenceConfig

STILL = ReferenceConfig(MotionConfig(hold=1.0, reach=0.0, punch=0.0, wave=0.0, swing=0.0), ClipConfig(share=0.0))
NOMINAL = RandomizationConfig(enabled=False)
NOISY = ObservationConfig(noise=NoiseConfig(enabled=True))
ON_ITS_SIDE = torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0], dtype=torch.float64)


def zeros(env: HumanoidEnv) -> torch.Tensor:
    return torch.zeros(env.num_envs, env.num_actions)


def actions(env: HumanoidEnv, seed: int = 0, scale: float = 0.3) -> Iterator[torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    while True:
        yield scale * torch.randn(env.num_envs, env.num_actions, generator=rng)


def drive(env: HumanoidEnv, steps: int, seed: int = 0, scale: float = 0.3) -> list[torch.Tensor]:
    """Actors' observations over `steps` of random actions."""
    return [env.step(a)[0]["policy"] for a, _ in zip(actions(env, seed, scale), range(steps), strict=False)]


def rollout(env: HumanoidEnv, steps: int, seed: int = 0, scale: float = 0.3) -> tuple[torch.Tensor, torch.Tensor]:
    """All that agents see and get over `steps`, (steps, N, -1), and which envs ended, (steps, N)."""
    seen, ended = [], []
    for action, _ in zip(actions(env, seed, scale), range(steps), strict=False):
        obs, reward, done, extras = env.step(action)
        groups = [obs[name] for name in sorted(obs.keys())]
        seen.append(torch.cat((*groups, reward[:, None], done[:, None], extras["group_rewards"]), 1))
        ended.append(done)
    return torch.stack(seen), torch.stack(ended)


def knock_over(env: HumanoidEnv, index: int) -> None:
    """Lay a robot on its side in mid-air, where nothing touches it."""
    env.sim.qpos[index, 3:7] = ON_ITS_SIDE


def history_of(env: HumanoidEnv, policy: torch.Tensor) -> dict[str, torch.Tensor]:
    """The actors' terms (N, steps, width), oldest first, scales undone."""
    out, start, steps = {}, 0, env.observer.history.steps
    for name, width, scale in env.observer.history.terms:
        out[name] = policy[:, start : start + steps * width].unflatten(1, (steps, width)) / scale
        start += steps * width
    assert start == policy.shape[1]
    return out


def newest(env: HumanoidEnv, policy: torch.Tensor) -> dict[str, torch.Tensor]:
    """The present values of the actors' terms, scales undone."""
    return {name: values[:, -1] for name, values in history_of(env, policy).items()}


def one_step(env: HumanoidEnv, present: torch.Tensor) -> dict[str, torch.Tensor]:
    """Terms of an observation of one step, scales undone."""
    widths = [width for _, width, _ in env.observer.history.terms]
    values = present.split(widths, 1)
    return {name: v / scale for (name, _, scale), v in zip(env.observer.history.terms, values, strict=True)}


def privileged(env: HumanoidEnv, observed: torch.Tensor) -> dict[str, torch.Tensor]:
    """What critics alone see, by term, scales undone."""
    terms = env.observer.layout()["critic_terms"]
    values = observed.split([width for _, width, _ in terms], 1)
    return {name: v / scale for (name, _, scale), v in zip(terms, values, strict=True)}


def mujoco_of(env: HumanoidEnv, index: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """One env, in MuJoCo itself: its masses, gains, state and controls, and all that follows from them."""
    model = copy.copy(env.sim.model)
    for name in ("geom_friction", "body_mass", "body_inertia", "actuator_biasprm"):
        getattr(model, name)[:] = env.sim.field(name)[index].numpy()
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    data.qpos[:], data.qvel[:], data.ctrl[:] = env.sim.qpos[index], env.sim.qvel[index], env.sim.ctrl[index]
    mujoco.mj_forward(model, data)
    return model, data


def felt(model: mujoco.MjModel, data: mujoco.MjData, xfrc: torch.Tensor) -> np.ndarray:
    """Generalised forces (nv,) of wrenches (bodies, 6) at the bodies' centres of mass."""
    out = np.zeros(model.nv)
    for body, wrench in enumerate(xfrc.double().numpy()):
        mujoco.mj_applyFT(model, data, wrench[:3], wrench[3:], data.xipos[body], body, out)
    return out


def at_point(model: mujoco.MjModel, data: mujoco.MjData, body: str, point_w, force_w) -> np.ndarray:
    """Generalised forces (nv,) of a force at a point of a body, all in the world frame."""
    out = np.zeros(model.nv)
    force = np.asarray(force_w, dtype=np.float64)
    mujoco.mj_applyFT(model, data, force, np.zeros(3), np.asarray(point_w), model.body(body).id, out)
    return out


def hold_still(env: HumanoidEnv, stand: float = 1.0) -> None:
    """Commands at rest at nominal height and arms in the default pose, until further notice."""
    n = env.num_envs
    env.commands.override(
        torch.zeros(n, 2), torch.zeros(n), torch.full((n,), stand), torch.full((n,), env.spec.nominal_height_m)
    )
    env.motions.hold(env.motions.default)
