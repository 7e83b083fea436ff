"""Commanded against effective stiffness: a hand under a load that grows step by step, left to settle at each."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from cotap.agents.actors import as_dict
from cotap.checks import require_finite, require_one_of, require_positive_int, require_range
from cotap.compliance import condition_number
from cotap.envs import H1Env, H1EnvConfig
from cotap.envs.commands import STEADY_RAD
from cotap.evaluation.quiet import quiet
from cotap.evaluation.report import save_figure
from cotap.evaluation.rollout import PolicyFunction, idle
from cotap.evaluation.scenario import PELVIS, mirrored_pose


@dataclass
class StaticStiffness:
    """Loads from nothing to `force` on one hand, each in worlds of its own."""

    force: tuple[float, float, float] = (0.0, 0.0, -10.0)
    """Full load along x, y and z of the heading frame [N]."""
    hand: str = "left"
    """left or right."""
    pelvis: str = "fixed"
    """fixed: held in the air, no policy. free: standing, legs under the policy."""
    arm_pose: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.3)
    """Arm joints [rad], as of the left arm; the right arm takes the mirror image."""
    levels: int = 11
    """Number of loads, from zero to full."""
    repeats: int = 1
    """Worlds per load."""
    settle_seconds: float = 10.0
    """How long a load is left to settle [s]; the last second is measured."""
    arm_actions: bool = False
    """Let the policy's own residual move the arms (pelvis free)."""
    torque_limit_scale: float = 1.0
    """Factor on the robot's torque limits."""
    seed: int = 0
    """Seed of worlds."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        require_one_of("hand", self.hand, ("left", "right"))
        require_one_of("pelvis", self.pelvis, PELVIS)
        for i, value in enumerate(self.force):
            require_finite(f"force[{i}]", value)
        if not any(self.force):
            raise ValueError(f"force must not be zero along all axes, got {self.force}")
        for i, value in enumerate(self.arm_pose):
            require_range(f"arm_pose[{i}]", value, -math.pi, 1.5 * math.pi)
        require_range("levels", self.levels, 2, 1000)
        require_positive_int("repeats", self.repeats)
        require_range("settle_seconds", self.settle_seconds, 2.0, 600.0)
        require_range("torque_limit_scale", self.torque_limit_scale, 1e-3, 1e6)

    @property
    def num_envs(self) -> int:
        """Worlds in all."""
        return self.levels * self.repeats

    def configure(self, env: H1EnvConfig) -> H1EnvConfig:
        """Turn an environment into this protocol's. Changes and returns `env`."""
        self.check()
        quiet(env)
        env.num_envs, env.seed, env.torque_limit_scale = self.num_envs, self.seed, self.torque_limit_scale
        env.fixed_base = self.pelvis == "fixed"
        env.motions.clips.share = 0.0
        env.terminations.episode_s = 1e6
        env.commands.steady_rad = STEADY_RAD
        env.commands.stand_probability, env.commands.height_offset = 1.0, (0.0, 0.0)
        env.force.force, env.force.hand, env.force.start_s = self.force, self.hand, self.settle_seconds
        return env


@dataclass(frozen=True)
class StaticResult:
    """What was measured. L loads, each the mean of its worlds that did not fall."""

    force: torch.Tensor
    """(L, 3) [N]."""
    displacement: torch.Tensor
    """(L, 3) of the hand against the torso, heading frame [m]."""
    condition: float
    """Condition number of the hand's Jacobian before the load."""
    saturated: bool
    """Whether an arm joint was at its torque limit at the end."""
    num_falls: int
    spread: torch.Tensor = field(default_factory=lambda: torch.zeros(0))
    """(L, 3) standard deviation over worlds [m]."""

    def effective_stiffness(self) -> list[float | None]:
        """Full load over displacement, per axis that is loaded [N/m]; None where nothing pushes or nothing moves."""
        out: list[float | None] = []
        for force, moved in zip(self.force[-1].tolist(), self.displacement[-1].tolist(), strict=True):
            out.append(force / moved if force != 0.0 and abs(moved) > 1e-9 else None)
        return out


@dataclass(frozen=True)
class Settled:
    """What a load that is held does to N hands; on the processor."""

    moved: torch.Tensor
    """(N, 3) displacement against the torso, heading frame [m]."""
    condition: torch.Tensor
    """(N,) condition number of the hand's Jacobian before the load."""
    fell: torch.Tensor
    """(N,) bool."""
    saturated: torch.Tensor
    """(N,) bool: an arm joint was at its torque limit at the end."""


