"""How fast this machine trains."""

from __future__ import annotations

import time
from typing import Any

from rsl_rl.env import VecEnv

from cotap.agents.actors import as_dict
from cotap.agents.dual_ppo import DualPPO, DualPPOConfig
from cotap.agents.runner import layout_of


class TimedTraining:
    """Training without a run: nothing is logged or saved.

    Args:
        env: Whose robots learn.
        ppo: How.
        device: Where the networks live.
    """

    def __init__(self, env: VecEnv, ppo: DualPPOConfig, device: str = "cpu") -> None:
        self.env: Any = env
        self.alg = DualPPO(layout_of(env, ppo.symmetric), env.num_envs, ppo, device)

    def run(self) -> float:
        """Samples per second of one whole iteration, which collects and learns."""
        alg, env = self.alg, self.env
        start = time.perf_counter()
        obs = as_dict(env.get_observations())
        for _ in range(alg.cfg.steps):
            obs, _, dones, extras = env.step(alg.act(obs))
            obs = as_dict(obs)
            alg.process_step(extras["group_rewards"], dones, extras["time_outs"])
        alg.compute_returns(obs)
        alg.update()
        return alg.cfg.steps * env.num_envs / (time.perf_counter() - start)
