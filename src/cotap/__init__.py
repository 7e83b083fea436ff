"""cotap: compliant whole-body control of humanoids, learned on any machine."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("cotap")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0.0.0"


def _register() -> None:
    try:
        from gymnasium.envs.registration import register
    except ImportError:  # the compliance library serves users who have no simulator
        return
    register(
        id="CoTaP/H1-v0",
        entry_point="cotap.envs.gym:H1SingleEnv",
        vector_entry_point="cotap.envs.gym:H1VectorEnv",
    )


_register()
