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
from tensordict import TensorDict

from cotap.checks import quoted, require_one_of
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

    Falls terminate an episode, its length truncates it. What follows is Gymnasium's, by `autoreset_mode`:

    - SAME_STEP: ended envs restart within the step. The observation is the new episode's first, `infos["final_obs"]`
      has the old one's last, and `infos["final_info"]["diverged"]` tells which envs ended because their state stopped
      being a number; the `final_obs` of those is the observation before.
    - NEXT_STEP, which Gymnasium's observation wrappers ask for: the observation is the old episode's last,
      `infos["diverged"]` as above, and the next step restarts the env, whatever its action, with reward 0.
    - DISABLED: as NEXT_STEP, but it is for the caller to restart ended envs, by `reset(options={"reset_mask": ...})`.

    `infos["group_rewards"]` (N, 2) has each agent's reward. Without a seed, the first reset follows `cfg.seed`, and
    later ones go on with the same random numbers.

    Args:
        num_envs: Number of envs; `cfg.num_envs` gives way to it.
        cfg: The environment's config, default `HumanoidEnvConfig()`; copied.
        autoreset_mode: When ended envs restart; one of Gymnasium's, or its value, such as "NextStep".
        **cfg_fields: Fields of `HumanoidEnvConfig` to replace in `cfg`.

    Raises:
        ValueError: a field is unknown or out of its range, or there is no such mode.
    """

    def __init__(
        self, num_envs: int = 1, cfg: HumanoidEnvConfig | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP, **cfg_fields: Any,
    ) -> None:  # fmt: skip
        modes = {mode.value: mode for mode in AutoresetMode}
        name = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        self._mode = modes[require_one_of("autoreset_mode", name, modes)]
        self.envs = _built(_config(cfg, num_envs, cfg_fields))
        self.num_envs = num_envs
        self._ended = torch.zeros(num_envs, dtype=torch.bool, device=self.envs.device)
        self.metadata = {"autoreset_mode": self._mode, "render_modes": []}
        self.single_observation_space, self.single_action_space = _spaces(self.envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Restart every env, or those of `options["reset_mask"]` (N,) bool; the others keep their observations. With a
        seed, all starts over: bodies, curricula and random numbers too.

        Raises:
            ValueError: the mask is no such array, has nobody or comes with a seed, or there is another option.
        """
        _require_options(options, ("reset_mask",))
        super().reset(seed=seed)
        if options and "reset_mask" in options:
            mask = torch.as_tensor(_mask(options["reset_mask"], self.num_envs, seed), device=self.envs.device)
            _begin_anew(self.envs, mask)
            self._ended = self._ended & ~mask
        else:
            self.envs = _restarted(self.envs, seed)
            self._ended = torch.zeros_like(self._ended)
        return self.envs.get_observations()["policy"].cpu().numpy().copy(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance by one control step. Raises ValueError if actions (N, A) have another shape or are not finite."""
        sent, waiting = torch.as_tensor(np.asarray(actions, dtype=np.float32), device=self.envs.device), self._ended
        if waiting.any() and sent.shape == (self.num_envs, self.envs.num_actions):
            sent = torch.where(waiting.unsqueeze(1), torch.zeros_like(sent), sent)
        observations, rewards, done, extras = self.envs.step(sent)
        seen, done = observations["policy"], done & ~waiting
        if self._mode != AutoresetMode.SAME_STEP and done.any():
            seen = torch.where(done.unsqueeze(1), self.envs.final_observation, seen)
        if waiting.any():  # the step was for the others
            begun = _begin_anew(self.envs, waiting)
            seen = torch.where(waiting.unsqueeze(1), begun, seen)
        if self._mode == AutoresetMode.NEXT_STEP:
            self._ended = done
        group_rewards = torch.where(waiting.unsqueeze(1), 0.0, extras["group_rewards"])
        infos = {"group_rewards": group_rewards.cpu().numpy(), "_group_rewards": np.ones(self.num_envs, dtype=bool)}
        return (
            seen.cpu().numpy().copy(),
            torch.where(waiting, 0.0, rewards.double()).cpu().numpy(),
            (extras["falls"] & ~waiting).cpu().numpy(),
            (extras["time_outs"] & ~waiting).cpu().numpy(),
            infos | (self._final_infos(done.cpu().numpy()) if done.any() else {}),
        )

    def _final_infos(self, done: np.ndarray) -> dict[str, Any]:
        diverged_envs = {"diverged": self.envs.diverged.cpu().numpy() & done, "_diverged": done.copy()}
        if self._mode != AutoresetMode.SAME_STEP:
            return diverged_envs
        last = self.envs.final_observation.cpu().numpy()
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in done.nonzero()[0]:
            final_obs[i] = last[i].copy()
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
        """Start a new episode. With a seed, all starts over: the body, the curriculum and the random numbers too.
        Raises ValueError for options: there are none."""
        _require_options(options, ())
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


def _begin_anew(envs: HumanoidEnv, mask: torch.Tensor) -> torch.Tensor:
    """Restart the envs of `mask` (N,) alone; for the others no time passes. Returns observations (N, O)."""
    observer, seen = envs.observer, dict(envs.get_observations().items())
    before = observer.state_dict()
    envs._restart(mask)
    begun = dict(envs._observe(mask).items())
    observer.load_state_dict(_merged(before, observer.state_dict(), mask))
    envs._observations = TensorDict(_merged(seen, begun, mask), batch_size=[envs.num_envs])
    return envs.get_observations()["policy"]


def _merged(old: Any, new: Any, mask: torch.Tensor) -> Any:
    """Tables of tensors (N, ...): `new` in the envs of `mask` (N,), `old` in the others."""
    if isinstance(old, dict):
        return {name: _merged(value, new[name], mask) for name, value in old.items()}
    return torch.where(mask.reshape(-1, *[1] * (old.dim() - 1)), new, old)


def _require_options(options: dict[str, Any] | None, known: tuple[str, ...]) -> None:
    for name in options or {}:
        if name not in known:
            raise ValueError(f"reset knows no option {quoted(name)}; known: {', '.join(known) or 'none'}")


def _mask(mask: Any, num_envs: int, seed: int | None) -> np.ndarray:
    """A mask of envs to restart. Raises ValueError unless it is (N,) bool, has somebody, and there is no seed."""
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (num_envs,):
        shown = f"{mask.dtype} of {mask.shape}" if isinstance(mask, np.ndarray) else quoted(mask)
        raise ValueError(f"reset_mask must be an array of bool of shape ({num_envs},), got {shown}")
    if not mask.any():
        raise ValueError("reset_mask must name one env at least")
    if seed is not None:
        raise ValueError(f"reset_mask goes without a seed, got {seed}: all envs draw from one generator")
    return mask
