"""A task of the arms in which no constant law is best: hold a free hand, carry a load, give way to a push.

What helps two of these hurts the third. A policy sees which one it is from what happens to the arms alone: loads come
on both hands and last, pushes come on one.
"""

from __future__ import annotations

from cotap.envs.external_forces import ExternalForceConfig
from cotap.envs.hand_loads import HandLoadConfig
from cotap.envs.pushes import PushConfig

TASK_WEIGHTS = {"free_hand_error": -20.0, "loaded_hand_error": -20.0, "push_resistance": -1.0}
"""Terms of the upper agent's rewards that the task consists of, with their weights [1/s]."""


def task_forces() -> ExternalForceConfig:
    """Loads on hands, and pushes on hands, long enough that a hand has gone out of the way before they end."""
    loads = HandLoadConfig(enabled=True, force_x=(-25.0, 25.0), force_y=(-25.0, 25.0), force_z=(-40.0, 0.0))
    pushes = PushConfig(
        enabled=True, episode_share=1.0, velocity=(0.3, 0.7), hand_share=1.0, link_share=0.0,
        duration_s=(1.0, 2.0), interval_s=(2.5, 4.5),
    )  # fmt: skip
    return ExternalForceConfig(loads, pushes)
