"""The environment: an rsl_rl VecEnv of humanoids, and the components it is made of."""

from cotap.envs.config import HumanoidEnvConfig
from cotap.envs.humanoid_env import HumanoidEnv

H1Env, H1EnvConfig = HumanoidEnv, HumanoidEnvConfig
"""Their former names, for one release."""

__all__ = ["H1Env", "H1EnvConfig", "HumanoidEnv", "HumanoidEnvConfig"]
