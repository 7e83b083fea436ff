"""Every law of the arms side by side: the paper's Table VI and Fig. 9, and what backs its Table I.

python -m reports.compare_laws static --num-envs 384
python -m reports.compare_laws transient --num-envs 256
python -m reports.compare_laws properties

Each writes NAME.md, NAME.json and NAME.png into `--output`.
"""

from __future__ import annotations

import sys
import time
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Any

import torch
import tyro

from cotap.agents.checkpoint import write_json
from cotap.checks import require_one_of, require_range
from cotap.compare import difference
from cotap.compliance.laws import LawConfig, reads
from cotap.configs import to_plain
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import Options, run
from cotap.evaluation.disturbance import Impact
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.protocol import HELD
from cotap.evaluation.report import save_figure
from cotap.evaluation.rollout import idle
from cotap.evaluation.stability import Stability, energy_summary, exchanged_energy, growth_rates
from cotap.evaluation.static import StaticStiffness, settle
from cotap.files import write_atomically
from reports.law_figures import draw_properties, draw_static, draw_transient
from reports.paper.tables import PROPERTIES, STATIC
from reports.paper.words import hundredfold, number
from reports.wrong_model import misjudge

LOADS_N = (10.0, 30.0, 50.0)
COTAP: dict[str, Any] = {"method": "cotap", "alpha": 1.0, "error": "joint", "damping": "critical"}
TASK, DAMPED_AS_PD = {"error": "task"}, {"damping": "pd"}
ROWS: dict[str, dict[str, Any]] = {
    "pd": {"method": "pd"},
    "soft-pd": {"method": "soft-pd"},
    "cotap, joint error": COTAP,
    "cotap, task error": COTAP | TASK,
    "cotap, joint error, PD's damping": COTAP | DAMPED_AS_PD,
    "cotap, task error, PD's damping": COTAP | TASK | DAMPED_AS_PD,
    "facet": {"method": "facet"},
    "cotap+facet, joint error": COTAP | {"method": "cotap+facet"},
    "cotap+facet, task error": COTAP | {"method": "cotap+facet"} | TASK,
    "cotap+facet-matched, joint error": COTAP | {"method": "cotap+facet-matched"},
    "cotap+facet-matched, task error": COTAP | {"method": "cotap+facet-matched"} | TASK,
    "hmc, alpha 0.5": {"method": "hmc", "alpha": 0.5},
    "hmc, alpha 1": {"method": "hmc", "alpha": 1.0},
    "dcc": {"method": "dcc"},
}
"""Laws by the name of their row: what it says holds whatever the policy was trained with."""
AT_REST = tuple(name for name in ROWS if "damping" not in name)
"""Rows that differ at rest."""
STRUCK = (
    "pd", "facet", "cotap, joint error, PD's damping", "cotap, joint error", "cotap, task error",
    "cotap+facet, joint error", "cotap+facet-matched, joint error",
)  # fmt: skip
"""Rows that are struck."""


def laws_of(name: str, stiffness: float, null_stiffness: float, sensing: str = "privileged") -> LawOptions:
    """The laws of a row; what its law does not read is left out."""
    common = {"stiffness": (stiffness,), "null_stiffness": null_stiffness, "sensing": sensing}
    return LawOptions(**{k: v for k, v in common.items() if reads(ROWS[name]["method"], k)}, **ROWS[name])


