"""Many trials of one policy in one engine: falls, stops and the evaluation's own measures, as JSON."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from cotap.configs import to_plain
from cotap.deployment.controller import Controller, command_config, gait_config, robot_of
from cotap.deployment.engines import EngineConfig, make_engine
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.robot import Perturbations, Robot
from cotap.deployment.safety import SafetyConfig
from cotap.deployment.scenario import Scenario
from cotap.deployment.trial import Pilot, Trial, run_trial, trajectory
from cotap.envs import HumanoidEnvConfig
from cotap.envs.commands import CommandConfig
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluation.metrics import summarize, tracking_measures
from cotap.evaluation.velocity_tracking import VelocityTracking


def evaluation_commands(commands: CommandConfig) -> CommandConfig:
    """Random commands as the velocity-tracking evaluation draws them, approached as in training."""
    return VelocityTracking().configure(HumanoidEnvConfig(commands=replace(commands))).commands


def run_trials(
    policy: OnnxPolicy, laws: UpperBodyConfig, engine_cfg: EngineConfig, perturbations: Perturbations,
    safety: SafetyConfig, scenario: Scenario, count: int, seed: int, pilot: Pilot | None = None, progress: bool = True,
) -> list[Trial]:  # fmt: skip
    """Run `count` trials that differ in their random commands, motions and perturbations."""
    spec = robot_of(policy.metadata)
    scenario.check(spec)
    commands = evaluation_commands(command_config(policy.metadata))
    engine = make_engine(engine_cfg, spec)
    try:
        robot = Robot(engine, engine_cfg, spec, policy.metadata.control_dt, perturbations)
        trials: list[Trial] = []
        for i in tqdm(range(count), desc="trials", disable=not progress or count == 1, leave=False):
            motion = scenario.arms.reference(spec, policy.metadata.control_dt)
            controller = Controller(policy, spec, laws, commands, motion, seed + i)
            trials.append(run_trial(robot, controller, scenario, safety, seed + i, pilot))
        return trials
    finally:
        engine.close()


def report(
    trials: list[Trial], policy_path: Path | str, policy: OnnxPolicy, laws: UpperBodyConfig, engine_cfg: EngineConfig,
    perturbations: Perturbations, safety: SafetyConfig, scenario: Scenario, seed: int, started: float,
) -> dict[str, Any]:  # fmt: skip
    """What `--json` writes; measures as the velocity-tracking evaluation takes them, with trials for envs."""
    steps = max(1, round(scenario.seconds / policy.metadata.control_dt))
    recorded = [trial for trial in trials if trial.rows]
    measures: dict[str, torch.Tensor] = {}
    if recorded:
        # A pilot may have ended the trials that stand; those that fell are fallen to the scenario's end.
        steps = max((len(trial.rows) for trial in recorded if not trial.fell), default=steps)
        measures = tracking_measures(trajectory(recorded, steps), gait_config(policy.metadata).period_s)
        measures.pop("e_path")
    return {
        "protocol": "deploy",
        "engine": engine_cfg.engine,
        "settings": {
            "policy_sha256": hashlib.sha256(Path(policy_path).read_bytes()).hexdigest(),
            "checkpoint_sha256": policy.metadata.checkpoint_sha256, "seed": seed, "engine": to_plain(engine_cfg),
            "laws": to_plain(laws), "perturbations": to_plain(perturbations), "safety": to_plain(safety),
            "scenario": to_plain(scenario),
        },
        "num_trials": len(trials),
        "num_falls": sum(trial.fell for trial in trials),
        "stops": dict(Counter(_kind(trial.stopped) for trial in trials if trial.stopped)),
        "seconds": time.perf_counter() - started,
        "metrics": {name: summarize(value, seed) for name, value in measures.items()},
        "trials": [
            {"seconds": len(t.rows) * t.dt, "fell": t.fell, "stopped": t.stopped, "stopped_at_s": t.stopped_at_s,
             "touched_s": t.touched_s} | _stores(t)
            for t in trials
        ],
    }  # fmt: skip


def _stores(trial: Trial) -> dict[str, float]:
    """Lowest level of the arms' energy stores [J], and the mean share of a change of stiffness that was held back."""
    if not trial.stores:
        return {}
    level, held_back = (torch.stack(column) for column in zip(*trial.stores, strict=True))
    lowest = level[level.isfinite()].min()  # NaN for an arm whose law has none
    return {"lowest_store_energy": float(lowest), "held_back": float(held_back.nanmean())}


def _kind(reason: str) -> str:
    """The reason without its figures and joints, to be counted."""
    for kind in ("tilted", "torque limit", "reading", "policy's output", "diverged"):
        if kind in reason:
            return kind
    return reason
