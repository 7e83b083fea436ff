"""How fast this machine trains."""

from __future__ import annotations

import time
from typing import Any

from rsl_rl.env import VecEnv

from cotap.agents.actors import as_dict
from cotap.agents.distillation import Guide
from cotap.agents.dual_ppo import DualPPO, DualPPOConfig
from cotap.agents.runner import layout_of


class TimedTraining:
    """Training without a run: nothing is logged or saved.

    Args:
        env: The environment.
        ppo: Hyperparameters.
        device: Where the networks live.
        guide: A frozen policy to stay close to, as in a distillation; None for none.
    """

    def __init__(self, env: VecEnv, ppo: DualPPOConfig, device: str = "cpu", guide: Guide | None = None) -> None:
        self.env: Any = env
        self.device = device
        self.alg = DualPPO(layout_of(env, ppo.symmetric), env.num_envs, ppo, device, guide)

    def run(self) -> float:
        """Samples per second of one whole iteration, which collects and learns."""
        alg, env, device = self.alg, self.env, self.device
        start = time.perf_counter()
        obs = as_dict(env.get_observations(), device)
        for _ in range(alg.cfg.steps):
            obs, _, dones, extras = env.step(alg.act(obs).to(env.device))
            obs = as_dict(obs, device)
            learned = (extras["group_rewards"], dones, extras["time_outs"])
            alg.process_step(*(value.to(device) for value in learned))
        alg.compute_returns(obs)
        alg.update()
        return alg.cfg.steps * env.num_envs / (time.perf_counter() - start)
