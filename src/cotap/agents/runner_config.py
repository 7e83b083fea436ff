"""How long to train and how often to save: apart from the runner, whose imports a reader of configs does not need."""

from __future__ import annotations

from dataclasses import dataclass

from cotap.checks import require_positive_int


@dataclass
class RunnerConfig:
    """How long to train and how often to save."""

    iterations: int = 400
    """Iterations in all, with those of a resumed run."""
    save_interval: int = 25
    """Iterations between checkpoints."""
    save_envs: bool = True
    """Save every env's state (14 kB), so that a run goes on exactly; without, envs start afresh."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_positive_int("runner.iterations", self.iterations)
        require_positive_int("runner.save_interval", self.save_interval)
