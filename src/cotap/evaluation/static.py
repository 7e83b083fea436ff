"""Commanded against effective stiffness: a hand under a load that grows step by step, left to settle at each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cotap.agents.actors import as_dict
from cotap.checks import require_finite, require_one_of, require_range
from cotap.compliance import condition_number
from cotap.compliance.laws import WITHOUT_STIFFNESS
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.evaluation.protocol import mirrored_pose, require_pose
from cotap.evaluation.report import heading, pyplot, save_figure
from cotap.evaluation.rollout import PolicyFunction, acting, picture_row, upper_share
from cotap.evaluation.scenario import Stance


@dataclass
class HeldLoad(Stance):
    """What the protocols have in common that load one hand and let it settle."""

    randomize: bool = False
    """Vary masses, friction, gains and delay."""
    hand: str = "left"
    """left or right."""
    pelvis: str = "fixed"
    """free, or fixed in the air, without a policy."""
    upper_actions: str = "reference"
    """What moves the arms: policy or reference. reference leaves out the policy's own arm actions; a number from 0 to 1
    is the share of them that is left. With --pelvis free alone."""
    settle_seconds: float = 10.0
    """Time to settle, without the load and again with it [s]. The last second of each is measured."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        require_one_of("hand", self.hand, ("left", "right"))
        upper_share(self.upper_actions)
        require_range("settle_seconds", self.settle_seconds, 2.0, 600.0)

    @property
    def window(self) -> dict[str, float]:
        """What is measured, from the start [s]."""
        return {"start": 2.0 * self.settle_seconds - 1.0, "end": 2.0 * self.settle_seconds}

    def configure(self, env_cfg: HumanoidEnvConfig) -> HumanoidEnvConfig:
        """Turn the environment that a policy was trained in into this protocol's. Changes and returns `env_cfg`."""
        super().configure(env_cfg)
        env_cfg.forces.scripted = ForceProfile((1.0, 1.0, 1.0), self.hand, self.settle_seconds)
        return env_cfg

    def load(self, env: HumanoidEnv, force_h: torch.Tensor) -> int:
        """Load the hand of every env by `force_h` (N, 3) [N], heading frame. Returns which hand that is."""
        side = [arm.side for arm in env.spec.arms].index(self.hand)
        env.forces.scripted.amplitude_h.zero_()
        env.forces.scripted.amplitude_h[:, side] = force_h.to(env.device)
        return side


@dataclass
class StaticStiffness(HeldLoad):
    """Commanded against effective stiffness of a hand under loads from nothing to --force."""

    num_envs: int = 11
    """Number of envs, dealt to the loads evenly."""
    force: tuple[float, float, float] = (0.0, 0.0, -10.0)
    """Full load along x, y, z of the heading frame [N]."""
    levels: int = 11
    """Number of loads, from zero to full."""
    arm_pose: tuple[float, ...] = ()
    """Arm joints, as of the left arm [rad]. The right arm mirrors it. By default the default pose."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        for i, value in enumerate(self.force):
            require_finite(f"force[{i}]", value)
        if not any(self.force):
            raise ValueError(f"force must not be zero along all axes, got {self.force}")
        require_pose(self.arm_pose)
        require_range("levels", self.levels, 2, 1000)
        if self.num_envs < self.levels:
            raise ValueError(f"num_envs must be at least levels ({self.levels}), got {self.num_envs}")

    def prepare(self, env: HumanoidEnv) -> None:
        """Give every env its load, and its arms their pose."""
        super().prepare(env)
        shares = torch.linspace(0.0, 1.0, self.levels)[torch.arange(env.num_envs) % self.levels]
        self.load(env, shares.unsqueeze(1) * torch.tensor(self.force))
        env.motions.hold(mirrored_pose(env, self.arm_pose))

    def evaluate(self, env: HumanoidEnv, policy: PolicyFunction) -> dict[str, Any]:
        """Run in an environment that is prepared. Returns the measured part of the JSON."""
        law = env.cfg.upper_body.of(self.hand)
        commanded = None if law.name in WITHOUT_STIFFNESS else law.stiffness
        measured = measure(env, self, policy)
        self.film = measured.film
        return {"num_falls": measured.num_falls, **summary(measured, commanded), "window": self.window}

    def table(self, result: dict[str, Any]) -> str:
        """Commanded and effective stiffness, axis by axis, as Markdown."""
        return table(result)

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Force against displacement along the load."""
        plot(path, result)