@dataclass
class Static:
    """Downward displacement of the left hand under 10, 30 and 50 N downward, every law (paper, Table VI)."""

    checkpoint: str = "h1-cotap"
    """Policy (pelvis free): a file, or a shipped policy's name."""
    facet_checkpoint: str = ""
    """Policy of the row facet, which else has that of the others."""
    pelvis: str = "free"
    """free or fixed."""
    stiffness: float = 500.0
    """Of the hand, along all axes [N/m]."""
    null_stiffness: float = LawConfig.null_stiffness
    """Stiffness of arm motion that leaves the hand where it is [Nm/rad]."""
    num_envs: int = 96
    """Number of envs, dealt to the loads (0, 10, ... 50 N) evenly."""
    settle_seconds: float = 8.0
    """How long a load is left to settle [s]; the last second is measured."""
    upper_actions: str = "reference"
    """What moves the arms (pelvis free): policy, or reference for the raw reference."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""
    sensing: str = "privileged"
    """Force on the hand: privileged or estimated."""
    threads: int = 0
    """CPU threads; 0 takes every CPU."""
    seed: int = 0
    """Seed of envs."""
    laws: tuple[str, ...] = AT_REST
    """Rows to measure."""
    output: str = "runs/laws"
    """Folder of what is written."""

    def measure(self) -> dict[str, Any]:
        """Downward displacements [m] under the three loads, by row."""
        rows = {}
        for name in self.laws:
            # 0, 10, ..., 50 N, each in envs of its own.
            protocol = StaticStiffness(
                force=(0.0, 0.0, -50.0), pelvis=self.pelvis, levels=6, num_envs=self.num_envs, seed=self.seed,
                settle_seconds=self.settle_seconds, upper_actions=self.upper_actions,
                torque_limit_scale=self.torque_limit_scale,
            )  # fmt: skip
            laws = laws_of(name, self.stiffness, self.null_stiffness, self.sensing)
            options = Options(protocol, laws, checkpoint=policy_of(self, name), threads=self.threads)
            with redirect_stdout(StringIO()):  # its own table
                result = run("static-stiffness", options)
            curve = result["curve"]
            levels = (1, 3, 5)
            rows[name] = {
                "displacement": [_down(curve["displacement"][i]) for i in levels],
                "half_interval": [_half_interval(curve["spread"][i][2], curve["standing"][i]) for i in levels],
                "torque_saturated": result["torque_saturated"],
                "num_falls": result["num_falls"],
                "num_envs": result["num_envs"],
                "checkpoint_sha256": result["settings"]["checkpoint_sha256"],
            }
            print(f"  {name}", file=sys.stderr)
        return {"loads_n": LOADS_N, "ideal": [load / self.stiffness for load in LOADS_N], "rows": rows}

    def table(self, result: dict[str, Any]) -> str:
        """As Markdown, in centimetres; errors against the ideal in brackets."""
        ideal = result["ideal"]
        loads = " | ".join(f"{n:g} N" for n in LOADS_N)
        lines = [f"| law, displacement [cm] | {loads} | torque limit | fell | paper |", "|---|---|---|---|---|---|---|"]
        lines.append(f"| ideal | {' | '.join(f'{100.0 * v:.1f}' for v in ideal)} | | | |")
        for name, row in result["rows"].items():
            measured = zip(row["displacement"], row["half_interval"], ideal, strict=True)
            cells = " | ".join(_displacement(*one) for one in measured)
            paper = " / ".join(f"{100.0 * v:g}" for v in STATIC[name]) if name in STATIC else ""
            reached = "reached" if row["torque_saturated"] else ""
            lines.append(f"| {name} | {cells} | {reached} | {row['num_falls']} of {row['num_envs']} | {paper} |")
        envs = f"{self.num_envs // 6} envs or more per load"
        return "\n".join([*lines, "", f"Pelvis {self.pelvis}, arms held, {envs}, {self.stiffness:g} N/m."])

    def draw(self, result: dict[str, Any]) -> Any:
        """Displacement against load."""
        return draw_static(result)


def _displacement(got: float | None, half: float | None, ideal: float) -> str:
    """A mean with the half of its interval, if it has one [cm], and its error as a share of the ideal."""
    if got is None:
        return "-"
    interval = "" if half is None else f"±{100.0 * half:.1f}"
    return f"{100.0 * got:.1f}{interval} ({got / ideal - 1.0:+.0%})"


def _half_interval(std: float, envs: int) -> float | None:
    """Of the mean over so many envs, with 95 % probability; None of fewer than two."""
    return 1.96 * std / envs**0.5 if envs > 1 else None


def _down(displacement: list[float | None]) -> float | None:
    return None if displacement[2] is None else -displacement[2]


def policy_of(options: Static | Transient, name: str) -> str:
    """The checkpoint of a row."""
    return (options.facet_checkpoint if name == "facet" else "") or options.checkpoint


@dataclass
class Transient:
    """What a hand does after a push on it, every law (paper, Fig. 9): error over time, energy of its oscillation."""

    checkpoint: str = "h1-cotap"
    """Policy: a file, or a shipped policy's name."""
    facet_checkpoint: str = ""
    """Policy of the row facet, which else has that of the others."""
    forces: tuple[float, ...] = (200.0, 500.0)
    """Along x on the left hand, for 50 ms [N]. The smaller leaves arms under PD and CoTaP below their torque limits."""
    stiffness: float = 500.0
    """Of the hand, along all axes [N/m]."""
    null_stiffness: float = LawConfig.null_stiffness
    """Stiffness of arm motion that leaves the hand where it is [Nm/rad]."""
    num_envs: int = 64
    """Envs per law and force."""
    mode: str = "stance"
    """stance or walking."""
    pelvis: str = "free"
    """free or fixed."""
    upper_actions: str = "policy"
    """What moves the arms: policy, or reference for the raw reference."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""
    threads: int = 0
    """CPU threads; 0 takes every CPU."""
    seed: int = 0
    """Seed of envs."""
    laws: tuple[str, ...] = STRUCK
    """Rows to measure."""
    output: str = "runs/laws"
    """Folder of what is written."""

    def measure(self) -> dict[str, Any]:
        """Measures and curves, by force and row."""
        forces = {}
        for force in self.forces:
            rows = forces[f"{force:g}"] = {}
            for name in self.laws:
                protocol = Impact(
                    num_envs=self.num_envs, seed=self.seed, mode=self.mode, pelvis=self.pelvis, motion=(HELD,),
                    upper_actions=self.upper_actions, torque_limit_scale=self.torque_limit_scale,
                    force=(force, 0.0, 0.0),
                )  # fmt: skip
                laws = laws_of(name, self.stiffness, self.null_stiffness)
                options = Options(protocol, laws, checkpoint=policy_of(self, name), threads=self.threads)
                with redirect_stdout(StringIO()):  # its own table
                    result = run("impact", options)
                kept = ("num_envs", "num_falls", "metrics_without_falls", "window", "curve")
                rows[name] = {k: result[k] for k in kept} | {
                    "checkpoint_sha256": result["settings"]["checkpoint_sha256"]
                }
                print(f"  {force:g} N, {name}", file=sys.stderr)
        return {"forces": forces}

    def table(self, result: dict[str, Any]) -> str:
        """As Markdown: a table per force, and whether a hand oscillates less than FACET's, as in the paper."""
        lines = []
        for force, rows in result["forces"].items():
            lines += [
                f"**{force} N for 50 ms, {self.mode}, pelvis {self.pelvis}, arms held, {self.stiffness:g} N/m**", "",
                "| law | error of the hand, mean of 1 s [m] | arms at their torque limit [%] "
                "| energy of oscillation [J/kg] | beside FACET's | overshoot [%] | settled [s] | fell |",
                "|---|---|---|---|---|---|---|---|",
            ]  # fmt: skip
            for name, row in rows.items():
                m = row["metrics_without_falls"]
                cells = [
                    number(m["e_ee_hit"]), hundredfold(m["share_at_limit"], 0), number(m["oscillation_energy"]),
                    _beside_facet(rows, name), hundredfold(m["overshoot"], 0), number(m["settle_s"], 2),
                ]  # fmt: skip
                lines.append(f"| {name} | {' | '.join(cells)} | {row['num_falls']} of {row['num_envs']} |")
            lines.append("")
        return "\n".join(lines).rstrip()

    def draw(self, result: dict[str, Any]) -> Any:
        """The hand's displacement along the push over time."""
        return draw_transient(result)


