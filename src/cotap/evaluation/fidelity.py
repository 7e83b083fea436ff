"""Commanded against felt stiffness over many arm poses at once: how faithful compliance is while a policy stands."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import torch

from cotap.checks import require_range
from cotap.compliance import condition_number
from cotap.compliance.dynamics import gravity_torque
from cotap.compliance.laws import WITHOUT_STIFFNESS
from cotap.envs import HumanoidEnv
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.metrics import bootstrap_draws, summarize
from cotap.evaluation.report import heading, pyplot, save_figure
from cotap.evaluation.rollout import PolicyFunction, acting
from cotap.evaluation.static import HeldLoad, settle
from cotap.motions.clearance import touching
from cotap.motions.reference import ClipConfig, load_clips
from cotap.robots import RobotSpec
from cotap.robots.chains import arm_chains, arm_inertias

HOLDABLE = 0.9
"""Hands whose load asks an arm joint for more than this share of its torque limit do not count."""

QUANTILES = {"50": 0.5, "95": 0.95}
"""Of the errors of single hands, by name."""


@dataclass
class Fidelity(HeldLoad):
    """Commanded against felt stiffness over many arm poses, axes and stiffnesses, by default while standing.

    A load should move the hand by a set way. Every env has a pose, an axis and a stiffness of its own.
    """

    laws: ClassVar[LawOptions] = LawOptions(method="cotap")
    drives: ClassVar[dict[str, str]] = {"stiffness": "--stiffness-values"}

    num_envs: int = 192
    """Number of envs. They are dealt to stiffnesses, axes and poses: with 4 stiffnesses, a pose takes 12."""
    stiffness_values: tuple[float, ...] = (100.0, 200.0, 400.0, 800.0)
    """Hand stiffnesses, in place of --stiffness [N/m]."""
    displacement: float = 0.02
    """How far the load should move the hand [m]. At most 0.05."""
    condition: float = 8.0
    """Largest condition number of the poses' Jacobians."""
    library: str = ""
    """Motion library (.npz) that poses are drawn from. By default the shipped one."""
    pelvis: str = "free"
    """free, or fixed in the air, without a policy."""
    upper_actions: str = "policy"
    """What moves the arms: policy or reference. reference leaves out the policy's own arm actions; a number from 0 to 1
    is the share of them that is left. With --pelvis free alone."""
    settle_seconds: float = 6.0
    """Time to settle, without the load and again with it [s]. The last second of each is measured."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        super().check()
        if not self.stiffness_values:
            raise ValueError("stiffness_values must not be empty")
        for i, value in enumerate(self.stiffness_values):
            require_range(f"stiffness_values[{i}]", value, 1.0, 1e5)
        require_range("displacement", self.displacement, 1e-4, 0.05)
        require_range("condition", self.condition, 1.0, 1e3)

    def evaluate(self, env: HumanoidEnv, policy: PolicyFunction) -> dict[str, Any]:
        """Run. Returns the measured part of the JSON."""
        measured, coverage = measure(env, self, policy)
        self.film = measured.film
        falls = int(measured.fell.sum())
        return {"num_falls": falls, **summary(measured, coverage, self), "window": self.window}

    def table(self, result: dict[str, Any]) -> str:
        """Errors by axis and stiffness, as Markdown."""
        return table(result)

    def plot(self, path: Path, result: dict[str, Any]) -> None:
        """Error against commanded stiffness, axis by axis."""
        plot(path, result)


@dataclass(frozen=True)
class FidelityResult:
    """W envs, each with a pose, an axis and a stiffness of its own."""

    axis: torch.Tensor
    """(W,) 0, 1 or 2."""
    pose: torch.Tensor
    """(W,) number of the pose, which one env of every axis and stiffness has."""
    stiffness: torch.Tensor
    """(W,) commanded [N/m]."""
    way: torch.Tensor
    """(W,) how far the hand went along the load, as a share of how far it should."""
    fell: torch.Tensor
    """(W,) bool."""
    unholdable: torch.Tensor
    """(W,) bool: the load asks for more torque than the arm is trusted with; left out."""
    touching: torch.Tensor
    """(W,) bool: the arm touches the body, which then holds the hand, before the load or under it; left out."""
    saturated: torch.Tensor
    """(W,) bool: an arm joint was at its torque limit at the end."""
    film: torch.Tensor = field(default_factory=lambda: torch.zeros(0, 0))
    """Of the first env, as `Trajectory` has it."""

    @property
    def counted(self) -> torch.Tensor:
        """(W,) bool: envs that say something about stiffness."""
        return ~(self.fell | self.unholdable | self.touching)


def conditions(joints: torch.Tensor, spec: RobotSpec) -> torch.Tensor:
    """Condition number (T, A) of each hand's Jacobian, for arm joints (T, U)."""
    chains = arm_chains(spec)
    return condition_number(chains.jacobian(chains.pose(joints.unflatten(1, (len(spec.arms), -1)))))


