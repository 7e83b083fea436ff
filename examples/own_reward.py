"""A reward of your own, and a training from Python: the legs are also paid for feet that move slowly."""

from pathlib import Path

import torch

from cotap.configs import BASE_RECIPES
from cotap.envs.rewards import LowerRewards, StepRecord, reward_group, term
from cotap.train import BaseOptions, train_base


@reward_group
class OwnRewards(LowerRewards):
    """All terms of the lower agent, and one more."""

    @term(-0.05)
    def foot_speed(s: StepRecord) -> torch.Tensor:
        """Horizontal speed of all feet, summed up (N,) [m/s]."""
        return s.state.foot_velocity_w[:, :, :2].norm(dim=2).sum(1)


def train(run_dir: str, iterations: int = 2, num_envs: int = 64) -> Path:
    """Train the recipe `quick` with these rewards. Returns the folder of the run."""
    training = BASE_RECIPES["quick"]()
    training.env.rewards.lower = OwnRewards(track_height=1.5)  # a weight may change, too
    training.env.num_envs, training.runner.iterations = num_envs, iterations
    return train_base(BaseOptions(run_dir=run_dir, training=training))


if __name__ == "__main__":
    train("runs/own-reward")
