"""Fit `TiltEstimate`: in simulation, pull at the hands of robots that walk and stand, and see what tells it.

`collect` lets them follow commands under random loads and writes what they felt, and the tilt that the loads asked for,
to a file; `fit` learns from such files, prints how far off it is in worlds that it was not shown, and writes the
weights that the package ships. Robots lean by the true tilt (`--lean truth`) or by what the weights in force tell
(`--lean sense`): what they get wrong shows only where robots have leant by it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

from cotap.agents.actors import as_dict
from cotap.checks import require_range
from cotap.envs import H1Env, load_sense
from cotap.envs.commands import Command
from cotap.envs.judgement import save_weights
from cotap.envs.load_sense import LoadSense, TiltEstimate, load_reflection, load_tilt
from cotap.envs.state import RobotState
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.policy import find_checkpoint, load_policy
from cotap.evaluation.protocols import VelocityTracking
from cotap.files import require_output, write_arrays
from cotap.robots import ROBOTS

EVERY = 4
"""Control steps between two that are kept: neighbours tell the same."""
KEPT_OUT = 8
"""One world in so many is not learned from."""


class Recorder(LoadSense):
    """Writes down, beside sensing, what there was to sense.

    Args:
        env: The environment whose sense this becomes.
        truth: Whether robots lean by the true tilt instead of by what they sense.
    """

    def __init__(self, env: H1Env, truth: bool) -> None:
        super().__init__(env.spec, env.num_envs, env.dt)
        self._env, self._truth = env, truth
        self._true = torch.zeros_like(self.tilt)
        self._steps = 0
        self.seen: list[torch.Tensor] = []
        self.tilts: list[torch.Tensor] = []
        self.squares: list[float] = []
        env.load_sense = self

    def step(self, s: RobotState, command: Command, torque: torch.Tensor) -> None:
        """Sense and write down. Arguments as of `LoadSense.step`."""
        self._true = torch.where(self._fresh.unsqueeze(1), 0.0, self._true)
        super().step(s, command, torque)
        # Blows are over before a robot could lean against them, and are to be told from loads.
        struck = self._env.blows.current().any(2).any(1, keepdim=True)
        tilt = torch.where(struck, self._true, load_tilt(s, s.hand_pos_w, self._env.hand_force_w, self._env.weight_n))
        self._true = torch.lerp(self._true, torch.nan_to_num(tilt), self._tilt_share)
        self.squares.append(float((self.tilt - self._true).square().mean()))
        if self._truth:
            self.tilt = self._true
        if self._steps % EVERY == 0:
            self.seen.append(self.read.half())
            self.tilts.append(self._true.half())
        self._steps += 1

    def remember(self, s: RobotState, command: Command, torque: torch.Tensor) -> torch.Tensor:
        """What the network reads, kept. Arguments as of `step`."""
        self.read = super().remember(s, command, torque)
        return self.read


def collect(options: argparse.Namespace) -> int:
    """Let robots walk and stand under loads and write what they felt."""
    require_output("--output", options.output, (".npz",))
    require_range("--seconds", options.seconds, 0.1, 1e4)
    torch.set_num_threads(options.threads)
    policy = load_policy(find_checkpoint(options.checkpoint))
    protocol = VelocityTracking(num_envs=options.num_envs, seed=options.seed, hand_force=options.size, collision="full")
    cfg = protocol.configure(policy.env_config)
    cfg.num_threads, cfg.commands.lean_into_loads = options.threads, True
    if options.stiffness:
        cfg.upper_body = LawOptions(method="cotap", stiffness=(options.stiffness,) * 3).configure()
    blows = cfg.blows
    blows.enabled, blows.force = options.blow > 0.0, (0.1 * options.blow, options.blow)
    blows.episode_share, blows.curriculum_start = 1.0, 1.0
    blows.curriculum_step = blows.curriculum_back = 0.0
    env = H1Env(cfg)
    recorder = Recorder(env, options.lean == "truth")
    observations = env.reset()
    falls = 0
    for _ in range(round(options.seconds / env.dt)):
        observations, _, _, extras = env.step(policy(as_dict(observations)))
        falls += int(extras["falls"].sum())
    seen, tilts = torch.stack(recorder.seen), torch.stack(recorder.tilts)
    world = np.broadcast_to(np.arange(env.num_envs), seen.shape[:2]).reshape(-1)
    write_arrays(
        options.output, {"seen": seen.flatten(0, 1).numpy(), "tilt": tilts.flatten(0, 1).numpy(), "world": world}
    )
    off = (sum(recorder.squares) / len(recorder.squares)) ** 0.5
    print(
        f"{falls} falls in {options.seconds:g} s of {env.num_envs} worlds; the weights in force are {off:.4f} rad off"
    )
    return 0


def fit(options: argparse.Namespace) -> int:
    """Learn from what robots felt and write the weights."""
    require_output("--output", options.output, (".npz",))
    torch.manual_seed(0)
    torch.set_num_threads(options.threads)
    files = [np.load(name, allow_pickle=False) for name in options.recordings]
    x, y, world = (torch.from_numpy(np.concatenate([f[name] for f in files])) for name in ("seen", "tilt", "world"))
    model = TiltEstimate(load_reflection(ROBOTS["h1"]()))
    # Learned in units of what usually happens, the same left and right.
    power = torch.cat([rows.float().square().mean(0, keepdim=True) for rows in x.split(100_000)]).mean(0, keepdim=True)
    scale = (0.5 * (power + model.reflection(power).abs())).sqrt().clamp_min(1e-2)
    kept_out = world % KEPT_OUT == 0
    learned = (~kept_out).nonzero()[:, 0]
    optimizer = torch.optim.AdamW(model.parameters(), lr=2e-3, weight_decay=options.decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.steps)
    for _ in range(options.steps):
        rows = learned[torch.randint(len(learned), (options.batch,))]
        loss = (model(x[rows].float() / scale) - y[rows].float()).square().sum(1).mean() * 100.0
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        told = torch.cat([model(rows.float() / scale) for rows in x[kept_out].split(100_000)])
        model.net[0].weight /= scale  # pyright: ignore[reportIndexIssue, reportArgumentType]
    true = y[kept_out].float()
    off, size = ((t.square().mean(0)).sqrt().tolist() for t in (told - true, true))
    print(
        f"{len(learned)} moments; off by {off[0]:.4f} and {off[1]:.4f} of {size[0]:.4f} and {size[1]:.4f} rad, x and y"
    )
    save_weights(model.net, options.output)
    print(f"wrote {options.output}")
    return 0


def main() -> int:
    """Parse the command line and run it. Returns the exit status: 0, or 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    pull = commands.add_parser("collect", help="pull at robots' hands")
    pull.add_argument("--checkpoint", default="base", help="policy that drives them")
    pull.add_argument("--stiffness", type=float, default=0.0, help="arms under CoTaP at this K_ee [N/m]; 0 for PD")
    pull.add_argument("--size", type=float, default=20.0, help="largest load, per axis, on each hand [N]")
    pull.add_argument("--blow", type=float, default=0.0, help="largest blow that comes beside loads [N]")
    pull.add_argument("--lean", choices=("truth", "sense"), default="sense", help="what robots lean by")
    pull.add_argument("--seconds", type=float, default=10.0)
    pull.add_argument("--num-envs", type=int, default=1024)
    pull.add_argument("--seed", type=int, default=0)
    pull.add_argument("--threads", type=int, default=1)
    pull.add_argument("--output", type=Path, required=True)
    pull.set_defaults(run=collect)
    learn = commands.add_parser("fit", help="learn from recordings")
    learn.add_argument("recordings", type=Path, nargs="+")
    learn.add_argument("--steps", type=int, default=6000)
    learn.add_argument("--batch", type=int, default=2048)
    learn.add_argument("--decay", type=float, default=1e-3)
    learn.add_argument("--threads", type=int, default=1)
    learn.add_argument("--output", type=Path, default=Path(load_sense.__file__).with_suffix(".npz"))
    learn.set_defaults(run=fit)
    options = parser.parse_args()
    try:
        return options.run(options)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