def settle(env: H1Env, policy: PolicyFunction | None, seconds: float, side: int, arm_actions: bool) -> Settled:
    """Let `env` settle for `seconds` without its scripted force, which must set in then, and again with it.

    Args:
        env: The worlds.
        policy: Who acts; None for nobody.
        seconds: Time before and after the force sets in, of which the last second is averaged [s].
        side: Which hand is looked at.
        arm_actions: Whether the policy's own arm actions count.
    """
    obs, act = env.reset(), policy or idle(env)
    fell = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    averages: list[torch.Tensor] = []
    steps, window = round(seconds / env.dt), round(1.0 / env.dt)
    rotation = torch.zeros(env.num_envs, 3, 3, device=env.device)
    condition = torch.zeros(env.num_envs, device=env.device)
    for begin in (0, steps):  # without the load, then with it
        total = torch.zeros(env.num_envs, 3, device=env.device)
        for step in range(steps):
            action = act(as_dict(obs, env.device)).clone()
            if not arm_actions:
                action[:, env.action_slices["upper"]] = 0.0
            obs, _, _, extras = env.step(action)
            fell |= extras["falls"]
            if step >= steps - window:
                total += env.record.state.arms.tip[:, side] / window
        averages.append(total)
        if begin == 0:
            s = env.state
            rotation = s.heading_w.transpose(1, 2) @ s.torso_rotation_w
            condition = condition_number(env.reader.arm_chains.jacobian(s.arms)[:, side])
    moved = (rotation @ (averages[1] - averages[0]).unsqueeze(-1)).squeeze(-1)
    torque = env.record.torque[:, env.action_slices["upper"]].unflatten(1, (len(env.spec.arms), -1))[:, side]
    saturated = (torque.abs() > 0.999 * env.arm_limits[side]).any(1)
    return Settled(moved.cpu(), condition.cpu(), fell.cpu(), saturated.cpu())


def measure(env: H1Env, protocol: StaticStiffness, policy: PolicyFunction | None) -> StaticResult:
    """Run the protocol in `env`, made from its config."""
    side = [arm.side for arm in env.spec.arms].index(protocol.hand)
    levels = torch.linspace(0.0, 1.0, protocol.levels).repeat_interleave(protocol.repeats)
    env.scripted.amplitude_h = env.scripted.amplitude_h * levels[:, None, None].to(env.device)
    env.motions.hold(mirrored_pose(env, protocol.arm_pose))
    settled = settle(
        env, policy if protocol.pelvis == "free" else None, protocol.settle_seconds, side, protocol.arm_actions
    )
    means, spreads, forces = [], [], []
    for level in range(protocol.levels):
        mine = slice(level * protocol.repeats, (level + 1) * protocol.repeats)
        standing = settled.moved[mine][~settled.fell[mine]]
        means.append(standing.mean(0) if len(standing) else torch.full((3,), math.nan))
        spreads.append(standing.std(0) if len(standing) > 1 else torch.zeros(3))
        forces.append(env.scripted.amplitude_h[level * protocol.repeats, side])
    return StaticResult(
        torch.stack(forces), torch.stack(means), float(settled.condition.mean()), bool(settled.saturated.any()),
        int(settled.fell.sum()), torch.stack(spreads),
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
        notes.append(f"{content['num_falls']} of {content['num_envs']} worlds fell")
    return "\n".join([*lines, "", f"static-stiffness, {content['method']}: {'; '.join(notes)}"])


def plot(path: Path, result: StaticResult, commanded: tuple[float, ...] | None, load: tuple[float, ...]) -> None:
    """Force against displacement along the load, with the line that the commanded stiffness asks for."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    direction = torch.tensor(load) / torch.tensor(load).norm()
    force, moved = result.force @ direction, result.displacement @ direction
    figure, axis = plt.subplots(figsize=(5.2, 4.0), constrained_layout=True)
    axis.plot(1e3 * moved, force, "o-", color="#2171b5", label="measured")
    if commanded is not None:
        ideal = (result.force / torch.tensor(commanded)) @ direction
        axis.plot(1e3 * ideal, force, "--", color="0.4", label="commanded")
    axis.set(xlabel="displacement along the load [mm]", ylabel="force [N]")
    axis.grid(alpha=0.2)
    axis.legend(frameon=False)
    save_figure(figure, path)
