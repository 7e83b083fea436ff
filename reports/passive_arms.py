"""The energy store against adversaries, on arms of a fixed base whose own energy is accounted for to 1e-9 J.

python -m reports.passive_arms --output docs/laws

Writes passive_arms.json and passive_arms.md there. Needs no policy and no engine. A search lets exciters loose on
CoTaP's law with a store; then the best of them do the same to the law without.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
import tyro
from tqdm import tqdm

from cotap.agents.checkpoint import write_json
from cotap.checks import require_one_of, require_positive_int, require_range, require_seed
from cotap.compliance.arguments import symmetric_part
from cotap.compliance.dynamics import joint_inertia
from cotap.compliance.interface import Arms, ArmState, LawParameters, LawReport, TorqueLaw
from cotap.compliance.laws import DAMPINGS, LAWS, LawConfig
from cotap.compliance.passivity import rate_margin
from cotap.configs import to_plain
from cotap.evaluation.exciter import COMMANDS, GENES, Exciters, Limits, natural_frequency, next_generation
from cotap.evaluation.metrics import summarize
from cotap.evaluation.passivity import Tally
from cotap.evaluation.stability import random_poses
from cotap.files import write_atomically
from cotap.robots import ROBOTS
from cotap.robots.chains import arm_model
from reports.arm_motion import Motion, Pulled, rates
from reports.cells import cell

DT = 0.02
LIMITS = Limits(force=15.0, brake=40.0, stiffness=(80.0, 1200.0), seconds=math.nan)
"""Of all exciters; how long they have is an option."""
MEAN_N_M = math.sqrt(math.prod(LIMITS.stiffness))


@dataclass
class Options:
    """Which arms, and how many exciters."""

    robots: tuple[str, ...] = ("h1", "g1")
    """Whose arms."""
    dampings: tuple[str, ...] = DAMPINGS
    """Dampings of the law: critical or pd."""
    exciters: int = 2000
    """Exciters of a generation, each on an arm at a pose of its own."""
    generations: int = 5
    """Generations of the search."""
    seconds: float = 3.0
    """Time that an exciter has [s]."""
    substeps: int = 2
    """Steps of the simulation in a control step of 20 ms."""
    seed: int = 0
    """Of poses and search."""
    output: str = "runs/laws"
    """Folder of what is written."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for robot in self.robots:
            require_one_of("robots", robot, ROBOTS.keys())
        for damping in self.dampings:
            require_one_of("dampings", damping, DAMPINGS)
        require_range("exciters", self.exciters, 4 * len(COMMANDS), 1_000_000)
        require_positive_int("generations", self.generations)
        require_range("seconds", self.seconds, 0.1, 3600.0)
        require_positive_int("substeps", self.substeps)
        require_seed("seed", self.seed)


@dataclass(frozen=True)
class Trial:
    """What a generation of N exciters has done."""

    tally: Tally
    meets: torch.Tensor
    """(N,) share of the changes of stiffness made that meet the rate condition, and so need no store."""


