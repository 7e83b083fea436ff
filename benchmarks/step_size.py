"""What the physics step costs in accuracy and buys in speed: joint PD under random targets, against 0.5 ms.

Prints two Markdown tables. `explicit` computes the torque before every physics step; `implicit` lets MuJoCo's actuators
add the damping inside its implicit integrator, as the environment does. The second table tells whether resting arms
tremble under CoTaP in the environment, with the pelvis held: how far joint speeds are from their mean over a second.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time

import numpy as np
import torch
from mjbatch import Batch

from cotap.compliance.laws import LawConfig
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluation.stability import random_poses
from cotap.evaluation.undisturbed import disable_disturbances
from cotap.robots import ROBOTS, RobotSpec
from cotap.robots.mjcf import build_model

CONTROL_DT = 0.02
VARIANTS = ((0.005, False), (0.005, True), (0.01, False), (0.01, True))
"""Physics step [s], and whether damping is implicit."""
SUBSTEPS = (2, 4, 8)
"""Physics steps to a control step, with arms at rest."""
STIFFNESSES = (100.0, 300.0, 1000.0)
"""Of hands at rest [N/m]."""
REST_S = 9.0
"""Time that arms get to come to rest [s]; the second after it is measured."""


def simulate(spec: RobotSpec, timestep_s: float, implicit: bool, targets: np.ndarray) -> tuple[np.ndarray, float]:
    """Joint angles (T, N, J) after every control step under `targets` (T, N, J), and seconds spent stepping."""
    steps, envs, _ = targets.shape
    kp, kd, default = (np.array([getattr(j, name) for j in spec.joints]) for name in ("kp", "kd", "default_rad"))
    model = build_model(spec, "feet", timestep_s)
    if not implicit:
        model.actuator_biasprm[:] = 0.0
    batch = Batch(model, envs)
    qpos, qvel, ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
    qpos[:, 2], qpos[:, 7:] = spec.base_height_m, default
    out = np.empty_like(targets)
    spent = 0.0
    for t in range(steps):
        for _ in range(round(CONTROL_DT / timestep_s)):
            damping = 0.0 if implicit else kp * qpos[:, 7:] + kd * qvel[:, 6:]
            ctrl[:] = kp * targets[t] - damping
            start = time.perf_counter()
            batch.step()
            spent += time.perf_counter() - start
        out[t] = qpos[:, 7:]
    return out, spent


def tremor(robot: str, substeps: int, stiffness: float, envs: int) -> tuple[float, float]:
    """How joints of arms at rest tremble: rms of their speeds about the mean of a second, over all and of the worst env
    [rad/s]. Targets are random poses, halfway to the default one."""
    cfg = disable_disturbances(HumanoidEnvConfig(robot=robot, num_envs=envs, fixed_base=True, substeps=substeps))
    law = LawConfig("cotap", (stiffness, stiffness, stiffness))
    cfg.upper_body = UpperBodyConfig(left=law, right=law)
    cfg.terminations.episode_s = 1e6
    env = HumanoidEnv(cfg)
    poses = random_poses(env.spec, envs, torch.Generator().manual_seed(0)).flatten(1)
    env.motions.hold(torch.lerp(env.motions.default, poses, 0.5))
    upper, speeds = env.spec.indices(env.spec.upper_joints), []
    for _ in range(round((REST_S + 1.0) / CONTROL_DT)):
        env.step(torch.zeros(envs, env.num_actions))
        speeds.append(env.state.joint_vel[:, upper])
    last = torch.stack(speeds[-round(1.0 / CONTROL_DT) :])
    rms = (last - last.mean(0)).square().mean((0, 2)).sqrt()
    return float(rms.square().mean().sqrt()), float(rms.max())


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", choices=tuple(ROBOTS), default="h1")
    parser.add_argument("--envs", type=int, default=256)
    parser.add_argument("--seconds", type=float, default=0.5)
    parser.add_argument(
        "--spread", type=float, default=0.15, help="standard deviation of targets about the default [rad]"
    )
    parser.add_argument("--repeats", type=int, default=7, help="rounds of timing")
    parser.add_argument("--poses", type=int, default=64, help="arm poses at rest")
    options = parser.parse_args()
    spec, rng = ROBOTS[options.robot](), np.random.default_rng(0)
    default = [joint.default_rad for joint in spec.joints]
    steps = round(options.seconds / CONTROL_DT)
    # Targets hold for five control steps, so that joints have time to go somewhere.
    draws = rng.normal(size=(-(-steps // 5), options.envs, len(default))) * options.spread
    targets = default + np.repeat(draws, 5, axis=0)[:steps]
    reference, _ = simulate(spec, 0.0005, True, targets)
    rms: dict[tuple[float, bool], np.ndarray] = {}
    spent: dict[tuple[float, bool], list[float]] = {variant: [] for variant in VARIANTS}
    for _ in range(options.repeats):  # in turn, so that all meet the same machine
        for variant in VARIANTS:
            angles, seconds = simulate(spec, *variant, targets)
            rms[variant] = np.sqrt(np.mean((angles - reference) ** 2, axis=(0, 1)))
            spent[variant].append(seconds)
    print("| step | torque | rms error, mean over joints [rad] | worst joint [rad] | control steps/s, relative |")
    print("|---|---|---|---|---|")
    for timestep_s, implicit in VARIANTS:
        variant = (timestep_s, implicit)
        speed = statistics.median(a / b for a, b in zip(spent[VARIANTS[0]], spent[variant], strict=True))
        kind = "implicit" if implicit else "explicit"
        error = rms[variant]
        print(f"| {1e3 * timestep_s:g} ms | {kind} | {error.mean():.4f} | {error.max():.4f} | {speed:.2f} |")
    print("\n| step | stiffness of the hands [N/m] | tremor of joint speeds, rms [rad/s] | of the worst pose [rad/s] |")
    print("|---|---|---|---|")
    for substeps in SUBSTEPS:
        for stiffness in STIFFNESSES:
            rms, worst = tremor(options.robot, substeps, stiffness, options.poses)
            print(f"| {1e3 * CONTROL_DT / substeps:g} ms | {stiffness:g} | {rms:.4f} | {worst:.4f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
