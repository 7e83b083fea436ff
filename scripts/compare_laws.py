"""Every law of the arms side by side: static errors as in the paper's Table VI, and what backs its Table I.

python scripts/compare_laws.py static --pelvis free --repeats 64 --json static.json
python scripts/compare_laws.py properties --json properties.json
"""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Any

import torch
import tyro

from cotap.agents.checkpoint import write_json
from cotap.checks import require_one_of, require_range
from cotap.configs import to_plain
from cotap.envs import H1Env, H1EnvConfig
from cotap.evaluate import StaticStiffnessOptions, static_stiffness
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.stability import Stability, energy_summary, exchanged_energy, growth_rates
from cotap.evaluation.static import StaticStiffness, measure
from cotap.evaluation.wrong_model import misjudge
from cotap.robots import h1

LOADS_N = (10.0, 30.0, 50.0)
ROWS: dict[str, dict[str, Any]] = {
    "pd": {"method": "pd"},
    "soft-pd": {"method": "soft-pd"},
    "cotap, joint error": {"method": "cotap"},
    "cotap, task error": {"method": "cotap", "error": "task"},
    "facet": {"method": "facet"},
    "cotap+facet, joint error": {"method": "cotap+facet"},
    "cotap+facet, task error": {"method": "cotap+facet", "error": "task"},
    "cotap+facet-matched, joint error": {"method": "cotap+facet-matched"},
    "cotap+facet-matched, task error": {"method": "cotap+facet-matched", "error": "task"},
    "hmc, alpha 0.5": {"method": "hmc", "alpha": 0.5},
    "hmc, alpha 1": {"method": "hmc"},
    "dcc": {"method": "dcc"},
}
"""Laws by the name of their row."""