class Bench:
    """A and A arms side by side, N in all, under one law, at poses at which they begin and which they hold.

    Args:
        arms: Of a robot, in float64.
        law: What drives them.
        pose: (N / A, A, n) [rad].
        options: How long an episode is, in steps of which size.
    """

    def __init__(self, arms: Arms, law: LawConfig, pose: torch.Tensor, options: Options) -> None:
        self._arms, self._cfg, self._pose, self._options = arms, law, pose, options
        begin = arms.chains.pose(pose)
        self.natural = natural_frequency(arms, begin, MEAN_N_M).flatten()
        """(N,) natural angular frequency of the hands [rad/s]."""
        self._home = begin.tip
        self._upright = torch.eye(3, dtype=pose.dtype).expand(len(pose), 3, 3)

    def exciters(self, genes: torch.Tensor, command: torch.Tensor) -> Exciters:
        """With genes (N, GENES) and commands (N,), one to a hand."""
        limits = replace(LIMITS, seconds=self._options.seconds)
        return Exciters(genes, command, self.natural, limits, self._options.seed)

    def try_out(self, genes: torch.Tensor, command: torch.Tensor) -> Trial:
        """An episode of every exciter, its pull steady over a control step."""
        exciters = self.exciters(genes, command)
        law, motion = LAWS["cotap"](self._arms, self._cfg), Motion(self._pose, torch.zeros_like(self._pose))
        tally, meets, before = Tally.empty(len(genes), "cpu"), torch.zeros_like(self.natural), None
        tally.drawn = tally.drawn.double()
        steps = round(self._options.seconds / DT)
        for step in range(steps):
            speed, pose = rates(self._arms, motion), self._arms.chains.pose(motion.angle)
            velocity = (self._arms.chains.jacobian(pose) @ speed.unsqueeze(-1)).flatten(0, 1).squeeze(-1)
            asked = exciters.command(step * DT, (pose.tip - self._home).flatten(0, 1), velocity)
            state = ArmState(motion.angle, speed, self._pose, pose, self._upright, fresh=self._fresh(step), dt=DT)
            torque, report = law(state, self._parameters(*asked))
            force = exciters.force(step * DT, velocity).unflatten(0, self._pose.shape[:2])
            motion = self._on(motion, torque, force, report, tally)
            meets += self._meets(pose, torque, before or torque)
            before = torque
        return Trial(tally, meets / steps)

    def _on(self, motion: Motion, torque: TorqueLaw, force: torch.Tensor, report: LawReport, tally: Tally) -> Motion:
        """A control step; what the force does is added to the tally."""
        pulled, store = Pulled(self._arms, torque, force), report.values.get("store_energy")
        tip = self._arms.chains.pose(motion.angle).tip
        for _ in range(self._options.substeps):
            motion = pulled.after(motion, DT / self._options.substeps)
            reached = self._arms.chains.pose(motion.angle).tip
            work = (force * (reached - tip)).sum(-1).flatten()
            tally.add(work, tally.fell, None if store is None else store.flatten().unsqueeze(1))
            tip = reached
        return self._ended(motion, tally)

    def _ended(self, motion: Motion, tally: Tally) -> Motion:
        """Ends episodes of arms of which a joint has left its range of angle or speed; these rest where they began."""
        arms = self._arms
        out = (motion.angle < arms.low) | (motion.angle > arms.high) | (rates(arms, motion).abs() > arms.speed)
        out = out.any(-1)
        tally.fell = tally.fell | out.flatten()
        over = tally.fell.unflatten(0, out.shape).unsqueeze(-1)
        return Motion(torch.where(over, self._pose, motion.angle), torch.where(over, 0.0, motion.momentum))

    def _meets(self, pose: Any, torque: TorqueLaw, before: TorqueLaw) -> torch.Tensor:
        """(N,) 1 where the last change, spread over a control step, meets the condition at both of its ends."""
        mass = joint_inertia(self._arms.inertias, pose)
        ends = [(symmetric_part(x.damping), symmetric_part(x.stiffness)) for x in (before, torque)]
        slack, change = ((now - then) / DT for then, now in zip(*ends, strict=True))
        margins = [rate_margin(mass, damping, stiffness, change, slack) for damping, stiffness in ends]
        return (torch.minimum(*margins) >= 0.0).double().flatten()

    def _fresh(self, step: int) -> torch.Tensor:
        return torch.full(self._pose.shape[:2], step == 0)

    def _parameters(self, stiffness: torch.Tensor, alpha: torch.Tensor) -> LawParameters:
        """Of the law, with what exciters (N,) command."""
        shape = self._pose.shape[:2]
        null = torch.full(shape, self._cfg.null_stiffness, dtype=self._pose.dtype)
        return LawParameters(stiffness.unflatten(0, shape), null, alpha.unflatten(0, shape))


