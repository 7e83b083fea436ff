"""The environment as Gymnasium sees it: `gymnasium.make_vec("CoTaP/H1-v0", num_envs=64)`, or one env with `make`.

Every robot that ships has such an id.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from cotap.checks import require_one_of
from cotap.envs.config import HumanoidEnvConfig
from cotap.envs.humanoid_env import HumanoidEnv


def _config(cfg: HumanoidEnvConfig | None, num_envs: int, fields: dict[str, Any]) -> HumanoidEnvConfig:
    """A config of the caller's own making, copied so that neither side surprises the other."""
    known = [f.name for f in dataclasses.fields(HumanoidEnvConfig)]
    for name in fields:
        require_one_of("field of HumanoidEnvConfig", name, known)
    return copy.deepcopy(dataclasses.replace(cfg or HumanoidEnvConfig(), **fields, num_envs=num_envs))


def _built(cfg: HumanoidEnvConfig) -> HumanoidEnv:
    env = HumanoidEnv(cfg)
    env.keeps_final_observation = True
    return env


def _spaces(envs: HumanoidEnv) -> tuple[Box, Box]:
    """Observation and action space of one env."""
    clip = envs.cfg.actions.clip
    width = envs.get_observations()["policy"].shape[1]
    return (
        Box(-np.inf, np.inf, (width,), np.float32),
        Box(-clip, clip, (envs.num_actions,), np.float32),
    )


class HumanoidVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N robots in one batch: observations (N, O), actions (N, J), rewards (N,) the sum of both agents'. Arrays are
    on the CPU whatever the backend.

    Falls terminate an episode, its length truncates it. Ended envs restart within the step (autoreset SAME_STEP): the
    observation is the new episode's first, `infos["final_obs"]` has the old one's last, and
    `infos["final_info"]["diverged"]` tells which envs ended because their state stopped being a number; the
    `final_obs` of those is the observation before. `infos["group_rewards"]` (N, 2) has each agent's reward.

    Without a seed, the first reset follows `cfg.seed`, and later ones go on with the same random numbers.

    Args:
        num_envs: Number of envs; `cfg.num_envs` gives way to it.
        cfg: The environment's config, default `HumanoidEnvConfig()`; copied.
        **cfg_fields: Fields of `HumanoidEnvConfig` to replace in `cfg`.

    Raises:
        ValueError: a field is unknown or out of its range.
    """

    def __init__(self, num_envs: int = 1, cfg: HumanoidEnvConfig | None = None, **cfg_fields: Any) -> None:
        self.envs = _built(_config(cfg, num_envs, cfg_fields))
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.single_observation_space, self.single_action_space = _spaces(self.envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002 - Gymnasium's interface; there are none
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Restart every env. With a seed, all starts over: bodies, curricula and random numbers too."""
        super().reset(seed=seed)
        self.envs = _restarted(self.envs, seed)
        return self.envs.get_observations()["policy"].cpu().numpy().copy(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance by one control step. Raises ValueError if actions (N, J) have another shape or are not finite."""
        observations, rewards, done, extras = self.envs.step(
            torch.as_tensor(np.asarray(actions, dtype=np.float32), device=self.envs.device)
        )
        everyone = np.ones(self.num_envs, dtype=bool)
        infos: dict[str, Any] = {"group_rewards": extras["group_rewards"].cpu().numpy(), "_group_rewards": everyone}
        if done.any():
            infos |= self._final_infos(done.cpu().numpy())
        return (
            observations["policy"].cpu().numpy().copy(),
            rewards.double().cpu().numpy(),
            extras["falls"].cpu().numpy(),
            extras["time_outs"].cpu().numpy(),
            infos,
        )

    def _final_infos(self, done: np.ndarray) -> dict[str, Any]:
        last = self.envs.final_observation.cpu().numpy()
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in done.nonzero()[0]:
            final_obs[i] = last[i].copy()
        diverged_envs = {"diverged": self.envs.diverged.cpu().numpy(), "_diverged": done.copy()}
        return {
            "final_obs": final_obs,
            "_final_obs": done.copy(),
            "final_info": diverged_envs,
            "_final_info": done.copy(),
        }


class HumanoidSingleEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot: observation (O,), action (J,), reward the sum of both agents'. Arguments as of `HumanoidVectorEnv`.

    Unseeded copies are alike: `reset(seed=...)` tells them apart.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, cfg: HumanoidEnvConfig | None = None, **cfg_fields: Any) -> None:
        self.envs = _built(_config(cfg, 1, cfg_fields))
        self.observation_space, self.action_space = _spaces(self.envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new episode. With a seed, all starts over: the body, the curriculum and the random numbers too."""
        super().reset(seed=seed, options=options)
        self.envs = _restarted(self.envs, seed)
        return self.envs.get_observations()["policy"][0].cpu().numpy().copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one control step; the observation that ends an episode is still of that episode."""
        row = torch.as_tensor(np.asarray(action, dtype=np.float32), device=self.envs.device).unsqueeze(0)
        observations, rewards, done, extras = self.envs.step(row)
        last = self.envs.final_observation if done[0] else observations["policy"]
        info = {
            "group_rewards": extras["group_rewards"][0].cpu().numpy(),
            "diverged": bool(done[0] & self.envs.diverged[0]),
        }
        return (
            last[0].cpu().numpy().copy(),
            float(rewards[0]),
            bool(extras["falls"][0]),
            bool(extras["time_outs"][0]),
            info,
        )


def _restarted(envs: HumanoidEnv, seed: int | None) -> HumanoidEnv:
    """`envs` after a restart of all, or new ones if there is a seed, so that a seed decides everything."""
    if seed is not None:
        return _built(dataclasses.replace(envs.cfg, seed=seed))
    envs.reset()
    return envs
