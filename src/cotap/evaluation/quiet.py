"""What every evaluation begins with: an environment in which nothing acts on robots but what is asked for."""

from __future__ import annotations

from cotap.envs import H1EnvConfig
from cotap.envs.forces import ForceProfile
from cotap.envs.punches import PunchConfig


def quiet(env: H1EnvConfig) -> H1EnvConfig:
    """Take everything out of an environment that training puts in: help, forces, blows, paths to follow, bumps,
    randomisation, noise. Changes and returns `env`."""
    env.assist.enabled = env.hand_forces.enabled = env.blows.enabled = env.randomization.enabled = False
    env.observations.noise.enabled = False
    env.force, env.punches = ForceProfile(), PunchConfig()
    env.impedance.share, env.unevenness_m = 0.0, 0.0
    return env