@dataclass
class Static:
    """Downward displacement of the left hand under 10, 30 and 50 N downward, every law."""

    checkpoint: str = ""
    """Policy of the legs (pelvis free); by default the shipped base policy."""
    pelvis: str = "free"
    """free or fixed."""
    stiffness: float = 500.0
    """Of the hand, along all axes [N/m]."""
    null_stiffness: float = 25.0
    """[Nm/rad]."""
    repeats: int = 16
    """Worlds per load."""
    settle_seconds: float = 8.0
    """How long a load is left to settle [s]; the last second is measured."""
    arm_actions: bool = False
    """Let the policy's own residual move the arms (pelvis free)."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""
    sensing: str = "privileged"
    """Force on the hand: privileged or estimated."""
    threads: int = 0
    """Processor threads; 0 takes every processor."""
    seed: int = 0
    """Seed of worlds."""
    laws: tuple[str, ...] = tuple(ROWS)
    """Rows to measure."""
    json: str = ""
    """Write the result here."""

    def measure(self) -> dict[str, Any]:
        """Downward displacements [m] under the three loads, by row."""
        rows = {}
        for name in self.laws:
            laws = LawOptions(
                stiffness=(self.stiffness,), null_stiffness=self.null_stiffness, sensing=self.sensing, **ROWS[name]
            )
            # 0, 10, ..., 50 N, each in worlds of its own.
            protocol = StaticStiffness(
                force=(0.0, 0.0, -50.0), pelvis=self.pelvis, levels=6, repeats=self.repeats, seed=self.seed,
                settle_seconds=self.settle_seconds, arm_actions=self.arm_actions,
                torque_limit_scale=self.torque_limit_scale,
            )  # fmt: skip
            options = StaticStiffnessOptions(
                checkpoint=self.checkpoint, threads=self.threads, laws=laws, protocol=protocol
            )
            with redirect_stdout(StringIO()):  # its own table
                result = static_stiffness(options)
            down = [d[2] for d in result["curve"]["displacement"]]
            rows[name] = {
                "displacement": [None if down[i] is None else -down[i] for i in (1, 3, 5)],
                "torque_saturated": result["torque_saturated"],
                "num_falls": result["num_falls"],
                "num_envs": result["num_envs"],
                "checkpoint_sha256": result["settings"]["checkpoint_sha256"],
            }
            print(f"  {name}", file=sys.stderr)
        return {"loads_n": LOADS_N, "ideal": [load / self.stiffness for load in LOADS_N], "rows": rows}

    def table(self, result: dict[str, Any]) -> str:
        """As Markdown, errors against the ideal in brackets."""
        lines = [f"| law | {' | '.join(f'{n:g} N' for n in LOADS_N)} | fell |", "|---|---|---|---|---|"]
        lines.append(f"| ideal | {' | '.join(f'{v:.4f}' for v in result['ideal'])} | |")
        for name, row in result["rows"].items():
            cells = [
                "-" if got is None else f"{got:.4f} ({got / ideal - 1.0:+.0%})"
                for got, ideal in zip(row["displacement"], result["ideal"], strict=True)
            ]
            lines.append(f"| {name} | {' | '.join(cells)} | {row['num_falls']} of {row['num_envs']} |")
        return "\n".join(lines)


@dataclass
class Properties:
    """What backs Table I: effect of the stiffness commanded, of a wrong model, growth of the loop, energy drawn."""

    stability: Stability = field(default_factory=Stability)
    stiffness: float = 500.0
    """[N/m]; the effect of changing it is that between half and twice of it."""
    load: float = 5.0
    """Downward, on the left hand [N]."""
    wrong_length: float = 1.1
    """Factor on the arms' links in the law's model, but not in the arms."""
    wrong_mass: float = 1.2
    """The same of their masses."""
    settle_seconds: float = 8.0
    """How long a load is left to settle [s]."""
    threads: int = 0
    """Processor threads; 0 takes every processor."""
    laws: tuple[str, ...] = tuple(ROWS)
    """Rows to measure."""
    json: str = ""
    """Write the result here."""

    def measure(self) -> dict[str, Any]:
        """All of it, by row."""
        self.stability.check()
        rows = {}
        for name in self.laws:
            soft, _ = self._moved(name, 0.5 * self.stiffness)
            stiff, _ = self._moved(name, 2.0 * self.stiffness)
            right, at = self._moved(name, self.stiffness)
            wrong, misled = self._moved(name, self.stiffness, wrong=True)
            arms = self._laws(name, self.stiffness).configure()
            cfg = self.stability.configure(H1EnvConfig(backend="mjbatch", num_threads=self.threads))
            cfg.upper_body = arms
            rows[name] = {
                "softer_over_stiffer": soft / stiff,
                "wrong_over_right_displacement": wrong / right,
                "wrong_model_shift": float((misled - at).norm()),
                "linearised": growth_rates(h1(), arms.left, self.stability),
                "energy": energy_summary(exchanged_energy(H1Env(cfg), self.stability)),
            }
            print(f"  {name}", file=sys.stderr)
        return {"rows": rows}

    def _laws(self, name: str, stiffness: float) -> LawOptions:
        return LawOptions(stiffness=(stiffness,), null_stiffness=25.0, **ROWS[name])

    def _moved(self, name: str, stiffness: float, wrong: bool = False) -> tuple[float, torch.Tensor]:
        """Downward displacement under the load, pelvis fixed, and where (3,) the hand is without one [m]."""
        protocol = StaticStiffness(force=(0.0, 0.0, -self.load), levels=2, settle_seconds=self.settle_seconds)
        cfg = protocol.configure(H1EnvConfig(backend="mjbatch", num_threads=self.threads))
        cfg.upper_body = self._laws(name, stiffness).configure()
        env = H1Env(cfg)
        if wrong:
            misjudge(env, self.wrong_length, self.wrong_mass)
        moved = -float(measure(env, protocol, None).displacement[-1, 2])
        return moved, env.state.arms.tip[0, 0].clone()

    def table(self, result: dict[str, Any]) -> str:
        """As Markdown."""
        lines = [
            f"| law | adjustable: displacement at {self.stiffness / 2:g} over {self.stiffness * 2:g} N/m (ideal 4) "
            "| wrong model: displacement over the right one's | shift without a load [m] "
            "| largest real part, free [1/s] | poses unstable, worst wall | trials drawn from "
            "| the same, stiffness changing |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for name, row in result["rows"].items():
            rest = [r for r in row["linearised"] if r["load_rad"] == 0.0]
            free = next((f"{r['largest_real_part']:+.2f}" for r in rest if r["wall"] == 0.0), "-")
            worst = max(rest, key=lambda r: r["share_unstable"])
            constant, changing = row["energy"]["constant_stiffness"], row["energy"]["changing_stiffness"]
            lines.append(
                f"| {name} | {row['softer_over_stiffer']:.2f} | {row['wrong_over_right_displacement']:.2f} "
                f"| {row['wrong_model_shift']:.4f} | {free} | {worst['share_unstable']:.1%} at {worst['wall']:g} N/m "
                f"| {constant['share_drawn']:.1%} | {changing['share_drawn']:.1%} |"
            )
        return "\n".join(lines)


TABLES = {"static": Static, "properties": Properties}


def main(argv: list[str] | None = None) -> int:
    """Parse, measure, report. Returns the exit status: 0, or 2 for bad input."""
    args = list(sys.argv[1:] if argv is None else argv)
    try:
        if not args or args[0] in ("-h", "--help"):
            print(f"usage: compare_laws.py TABLE [options]; tables: {', '.join(TABLES)}")
            return 0 if args else 2
        kind = TABLES[require_one_of("table", args[0], TABLES.keys())]
        options = tyro.cli(kind, args=args[1:], prog=f"compare_laws.py {args[0]}")
        for name in options.laws:
            require_one_of("law", name, ROWS.keys())
        require_range("stiffness", options.stiffness, 1.0, 1e5)
        require_range("threads", options.threads, 0, 4096)
        if options.threads:
            torch.set_num_threads(options.threads)
        if options.json and not Path(options.json).resolve().parent.is_dir():
            raise ValueError(f"--json {options.json!r}: its folder does not exist")
        result = options.measure()
        if options.json:
            write_json(Path(options.json), result | {"settings": to_plain(options)})
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(options.table(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
