"""What every evaluation begins with: an environment in which nothing acts on robots but what is asked for."""

from __future__ import annotations

from cotap.envs import HumanoidEnvConfig
from cotap.envs.curriculum import CurriculumConfig
from cotap.envs.external_forces import ExternalForceConfig


def disable_disturbances(env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
    """Switch off what training adds to an environment: assistance, curriculum, forces, paths, bumps, randomization,
    noise. Changes and returns `env_cfg`."""
    env_cfg.forces, env_cfg.curriculum = ExternalForceConfig(), CurriculumConfig()
    env_cfg.assist.enabled = env_cfg.randomization.enabled = env_cfg.observations.noise.enabled = False
    env_cfg.path.share, env_cfg.unevenness_m = 0.0, 0.0
    return env_cfg
