"""The task of learned modulation: a policy that sets alpha and stiffness beside the best constant setting.

python -m reports.modulation_grid --checkpoint runs/modulated/checkpoint_002441.pt

Writes modulation_grid.md and modulation_grid.json. A grid over alpha and a stiffness alike along all axes comes first;
then stiffness is refined axis by axis around the best of it. The setting with the largest return, an oracle and the
policy then run with another seed, so that luck in the grid does not count, each without and with an energy store, the
setting also with the policy's own legs, which have learned to stand in the task. Targets of the arms are their raw
reference throughout, because targets can give way as laws can. The oracle sets the laws by the hand's true state, which
no policy sees, within the modulation's rates: for hands that are free, loaded and pushed it takes the setting of the
grid that is best for that part. It says what there is to gain.
"""

from __future__ import annotations

import contextlib
import io
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
import tyro

from cotap.agents.checkpoint import write_json
from cotap.checks import require_positive_int, require_range, require_seed, shortened
from cotap.compare import measure_difference
from cotap.configs import to_plain
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.modulation import Modulation
from cotap.evaluate import Options as EvaluateOptions
from cotap.evaluate import run
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.protocol import Protocol
from cotap.evaluation.task import PARTS, Task
from cotap.files import write_atomically
from reports.cells import cell

SHOWN = ("return", *PARTS, "alpha", "stiffness", "fall_fraction")
"""Columns of the table of settings."""
COMPARED = ("return", *(f"return_{part}" for part in PARTS), *PARTS, "fall_fraction")
"""Rows of the table of differences."""
REFINED_BY = (4.0, 2.0)
"""Factors by which the stiffness along axes is changed, one after the other, around the best setting."""
AXES = ((0,), (1,), (2,), (0, 1))
"""Axes whose stiffness is changed together: each of x, y and z, and the horizontal ones."""
STORE = {False: "no store", True: "store"}

Setting = tuple[float, float, float, float]
"""Alpha, and stiffness along x, y and z [N/m]."""


@dataclass
class Options:
    """What is compared."""

    checkpoint: str = ""
    """The policy that sets the laws; empty for none: best constant setting and oracle alone."""
    constant_checkpoint: str = "h1-cotap"
    """The policy whose legs carry the grid, the best setting and the oracle."""
    alphas: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)
    """Of the grid."""
    stiffnesses: tuple[float, ...] = (80.0, 160.0, 300.0, 600.0, 1200.0)
    """Of the grid, alike along all axes [N/m]; refined ones stay within. At alpha 0 it does nothing, and the first one
    is run alone."""
    num_envs: int = 1024
    """Envs of the comparison."""
    grid_envs: int = 256
    """Envs of each setting of the grid."""
    episode_seconds: float = 20.0
    """Length of each evaluation [s]."""
    seed: int = 0
    """Of the grid; the comparison has the next one."""
    threads: int = 0
    """CPU threads; 0 takes every CPU."""
    output: str = "runs/modulation_grid"
    """Folder of what is written."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name, low, high in (("alphas", 0.0, 1.0), ("stiffnesses", 1.0, 1e5)):
            require_positive_int(f"number of {name}", len(getattr(self, name)))
            for i, value in enumerate(getattr(self, name)):
                require_range(f"{name}[{i}]", value, low, high)
        require_positive_int("num_envs", self.num_envs)
        require_positive_int("grid_envs", self.grid_envs)
        require_seed("seed", self.seed)
        require_range("episode_seconds", self.episode_seconds, 0.1, 3600.0)

    def settings(self) -> list[Setting]:
        """Those of the grid."""
        pairs = product(self.alphas, self.stiffnesses)
        return [(alpha, k, k, k) for alpha, k in pairs if alpha > 0.0 or k == self.stiffnesses[0]]

    def refined(self, best: Setting, factor: float) -> list[Setting]:
        """Settings around `best`, stiffer and softer along some axes by `factor`, within the grid's bounds."""
        low, high = min(self.stiffnesses), max(self.stiffnesses)
        found = {best: None}  # keeps their order
        for axes, change in product(AXES, (factor, 1.0 / factor)):
            alpha, *k = best
            x, y, z = (min(max(v * change, low), high) if i in axes else v for i, v in enumerate(k))
            found[alpha, x, y, z] = None
        return [setting for setting in found if setting != best]


