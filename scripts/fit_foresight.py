"""Fit `StandingRisk`: in simulation, let robots stand under a policy whatever happens, and see who falls when.

`collect` lets them stand and writes what they felt to a file; `fit` learns from such files, prints how many falls it
sees coming how far ahead in worlds that it was not shown, and how often it is wrong, and writes the weights that the
package ships.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
import torch

from cotap.agents.actors import as_dict
from cotap.envs import H1Env, foresight
from cotap.envs.foresight import AHEAD_S, SURE, StandingRisk
from cotap.envs.judgement import save_weights
from cotap.envs.step_timing import feature_reflection, features
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.policy import find_checkpoint, load_policy
from cotap.evaluation.protocols import VelocityTracking
from cotap.files import write_arrays
from cotap.robots import ROBOTS

SAFE_S = 2.4
"""A robot that is still standing after so long was not about to fall [s]."""
EVERY = 3
"""Control steps between two that are kept: neighbours tell the same."""
NEVER_S = 1e3
DISTURBANCES = ("none", "loads", "blows")


def collect(options: argparse.Namespace) -> int:
    """Let robots stand and write what they felt."""
    torch.set_num_threads(options.threads)
    env, policy = _make(options)
    default = torch.tensor([j.default_rad for j in env.spec.joints])
    seen, stands, falls = [], [], []
    observations = env.get_observations()
    for _ in range(round(options.seconds / env.dt)):
        command = env.commands.current()
        seen.append(features(env.state, command, default).half())
        stands.append(command.stand > 0.5)
        observations, _, _, extras = env.step(policy(as_dict(observations)))
        falls.append(extras["falls"].clone())
    x, s, f = (torch.stack(rows) for rows in (seen, stands, falls))
    until_s = time_to_fall(s, f, env.dt)
    # Of the last steps nobody knows what comes of them.
    kept = s.clone()
    kept[len(s) - round(SAFE_S / env.dt) :] = False
    kept[torch.arange(len(s)) % EVERY > 0] = False
    world = torch.arange(env.num_envs).expand(len(s), -1)
    arrays = {"seen": x[kept].numpy(), "until_s": until_s[kept].numpy(), "world": world[kept].numpy()}
    write_arrays(options.output, arrays)
    print(f"{int(f.any(0).sum())} of {env.num_envs} worlds fell in {options.seconds:g} s; wrote {options.output}")
    return 0


def time_to_fall(stands: torch.Tensor, falls: torch.Tensor, dt: float) -> torch.Tensor:
    """How long (T, N) [s] it takes from each control step to a fall out of standing; NEVER_S where stepping or the
    end comes first.

    Args:
        stands: (T, N) bool, before each step.
        falls: (T, N) bool, in each step.
        dt: Control step [s].
    """
    until = torch.full(stands.shape, NEVER_S)
    present = torch.full(stands.shape[1:], NEVER_S)
    for step in range(len(stands) - 1, -1, -1):
        present = torch.where(falls[step], 0.0, present + dt)
        present = torch.where(stands[step], present, NEVER_S)
        until[step] = present
    return until.clamp_max(NEVER_S)


def _make(options: argparse.Namespace) -> tuple[H1Env, torch.nn.Module]:
    """Robots that are mostly told to stand, and never step for their balance; and the policy that drives them."""
    policy = load_policy(find_checkpoint(options.checkpoint))
    protocol = VelocityTracking(
        num_envs=options.num_envs, seed=options.seed, stand_probability=0.7, steady_rad=10.0, collision="full"
    )
    protocol.hand_force = options.size if options.disturbance == "loads" else 0.0
    cfg = protocol.configure(policy.env_config)
    cfg.num_threads = options.threads
    cfg.commands.step_timing = cfg.commands.foresee_falls = False
    if options.stiffness:
        cfg.upper_body = LawOptions(method="cotap", stiffness=(options.stiffness,)).configure()
    blows = cfg.blows
    blows.enabled, blows.episode_share, blows.curriculum_start = options.disturbance == "blows", 1.0, 1.0
    blows.curriculum_step = blows.curriculum_back = 0.0
    if blows.enabled:
        blows.force = (0.1 * options.size, options.size)
    env = H1Env(cfg)
    env.reset()
    return env, policy


def fit(options: argparse.Namespace) -> int:
    """Learn from what robots felt and write the weights."""
    torch.manual_seed(0)
    files = [np.load(name, allow_pickle=False) for name in options.recordings]
    x = torch.from_numpy(np.concatenate([f["seen"] for f in files])).float()
    until_s = torch.from_numpy(np.concatenate([f["until_s"] for f in files]))
    first = np.cumsum([0] + [int(f["world"].max()) + 1 for f in files[:-1]])
    world = torch.from_numpy(np.concatenate([f["world"] + n for f, n in zip(files, first, strict=True)]))
    kept = world % 8 == 0
    near, far = until_s <= AHEAD_S, until_s > SAFE_S
    pools = [(mask & ~kept).nonzero()[:, 0] for mask in (near, far)]
    for what, pool in zip(("that are about to fall", f"that stand for {SAFE_S:g} s more"), pools, strict=True):
        if len(pool) == 0:
            raise SystemExit(f"there are no robots {what} in {', '.join(map(str, options.recordings))}: record more")
    reflection = feature_reflection(ROBOTS["h1"]())
    # Learned in units of what usually happens, the same left and right.
    power = x.square().mean(0, keepdim=True)
    scale = (0.5 * (power + reflection(power).abs())).sqrt().clamp_min(1e-3)
    x = x / scale
    model = StandingRisk(reflection)
    optimizer = torch.optim.AdamW(model.parameters(), lr=2e-3, weight_decay=options.decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.steps)
    truth = torch.cat((torch.ones(options.batch), torch.zeros(4 * options.batch)))
    for _ in range(options.steps):
        sizes = (options.batch, 4 * options.batch)
        rows = torch.cat([pool[torch.randint(len(pool), (n,))] for pool, n in zip(pools, sizes, strict=True)])
        loss = torch.nn.functional.binary_cross_entropy_with_logits(model(x[rows]), truth)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        logit = torch.cat([model(rows) for rows in x[kept].split(100_000)])
    _report(logit, until_s[kept], world[kept])
    with torch.no_grad():
        model.net[0].weight /= scale  # pyright: ignore[reportIndexIssue, reportArgumentType]
    save_weights(model.net, options.output)
    print(f"wrote {options.output}")
    return 0


def _report(logit: torch.Tensor, until_s: torch.Tensor, world: torch.Tensor) -> None:
    """Print what is seen how far ahead, and how often wrongly."""
    safe = logit[until_s > SAFE_S]
    print(f"in {len(safe)} moments of robots that stood on {(safe > SURE).float().mean():.2%} are taken for falls")
    for start in (0.3, 0.6, 0.9, 1.2):
        rows = (until_s >= start) & (until_s < start + 0.3)
        worlds, place = world[rows].unique(return_inverse=True)
        highest = torch.full((len(worlds),), -math.inf).scatter_reduce(0, place, logit[rows], "amax")
        caught = (highest > SURE).float().mean()
        print(f"of {len(worlds)} worlds that fall {start:g} to {start + 0.3:g} s later {caught:.1%} are")


def main() -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    stand = commands.add_parser("collect", help="let robots stand")
    stand.add_argument("--checkpoint", default="base", help="policy that drives them")
    stand.add_argument("--stiffness", type=float, default=0.0, help="arms under CoTaP at this K_ee [N/m]; 0 for PD")
    stand.add_argument("--disturbance", choices=DISTURBANCES, default="none", help="what comes upon the hands")
    stand.add_argument("--size", type=float, default=0.0, help="its largest force, of loads per axis [N]")
    stand.add_argument("--seconds", type=float, default=15.0)
    stand.add_argument("--num-envs", type=int, default=1024)
    stand.add_argument("--seed", type=int, default=0)
    stand.add_argument("--threads", type=int, default=1)
    stand.add_argument("--output", type=Path, required=True)
    stand.set_defaults(run=collect)
    learn = commands.add_parser("fit", help="learn from recordings")
    learn.add_argument("recordings", type=Path, nargs="+")
    learn.add_argument("--steps", type=int, default=6000)
    learn.add_argument("--batch", type=int, default=1024)
    learn.add_argument("--decay", type=float, default=1e-3)
    learn.add_argument("--output", type=Path, default=Path(foresight.__file__).with_suffix(".npz"))
    learn.set_defaults(run=fit)
    options = parser.parse_args()
    if getattr(options, "seconds", math.inf) <= SAFE_S:
        parser.error(
            f"--seconds {options.seconds:g} must be more than {SAFE_S:g}: of the last ones nobody knows what comes"
        )
    return options.run(options)


if __name__ == "__main__":
    sys.exit(main())