@dataclass(frozen=True)
class StaticResult:
    """What was measured. L loads, each the mean of its envs that did not fall."""

    force: torch.Tensor
    """(L, 3) [N]."""
    displacement: torch.Tensor
    """(L, 3) of the hand against the torso, heading frame [m]."""
    condition: float
    """Condition number of the hand's Jacobian before the load."""
    saturated: bool
    """Whether an arm joint was at its torque limit at the end."""
    num_falls: int
    spread: torch.Tensor
    """(L, 3) standard deviation over those envs [m]; zero of fewer than two."""
    standing: torch.Tensor
    """(L,) how many they are."""
    film: torch.Tensor
    """Of the first env, as `Trajectory` has it."""

    def effective_stiffness(self) -> list[float | None]:
        """Full load over displacement, per axis that is loaded [N/m]; None where nothing pushes or nothing moves."""
        out: list[float | None] = []
        for force, moved in zip(self.force[-1].tolist(), self.displacement[-1].tolist(), strict=True):
            out.append(force / moved if force != 0.0 and abs(moved) > 1e-9 else None)
        return out


@dataclass(frozen=True)
class Settled:
    """What a load that is held does to N hands; on the CPU."""

    moved: torch.Tensor
    """(N, 3) displacement against the torso, heading frame [m]."""
    condition: torch.Tensor
    """(N,) condition number of the hand's Jacobian before the load."""
    fell: torch.Tensor
    """(N,) bool."""
    saturated: torch.Tensor
    """(N,) bool: an arm joint was at its torque limit at the end."""
    qpos: torch.Tensor
    """(2, N, nq) configurations before the load and at the end."""
    film: torch.Tensor
    """Of the first env, as `Trajectory` has it."""


def settle(env: HumanoidEnv, policy: PolicyFunction, seconds: float, side: int) -> Settled:
    """Let `env` settle for `seconds` without its scripted force, which must set in then, and again with it.

    Args:
        env: The envs.
        policy: Who acts.
        seconds: Time before and after the force sets in, of which the last second is averaged [s].
        side: Which hand is looked at.
    """
    obs = env.reset()
    fell = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    averages: list[torch.Tensor] = []
    ends: list[torch.Tensor] = []
    frames: list[torch.Tensor] = []
    steps, window = round(seconds / env.dt), round(1.0 / env.dt)
    rotation = torch.zeros(env.num_envs, 3, 3, device=env.device)
    condition = torch.zeros(env.num_envs, device=env.device)
    for begin in (0, steps):  # without the load, then with it
        total = torch.zeros(env.num_envs, 3, device=env.device)
        for step in range(steps):
            obs, _, _, extras = env.step(policy(as_dict(obs, env.device)))
            fell |= extras["falls"]
            frames.append(picture_row(env))
            if step >= steps - window:
                total += env.record.state.arms.tip[:, side] / window
        averages.append(total)
        ends.append(env.sim.qpos.cpu().clone())
        if begin == 0:
            s = env.state
            rotation = s.torso_to_heading
            condition = condition_number(env.reader.arm_chains.jacobian(s.arms)[:, side])
    moved = (rotation @ (averages[1] - averages[0]).unsqueeze(-1)).squeeze(-1)
    torque = env.record.torque[:, env.num_lower :].unflatten(1, (len(env.spec.arms), -1))[:, side]
    saturated = (torque.abs() > 0.999 * env.arm_limits[side]).any(1)
    return Settled(
        moved.cpu(), condition.cpu(), fell.cpu(), saturated.cpu(), torch.stack(ends), torch.stack(frames).cpu()
    )


