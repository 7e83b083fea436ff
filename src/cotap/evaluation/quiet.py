"""What every evaluation begins with: an environment in which nothing acts on robots but what is asked for."""

from __future__ import annotations

from cotap.envs import H1EnvConfig
from cotap.envs.disturbances import HandForceConfig
from cotap.envs.forces import ForceProfile
from cotap.envs.punches import PunchConfig
from cotap.envs.retries import RetryConfig


def quiet(env: H1EnvConfig) -> H1EnvConfig:
    """Take everything out of an environment that training puts in: help, forces, blows, paths to follow, bumps,
    second tries, randomisation, noise. Changes and returns `env`."""
    env.assist.enabled = env.blows.enabled = env.randomization.enabled = False
    env.observations.noise.enabled = False
    env.force, env.punches = ForceProfile(), PunchConfig()
    env.hand_forces, env.retries = HandForceConfig(enabled=False), RetryConfig()
    env.impedance.share, env.unevenness_m = 0.0, 0.0
    return env