@dataclass
class Trial(Task):
    """The task, with or without an energy store, and perhaps with an oracle."""

    passive: bool = False
    """Whether the laws have an energy store, whatever the policy was trained with."""
    by_state: tuple[Setting, ...] = ()
    """Settings of hands that are free, loaded and pushed; empty for laws as they are."""

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this trial's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        laws = env_cfg.upper_body
        laws.left.passive = laws.right.passive = self.passive
        if self.by_state:
            laws.modulation.hold()
        return env_cfg

    def prepare(self, env: HumanoidEnv) -> None:
        """Nothing is recorded yet, and no hand is touched."""
        super().prepare(env)
        laws = [env.cfg.upper_body.of(arm.side) for arm in env.spec.arms]
        self._rates = Modulation(replace(env.cfg.upper_body.modulation, kind="stiffness"), laws, env.dt)

    def before_step(self, env: HumanoidEnv, step: int) -> None:
        """Keep what the last step was worth, and set the laws by the state that hands were in."""
        super().before_step(env, step)
        if self.by_state:
            free = torch.zeros(env.num_envs, len(env.spec.arms), dtype=torch.long, device=env.device)
            state = hand_states(env) if step else free
            self._rates.approach(env.upper_body.parameters, asked(self.by_state, state))


def hand_states(env: HumanoidEnv) -> torch.Tensor:
    """(N, A) what acted on hands in the last step: 0 nothing; 1 a load, or a load and a push; 2 a push alone."""
    record = env.record
    return torch.where(record.free_hands, 0, torch.where(record.pushed_hands, 2, 1))


def asked(by_state: Sequence[Setting], state: torch.Tensor) -> torch.Tensor:
    """What `Modulation.approach` is to bring about for arms in `state` (N, A), (N, 4 A)."""
    rows = [[alpha, *map(math.log, stiffness)] for alpha, *stiffness in by_state]
    return torch.tensor(rows, device=state.device)[state].flatten(1)


def measure(options: Options) -> dict[str, Any]:
    """The grid, and the policy and the oracle beside its best setting."""
    grid = _grid(options)
    best = _best(grid, "return")
    by_state = tuple(_best(grid, f"return_{part}") for part in PARTS)
    start = options.constant_checkpoint
    rows: list[dict[str, Any]] = []
    for passive in (False, True):

        def tried(
            path: str, constant: Setting | None = None, by_state: tuple[Setting, ...] = (), passive: bool = passive
        ) -> dict[str, Any]:
            again = {"num_envs": options.num_envs, "seed": options.seed + 1, "per_env": True}
            trial = Trial(**again, upper_actions="reference", by_state=by_state, passive=passive)
            return _run(options, path, trial, constant)

        here = [{"label": f"best constant: {_named(best)}", **tried(start, best)}]
        here.append({"label": "oracle: set by the hand's true state", **tried(start, by_state=by_state)})
        if options.checkpoint:
            here.append({"label": "best constant, the policy's legs", **tried(options.checkpoint, best)})
            here.append({"label": "set by the policy", **tried(options.checkpoint)})
        for row in here:
            more = {name: measure_difference(here[0], row, name, False) for name in COMPARED}
            rows.append(row | {"passive": passive, "less_constant": more})
    for row in rows:  # they have served their purpose
        del row["per_env"]
    return {"grid": grid, "best": best, "by_state": dict(zip(PARTS, by_state, strict=True)), "compared": rows}


