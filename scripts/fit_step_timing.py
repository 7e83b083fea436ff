"""Fit `FallRisk`: in simulation, strike robots under a policy, put the gait clock anywhere soon after, see who falls.

`collect` runs trials and writes them to a file; `fit` learns from such files, prints how well it predicts trials that
it was not shown, and writes the weights that the package ships.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
import torch

from cotap.agents.actors import as_dict
from cotap.envs import H1Env, step_timing
from cotap.envs.commands import STEADY_RAD, Catch, Command
from cotap.envs.judgement import save_weights
from cotap.envs.state import RobotState
from cotap.envs.step_timing import BINS, FallRisk, feature_reflection, features, risk_at
from cotap.evaluation.policy import find_checkpoint, load_policy
from cotap.files import write_arrays
from cotap.robots import ROBOTS

WATCH_S = 2.2
"""A robot that is on its feet for so long after the clock was set has caught itself [s]."""
SOON_STEPS = (2, 10)
"""The clock is set so many control steps after a blow."""
KEEP = 0.3
"""Share of the trials in which the clock goes on as it would."""


class RandomCatch:
    """In place of `StepTiming`: sets the clock at random once after each blow, and keeps what it saw and did."""

    def __init__(self, env: H1Env) -> None:
        n = env.num_envs
        self._env = env
        self._default = torch.tensor([j.default_rad for j in env.spec.joints])
        self._delay = torch.zeros(n, dtype=torch.long)
        self._age = torch.full((n,), 1_000_000)
        self._left_s = env.hand_forces._remaining_s.clone()
        """Until the loads on the hands change."""
        self.seen = torch.zeros(n, 9 + 2 * env.num_actions)
        self.choice = torch.zeros(n)
        """(N,) the phase that was chosen, or -1 for standing on."""
        self.open = torch.zeros(n, dtype=torch.bool)
        """(N,) trials under way."""

    def reset(self, mask: torch.Tensor) -> None:
        """Trials in `mask` (N,) are void."""
        self._left_s[mask] = math.inf  # new loads at a start are no event
        self.open[mask] = False
        self._age[mask] = 1_000_000

    def step(self, s: RobotState, command: Command, leans: torch.Tensor) -> Catch:  # noqa: ARG002
        """As `StepTiming.step`."""
        n, rng = self._env.num_envs, self._env.rng
        left_s = self._env.hand_forces._remaining_s
        struck = (self._env.blows._since_s == 0.0) | (left_s > self._left_s)
        self._left_s = left_s.clone()
        self._age = torch.where(struck, 0, self._age + 1)
        self._delay = torch.where(struck, torch.randint(*SOON_STEPS, (n,), generator=rng), self._delay)
        now = self._age == self._delay
        stands = command.stand > 0.5
        keeps = torch.rand(n, generator=rng) < KEEP
        phase = torch.where(keeps, command.phase, torch.rand(n, generator=rng))
        chosen = torch.where(keeps & stands, -1.0, phase)
        self.seen = torch.where(now[:, None], features(s, command, self._default), self.seen)
        self.choice = torch.where(now, chosen, self.choice)
        self.open |= now
        jumps = now & ~(keeps & stands)
        # Hurrying belongs to catching: whoever goes on stepping after a blow hurries, too.
        since_s = (self._age - self._delay) * self._env.dt
        return Catch(jumps, phase, (since_s >= 0.0) & (since_s < step_timing.HURRY_S) & self.open & (self.choice >= 0))

    def over(self) -> torch.Tensor:
        """(N,) bool: trials that end now because nothing more can come of them."""
        return self.open & ((self._age - self._delay) * self._env.dt >= WATCH_S)


def collect(options: argparse.Namespace) -> int:
    """Run trials and write them."""
    torch.set_num_threads(options.threads)
    policy = load_policy(find_checkpoint(options.checkpoint))
    cfg = policy.env_config
    cfg.num_envs, cfg.seed, cfg.num_threads = options.num_envs, options.seed, options.threads
    cfg.assist.enabled = cfg.commands.step_timing = False
    cfg.commands.steady_rad, cfg.commands.stand_probability = STEADY_RAD, 0.4
    loads, blows = cfg.hand_forces, cfg.blows
    loads.enabled, loads.hold_s, loads.curriculum_start = (
        options.loads > 0.0,
        (WATCH_S + 0.3, WATCH_S + 0.8),
        options.loads,
    )
    loads.episode_share, loads.curriculum_step, loads.curriculum_back = 1.0, 0.0, 0.0
    blows.enabled, blows.episode_share, blows.curriculum_start = options.loads == 0.0, 1.0, 1.0
    blows.curriculum_step = blows.curriculum_back = 0.0
    blows.force, blows.duration_s, blows.interval_s = (100.0, 600.0), (0.03, 0.06), (WATCH_S + 0.3, WATCH_S + 0.8)
    env = H1Env(cfg)
    env.step_timing = trials = RandomCatch(env)  # pyright: ignore[reportAttributeAccessIssue]
    env.reset()
    seen, choice, fell = [], [], []
    count = 0
    while count < options.trials:
        opened = trials.open.clone()
        x, c = trials.seen.clone(), trials.choice.clone()
        *_, extras = env.step(policy(as_dict(env.get_observations())))
        # A fall voids the trial in the restart, so it is judged by what was open before.
        thrown = extras["falls"] & opened
        taken = trials.over() & ~extras["falls"]
        trials.open &= ~taken
        for mask, value in ((thrown, 1.0), (taken, 0.0)):
            seen.append(x[mask])
            choice.append(c[mask])
            fell.append(torch.full((int(mask.sum()),), value))
            count += int(mask.sum())
    data = {"seen": torch.cat(seen), "choice": torch.cat(choice), "fell": torch.cat(fell)}
    arrays = {k: v.numpy() for k, v in data.items()}
    write_arrays(options.output, arrays)
    print(f"{count} trials, {data['fell'].mean():.1%} fell; wrote {options.output}")
    return 0


def fit(options: argparse.Namespace) -> int:
    """Learn from trials and write the weights."""
    torch.manual_seed(0)
    files = [np.load(name, allow_pickle=False) for name in options.trials]
    x, choice, fell = (torch.from_numpy(np.concatenate([f[k] for f in files])) for k in ("seen", "choice", "fell"))
    order = torch.randperm(len(x))
    shown, kept = order[len(x) // 10 :], order[: len(x) // 10]
    model = FallRisk(feature_reflection(ROBOTS["h1"]()))
    optimizer = torch.optim.AdamW(model.parameters(), lr=2e-3, weight_decay=options.decay)
    batches = options.epochs * (len(shown) // options.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=max(batches, 1))

    def loss(rows: torch.Tensor) -> torch.Tensor:
        logits, at = model(x[rows]), choice[rows]
        stepping = risk_at(logits, at.clamp_min(0.0))
        chosen = torch.where(at < 0.0, logits[:, BINS], stepping)
        return torch.nn.functional.binary_cross_entropy_with_logits(chosen, fell[rows])

    for epoch in range(options.epochs):
        model.train()
        for rows in shown[torch.randperm(len(shown))].split(options.batch):
            if len(rows) < options.batch:
                continue
            optimizer.zero_grad()
            value = loss(rows + 0)
            value.backward()
            optimizer.step()
            schedule.step()
        if epoch % 5 == 4 or epoch == options.epochs - 1:
            model.eval()
            with torch.no_grad():
                print(
                    f"epoch {epoch + 1}: log loss {loss(shown):.4f}, on trials not shown {loss(kept):.4f}", flush=True
                )
    base = fell.mean()
    print(f"log loss of knowing nothing {-(base * base.log() + (1 - base) * (1 - base).log()):.4f}")
    with torch.no_grad():
        risk = model(x[kept]).sigmoid()
        went_on, chosen = risk_at(risk, choice[kept].clamp_min(0.0)), risk[:, :BINS].amin(1)
        print(f"expected falls: as the clock was set {went_on.mean():.3f}, at its best {chosen.mean():.3f}")
    save_weights(model.net, options.output)
    print(f"wrote {options.output}")
    return 0


def main() -> int:
    """Parse the command line and run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    trials = commands.add_parser("collect", help="run trials")
    trials.add_argument(
        "--checkpoint", default="cotap", help="policy under which robots are struck, under its own laws"
    )
    trials.add_argument("--trials", type=int, default=30_000)
    trials.add_argument(
        "--loads",
        type=float,
        default=0.0,
        help="in place of blows, loads on both hands that change, of this share of their size",
    )
    trials.add_argument("--num-envs", type=int, default=1024)
    trials.add_argument("--seed", type=int, default=0)
    trials.add_argument("--threads", type=int, default=1)
    trials.add_argument("--output", type=Path, required=True)
    trials.set_defaults(run=collect)
    learn = commands.add_parser("fit", help="learn from trials")
    learn.add_argument("trials", type=Path, nargs="+")
    learn.add_argument("--epochs", type=int, default=30)
    learn.add_argument("--batch", type=int, default=512)
    learn.add_argument("--decay", type=float, default=0.05)
    learn.add_argument("--output", type=Path, default=Path(step_timing.__file__).with_suffix(".npz"))
    learn.set_defaults(run=fit)
    options = parser.parse_args()
    return options.run(options)


if __name__ == "__main__":
    sys.exit(main())
