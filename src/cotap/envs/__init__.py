"""The environment: an rsl_rl VecEnv of H1 robots, and the components it is made of."""

from cotap.envs.h1_env import H1Env, H1EnvConfig

__all__ = ["H1Env", "H1EnvConfig"]