def _beside_facet(rows: dict[str, Any], name: str) -> str:
    """Whether a hand oscillates less than FACET's, by the interval of the difference."""
    if name == "facet" or "facet" not in rows:
        return ""
    d = difference(*(rows[n]["metrics_without_falls"]["oscillation_energy"] for n in ("facet", name)))
    if d["difference"] is None:
        return f"({d['reason']})"
    low, high = d["ci95"]
    return "**less**" if high < 0.0 else "more" if low > 0.0 else "cannot be distinguished"


@dataclass
class Properties:
    """What backs Table I: effect of the stiffness commanded, of a wrong model, growth of the loop, energy drawn."""

    stability: Stability = field(default_factory=Stability)
    robot: str = "h1"
    """Whose arms."""
    stiffness: float = 500.0
    """[N/m]; the effect of changing it is that between half and twice of it."""
    null_stiffness: float = LawConfig.null_stiffness
    """Stiffness of arm motion that leaves the hand where it is [Nm/rad]."""
    load: float = 5.0
    """Downward, on the left hand [N]."""
    wrong_length: float = 1.1
    """Factor on joint offsets and centres of mass, but for each arm's first link's, in the law's model."""
    wrong_mass: float = 1.2
    """Factor on the masses of the same links there."""
    settle_seconds: float = 8.0
    """How long a load is left to settle [s]."""
    threads: int = 0
    """CPU threads; 0 takes every CPU."""
    laws: tuple[str, ...] = tuple(ROWS)
    """Rows to measure."""
    output: str = "runs/laws"
    """Folder of what is written."""

    def measure(self) -> dict[str, Any]:
        """All of it, by row."""
        self.stability.check()
        require_range("load", self.load, 0.1, 1000.0)
        require_range("settle_seconds", self.settle_seconds, 2.0, 600.0)
        rows = {}
        for name in self.laws:
            k = self.stiffness
            (soft, stiff, right), at = self._moved(name, (0.5 * k, 2.0 * k, k))
            (wrong,), misled = self._moved(name, (k,), wrong=True)
            arms = laws_of(name, self.stiffness, self.null_stiffness).configure()
            cfg = self.stability.configure(
                HumanoidEnvConfig(robot=self.robot, backend="mujoco", num_threads=self.threads)
            )
            cfg.upper_body = arms
            env = HumanoidEnv(cfg)
            rows[name] = {
                "softer_over_stiffer": soft / stiff,
                "wrong_over_right_displacement": wrong / right,
                "wrong_model_shift": float((misled - at).norm()),
                "linearised": growth_rates(env.spec, arms.built(arms.left), self.stability, env.dt),
                "energy": energy_summary(exchanged_energy(env, self.stability)[0]),
            }
            print(f"  {name}", file=sys.stderr)
        return {"rows": rows}

    def _moved(self, name: str, stiffness: tuple[float, ...], wrong: bool = False) -> tuple[list[float], torch.Tensor]:
        """Downward displacements under the load at these stiffnesses, and where (3,) a hand is without one [m].

        Pelvis fixed; the stiffness of the hand without a load is the last.
        """
        protocol = StaticStiffness(num_envs=1 + len(stiffness), levels=2, settle_seconds=self.settle_seconds)
        cfg = protocol.configure(HumanoidEnvConfig(robot=self.robot, backend="mujoco", num_threads=self.threads))
        cfg.upper_body = laws_of(name, stiffness[-1], self.null_stiffness).configure()
        env = HumanoidEnv(cfg)
        if wrong:
            misjudge(env, self.wrong_length, self.wrong_mass)
        env.upper_body.parameters.stiffness[:-1] = torch.tensor(stiffness)[:, None, None]
        protocol.prepare(env)
        force = torch.zeros(env.num_envs, 3)
        force[:-1, 2] = -self.load
        side = protocol.load(env, force)
        moved = settle(env, idle(env), self.settle_seconds, side).moved[:-1, 2]
        return (-moved).tolist(), env.state.arms.tip[-1, side].clone()

    def table(self, result: dict[str, Any]) -> str:
        """As Markdown: Table I in figures, and what the stability column sums up."""
        lines = [
            f"| law | adjustable: displacement at {self.stiffness / 2:g} over that at {self.stiffness * 2:g} N/m (4 if "
            "the hand obeys) | model-aware: displacement under a wrong model over that under the right one "
            "| and where the hand goes without a load [mm] | stable: poses unstable, hand free / worst wall "
            "| energy drawn, share of trials: stiffness constant / changing | the paper's Table I |",
            "|---|---|---|---|---|---|---|",
        ]
        for name, row in result["rows"].items():
            energy = (row["energy"][f"{k}_stiffness"]["share_drawn"] for k in ("constant", "changing"))
            shares = [max(part, default=0.0) for part in _shares_unstable(row)]
            lines.append(
                f"| {name} | {row['softer_over_stiffer']:.2f} | {row['wrong_over_right_displacement']:.2f} "
                f"| {1e3 * row['wrong_model_shift']:.1f} | {' / '.join(f'{v:.1%}' for v in shares)} "
                f"| {' / '.join(f'{v:.1%}' for v in energy)} | {PROPERTIES.get(ROWS[name]['method'], '')} |"
            )
        lines += ["", "| law | stiffness | least energy, mean [J] | least of all [J] | trials drawn from | diverged |",
                  "|---|---|---|---|---|---|"]  # fmt: skip
        for name, row in result["rows"].items():
            for key, e in row["energy"].items():
                if not e["share_drawn"] and not e["num_diverged"]:
                    continue
                least = " | ".join(
                    "-" if e[k] is None else f"{e[k]:+.4f}" for k in ("mean_least_energy", "least_energy")
                )
                lines.append(
                    f"| {name} | {key.split('_')[0]} | {least} | {e['share_drawn']:.1%} of {e['trials']} "
                    f"| {e['num_diverged']} |"
                )
        energy = (
            "The second table has the laws that gave energy away under random swinging forces, or diverged; "
            "properties.json has all. `cotap evaluate passivity` searches for the forces that draw most."
        )
        wrong = (
            f"a wrong model has joint offsets and centres of mass {self.wrong_length:g} times as far out and masses "
            f"{self.wrong_mass:g} times as large as they are, but for each arm's first link; rotational inertias stay."
        )
        return "\n".join([*lines, "", f"{energy} {self.stability.poses} poses; {wrong}"])

    def draw(self, result: dict[str, Any]) -> Any:
        """Bars per law."""
        return draw_properties(result)


