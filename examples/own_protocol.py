"""A protocol of your own: how well do robots turn on the spot? It takes the options of all protocols, and its own.

python examples/own_protocol.py --num-envs 4 --json turning.json
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch

from cotap.envs import HumanoidEnv
from cotap.evaluate import PROTOCOLS, main
from cotap.evaluation.metrics import masked_mean, outcome
from cotap.evaluation.protocol import RolloutProtocol
from cotap.evaluation.report import save_figure
from cotap.evaluation.rollout import Trajectory


@dataclass
class Turning(RolloutProtocol):
    """Robots turn on the spot: how fast, and how far they stray."""

    turning_rate: float = 0.6
    """What is asked for, positive to the left [rad/s]."""

    @property
    def seconds(self) -> float:
        return 6.0

    def prepare(self, env: HumanoidEnv) -> None:
        super().prepare(env)
        n, zeros = env.num_envs, torch.zeros(env.num_envs)
        height = torch.full((n,), env.spec.nominal_height_m)
        env.commands.override(torch.zeros(n, 2), zeros + self.turning_rate, zeros, height)

    def measure(self, trajectory: Trajectory, env: HumanoidEnv) -> dict[str, Any]:
        alive = trajectory.alive()  # (T, N): up to an env's fall
        late = alive & (torch.arange(len(alive)) * env.dt > 2.0).unsqueeze(1)  # it turns as fast as it will
        away = (trajectory.position - trajectory.position[0]).norm(dim=2)
        measures = {"turned": masked_mean(trajectory.velocity[..., 2], late), "strayed": (away * alive).amax(0)}
        return outcome(measures, alive[-1], self.seed, self.per_env)

    def plot(self, path: Path, result: dict[str, Any]) -> None:  # noqa: ARG002
        figure, axes = plt.subplots()
        axes.plot(*self.trajectory.position.unbind(2))
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        save_figure(figure, path)


PROTOCOLS["turning"] = Turning

if __name__ == "__main__":
    sys.exit(main(["turning", *sys.argv[1:]]))
