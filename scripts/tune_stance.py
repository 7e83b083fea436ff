"""Search for the feedback that keeps a robot standing (`RobotSpec.stance`): the cross-entropy method in simulation.

Every candidate stands in several worlds, randomised as in training, arms moving, at one height: first nominal, then,
once those gains are in the robot's description, the low one. Prints the mean of the candidates that stood best.
"""

from __future__ import annotations

import argparse
import sys

import torch

from cotap.envs import H1Env, H1EnvConfig

# What an inverted pendulum on its ankles asks for, to begin with: columns as in StanceGain.gain, then the bias.
START = ((0.0,) * 9, (0.0,) * 9, (4.0, 0.0, -1.0, -7.0, 0.75, 0.0, -0.2, -1.2, 0.0))
SPREAD = ((0.4,) * 4 + (0.1, 0.05, 0.05, 0.1, 0.05), (0.4,) * 4 + (0.1, 0.05, 0.05, 0.1, 0.1),
          (1.0,) * 4 + (0.3, 0.1, 0.1, 0.2, 0.1))  # fmt: skip


def make_env(num_envs: int, seed: int, threads: int) -> H1Env:
    """Worlds that stand, nothing but randomisation and moving arms against them."""
    cfg = H1EnvConfig(num_envs=num_envs, backend="mjbatch", seed=seed, num_threads=threads)
    cfg.hand_forces.enabled = cfg.blows.enabled = False
    cfg.terminations.episode_s = 1e6
    return H1Env(cfg)


def stand(env: H1Env, gains: torch.Tensor, offset_m: float, seconds: float) -> tuple[torch.Tensor, torch.Tensor]:
    """How well (N,) the gains (N, n, 2 n + 3) stand, at most 1, and whether (N,) they stood to the end."""
    n = env.num_envs
    height = torch.full((n,), env.spec.nominal_height_m + offset_m)
    env.commands.override(torch.zeros(n, 2), torch.zeros(n), torch.ones(n), height)
    env.reset()
    env.joint_targets.stance.set_gains(gains, 0 if offset_m == 0.0 else 1)
    score, standing = torch.zeros(n), torch.ones(n)
    steps = round(seconds / env.dt)
    for _ in range(steps):
        *_, extras = env.step(torch.zeros(n, env.num_actions))
        standing = standing * ~extras["falls"]
        s = env.state
        speed = s.torso_linear_velocity_h[:, :2].square().sum(1)
        tilt = s.projected_gravity_t[:, :2].square().sum(1)
        score += standing * (1.0 - (5.0 * speed).clamp_max(0.5) - (2.0 * tilt).clamp_max(0.3)) / steps
    return score, standing


def main() -> int:
    """Search and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--height-offset", type=float, default=0.0, help="relative to nominal [m]")
    parser.add_argument("--generations", type=int, default=20)
    parser.add_argument("--candidates", type=int, default=48)
    parser.add_argument("--worlds", type=int, default=6, help="worlds per candidate")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long they stand")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    env = make_env(options.candidates * options.worlds, options.seed, options.threads)
    mean, spread = torch.tensor(START), torch.tensor(SPREAD)
    if options.height_offset != 0.0:  # on the way down from nominal height, for which the robot's gains are
        nominal = env.spec.stance.gains[0]
        mean = torch.cat((torch.tensor(nominal.gain), torch.tensor(nominal.bias).unsqueeze(1)), 1)
    best = max(2, options.candidates // 6)
    for generation in range(options.generations):
        candidates = mean + spread * torch.randn(options.candidates, *mean.shape)
        score, stood = stand(
            env, candidates.repeat_interleave(options.worlds, 0), options.height_offset, options.seconds
        )
        score, stood = (x.reshape(options.candidates, -1).mean(1) for x in (score, stood))
        chosen = score.topk(best).indices
        mean = 0.4 * mean + 0.6 * candidates[chosen].mean(0)
        spread = 0.4 * spread + 0.6 * candidates[chosen].std(0)
        print(f"{generation}: score {score.mean():.3f}, of the best {score[chosen].mean():.3f}, which stood in "
              f"{stood[chosen].mean():.1%}", flush=True)  # fmt: skip
    gains = mean.expand(env.num_envs, *mean.shape)
    score, stood = stand(env, gains, options.height_offset, 2.0 * options.seconds)
    print(f"mean: score {score.mean():.3f}, stood in {stood.mean():.1%} for {2.0 * options.seconds:g} s")
    for row in mean.tolist():
        print("gain", [round(x, 3) for x in row[:-1]], "bias", round(row[-1], 3))
    return 0


if __name__ == "__main__":
    sys.exit(main())
