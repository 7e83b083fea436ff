"""cotap: compliant whole-body control of humanoids, learned on any machine."""

import os
from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("cotap")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0.0.0"


# torch's threads go on spinning for milliseconds after every operation that they share (GNU OpenMP's default), on the
# CPUs that physics wants by then: at 512 envs a step of the environment takes 1.2 times as long. Read when
# torch is loaded.
os.environ.setdefault("GOMP_SPINCOUNT", "20000")


def _register() -> None:
    try:
        from gymnasium.envs.registration import register
    except ImportError:  # the compliance library serves users who have no simulator
        return
    for robot in ("h1", "g1"):  # those of cotap.robots.ROBOTS, which this would load
        register(
            id=f"CoTaP/{robot.upper()}-v0",
            entry_point="cotap.envs.gymnasium:HumanoidSingleEnv",
            vector_entry_point="cotap.envs.gymnasium:HumanoidVectorEnv",
            kwargs={"robot": robot},
        )


_register()