def measure(robot: str, damping: str, options: Options) -> dict[str, Any]:
    """Search with the store, and try the best exciters without."""
    spec, rng = ROBOTS[robot](), torch.Generator().manual_seed(options.seed)
    arms = arm_model(spec).to(torch.float64)
    rest = torch.tensor([[spec.joint(name).default_rad for name in arm.joints] for arm in spec.arms]).double()
    pairs = -(-options.exciters // len(spec.arms))
    pose = torch.lerp(rest.expand(pairs, -1, -1), random_poses(spec, pairs, rng).double(), 0.5)
    law = LawConfig("cotap", damping=damping, passive=True)
    held, free = (Bench(arms, replace(law, passive=passive), pose, options) for passive in (True, False))
    count = pose.shape[0] * pose.shape[1]
    command = torch.arange(count) % len(COMMANDS)
    best = torch.randn(count, GENES, generator=rng, dtype=torch.float64)
    trial = held.try_out(best, command)
    tally, meets = trial.tally, trial.meets
    for _ in tqdm(range(1, options.generations), desc=f"{robot}, {damping}", leave=False, disable=None):
        genes = next_generation(best, tally.worth, command, rng)
        trial = held.try_out(genes, command)
        best = torch.where((trial.tally.worth > tally.worth).unsqueeze(1), genes, best)
        tally, meets = tally.or_better(trial.tally), meets + trial.meets
    without = free.try_out(best, command)
    switching = held.exciters(best, command).frequency / held.natural
    most = int(without.tally.most.argmax())
    return {
        "joints": pose.shape[-1], "episodes": count * options.generations,
        "drawn": summarize(tally.most, options.seed), "largest": float(tally.most.max()),
        "first_filling": law.store_energy, "lowest_store": float(tally.store.min()),
        "drawn_without": summarize(without.tally.most, options.seed),
        "largest_without": float(without.tally.most.max()),
        "worst": {"command": COMMANDS[int(command[most])], "frequency_over_natural": float(switching[most])},
        "share_ended": float(tally.fell.double().mean()),
        "share_ended_without": float(without.tally.fell.double().mean()),
        "rate_condition_met": float(meets.mean()) / options.generations,
        "rate_condition_met_without": float(without.meets.mean()),
        "by_command": {
            name: {"largest": float(tally.most[mine].max()), "largest_without": float(without.tally.most[mine].max())}
            for i, name in enumerate(COMMANDS)
            for mine in (command == i,)
        },
    }  # fmt: skip


def table(result: dict[str, Any]) -> str:
    """As Markdown."""
    lines = [
        "| arm, damping | episodes | drawn with the store [J] | largest | lowest level | the same exciters without [J] "
        "| largest | rate condition met, with and without |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, row in result["rows"].items():
        lines.append(
            f"| {name} | {row['episodes']} | {cell(row['drawn'])} | {row['largest']:.3f} "
            f"| {row['lowest_store']:.3f} | {cell(row['drawn_without'])} | {row['largest_without']:.2f} "
            f"| {row['rate_condition_met']:.1%}, {row['rate_condition_met_without']:.1%} |"
        )
    o = result["settings"]
    about = (
        f"Stores of {LawConfig().store_energy:g} J at first. Mean (95 % interval) over exciters, each the best of its "
        f"pose after {o['generations']} generations; {o['seconds']:g} s, or until a joint leaves its range of angle or "
        "speed; float64. The rate condition is that of Kronander and Billard, checked on every change that was made."
    )
    return "\n".join([*lines, "", about])


def main(argv: list[str] | None = None) -> int:
    """Parse, measure, report. Returns the exit status: 0, or 2 for bad input."""
    options = tyro.cli(Options, args=argv, description=__doc__, prog="python -m reports.passive_arms")
    try:
        options.check()
        output = Path(options.output)
        output.mkdir(parents=True, exist_ok=True)
        settings = {name: value for name, value in to_plain(options).items() if name != "output"}
        result: dict[str, Any] = {"settings": settings, "rows": {}}
        for robot, damping in product(options.robots, options.dampings):
            result["rows"][f"{robot.upper()}, {damping}"] = measure(robot, damping, options)
            write_json(output / "passive_arms.json", result)  # a row takes long
        text = table(result) + "\n"
        write_atomically(output / "passive_arms.md", lambda p: p.write_text(text, encoding="utf-8"))
    except (ValueError, ArithmeticError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
