"""How much energy an adversary can draw at a hand, law by law: it pushes, and commands stiffness, as it likes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from tqdm import tqdm

from cotap.agents.actors import as_dict
from cotap.checks import require_one_of, require_positive_int, require_range
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.envs.state import RobotState
from cotap.evaluation.exciter import COMMANDS, GENES, Exciters, Limits, natural_frequency, next_generation
from cotap.evaluation.law_options import LawOptions, parse_law
from cotap.evaluation.metrics import summarize
from cotap.evaluation.protocol import HELD, mirrored_pose, select_motion
from cotap.evaluation.report import heading, interval, pyplot, save_figure
from cotap.evaluation.rollout import UPPER_ACTIONS, PolicyFunction, acting, picture_row
from cotap.evaluation.scenario import Stance
from cotap.evaluation.stability import NOTHING_J, random_poses
from cotap.rotations import rotate


@dataclass
class Tally:
    """What N exciters have got."""

    drawn: torch.Tensor
    """(N,) net energy at present [J]."""
    most: torch.Tensor
    """(N,) the largest that it has been [J]; infinite where the simulation diverged."""
    taken: torch.Tensor
    """(N,) energy that came out of the hand [J]."""
    given: torch.Tensor
    """(N,) energy that went into it [J]."""
    store: torch.Tensor
    """(N,) lowest level of the left arm's store [J]; NaN where it has none."""
    fell: torch.Tensor
    """(N,) bool: nothing counts any more."""

    @staticmethod
    def empty(count: int, device: torch.device | str) -> Tally:
        """Nothing as yet."""
        zero = torch.zeros(count, device=device)
        return Tally(zero, zero, zero, zero, torch.full_like(zero, math.nan), torch.zeros_like(zero, dtype=torch.bool))

    def add(self, work: torch.Tensor, fell: torch.Tensor, store: torch.Tensor | None) -> None:
        """Count a step: what was put into the hand (N,) [J], and the levels (N, A) of the stores [J], if there are."""
        self.fell = self.fell | fell
        work = torch.where(self.fell, 0.0, work)
        self.taken, self.given = self.taken - work.clamp_max(0.0), self.given + work.clamp_min(0.0)
        self.drawn = self.drawn - work
        self.most = torch.fmax(self.most, self.drawn)
        if store is not None:
            self.store = torch.where(self.fell, self.store, torch.fmin(self.store, store[:, 0]))

    def finished(self, diverged: bool) -> Tally:
        """On the CPU; with everything drawn where it fell, if a fall means that it has `diverged`."""
        most = torch.where(self.fell, math.inf, self.most) if diverged else self.most
        return Tally(*(x.cpu() for x in (self.drawn, most, self.taken, self.given, self.store, self.fell)))

    def or_better(self, other: Tally) -> Tally:
        """Of each exciter what was worth more, with the lowest store and the falls of both."""
        better = other.worth > self.worth
        kept = {
            name: torch.where(better, getattr(other, name), getattr(self, name))
            for name in ("drawn", "most", "taken", "given")
        }
        return replace(self, **kept, store=torch.fmin(self.store, other.store), fell=self.fell | other.fell)

    @property
    def worth(self) -> torch.Tensor:
        """(N,) what a search should make larger: what is drawn, or else the share that came back, less 1."""
        return torch.where(self.most > NOTHING_J, self.most, self.taken / self.given.clamp_min(NOTHING_J) - 1.0)