def library_poses(spec: RobotSpec, library: str = "") -> torch.Tensor:
    """Arm joints (T, U) of all motion in a library, at 50 Hz; by default of the one that comes with the package."""
    clips = load_clips(ClipConfig(library=library, held_out=()), spec).clips
    return torch.cat([torch.as_tensor(clip.arms) for clip in clips])


def measure(env: HumanoidEnv, protocol: Fidelity, policy: PolicyFunction) -> tuple[FidelityResult, float]:
    """Run the protocol in `env`, made from its config. Returns what was measured, and the share of the library's time
    that poses of its condition number cover."""
    if env.cfg.upper_body.of(protocol.hand).name in WITHOUT_STIFFNESS:
        raise ValueError("fidelity needs a law with a stiffness at the hand, such as --method cotap")
    frames = library_poses(env.spec, protocol.library)
    side = [arm.side for arm in env.spec.arms].index(protocol.hand)
    good = conditions(frames, env.spec)[:, side] <= protocol.condition
    if not good.any():
        raise ValueError(f"condition {protocol.condition}: no pose of the motion library has one that low")
    rng = torch.Generator().manual_seed(protocol.seed)
    levels, index = torch.tensor(protocol.stiffness_values), torch.arange(env.num_envs)
    stiffness, axis, number = levels[index % len(levels)], index // len(levels) % 3, index // (3 * len(levels))
    pose = frames[good][torch.randint(0, int(good.sum()), (int(number[-1]) + 1,), generator=rng)][number]
    direction = torch.nn.functional.one_hot(axis, 3) * (2.0 * torch.randint(0, 2, (len(axis), 1), generator=rng) - 1.0)
    force_h = stiffness.unsqueeze(1) * protocol.displacement * direction
    env.upper_body.parameters.stiffness[:] = stiffness[:, None, None].to(env.device)
    protocol.load(env, force_h)
    env.motions.hold(pose)
    unholdable = _torque_share(env, pose, side, force_h) > HOLDABLE
    settled = settle(env, acting(env, policy, protocol.upper_actions), protocol.settle_seconds, side)
    way = (settled.moved * direction).sum(1) / protocol.displacement
    touched = torch.stack([touching(env.sim.model, env.spec, side, qpos) for qpos in settled.qpos]).any(0)
    result = FidelityResult(
        axis, number, stiffness, way, settled.fell, unholdable, touched & ~settled.fell, settled.saturated, settled.film
    )
    return result, float(good.float().mean())


def _torque_share(env: HumanoidEnv, pose: torch.Tensor, side: int, force: torch.Tensor) -> torch.Tensor:
    """Largest share (N,) of its limit that a joint of the arm needs at `pose` (N, U) under `force` (N, 3), upright."""
    chains = arm_chains(env.spec)
    at = chains.pose(pose.unflatten(1, (len(env.spec.arms), -1)))
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(pose), 3)
    needed = gravity_torque(arm_inertias(env.spec), at, up)[:, side]
    needed = needed - (chains.jacobian(at)[:, side].transpose(-1, -2) @ force.unsqueeze(-1)).squeeze(-1)
    return (needed.abs() / env.arm_limits[side].cpu()).amax(1)


def summary(result: FidelityResult, coverage: float, protocol: Fidelity) -> dict[str, Any]:
    """The measured part of the evaluation's JSON. Errors are of the felt stiffness, as shares of the commanded one.
    Intervals are over poses, each of which every axis and stiffness has once.

    A hand that did not go where the load is has an error without bound: such hands are `num_wrong_way`, and what they
    leave without a bound, a mean, a quantile or `largest_error`, is null.
    """
    rows = []
    for axis, name in enumerate("xyz"):
        for level in protocol.stiffness_values:
            mine = result.counted & (result.axis == axis) & (result.stiffness == level)
            rows.append({"axis": name, "stiffness": level, **_error(result.way[mine], protocol.seed)})
    way, pose = result.way[result.counted], result.pose[result.counted]
    wrong = way <= 0.0
    # No stiffness, however large, moves a hand against its load: the error of one that went so has no bound.
    error = torch.where(wrong, math.inf, (1.0 / way - 1.0).abs())
    measured = [row for row in rows if row["n"] > 0]
    bounded = [abs(row["error"]) for row in measured if row["error"] is not None]
    return {
        "coverage": coverage,
        "num_unholdable": int(result.unholdable.sum()),
        "num_touching": int(result.touching.sum()),
        "num_saturated": int((result.saturated & result.counted).sum()),
        "num_wrong_way": int(wrong.sum()),
        "fidelity": rows,
        "largest_error": max(bounded) if measured and len(bounded) == len(measured) else None,
        "metrics": {"stiffness_error": _mean_error(error, pose, protocol.seed)},
        "error_quantiles": _quantiles(error),
        "error_quantiles_ci95": _quantile_intervals(error, pose, protocol.seed),
    }


