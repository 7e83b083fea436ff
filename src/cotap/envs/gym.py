"""The environment as Gymnasium sees it: `gymnasium.make_vec("CoTaP/H1-v0", num_envs=64)`, or one world with `make`."""

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
from cotap.envs.h1_env import H1Env, H1EnvConfig
from cotap.envs.terminations import diverged


class _Worlds(H1Env):
    """H1Env that keeps the last observation of ended worlds, which Gymnasium asks for, before they restart."""

    def step(self, actions: torch.Tensor) -> Any:
        """As `H1Env.step`; afterwards `final_observation` (N, width) holds in the rows of ended worlds."""
        self.final_observation = self._observations["policy"]
        self.diverged = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        return super().step(actions)

    def _finish(self, done: torch.Tensor, fell: torch.Tensor) -> None:
        super()._finish(done, fell)
        before, random_state = self._observations, self.rng.get_state()
        histories = self.history.buffer, self._clean_history.buffer
        self._observe(torch.zeros_like(done))
        self.diverged = diverged(self.sim.qpos, self.sim.qvel)
        # A diverged world has no observation to show; the one before stands for it, and the info says so.
        self.final_observation = torch.where(self.diverged.unsqueeze(1), before["policy"], self._observations["policy"])
        self._observations = before
        self.history.buffer, self._clean_history.buffer = histories
        self.rng.set_state(random_state)


def _config(cfg: H1EnvConfig | None, num_envs: int, fields: dict[str, Any]) -> H1EnvConfig:
    """A config of the caller's own making, copied so that neither side surprises the other."""
    known = [f.name for f in dataclasses.fields(H1EnvConfig)]
    for name in fields:
        require_one_of("field of H1EnvConfig", name, known)
    return copy.deepcopy(dataclasses.replace(cfg or H1EnvConfig(), **fields, num_envs=num_envs))


def _spaces(worlds: H1Env) -> tuple[Box, Box]:
    """Observation and action space of one world."""
    clip = worlds.cfg.actions.clip
    width = worlds.history.width * worlds.history.steps
    return (
        Box(-np.inf, np.inf, (width,), np.float32),
        Box(-clip, clip, (worlds.num_actions,), np.float32),
    )


class H1VectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N robots in one batch: observations (N, 430), actions (N, 19), rewards (N,) the sum of both agents'. Arrays are
    on the processor whatever the backend.

    Falls terminate an episode, its length truncates it. Ended worlds restart within the step (autoreset SAME_STEP): the
    observation is the new episode's first, `infos["final_obs"]` has the old one's last, and
    `infos["final_info"]["diverged"]` tells which worlds ended because their state stopped being a number; the
    `final_obs` of those is the observation before. `infos["group_rewards"]` (N, 2) has each agent's reward.

    Without a seed, the first reset follows `cfg.seed`, and later ones go on with the same random numbers.

    Args:
        num_envs: Number of worlds; `cfg.num_envs` gives way to it.
        cfg: The environment's config, default `H1EnvConfig()`; copied.
        **cfg_fields: Fields of `H1EnvConfig` to replace in `cfg`.

    Raises:
        ValueError: a field is unknown or out of its range.
    """

    def __init__(self, num_envs: int = 1, cfg: H1EnvConfig | None = None, **cfg_fields: Any) -> None:
        self.worlds = _Worlds(_config(cfg, num_envs, cfg_fields))
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.single_observation_space, self.single_action_space = _spaces(self.worlds)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,  # noqa: ARG002 - Gymnasium's interface; there are none
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Restart every world. With a seed, all starts over: bodies, curricula and random numbers too."""
        super().reset(seed=seed)
        self.worlds = _restarted(self.worlds, seed)
        return self.worlds.get_observations()["policy"].cpu().numpy().copy(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance by one control step. Raises ValueError if actions (N, 19) have another shape or are not finite."""
        observations, rewards, done, extras = self.worlds.step(
            torch.as_tensor(np.asarray(actions, dtype=np.float32), device=self.worlds.device)
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
        last = self.worlds.final_observation.cpu().numpy()
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in done.nonzero()[0]:
            final_obs[i] = last[i].copy()
        diverged_worlds = {"diverged": self.worlds.diverged.cpu().numpy(), "_diverged": done.copy()}
        return {
            "final_obs": final_obs,
            "_final_obs": done.copy(),
            "final_info": diverged_worlds,
            "_final_info": done.copy(),
        }


class H1SingleEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot: observation (430,), action (19,), reward the sum of both agents'. Arguments as of `H1VectorEnv`.

    Unseeded copies are alike: `reset(seed=...)` tells them apart.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, cfg: H1EnvConfig | None = None, **cfg_fields: Any) -> None:
        self.worlds = _Worlds(_config(cfg, 1, cfg_fields))
        self.observation_space, self.action_space = _spaces(self.worlds)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new episode. With a seed, all starts over: the body, the curriculum and the random numbers too."""
        super().reset(seed=seed, options=options)
        self.worlds = _restarted(self.worlds, seed)
        return self.worlds.get_observations()["policy"][0].cpu().numpy().copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one control step; the observation that ends an episode is still of that episode."""
        row = torch.as_tensor(np.asarray(action, dtype=np.float32), device=self.worlds.device).unsqueeze(0)
        observations, rewards, done, extras = self.worlds.step(row)
        last = self.worlds.final_observation if done[0] else observations["policy"]
        info = {"group_rewards": extras["group_rewards"][0].cpu().numpy(), "diverged": bool(self.worlds.diverged[0])}
        return (
            last[0].cpu().numpy().copy(),
            float(rewards[0]),
            bool(extras["falls"][0]),
            bool(extras["time_outs"][0]),
            info,
        )


def _restarted(worlds: _Worlds, seed: int | None) -> _Worlds:
    """`worlds` after a restart of all, or new ones if there is a seed, so that a seed decides everything."""
    if seed is not None:
        return _Worlds(dataclasses.replace(worlds.cfg, seed=seed))
    worlds.reset()
    return worlds