def _shares_unstable(row: dict[str, Any]) -> tuple[list[float], list[float]]:
    """Of all poses, hand free and hand held."""
    free, held = [], []
    for r in row["linearised"]:
        (held if r["wall"] else free).append(r["share_unstable"])
    return free, held


TABLES = {"static": Static, "transient": Transient, "properties": Properties}


def main(argv: list[str] | None = None) -> int:
    """Parse, measure, report. Returns the exit status: 0, or 2 for bad input."""
    args = list(sys.argv[1:] if argv is None else argv)
    try:
        if not args or args[0] in ("-h", "--help"):
            print(f"usage: python -m reports.compare_laws TABLE [options]; tables: {', '.join(TABLES)}")
            return 0 if args else 2
        kind = TABLES[require_one_of("table", args[0], TABLES.keys())]
        options = tyro.cli(kind, args=args[1:], prog=f"python -m reports.compare_laws {args[0]}")
        for name in options.laws:
            require_one_of("law", name, ROWS.keys())
        require_range("stiffness", options.stiffness, 1.0, 1e5)
        require_range("threads", options.threads, 0, 4096)
        if options.threads:
            torch.set_num_threads(options.threads)
        output = Path(options.output)
        output.mkdir(parents=True, exist_ok=True)
        started = time.perf_counter()
        result = options.measure()
        table = options.table(result)
        seconds = time.perf_counter() - started
        content = result | {"settings": to_plain(options), "seconds": seconds}
        write_json(output / f"{args[0]}.json", content)
        write_atomically(output / f"{args[0]}.md", lambda p: p.write_text(table + "\n", encoding="utf-8"))
        save_figure(options.draw(result), output / f"{args[0]}.png")
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