def _mean_error(error: torch.Tensor, pose: torch.Tensor, seed: int) -> dict[str, Any]:
    """As `summarize`; no mean where an error has no bound, and `n` of those that have one."""
    bounded = torch.isfinite(error)
    if bounded.all():
        return summarize(error, seed, group=pose)
    n = int(bounded.sum())
    reason = f"{len(error) - n} of {len(error)} hands did not go where the load is: their error has no bound"
    return {"mean": None, "std": None, "ci95": None, "n": n, "reason": reason}


def _quantiles(error: torch.Tensor) -> dict[str, float | None] | None:
    """Median and 95th percentile, null where that is an error without bound; None of nothing."""
    if len(error) == 0:
        return None
    between = "linear" if torch.isfinite(error).all() else "higher"  # nothing lies between a number and infinity
    return {name: _bounded(error.quantile(q, interpolation=between)) for name, q in QUANTILES.items()}


def _quantile_intervals(
    error: torch.Tensor, pose: torch.Tensor, seed: int, resamples: int = 1000
) -> dict[str, list[float | None]] | None:
    """95 % intervals of the same, by a bootstrap that draws poses; null for a bound that is none."""
    if len(error) == 0:
        return None
    poses, member = torch.unique(pose, return_inverse=True)
    error, order = error.sort()
    weight = bootstrap_draws(len(poses), seed, resamples)[:, member[order]].cumsum(1)
    intervals = {}
    for name, q in QUANTILES.items():
        at = (weight < q * weight[:, -1:]).sum(1)  # the first error that so large a share does not exceed
        ends = (error[at].quantile(p, interpolation="nearest") for p in (0.025, 0.975))
        intervals[name] = [_bounded(end) for end in ends]
    return intervals


def _bounded(value: torch.Tensor) -> float | None:
    return float(value) if math.isfinite(value) else None


def _error(way: torch.Tensor, seed: int) -> dict[str, Any]:
    """Error of the stiffness that the mean displacement over poses amounts to, with its interval.

    `wrong_way` of the `n` hands did not go where the load is; they count in the mean with the way that they went.
    """
    mean = summarize(way, seed)
    count = {"n": mean["n"], "wrong_way": int((way <= 0.0).sum())}
    if mean["mean"] is None:
        return {"error": None, "ci95": None, **count, "reason": "no env was counted"}
    low, high = mean["ci95"] or (mean["mean"], mean["mean"])
    if low <= 0.0:
        return {"error": None, "ci95": None, **count, "reason": "the hand did not go where the load is"}
    error = {"error": 1.0 / mean["mean"] - 1.0, **count}
    if mean["ci95"] is None:
        return error | {"ci95": None, "reason": mean["reason"]}
    return error | {"ci95": [1.0 / high - 1.0, 1.0 / low - 1.0]}


def table(content: dict[str, Any]) -> str:
    """Errors by axis and stiffness, as Markdown."""
    lines = [
        "| axis | commanded [N/m] | error | 95 % interval | poses | of them the wrong way |",
        "|---|---|---|---|---|---|",
    ]
    for row in content["fidelity"]:
        error = "-" if row["error"] is None else f"{row['error']:+.1%}"
        interval = row["reason"] if row["ci95"] is None else "{:+.1%} to {:+.1%}".format(*row["ci95"])
        counts = f"{row['n']} | {row['wrong_way']}"
        lines.append(f"| {row['axis']} | {row['stiffness']:g} | {error} | {interval} | {counts} |")
    notes = [
        f"{content['num_falls']} of {content['num_envs']} envs fell",
        f"{content['num_wrong_way']} hands did not go where the load is",
        f"{content['num_unholdable']} loads beyond the arm's torque",
        f"{content['num_touching']} hands whose arm touched the body, left out",
        f"poses cover {content['coverage']:.0%} of the motion library's time",
    ]
    return "\n".join([*lines, "", f"{heading(content)}: {'; '.join(notes)}"])


def plot(path: Path, content: dict[str, Any]) -> None:
    """Error against commanded stiffness, axis by axis; a cross on the upper edge for one without bound."""
    plt = pyplot()

    figure, axis = plt.subplots(figsize=(5.2, 3.8), constrained_layout=True)
    for name, color in zip("xyz", ("#cb181d", "#238b45", "#2171b5"), strict=True):
        rows = [r for r in content["fidelity"] if r["axis"] == name and r["error"] is not None]
        error = [100.0 * r["error"] for r in rows]
        spread = [[100.0 * abs(r["error"] - (r["ci95"] or [r["error"]] * 2)[k]) for r in rows] for k in (0, 1)]
        axis.errorbar([r["stiffness"] for r in rows], error, spread, fmt="o-", color=color, ms=3, capsize=2, label=name)
        boundless = [r["stiffness"] for r in content["fidelity"] if r["axis"] == name and r["error"] is None and r["n"]]
        axis.plot(boundless, [1.0] * len(boundless), "x", color=color, transform=axis.get_xaxis_transform())
    axis.axhline(0.0, color="0.4", lw=0.8)
    axis.set(xscale="log", xlabel="commanded stiffness [N/m]", ylabel="error of the felt stiffness [%]")
    axis.grid(alpha=0.2)
    axis.legend(frameon=False)
    save_figure(figure, path)
