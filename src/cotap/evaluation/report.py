"""Evaluations as JSON, tables and plots."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch

from cotap.evaluation.metrics import moving_average, settled
from cotap.evaluation.rollout import Trajectory
from cotap.files import require_output, write_atomically

UNITS = {
    "e_lin": "m/s", "e_lin_gait": "m/s", "e_yaw": "rad/s", "e_yaw_gait": "rad/s", "e_height": "m", "e_upper": "rad",
    "e_ee": "m", "j_upper": "Nm", "stand_drift": "m/s", "foot_slip": "m/s", "swing_height": "m",
    "stride_rate": "1/s", "e_path": "m",
    "e_torso": "m/s", "e_torso_x": "m/s", "e_torso_y": "m/s", "e_ee_hit": "m", "peak_torque": "Nm",
    "energy": "J", "recovery_s": "s", "settle_s": "s", "transient_energy": "J/kg", "oscillation_energy": "J/kg",
    "displacement_x": "m", "displacement_y": "m", "displacement_z": "m",
    "impedance_error": "m", "free_hand_error": "m", "loaded_hand_error": "m", "push_resistance": "N",
    "survival_s": "s", "position_error": "m", "yaw_error": "rad", "vibration": "rad/s^2", "j_upper_push": "Nm",
    "elbow_amplitude": "Nm", "elbow_rms": "Nm", "elbow_peak": "Nm", "arm_rms": "Nm", "hand_swing": "m",
    "stiffness": "N/m", "store_energy": "J", "stiffening_delay_s": "s",
}  # fmt: skip

LESS_IS_BETTER = (
    "e_lin", "e_lin_gait", "e_yaw", "e_yaw_gait", "e_height", "e_upper", "e_ee", "e_ee_hit", "e_path", "e_torso",
    "e_torso_x", "e_torso_y", "stand_drift", "foot_slip", "fall_fraction", "share_at_limit",
    "joints_near_limit", "impedance_error", "recovery_s", "settle_s",
    "transient_energy", "oscillation_energy", "overshoot", "overshoots", "load_overshoot", "stiffness_error",
    "position_error", "yaw_error", "vibration", "free_hand_error", "loaded_hand_error", "push_resistance",
    "held_back", "stiffening_delay_s",
)  # fmt: skip
MORE_IS_BETTER = (
    "still_share", "episode_length_fraction", "recovered_fraction", "settled_fraction", "completed_fraction",
    "survival_s", "return", "return_free_hand_error", "return_loaded_hand_error", "return_push_resistance",
    "reached_fraction",
)  # fmt: skip
"""Measures of which one direction is better. Of the others neither is: a soft hand goes far, and should."""


def better(measure: str) -> str:
    """`less` or `more`, whichever of a measure is better; empty if neither is."""
    name = measure.removeprefix("force_")  # what a recording has of the time after its first force
    return "less" if name in LESS_IS_BETTER else "more" if name in MORE_IS_BETTER else ""


def unit(measure: str) -> str:
    """A measure's unit, also of one side alone, by statics, or after a recording's first force; empty without one."""
    name = re.sub("^force_|(_static)?_(left|right)$", "", measure)
    return UNITS.get(name, "")


def require_outputs(json: str, plot: str, video: str) -> None:
    """Fail before the work rather than after it: ValueError where results cannot be written, or replace each other."""
    require_output("--json", json)
    require_output("--plot", plot, (".png",))
    require_output("--video", video, (".mp4",))
    sheet = str(sheet_path(video)) if video else ""
    wanted = {"--json": json, "--plot": plot, "--video": video, "the contact sheet of --video": sheet}
    named: dict[Path, str] = {}
    for option, path in wanted.items():
        if path and (other := named.setdefault(Path(path).resolve(), option)) != option:
            raise ValueError(f"{option} and {other} are one file, {path!r}")


def sheet_path(video: str) -> Path:
    """Where a video's contact sheet goes."""
    path = Path(video)
    return path.with_name(f"{path.stem}_frames.png")


def pyplot() -> Any:
    """matplotlib's `pyplot`, for figures that are written and not shown."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def save_figure(figure: Any, path: Path) -> None:
    """Write a matplotlib figure, whole or not at all, and close it."""
    write_atomically(path, lambda p: figure.savefig(p, dpi=130, format=path.suffix.lstrip(".") or "png"))
    pyplot().close(figure)


def interval(m: dict[str, Any], digits: int = 4, scale: float = 1.0) -> str:
    """The 95 % interval of a summary, times `scale`, or why there is none."""
    if m["ci95"] is None:
        return m["reason"]
    low, high = m["ci95"]
    return f"{scale * low:.{digits}f} to {scale * high:.{digits}f}"


def table(result: dict[str, Any]) -> str:
    """A Markdown table of an evaluation's metrics."""
    lines = ["| measure | mean | std | 95 % interval | unit |", "|---|---|---|---|---|"]
    for name, m in result["metrics"].items():
        if m["mean"] is None:
            lines.append(f"| {name} | - | - | {m['reason']} | |")
            continue
        lines.append(f"| {name} | {m['mean']:.4f} | {m['std']:.4f} | {interval(m)} | {unit(name)} |")
    for name, value in result.get("slopes", {}).items():
        slope = {"ci95": result["slopes_ci95"][name], "reason": "no env walked or stood under commands that differ"}
        lines.append(f"| {name} | {'-' if value is None else f'{value:.4f}'} | | {interval(slope)} | |")
    falls = f"{result['num_falls']} of {result['num_envs']} envs fell"
    return "\n".join([*lines, "", f"{heading(result)}: {falls}, {result['seconds']:.1f} s"])


def heading(result: dict[str, Any]) -> str:
    """What was evaluated, in words."""
    return f"{result['protocol']}, {result['method']}, arms {result['arms']}"


def plot_tracking(path: Path, t: Trajectory, gait_period_s: float, settle_s: float) -> None:
    """Commanded against gait-averaged measured velocity, one panel per axis, and heights in stance."""
    plt = pyplot()

    measured = moving_average(t.velocity, round(gait_period_s / t.dt))
    ok = settled(t, settle_s + gait_period_s)
    walking, standing = ok & ~t.stand, ok & t.stand
    figure, axes = plt.subplots(1, 4, figsize=(15, 3.9), constrained_layout=True)
    panels = [
        (f"{name} [{unit}]", t.command[..., i], measured[..., i], walking)
        for i, (name, unit) in enumerate(
            (("forward velocity", "m/s"), ("sideways velocity", "m/s"), ("yaw rate", "rad/s"))
        )
    ]
    panels.append(("torso height, standing [m]", t.height_command, t.height, standing))
    for axis, (label, commanded, got, mask) in zip(axes, panels, strict=True):
        x, y = commanded[mask], got[mask]
        keep = torch.randperm(x.numel(), generator=torch.Generator().manual_seed(0))[:4000]
        axis.scatter(x[keep], y[keep], s=2, alpha=0.25, color="#2171b5", linewidths=0)
        if x.numel():
            ends = [float(x.min()), float(x.max())]
            axis.plot(ends, ends, color="0.3", lw=1, ls="--", label="ideal")
        axis.set_xlabel(f"commanded {label}")
        axis.set_ylabel("measured")
        axis.grid(alpha=0.2)
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(loc="upper left", frameon=False)
    save_figure(figure, path)