def measure(env: HumanoidEnv, protocol: StaticStiffness, policy: PolicyFunction) -> StaticResult:
    """Run the protocol in `env`, which it has prepared."""
    side = [arm.side for arm in env.spec.arms].index(protocol.hand)
    settled = settle(env, acting(env, policy, protocol.upper_actions), protocol.settle_seconds, side)
    level = torch.arange(env.num_envs) % protocol.levels
    means, spreads, counts = [], [], []
    for i in range(protocol.levels):
        standing = settled.moved[(level == i) & ~settled.fell]
        means.append(standing.mean(0) if len(standing) else torch.full((3,), math.nan))
        spreads.append(standing.std(0) if len(standing) > 1 else torch.zeros(3))
        counts.append(len(standing))
    return StaticResult(
        env.forces.scripted.amplitude_h[: protocol.levels, side].cpu(), torch.stack(means),
        float(settled.condition.mean()), bool(settled.saturated.any()), int(settled.fell.sum()), torch.stack(spreads),
        torch.tensor(counts), settled.film,
    )  # fmt: skip


def summary(result: StaticResult, commanded: tuple[float, ...] | None) -> dict[str, Any]:
    """The measured part of the evaluation's JSON; `commanded` is None for laws that command no stiffness."""
    displacement = [None if math.isnan(v) else v for v in result.displacement[-1].tolist()]
    return {
        "effective_stiffness": {
            "commanded": None if commanded is None else list(commanded),
            "measured": [None if v is None or math.isnan(v) else v for v in result.effective_stiffness()],
        },
        "displacement": displacement,
        "condition_number": result.condition if math.isfinite(result.condition) else None,
        "torque_saturated": result.saturated,
        "curve": {
            "force": result.force.tolist(),
            "displacement": [[None if math.isnan(v) else v for v in row] for row in result.displacement.tolist()],
            "spread": result.spread.tolist(),
            "standing": result.standing.tolist(),
        },
    }


def table(content: dict[str, Any]) -> str:
    """Commanded and effective stiffness, axis by axis, as Markdown."""
    stiffness, moved, load = content["effective_stiffness"], content["displacement"], content["settings"]["force"]
    lines = [
        "| axis | load [N] | displacement [m] | commanded [N/m] | effective [N/m] | error |",
        "|---|---|---|---|---|---|",
    ]
    for i, axis in enumerate("xyz"):
        wanted = stiffness["commanded"][i] if stiffness["commanded"] else None
        got = stiffness["measured"][i]
        error = f"{got / wanted - 1.0:+.1%}" if got is not None and wanted is not None else "-"
        shown = [f"{v:.4f}" if v is not None else "-" for v in (moved[i],)]
        numbers = [f"{v:.1f}" if v is not None else "-" for v in (wanted, got)]
        lines.append(f"| {axis} | {load[i]:g} | {shown[0]} | {numbers[0]} | {numbers[1]} | {error} |")
    notes = [
        f"condition number {content['condition_number']:.2f}" if content["condition_number"] else "at a singularity"
    ]
    if content["torque_saturated"]:
        notes.append("an arm joint is at its torque limit")
    if content["num_falls"]:
        notes.append(f"{content['num_falls']} of {content['num_envs']} envs fell")
    return "\n".join([*lines, "", f"{heading(content)}: {'; '.join(notes)}"])


def plot(path: Path, content: dict[str, Any]) -> None:
    """Force against displacement along the load, with the line that the commanded stiffness asks for."""
    plt = pyplot()

    curve, commanded = content["curve"], content["effective_stiffness"]["commanded"]
    load = torch.tensor(content["settings"]["force"])
    direction, forces = load / load.norm(), torch.tensor(curve["force"])
    moved = torch.tensor([[math.nan if v is None else v for v in row] for row in curve["displacement"]])
    figure, axis = plt.subplots(figsize=(5.2, 4.0), constrained_layout=True)
    axis.plot(1e3 * moved @ direction, forces @ direction, "o-", color="#2171b5", label="measured")
    if commanded is not None:
        ideal = (forces / torch.tensor(commanded)) @ direction
        axis.plot(1e3 * ideal, forces @ direction, "--", color="0.4", label="commanded")
    axis.set(xlabel="displacement along the load [mm]", ylabel="force [N]")
    axis.grid(alpha=0.2)
    axis.legend(frameon=False)
    save_figure(figure, path)
