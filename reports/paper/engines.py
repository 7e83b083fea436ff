"""One policy in several engines: velocity tracking, a periodic load, and what robots do wrong.

The paper's section IV-C, with what statics predicts of the load beside what was measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cotap.checks import require_positive_int, require_range
from cotap.compliance.laws import LawConfig
from cotap.configs import to_plain
from cotap.deployment.controller import gait_config, law_config, robot_of
from cotap.deployment.engines import EngineConfig, EngineState, make_engine
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.robot import Perturbations
from cotap.deployment.safety import SafetyConfig
from cotap.deployment.scenario import ArmMotion, Scenario, TimedCommand
from cotap.deployment.trial import Trial, trajectory
from cotap.envs import HumanoidEnvConfig
from cotap.envs.scripted_forces import ForceProfile
from cotap.envs.state import StateReader
from cotap.envs.upper_body import UpperBody, UpperBodyConfig
from cotap.evaluation.law_options import parse_law
from cotap.evaluation.metrics import summarize, tracking_measures, wilson_interval
from cotap.evaluation.periodic import amplitude as swing_amplitude
from cotap.evaluation.periodic import elbow_joints
from cotap.evaluation.report import pyplot, save_figure
from cotap.motions.elbow import elbow_index
from cotap.motions.reference import HELD, MIXTURE
from cotap.robots import RobotSpec
from reports.cells import cell
from reports.paper.book import kept
from reports.paper.periodic import LEFT
from reports.paper.workers import Workers

STAND = (TimedCommand(stand=True),)
ONSET_S = 3.0
PERTURBATIONS = {
    "none": Perturbations(),
    "delay of 1 step": Perturbations(delay_steps=(1, 1)),
    "delay of 2 steps": Perturbations(delay_steps=(2, 2)),
    "5 % of readings lost": Perturbations(drop=0.05),
    "encoder noise of 0.01 rad, 0.5 rad/s": Perturbations(encoder_noise=0.01, velocity_noise=0.5),
    "masses wrong by 20 %": Perturbations(mass_error=0.2),
    "start off by 0.05 rad": Perturbations(start_error=0.05),
    "all at once, delay of 1 to 2 steps": Perturbations((1, 2), 0.05, 0.01, 0.5, 0.2, 0.05),
}
"""Every row of the table of perturbations."""
APART = Perturbations(start_error=0.02)
"""Of robots under one load, which would else all do the same."""
SWINGS = ("elbow_torque_nm", "elbow_torque_statics_nm", "hand_swing_m", "hand_swing_statics_m")
"""Amplitudes under the periodic load, and what statics makes of them; null where no trial stood."""
HELD_ARMS = "arms held"


@dataclass
class Comparison:
    """What is run; every part in every engine."""

    engines: tuple[str, ...] = ("mujoco", "pybullet")
    """Engines, by name."""
    trials: int = 100
    """Trials of velocity tracking."""
    perturbed_trials: int = 100
    """Trials of each perturbation."""
    load_trials: int = 100
    """Trials under the periodic load."""
    motion: str = MIXTURE
    """Clip for the arms, `mixture` or `none`. mixture: as in recipes. none: hold the default pose. Under the load,
    arms hold it anyhow."""
    episode_seconds: float = 20.0
    """Length of a trial of velocity tracking or under perturbations [s]."""
    seed: int = 0
    """Seed of all of it."""
    timestep: float = 0.001
    """Physics step [s]."""

    def check(self) -> None:
        """Raise ValueError naming the first field that is out of its range."""
        for name in ("trials", "perturbed_trials", "load_trials"):
            require_positive_int(name, getattr(self, name))
        require_range("episode_seconds", self.episode_seconds, 2.0, 3600.0)
        if not self.engines:
            raise ValueError("engines must name at least one engine")
        for name in self.engines:
            self.engine(name).check()

    @property
    def arms(self) -> ArmMotion:
        """What arms do, but under the load."""
        return ArmMotion(clip="" if self.motion == HELD else self.motion)

    def engine(self, name: str) -> EngineConfig:
        """The engine of that name."""
        return EngineConfig(name, self.timestep)


Run = Callable[..., list[Trial]]


def compare(path: Path, cfg: Comparison, jobs: int, parts: Path) -> dict[str, Any]:
    """Run everything. Returns what the report is written from; it does not depend on `jobs`.

    Args:
        path: The policy.
        cfg: What is run.
        jobs: How many processes share the trials.
        parts: Folder in which parts that are done are kept, and found again if they were run with the same settings.
    """
    policy = OnnxPolicy(path)
    about = to_plain(cfg) | {"checkpoint_sha256": policy.metadata.checkpoint_sha256}
    alone = {k: v for k, v in about.items() if k != "engines"}  # no engine's parts depend on which others there are
    result: dict[str, Any] = {"settings": about, "engines": {}}
    with Workers(path, jobs) as workers:
        for name in cfg.engines:
            engine, done = cfg.engine(name), result["engines"].setdefault(name, {})

            def run(
                scenario: Scenario, count: int, laws: UpperBodyConfig | None = None,
                wrong: Perturbations | None = None, engine: EngineConfig = engine,
            ) -> list[Trial]:  # fmt: skip
                laws = laws or law_config(policy.metadata)
                return workers.trials(
                    (laws, engine, wrong or Perturbations(), SafetyConfig(), scenario), count, cfg.seed
                )

            for part, measure in _parts(policy, cfg, run).items():
                found = kept(parts / f"{name}-{part}.json", True, alone, lambda of=measure: {"result": of()})
                done[part] = found["result"]
    return result


def _parts(policy: OnnxPolicy, cfg: Comparison, run: Run) -> dict[str, Callable[[], dict[str, Any]]]:
    """Everything that is run in one engine, by name."""
    spec, trained = robot_of(policy.metadata), law_config(policy.metadata)
    walk = Scenario(cfg.episode_seconds, cfg.arms)
    return {
        "velocity-tracking": lambda: tracking(run(walk, cfg.trials), policy, cfg),
        "periodic-load": lambda: periodic(run, spec, cfg, trained),
        "perturbations": lambda: {
            label: falls(run(walk, cfg.perturbed_trials, wrong=wrong)) for label, wrong in PERTURBATIONS.items()
        },
    }


def falls(trials: list[Trial]) -> dict[str, Any]:
    """How many fell, with the 95 % interval of the rate (Wilson's)."""
    n, k = len(trials), sum(t.fell for t in trials)
    return {"trials": n, "falls": k, "ci95": list(wilson_interval(k / n, n))}


def tracking(trials: list[Trial], policy: OnnxPolicy, cfg: Comparison) -> dict[str, Any]:
    """Falls and tracking errors."""
    measures = tracking_measures(_trajectory(trials, cfg.episode_seconds), gait_config(policy.metadata).period_s)
    names = ("e_lin", "e_lin_gait", "e_yaw_gait", "e_height", "e_upper", "stand_drift", "swing_height", "stride_rate")
    return falls(trials) | {"metrics": {name: summarize(measures[name], cfg.seed) for name in names}}


def periodic(
    run: Run, spec: RobotSpec, cfg: Comparison, trained: UpperBodyConfig, amplitude: float = 30.0, period: float = 4.0
) -> dict[str, Any]:
    """30 N up and down on both hands, right arm PD, left arm under compliance: swings at that period, and statics'.

    A slow load asks for joint torque `J^T F` whatever the stiffness, and moves the hand by `J K^-1 J^T F`. Of trials
    that stood.
    """
    laws = replace(trained, left=parse_law("left", LEFT, trained.left), right=LawConfig("pd"))
    load = ForceProfile((0.0, 0.0, amplitude), "both", ONSET_S, period_s=period)
    seconds = ONSET_S + 3.0 * period
    trials = run(Scenario(seconds, command=STAND, force=(load,)), cfg.load_trials, laws, APART)
    t = _trajectory(trials, seconds)
    begin = round((ONSET_S + period) / t.dt)  # the first period is left out
    stood = ~t.fell.any(0)
    out = falls(trials) | {"time": [], "arms": {arm.side: dict.fromkeys(SWINGS) for arm in spec.arms}}
    if not stood.any():
        return out
    hands = t.hand_offset[begin:, stood, :, 2].mean(1)
    torque = t.arm_torque[begin:, stood][:, :, elbow_joints(spec)].mean(1)
    poses = np.concatenate([trial.qpos[begin:] for trial in trials if not trial.fell])
    predicted = statics(spec, laws, mean_pose(poses), amplitude)
    moments, heights = swing_amplitude(torque, period, t.dt), swing_amplitude(hands, period, t.dt)
    out["time"] = (np.arange(len(torque)) * t.dt).tolist()
    for i, arm in enumerate(spec.arms):
        swings = (float(moments[i]), predicted[i][0], float(heights[i]), predicted[i][1])
        out["arms"][arm.side] = dict(zip(SWINGS, swings, strict=True)) | {
            "torque": torque[:, i].tolist(),
            "height": (hands[:, i] - hands[0, i]).tolist(),
        }
    return out


def mean_pose(qpos: np.ndarray) -> np.ndarray:
    """Mean (Q,) of configurations (T, Q); a quaternion and its negative are one orientation."""
    aligned = np.array(qpos)
    aligned[:, 3:7] *= np.where(qpos[:, 3:7] @ qpos[0, 3:7] < 0.0, -1.0, 1.0)[:, None]
    mean = aligned.mean(0)
    mean[3:7] /= np.linalg.norm(mean[3:7])
    return mean


def statics(spec: RobotSpec, laws: UpperBodyConfig, qpos: np.ndarray, force_z: float) -> list[tuple[float, float]]:
    """Per arm, what a vertical force [N] asks of the elbow [Nm] and how far it moves the hand upwards [m], at rest."""
    cfg = EngineConfig()
    engine = make_engine(cfg, spec)
    engine.reset(qpos, np.zeros(len(qpos) - 1), 1.0)
    reader = StateReader(spec, EngineState(engine), torch.float64)
    state = reader.read()
    body = UpperBody(laws, spec, 1, HumanoidEnvConfig().control_dt, torch.float64)
    arms = state.joint_pos[:, len(spec.lower_joints) :]
    body.send(state, arms, torch.zeros_like(arms))
    to_heading = state.torso_to_heading
    jacobian = (to_heading.unsqueeze(1) @ reader.arm_chains.jacobian(state.arms))[0]
    compliance = jacobian @ torch.linalg.inv(body.newest.stiffness[0]) @ jacobian.transpose(-1, -2)
    elbows = [elbow_index(spec, arm) for arm in spec.arms]
    return [
        (abs(float(jacobian[i, 2, elbow])) * force_z, float(compliance[i, 2, 2]) * force_z)
        for i, elbow in enumerate(elbows)
    ]


def _trajectory(trials: list[Trial], seconds: float) -> Any:
    return trajectory([trial for trial in trials if trial.rows], round(seconds / trials[0].dt))


def markdown(result: dict[str, Any]) -> str:
    """The report."""
    engines, motion = result["engines"], result["settings"]["motion"]
    moving = HELD_ARMS if motion == HELD else f"arms moving ({motion})"
    lines = [
        f"## Velocity tracking, {moving}",
        "",
        "| measure | " + " | ".join(engines) + " |",
        "|---" * (len(engines) + 1) + "|",
    ]
    lines.append("| trials that fell | " + " | ".join(_falls(e["velocity-tracking"]) for e in engines.values()) + " |")
    for name in next(iter(engines.values()))["velocity-tracking"]["metrics"]:
        row = [cell(e["velocity-tracking"]["metrics"][name]) for e in engines.values()]
        lines.append(f"| {name} | " + " | ".join(row) + " |")
    lines += ["", f"## Periodic load of 30 N, 4 s, both hands, {HELD_ARMS}: left alpha 0.7 at 500 N/m, right PD", ""]
    lines += [
        "| engine | arm | elbow torque [Nm] | of it statics | hand swing [m] | of it statics |",
        "|---|---|---|---|---|---|",
    ]
    for name, e in engines.items():
        for side, arm in e["periodic-load"]["arms"].items():
            cells = ("-" if arm[key] is None else f"{arm[key]:.3f}" for key in SWINGS)
            lines.append(f"| {name} | {side} | " + " | ".join(cells) + " |")
    lines += ["", f"## Perturbations, {moving}", "", "| what is wrong, fell | " + " | ".join(engines) + " |"]
    lines.append("|---" * (len(engines) + 1) + "|")
    for label in next(iter(engines.values()))["perturbations"]:
        lines.append(f"| {label} | " + " | ".join(_falls(e["perturbations"][label]) for e in engines.values()) + " |")
    return "\n".join(lines) + "\n"


def _falls(row: dict[str, Any]) -> str:
    low, high = row["ci95"]
    return f"{row['falls']} of {row['trials']} ({100 * low:.0f} to {100 * high:.0f} %)"


def figure(result: dict[str, Any], path: Path) -> None:
    """Torque of both elbows under the periodic load, as a picture."""
    plt = pyplot()

    engines = result["engines"]
    fig, axes = plt.subplots(1, len(engines), figsize=(4.6 * len(engines), 3.0), constrained_layout=True, squeeze=False)
    for axis, (name, e) in zip(axes[0], engines.items(), strict=True):
        p = e["periodic-load"]
        styles = (("right", "PD", "#d95f02", "-"), ("left", "alpha 0.7, 500 N/m", "#2171b5", "--"))
        for side, law, color, style in styles:  # the second, dashed, lets the first be seen
            torque, statics = p["arms"][side].get("torque", []), p["arms"][side]["elbow_torque_statics_nm"]
            axis.plot(p["time"], torque, style, color=color, lw=1.4, label=f"{side}, {law}")
            for end in (-1.0, 1.0) if torque else ():
                axis.axhline(np.mean(torque) + end * statics, color="0.4", ls=":", lw=1.0)
        axis.set(title=f"{name}; dotted: statics", xlabel="time [s]", ylabel="elbow torque [Nm]")
        low, high = axis.get_ylim()
        axis.set_ylim(min(low, -13.0), max(high, 17.0))
        axis.legend(frameon=False, fontsize=9, loc="upper right")
        axis.grid(alpha=0.2)
    save_figure(fig, path)