def _grid(options: Options) -> list[dict[str, Any]]:
    """Every setting of the grid, and those around its best, with what they got."""
    rows: list[dict[str, Any]] = []

    def add(settings: list[Setting]) -> None:
        for setting in settings:
            print(f"  {_named(setting)}", file=sys.stderr)
            trial = Trial(num_envs=options.grid_envs, seed=options.seed, upper_actions="reference")
            rows.append({"setting": setting, **_run(options, options.constant_checkpoint, trial, setting)})

    add(options.settings())
    for factor in REFINED_BY:
        known = {row["setting"] for row in rows}
        add([new for new in options.refined(_best(rows, "return"), factor) if new not in known])
    return rows


def _best(rows: list[dict[str, Any]], measure: str) -> Setting:
    """The setting with the largest mean of a measure."""
    return max(rows, key=lambda row: row["metrics"][measure]["mean"])["setting"]


def _run(options: Options, path: str, trial: Trial, constant: Setting | None) -> dict[str, Any]:
    """What `cotap compare` reads of a trial, at a constant setting or as the policy or the oracle sets the laws."""
    laws = LawOptions() if constant is None else LawOptions(alpha=constant[0], stiffness=constant[1:])
    timed = replace(trial, episode_seconds=options.episode_seconds)
    given: EvaluateOptions[Protocol] = EvaluateOptions(timed, laws, path, threads=options.threads)
    with contextlib.redirect_stdout(io.StringIO()):  # its own table
        result = run("task", given)
    settings = {"seed": trial.seed, "checkpoint_sha256": result["settings"]["checkpoint_sha256"]}
    kept = {name: result[name] for name in ("metrics", "per_env", "num_falls") if name in result}
    return {**kept, "settings": settings}


def table(result: dict[str, Any]) -> str:
    """As Markdown."""
    lines = [f"| setting | {' | '.join(SHOWN)} |", "|---" * (1 + len(SHOWN)) + "|"]
    lines += [_row(_named(row["setting"]), row) for row in result["grid"]]
    rows = result["compared"]
    lines += [_row(f"{row['label']}; {STORE[row['passive']]}", row) for row in rows]
    others = [row for row in rows if row["label"] != rows[0]["label"]]
    heads = [f"{row['label'].partition(':')[0]}, {STORE[row['passive']]}" for row in others]
    lines += ["", f"| less the best constant | {' | '.join(heads)} |", "|---" * (1 + len(others)) + "|"]
    for name in COMPARED:
        lines.append(f"| {name} | {' | '.join(_gained(row['less_constant'][name]) for row in others)} |")
    states = "; ".join(f"{part} {_named(setting)}" for part, setting in result["by_state"].items())
    about = (
        "Mean (95 % interval) over envs; returns per second, errors in m, resistance in N, stiffness in N/m. "
        f"Differences are env by env. The oracle's settings, by what they are best for: {states}."
    )
    return "\n".join([*lines, "", about])


def _named(setting: Setting) -> str:
    alpha, *stiffness = setting
    shown = dict.fromkeys(f"{k:g}" for k in stiffness) if len(set(stiffness)) == 1 else [f"{k:g}" for k in stiffness]
    return f"alpha {alpha:g}, {' x '.join(shown)} N/m"


def _row(label: str, row: dict[str, Any]) -> str:
    return f"| {label} | {' | '.join(cell(row['metrics'][name]) for name in SHOWN)} |"


def _gained(d: dict[str, Any]) -> str:
    if d["difference"] is None:
        return "-"
    low, high = d["ci95"]
    return f"{d['difference']:+.3f} ({low:+.3f} to {high:+.3f})"


def main(argv: list[str] | None = None) -> int:
    """Parse, measure, report. Returns the exit status: 0, or 2 for bad input."""
    options = tyro.cli(Options, args=argv, description=__doc__, prog="python -m reports.modulation_grid")
    try:
        options.check()
        output = Path(options.output)
        output.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        result = measure(options)
        result |= {"settings": to_plain(options), "seconds": time.perf_counter() - start}
        write_json(output / "modulation_grid.json", result)
        text = table(result) + "\n"
        write_atomically(output / "modulation_grid.md", lambda p: p.write_text(text, encoding="utf-8"))
    except (ValueError, OSError) as error:
        print(f"error: {shortened(str(error))}", file=sys.stderr)
        return 2
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