@dataclass
class Passivity(Stance):
    """Energy that can be drawn at a hand by whoever pushes it and commands its stiffness, and knows the law."""

    laws: ClassVar[LawOptions] = LawOptions(method="cotap")
    drives: ClassVar[dict[str, str]] = {
        "method": "--compared", "passive": "--compared", "stiffness": "--stiffness-range",
    }  # fmt: skip

    num_envs: int = 640
    """Number of exciters. They are dealt evenly to the laws and the ways of commanding stiffness."""
    randomize: bool = False
    """Vary masses, friction, gains and delay."""
    pelvis: str = "fixed"
    """free, or fixed in the air, without a policy."""
    upper_actions: str = "reference"
    """What moves the arms: policy or reference. reference leaves out the policy's own arm actions."""
    compared: tuple[str, ...] = (
        "pd", "cotap", "cotap:passive=true", "cotap:damping=pd", "cotap:damping=pd,passive=true", "facet", "hmc", "dcc",
    )  # fmt: skip
    """Laws, such as cotap:passive=true,store_energy=1. Each is on both arms."""
    generations: int = 8
    """Generations of the search for the best exciter. Each law and way of commanding stiffness has its own search, in
    which every exciter has a pose of its own."""
    episode_seconds: float = 4.0
    """Time that an exciter has [s]."""
    settle_seconds: float = 2.0
    """Rest before the exciter begins [s]."""
    force_size: float = 15.0
    """Largest force that pulls the left hand [N]."""
    brake: float = 40.0
    """Largest damping that brakes the hand [Ns/m]."""
    stiffness_range: tuple[float, float] = (80.0, 1200.0)
    """Softest and stiffest hand [N/m]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        require_one_of("upper_actions", self.upper_actions, UPPER_ACTIONS)
        if not self.compared:
            raise ValueError("compared must name laws, got nothing")
        for text in self.compared:
            parse_law("compared", text, self.laws.configure().left).check("compared")
        groups = len(self.compared) * len(COMMANDS)
        if self.num_envs < 4 * groups:
            raise ValueError(f"num_envs must be at least {4 * groups}, 4 for each law and command, got {self.num_envs}")
        require_positive_int("generations", self.generations)
        require_range("episode_seconds", self.episode_seconds, 0.1, 3600.0)
        require_range("settle_seconds", self.settle_seconds, 0.0, 3600.0)
        require_range("force_size", self.force_size, 0.1, 1000.0)
        require_range("brake", self.brake, 0.1, 1000.0)
        require_range("stiffness_range[0]", self.stiffness_range[0], 1.0, 1e5)
        require_range("stiffness_range[1]", self.stiffness_range[1], self.stiffness_range[0], 1e5)

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        select_motion(env_cfg.motions.clips, (HELD,), "")
        env_cfg.forces.scripted = ForceProfile((1.0, 1.0, 1.0), "left", start_s=0.0)
        return env_cfg

    def prepare(self, env: HumanoidEnv) -> None:
        """Put every env's arms under its law."""
        super().prepare(env)
        arms = env.cfg.upper_body
        if arms.left != arms.right:
            raise ValueError("passivity puts both arms under one law: name it by --compared, not by --left or --right")
        number = torch.arange(env.num_envs) % (len(self.compared) * len(COMMANDS))
        self.group = number.to(env.device)
        """(N,) law and command of each env: `law + len(compared) * command`."""
        for i, group in enumerate(number.tolist()):
            law = parse_law("compared", self.compared[group % len(self.compared)], arms.left)
            for arm in range(len(env.spec.arms)):
                env.set_law(i, arm, law)

    def evaluate(self, env: HumanoidEnv, policy: PolicyFunction) -> dict[str, Any]:
        """Search, at a pose of its own for every exciter. Returns the measured part of the JSON."""
        rng = torch.Generator().manual_seed(self.seed)
        act, groups = acting(env, policy, self.upper_actions), len(self.compared) * len(COMMANDS)
        poses = random_poses(env.spec, -(-env.num_envs // groups), rng).flatten(1).to(env.device)
        rest = mirrored_pose(env, ())
        # All laws and commands have the same poses.
        pose = torch.lerp(rest, poses, 0.5)[torch.arange(env.num_envs, device=env.device) // groups]
        settled = self.settle(env, act, pose)
        genes = torch.randn(env.num_envs, GENES, generator=rng)
        best, tally = genes, self.excite(env, act, genes, settled)
        for _ in tqdm(range(1, self.generations), desc="search", unit="generation", leave=False, disable=None):
            genes = next_generation(best, tally.worth, self.group.cpu(), rng)
            tried = self.excite(env, act, genes, settled)
            best = torch.where((tried.worth > tally.worth).unsqueeze(1), genes, best)
            tally = tally.or_better(tried)
        rows = {
            text: {
                command: _row(tally, (self.group == law + len(self.compared) * way).cpu(), self.seed)
                for way, command in enumerate(COMMANDS)
            }
            for law, text in enumerate(self.compared)
        }
        metrics = {f"{law}, {command}": row["drawn"] for law, r in rows.items() for command, row in r.items()}
        return {"num_falls": int(tally.fell.sum()), "rows": rows, "metrics": metrics}

    def settle(self, env: HumanoidEnv, act: PolicyFunction, pose: torch.Tensor) -> dict[str, Any]:
        """The environment's state once hands at the mean stiffness have come to rest, arms at `pose` (U,) or (N, U)."""
        env.motions.hold(pose)
        obs = env.reset()
        env.forces.scripted.amplitude_h[:, 0] = 0.0
        env.upper_body.parameters.stiffness = torch.full_like(env.upper_body.parameters.stiffness, self._mean)
        for _ in range(round(self.settle_seconds / env.dt)):
            obs, *_ = env.step(act(as_dict(obs, env.device)))
        return env.state_dict()

    def excite(self, env: HumanoidEnv, act: PolicyFunction, genes: torch.Tensor, settled: dict[str, Any]) -> Tally:
        """Let an exciter loose on every left hand, from a state that `settle` returned.

        With a fixed pelvis, the work that counts is that in the world, otherwise that against the torso.
        """
        env.load_state_dict(settled)
        obs = env.get_observations()
        limits = Limits(self.force_size, self.brake, self.stiffness_range, self.episode_seconds)
        way, arms = self.group // len(self.compared), len(env.spec.arms)
        natural = natural_frequency(env.upper_body.arms, env.state.arms, self._mean)[:, 0]
        exciters = Exciters(genes.to(env.device), way, natural, limits, self.seed)
        tally, frames, first_alpha = Tally.empty(env.num_envs, env.device), [], env.upper_body.parameters.alpha
        for step in range(round(self.episode_seconds / env.dt)):
            offset_h, velocity_h = _hand(env)
            stiffness, alpha = exciters.command(step * env.dt, offset_h, velocity_h)
            env.forces.scripted.amplitude_h[:, 0] = exciters.force(step * env.dt, velocity_h)
            env.upper_body.parameters.stiffness = stiffness.unsqueeze(1).repeat(1, arms, 1)
            env.upper_body.parameters.alpha = alpha.unsqueeze(1) * first_alpha
            before = env.state
            obs, _, _, extras = env.step(act(as_dict(obs, env.device)))
            frames.append(picture_row(env))
            tally.add(_work(env, before), extras["falls"], env.upper_body.report.get("store_energy"))
        self.film = torch.stack(frames).cpu()
        return tally.finished(diverged=env.cfg.fixed_base)

    @property
    def _mean(self) -> float:
        """The mean stiffness [N/m]."""
        return math.sqrt(math.prod(self.stiffness_range))

    def table(self, result: dict[str, Any]) -> str:
        """Energy drawn, law by law and command by command, as Markdown."""
        return table(result)

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """The same as bars."""
        plot(path, result)


def _hand(env: HumanoidEnv) -> tuple[torch.Tensor, torch.Tensor]:
    """Offset of the left hand from its reference [m] and its velocity against the torso [m/s], heading frame (N, 3)."""
    arms, s = env.upper_body.arms, env.state
    reference = env.motions.current().position.unflatten(1, (len(env.spec.arms), -1))
    offset_t = (s.arms.tip - arms.chains.pose(reference).tip)[:, 0]
    velocity_t = rotate(arms.chains.jacobian(s.arms)[:, 0], env.reader.arm_joints(s.joint_vel)[:, 0])
    return rotate(s.torso_to_heading, offset_t), rotate(s.torso_to_heading, velocity_t)


def _work(env: HumanoidEnv, before: RobotState) -> torch.Tensor:
    """What the force has put into the left hand (N,) [J] in the step that began at `before`."""
    after = env.record.state
    moved_w = after.hand_pos_w[:, 0] - before.hand_pos_w[:, 0]
    if not env.cfg.fixed_base:
        moved_w = rotate(before.torso_rotation_w, after.arms.tip[:, 0] - before.arms.tip[:, 0])
    return (env.hand_force_w[:, 0] * moved_w).sum(1)


def _row(tally: Tally, mine: torch.Tensor, seed: int) -> dict[str, Any]:
    """One law under one command, in the envs of `mine` (N,): what the best exciters draw at their poses."""
    drawn, store = tally.most[mine], tally.store[mine]
    found = drawn[drawn.isfinite()]
    return {
        "drawn": summarize(drawn, seed),
        "largest": float(found.max()) if len(found) else None,
        "share_drawn": summarize(drawn > NOTHING_J, seed),
        "num_diverged": int((~drawn.isfinite()).sum()),
        "num_falls": int(tally.fell[mine].sum()),
        "lowest_store": float(store[store.isfinite()].min()) if store.isfinite().any() else None,
    }


def table(content: dict[str, Any]) -> str:
    """Mean over poses with its interval, and the largest of all, in joules."""
    lines = [f"| law, energy drawn [J] | {' | '.join(COMMANDS)} |", "|---|" + "---|" * len(COMMANDS)]
    for law, row in content["rows"].items():
        lines.append(f"| {law} | {' | '.join(_cell(row[command]) for command in COMMANDS)} |")
    fell = f"{content['num_falls']} of {content['num_envs']} exciters saw a fall or a divergence in some generation"
    about = f"{heading(content)}, pelvis {content['settings']['pelvis']}, {content['settings']['mode']}"
    return "\n".join([*lines, "", "Mean (95 % interval) over poses; largest of all.", "", f"{about}: {fell}"])


def _cell(row: dict[str, Any]) -> str:
    diverged = f"; {row['num_diverged']} diverged" if row["num_diverged"] else ""
    if row["drawn"]["mean"] is None:
        return f"-{diverged}"
    return f"{row['drawn']['mean']:.3f} ({interval(row['drawn'], 3)}); {row['largest']:.2f}{diverged}"


def plot(path: Path, content: dict[str, Any]) -> None:
    """Bars with intervals, a group per command."""
    plt = pyplot()

    figure, axis = plt.subplots(figsize=(8.5, 3.8), constrained_layout=True)
    rows, width = content["rows"], 0.8 / len(content["rows"])
    for i, (law, row) in enumerate(rows.items()):
        cells = [row[command]["drawn"] for command in COMMANDS]
        mean = [c["mean"] or 0.0 for c in cells]
        low, high = zip(*(c["ci95"] or (m, m) for m, c in zip(mean, cells, strict=True)), strict=True)
        ends = [[m - v for m, v in zip(mean, low, strict=True)], [v - m for m, v in zip(mean, high, strict=True)]]
        at = [x - 0.4 + (i + 0.5) * width for x in range(len(COMMANDS))]
        axis.bar(at, mean, width, yerr=ends, capsize=2, color=plt.get_cmap("tab10")(i), label=law)
    axis.set_xticks(range(len(COMMANDS)), COMMANDS)
    axis.set_yscale("symlog", linthresh=0.01)
    axis.set(xlabel="how stiffness is commanded", ylabel="energy drawn at the hand [J]")
    axis.grid(axis="y", alpha=0.2)
    axis.legend(frameon=False, fontsize=7)
    save_figure(figure, path)
