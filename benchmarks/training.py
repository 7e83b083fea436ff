"""How fast: physics, environment and training on this machine, as ratios within one run, beside its peers.

The physics reference is fixed: control steps of four 5 ms `mj_step` of the robot with feet-only contacts in plain
mjbatch, from the states and with the torques of a recorded rollout (of the robot's shipped base policy, or of zero
actions where none is shipped), and nothing else. Open-loop torques soon make a robot fall, so each control step starts
from its recorded state (restarts included); only the stepping is timed. All figures are control steps (20 ms) per
second. Parts are measured in turn, several times over: rates are medians over the rounds, ratios are medians of the
ratios within rounds.
"""

from __future__ import annotations

# MuJoCo's extension module has no type stubs.
# pyright: reportAttributeAccessIssue=false
import cotap  # noqa: F401 - before torch, which reads when it is loaded for how long its threads may spin

# isort: split
import argparse
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from mujoco import rollout

from cotap.agents.actors import as_dict
from cotap.agents.checkpoint import write_json
from cotap.agents.distillation import Guide
from cotap.agents.timing import TimedTraining
from cotap.checks import require_positive_int, require_range
from cotap.compliance import ArmKinematics, modulate_stiffness
from cotap.compliance.fast import blended_stiffness
from cotap.compliance.interface import ArmState, LawParameters
from cotap.compliance.inverse_kinematics import ArmIK
from cotap.compliance.laws import LAWS, LawConfig
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES
from cotap.configs.base import BaseTraining
from cotap.envs import HumanoidEnv
from cotap.evaluation.policy import find_checkpoint, load_policy, shipped_names
from cotap.motions import MotionClip, MotionLibrary
from cotap.motions.reference import ReferenceConfig, ReferenceMotion
from cotap.robots import ROBOTS, RobotSpec
from cotap.robots.chains import arm_model
from cotap.robots.mjcf import build_model
from cotap.sim import batch_of

PEER_ENVS = 32
SUBSTEPS, TIMESTEP_S = 4, 0.005
WARM_UP_STEPS = 50
PEERS = ("mujoco_rollout", "gymnasium_async", "gymnasium_sync")
VERSIONED = ("torch", "mujoco", "mjbatch", "rsl-rl-lib", "gymnasium", "numpy", "pytorch-kinematics")

Actor = Callable[[dict[str, torch.Tensor]], torch.Tensor]


@dataclass(frozen=True)
class Recording:
    """States before, and torques during, K control steps of N envs."""

    qpos: np.ndarray
    qvel: np.ndarray
    torque: np.ndarray


def actor(checkpoint: str, robot: str = "h1") -> tuple[str, Actor]:
    """A policy and its name: of a checkpoint, or else the robot's shipped base, or else zero actions."""
    name = checkpoint or (f"{robot}-base" if f"{robot}-base" in shipped_names() else "")
    if name:
        return name, load_policy(find_checkpoint(name))
    joints = len(ROBOTS[robot]().joints)
    return "zero actions", lambda obs: torch.zeros(len(obs["policy"]), joints)


def reference_model(robot: str = "h1") -> mujoco.MjModel:
    """The robot at 5 ms with feet-only contacts, whose controls are torques."""
    model = build_model(ROBOTS[robot](), "feet", TIMESTEP_S)
    model.actuator_biasprm[:] = 0.0
    return model


def recipe(robot: str, stage: str = "base") -> BaseTraining:
    """Recipe `default` of a stage."""
    training = BASE_RECIPES["default"](robot)
    return training if stage == "base" else DISTILL_RECIPES["default"](training)


def full_env(
    num_envs: int, threads: int, backend: str = "mjbatch", robot: str = "h1", stage: str = "base"
) -> HumanoidEnv:
    """Everything on that recipe `default` has, as at the end of its training; envs time out at different times."""
    cfg = recipe(robot, stage).env
    cfg.num_envs, cfg.num_threads, cfg.backend = num_envs, threads, backend
    env = HumanoidEnv(cfg)
    env.samples = env.curriculum.samples = 10**9  # no wrench, and all forces at full size
    env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=env.max_episode_length)
    return env


def record(env: HumanoidEnv, policy: Actor, warm_up: int, steps: int) -> Recording:
    """Let the policy walk, then record."""
    rows: dict[str, list[np.ndarray]] = {"qpos": [], "qvel": [], "torque": []}
    obs = env.get_observations()
    for k in range(warm_up + steps):
        qpos, qvel = env.sim.qpos.clone(), env.sim.qvel.clone()
        obs, *_ = env.step(policy(as_dict(obs)))
        if k >= warm_up:
            rows["qpos"].append(qpos.numpy())
            rows["qvel"].append(qvel.numpy())
            rows["torque"].append(env.record.torque.double().numpy())
    return Recording(**{name: np.stack(values) for name, values in rows.items()})


class PhysicsReference:
    """Plain mjbatch on a recording; only the stepping is timed."""

    def __init__(self, recording: Recording, seconds: float, threads: int, robot: str = "h1") -> None:
        self.recording, self.seconds = recording, seconds
        self.batch = batch_of("mjbatch")(reference_model(robot), recording.qpos.shape[1], threads)
        self.qpos, self.qvel, self.ctrl = (self.batch.bind(name) for name in ("qpos", "qvel", "ctrl"))

    def run(self) -> float:
        r, spent, steps = self.recording, 0.0, 0
        while spent < self.seconds:
            for qpos, qvel, torque in zip(r.qpos, r.qvel, r.torque, strict=True):
                self.qpos[:], self.qvel[:], self.ctrl[:] = qpos, qvel, torque
                start = time.perf_counter()
                self.batch.step(nstep=SUBSTEPS)
                spent += time.perf_counter() - start
                steps += 1
        return steps * r.qpos.shape[1] / spent


class EnvStepping:
    """`HumanoidEnv.step` with everything on; the policy's own time is not counted."""

    def __init__(self, env: HumanoidEnv, policy: Actor, seconds: float) -> None:
        self.env, self.policy, self.seconds = env, policy, seconds

    def run(self) -> float:
        obs, spent, steps = self.env.get_observations(), 0.0, 0
        while spent < self.seconds:
            actions = self.policy(as_dict(obs))
            start = time.perf_counter()
            obs, *_ = self.env.step(actions)
            spent += time.perf_counter() - start
            steps += 1
        return steps * self.env.num_envs / spent


class Compliance:
    """Both arms of every env, from joint angles to torque: kinematics, stiffness, blend, gravity, two torques.

    For a second, over and over, arms swing and the stiffness of their hands goes from soft to stiff and back, each arm
    in its own time: what remembers, or holds changes back, has that to do.
    """

    STEPS = 50

    def __init__(
        self, num_envs: int, seconds: float, law: str = "cotap", passive: bool = False, robot: str = "h1"
    ) -> None:
        self.seconds, self.num_envs, spec = seconds, num_envs, ROBOTS[robot]()
        self.arms = arm_model(spec)
        self.chains = self.arms.chains
        self.law = LAWS[law](self.arms, LawConfig(law, passive=passive))
        self.force = torch.tensor([10.0, 0.0, -20.0]).repeat(num_envs, 2, 1)
        self.fresh = torch.ones(num_envs, 2, dtype=torch.bool)
        joints = [spec.joints[i] for i in spec.indices(spec.upper_joints)]
        low, high = torch.tensor([j.range_rad for j in joints]).unbind(1)
        rng = torch.Generator().manual_seed(0)
        middle = (low + (high - low) * torch.rand(num_envs, len(low), generator=rng)).unflatten(1, (2, -1))
        turns = torch.rand(num_envs, 2, generator=rng) + torch.arange(self.STEPS).div(self.STEPS)[:, None, None]
        swing = (2.0 * torch.pi * turns).sin().unsqueeze(-1)
        self.poses = middle + 0.1 * swing
        self.stiffness = (300.0 * 4.0**swing).expand(-1, -1, -1, 3)
        self.q = self.poses[0]
        self.to_heading = torch.eye(3).repeat(num_envs, 1, 1)
        shape = (num_envs, 2)
        self.parameters = LawParameters(torch.full((*shape, 3), 300.0), torch.full(shape, 25.0), torch.full(shape, 0.7))
        self.step, self.held = 0, 0.0

    def once(self) -> None:
        i = self.step % self.STEPS
        q, self.parameters.stiffness = self.poses[i], self.stiffness[i]
        pose = self.chains.pose(q)
        state = ArmState(q, q, q + 0.1, pose, self.to_heading, hand_force_h=self.force, fresh=self.fresh)
        law, report = self.law(state, self.parameters)
        for _ in range(2):  # physics steps
            law.at(q, q)
        if "held_back" in report.values:
            self.held += float((report.values["held_back"] > 0.0).double().mean())
        self.fresh, self.step = torch.zeros_like(self.fresh), self.step + 1

    def run(self) -> float:
        return self.num_envs * _rate(self.once, self.seconds)


class InverseKinematics(Compliance):
    """Joint targets of both arms of every env for hands that are 2 cm away."""

    def __init__(self, num_envs: int, seconds: float, robot: str = "h1") -> None:
        super().__init__(num_envs, seconds, robot=robot)
        self.ik = ArmIK(self.chains, self.arms.low, self.arms.high)
        self.tip = self.chains.pose(self.q).tip + 0.0115
        self.most = 0.02 * self.arms.speed

    def once(self) -> None:
        self.ik(self.tip, self.q, self.q, self.most)


class LiteralCompliance(Compliance):
    """The same stiffness from general-purpose parts, as a first reading of the paper would write it."""

    def __init__(self, num_envs: int, seconds: float, robot: str = "h1") -> None:
        super().__init__(num_envs, seconds, robot=robot)
        self.kinematics, self.eye = ArmKinematics(ROBOTS[robot]()), torch.eye(self.q.shape[-1])

    def once(self) -> None:
        jacobian = self.kinematics.jacobian(self.q)
        inverse = torch.linalg.pinv(jacobian)
        task = torch.diag_embed(1.0 / self.parameters.stiffness)
        projector = inverse @ jacobian
        null = self.eye / 25.0
        transposed = projector.transpose(-1, -2)
        compliance = inverse @ task @ inverse.transpose(-1, -2) + null - projector @ null @ transposed
        stiffness = torch.linalg.inv(compliance)
        values, vectors = torch.linalg.eigh(0.5 * (stiffness + stiffness.transpose(-1, -2)))
        values = values.clamp_min(1e-3).log()
        logarithm = (vectors * values.unsqueeze(-2)) @ vectors.transpose(-1, -2)
        torch.linalg.matrix_exp(0.7 * logarithm + 0.3 * self.eye * torch.log(torch.tensor(100.0)))


class GeneralBlend(Compliance):
    """The log-Euclidean blend alone, of any two stiffness matrices of both arms of every env."""

    def __init__(self, num_envs: int, seconds: float, robot: str = "h1") -> None:
        super().__init__(num_envs, seconds, robot=robot)
        jacobian, p = ArmKinematics(ROBOTS[robot]()).jacobian(self.q), self.parameters
        gains = self.arms.kp.expand_as(self.q)
        compliant = blended_stiffness(jacobian, p.stiffness, p.null_stiffness, gains, torch.ones(num_envs, 2))
        self.pair = compliant.stiffness, torch.diag_embed(gains)

    def once(self) -> None:
        modulate_stiffness(*self.pair, self.parameters.alpha)


class Reference:
    """The arms' reference: one control step of it, from so many clips."""

    def __init__(self, num_envs: int, seconds: float, clips: int, robot: str = "h1") -> None:
        spec, rng = ROBOTS[robot](), np.random.default_rng(0)
        self.seconds, self.num_envs, self.rng = seconds, num_envs, torch.Generator().manual_seed(0)
        cfg = ReferenceConfig()
        cfg.clips.share = 0.5 if clips else 0.0
        with tempfile.TemporaryDirectory() as folder:
            if clips:
                cfg.clips.library = f"{folder}/clips.npz"
                MotionLibrary([_made_clip(i, spec, rng) for i in range(clips)], spec).save(cfg.clips.library)
            self.motion = ReferenceMotion(cfg, spec, num_envs, 0.02)
        self.motion.reset(torch.ones(num_envs, dtype=torch.bool), self.rng)

    def run(self) -> float:
        return self.num_envs * _rate(lambda: self.motion.step(self.rng), self.seconds)


def _made_clip(number: int, spec: RobotSpec, rng: np.random.Generator) -> MotionClip:
    """Two to six seconds of slow motion."""
    frames = int(rng.integers(100, 300))
    wave = 0.2 * np.sin(np.linspace(0.0, 6.0, frames)[:, None] + rng.uniform(0.0, 6.0, len(spec.upper_joints)))
    return MotionClip(f"clip_{number}", wave.astype(np.float32), np.zeros((frames, 3), np.float32), "made", "none")


def _rate(once: Callable[[], None], seconds: float) -> float:
    """Calls per second over at least so long."""
    calls, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        once()
        calls += 1
    return calls / (time.perf_counter() - start)


class PlainEnv(gymnasium.Env):
    """Bare `mj_step` of the same model behind Gymnasium's interface."""

    def __init__(self, robot: str = "h1") -> None:
        self.model, self.height_m = reference_model(robot), ROBOTS[robot]().base_height_m
        self.data = mujoco.MjData(self.model)
        size = self.model.nq + self.model.nv
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.model.nu,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed, options=options)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[2] = self.height_m
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.data.ctrl[:] = 20.0 * action
        mujoco.mj_step(self.model, self.data, SUBSTEPS)
        return self._observation(), 0.0, False, False, {}

    def _observation(self) -> np.ndarray:
        return np.concatenate((self.data.qpos, self.data.qvel))


def gymnasium_rate(vector: gymnasium.vector.VectorEnv, seconds: float) -> float:
    """Steps per second of a vector of `PlainEnv`s, restarted every second of simulated time."""
    actions = vector.action_space
    actions.seed(0)
    vector.reset(seed=0)
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        vector.step(actions.sample())
        steps += 1
        if steps % 50 == 0:
            vector.reset()
    rate = steps * vector.num_envs / (time.perf_counter() - start)
    vector.close()
    return rate


def rollout_rate(recording: Recording, seconds: float, threads: int, robot: str = "h1") -> float:
    """Control steps per second of `mujoco.rollout` on the recording, from its states with its torques."""
    model = reference_model(robot)
    threads = threads or os.cpu_count() or 1
    data = [mujoco.MjData(model) for _ in range(threads)]
    k, n = recording.qpos.shape[:2]
    pool = rollout.Rollout(nthread=threads)
    state = np.zeros((n, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    spent, steps = 0.0, 0
    while spent < seconds:
        i = steps % k
        state[:, 1 : 1 + model.nq] = recording.qpos[i]
        state[:, 1 + model.nq : 1 + model.nq + model.nv] = recording.qvel[i]
        control = np.repeat(recording.torque[i][:, None], SUBSTEPS, 1)
        start = time.perf_counter()
        pool.rollout(model, data, state, control)
        spent += time.perf_counter() - start
        steps += 1
    pool.close()
    return steps * n / spent


def rounds(parts: dict[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """Run all parts in turn, `repeats` times over after one round of warming up."""
    results: dict[str, list[float]] = {name: [] for name in parts}
    for i in range(repeats + 1):
        for name, run in parts.items():
            rate = run()
            if i:
                results[name].append(rate)
    return results


def ratio(results: dict[str, list[float]], part: str, to: str = "physics") -> float | None:
    """Median of the ratios within rounds; None for a part that was not measured."""
    if part not in results:
        return None
    return statistics.median(a / b for a, b in zip(results[part], results[to], strict=True))


def peak_memory_mib(num_envs: int, threads: int, robot: str) -> float:
    """Peak resident memory of a training of two iterations, in a process of its own [MiB]."""
    options = {"robot": robot, "num-envs": num_envs, "iterations": 2, "threads": threads}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "cotap.train", "base", f"--run-dir={folder}/run"]
        command += [f"--{name}={value}" for name, value in options.items()]
        subprocess.run(command, check=True, capture_output=True)
    unit = 2**20 if sys.platform == "darwin" else 2**10  # bytes there, KiB elsewhere
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / unit


def machine() -> dict[str, Any]:
    """What this was measured on."""
    info = Path("/proc/cpuinfo")
    names = (
        [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        if info.exists()
        else []
    )
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in VERSIONED},
    }


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def rates_by_size(sizes: list[int], policy: Actor, options: argparse.Namespace) -> dict[str, float]:
    """Environment steps per second at each number of envs: medians over rounds."""
    rates: dict[str, list[float]] = {str(n): [] for n in sizes}
    for _ in range(options.repeats):
        for n in sizes:
            stepping = EnvStepping(full_env(n, options.threads, robot=options.robot), policy, options.seconds)
            stepping.run()  # warm up
            rates[str(n)].append(stepping.run())
    return {n: statistics.median(values) for n, values in rates.items()}


def sizes(text: str) -> list[int]:
    """Comma-separated positive integers."""
    values = [int(part) for part in text.split(",") if part]
    if any(n <= 0 for n in values):
        raise argparse.ArgumentTypeError(f"sizes must be positive, got {text!r}")
    return values


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Everything that goes into the JSON."""
    torch.manual_seed(0)
    num_envs, seconds, repeats, robot = options.num_envs, options.seconds, options.repeats, options.robot
    name, policy = actor(options.checkpoint, robot)
    memory = peak_memory_mib(num_envs, options.threads, robot)  # before this process grows: a child's begins with it
    env = full_env(num_envs, options.threads, robot=robot)
    recording = record(env, policy, WARM_UP_STEPS, options.steps)
    parts: dict[str, Callable[[], float]] = {
        "physics": PhysicsReference(recording, seconds, options.threads, robot).run,
        "env": EnvStepping(env, policy, seconds).run,
    }
    # Of its own: an untrained policy falls, and would leave the other on the ground.
    train_env = full_env(num_envs, options.threads, robot=robot)
    networks = {"default": "train", "paper": "train_paper"}
    for kind in options.networks:
        training = TimedTraining(train_env, BASE_RECIPES[kind](robot).ppo)
        parts[networks[kind]] = training.run
        if kind == "default":
            distill = recipe(robot, "distill")
            distill_env = full_env(num_envs, options.threads, robot=robot, stage="distill")
            guide = Guide(training.alg.model, distill.distillation)
            parts["distill"] = TimedTraining(distill_env, distill.ppo, guide=guide).run
    parts["reference"] = Reference(num_envs, seconds, 0, robot).run
    parts["reference_10000_clips"] = Reference(num_envs, seconds, 10_000, robot).run
    parts["compliance"] = Compliance(num_envs, seconds, robot=robot).run
    for law in LAWS:
        parts[f"law_{law}"] = Compliance(num_envs, seconds, law, robot=robot).run
    passive = Compliance(num_envs, seconds, passive=True, robot=robot)
    parts["passive"] = passive.run
    parts["inverse_kinematics"] = InverseKinematics(num_envs, seconds, robot).run
    parts["compliance_literal"] = LiteralCompliance(num_envs, seconds, robot).run
    parts["blend"] = GeneralBlend(num_envs, seconds, robot).run
    parts["mujoco_rollout"] = lambda: rollout_rate(recording, seconds, options.threads, robot)
    makers = [partial(PlainEnv, robot)] * PEER_ENVS
    parts["gymnasium_async"] = lambda: gymnasium_rate(gymnasium.vector.AsyncVectorEnv(makers), seconds)
    parts["gymnasium_sync"] = lambda: gymnasium_rate(gymnasium.vector.SyncVectorEnv(makers), seconds)
    results = rounds(parts, repeats)
    median = {name: statistics.median(rates) for name, rates in results.items()}
    parts.clear()
    del env, train_env
    by_size = rates_by_size(options.sizes, policy, options)
    return {
        "robot": robot,
        "num_envs": num_envs,
        "policy": name,
        "physics_steps_per_s": median["physics"],
        "env_steps_per_s": median["env"],
        "train_steps_per_s": median.get("train"),
        "train_paper_steps_per_s": median.get("train_paper"),
        "env_over_physics": ratio(results, "env"),
        "train_over_physics": ratio(results, "train"),
        "train_paper_over_physics": ratio(results, "train_paper"),
        "distill_steps_per_s": median.get("distill"),
        "distill_over_train": ratio(results, "distill", to="train"),
        "train_note": None if len(options.networks) == 2 else f"networks measured: {', '.join(options.networks)}",
        "env_steps_per_s_by_num_envs": by_size,
        "env_512_over_4096": by_size["512"] / by_size["4096"] if {"512", "4096"} <= by_size.keys() else None,
        "env_steps_per_s_spread": 1.0 - min(by_size.values()) / max(by_size.values()) if by_size else None,
        "clips_over_env": statistics.median(
            env / with_clips - env / without
            for env, with_clips, without in zip(
                results["env"], results["reference_10000_clips"], results["reference"], strict=True
            )
        ),
        "compliance_ms": 1e3 * num_envs / median["compliance"],
        "compliance_over_physics": ratio(results, "physics", to="compliance"),
        "passivity_ms": 1e3 * num_envs * (1.0 / median["passive"] - 1.0 / median["compliance"]),
        "passivity_over_physics": statistics.median(
            physics / passive - physics / plain
            for physics, passive, plain in zip(
                results["physics"], results["passive"], results["compliance"], strict=True
            )
        ),
        "passivity_held_back": passive.held / passive.step,
        "compliance_literal_ms": 1e3 * num_envs / median["compliance_literal"],
        "compliance_literal_over_compliance": ratio(results, "compliance", to="compliance_literal"),
        "blend_ms": 1e3 * num_envs / median["blend"],
        "blend_over_physics": ratio(results, "physics", to="blend"),
        "inverse_kinematics_ms": 1e3 * num_envs / median["inverse_kinematics"],
        "inverse_kinematics_over_physics": ratio(results, "physics", to="inverse_kinematics"),
        "laws_ms": {name: 1e3 * num_envs / median[f"law_{name}"] for name in LAWS},
        "laws_over_physics": {name: ratio(results, "physics", to=f"law_{name}") for name in LAWS},
        "peak_rss_mib": memory,
        "peers": {name: median[name] for name in PEERS},
        "rounds": results,
        "machine": machine(),
    }


def table(result: dict[str, Any]) -> str:
    """The result as a Markdown table."""
    reference = result["physics_steps_per_s"]
    rows: list[tuple[str, float | None, float | None]] = [
        ("physics reference", reference, 1.0),
        (f"environment, {result['num_envs']} envs", result["env_steps_per_s"], result["env_over_physics"]),
        ("training, default networks", result["train_steps_per_s"], result["train_over_physics"]),
        ("training, paper's networks", result["train_paper_steps_per_s"], result["train_paper_over_physics"]),
        *((name, rate, rate / reference) for name, rate in result["peers"].items()),
        *((f"environment, {n} envs", r, r / reference) for n, r in result["env_steps_per_s_by_num_envs"].items()),
    ]
    lines = ["| what | control steps/s | over physics |", "|---|---|---|"]
    lines += [f"| {name} | {rate:,.0f} | {over:.2f} |" for name, rate, over in rows if rate and over]
    compliance = (
        f"compliance of both arms: {result['compliance_ms']:.1f} ms, {result['compliance_over_physics']:.3f} of a "
        f"physics step; the literal pipeline takes {result['compliance_literal_over_compliance']:.1f} times as long"
    )
    passivity = (
        f"energy store of both arms: {result['passivity_ms']:.1f} ms on top, {result['passivity_over_physics']:.3f} of "
        f"a physics step, while {result['passivity_held_back']:.1%} of the arms' changes are held back"
    )
    ik = (
        f"inverse kinematics of both arms: {result['inverse_kinematics_ms']:.1f} ms, "
        f"{result['inverse_kinematics_over_physics']:.3f} of a physics step"
    )
    laws = [
        f"| {name} | {result['laws_ms'][name]:.1f} | {over:.3f} |" for name, over in result["laws_over_physics"].items()
    ]
    laws = ["", "| law of the arms, per control step | ms | over physics |", "|---|---|---|", *laws, ""]
    blend = (
        f"general log-Euclidean blend of both arms: {result['blend_ms']:.1f} ms, {result['blend_over_physics']:.3f} of "
        "a physics step"
    )
    shares = {
        "train_over_physics": "training over physics",
        "env_512_over_4096": "environment, rate at 512 envs over that at 4096",
        "distill_over_train": "samples/s of stage 2 over those of stage 1",
    }
    asked = [f"{words}: {result[name]:.2f}" for name, words in shares.items() if result[name]]
    clips = f"10,000 clips beside generated arm motion cost {result['clips_over_env']:.2%} of an environment step"
    return "\n".join(
        [
            *lines,
            *laws,
            compliance,
            passivity,
            blend,
            ik,
            clips,
            *asked,
            f"\npeak memory of training: {result['peak_rss_mib']:,.0f} MiB",
        ]
    )


def main() -> int:
    """Parse, measure, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", choices=tuple(ROBOTS), default="h1")
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument(
        "--seconds", type=float, default=3.0, help="least time per measurement; training takes one iteration"
    )
    parser.add_argument("--repeats", type=int, default=3, help="rounds, after one of warming up")
    parser.add_argument("--steps", type=int, default=20, help="control steps recorded for the physics reference")
    parser.add_argument("--sizes", type=sizes, default=[512, 1024, 2048, 4096, 8192], help="comma-separated")
    parser.add_argument("--networks", nargs="+", choices=("default", "paper"), default=["default", "paper"])
    parser.add_argument("--threads", type=int, default=0, help="threads of physics and torch; 0 takes every core")
    parser.add_argument("--checkpoint", default="", help="policy to record and drive with; by default the shipped base")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--quick", action="store_true", help="small and short: shows that it runs, measures little")
    options = parser.parse_args()
    if options.quick:
        options.num_envs, options.seconds, options.repeats, options.steps = 256, 0.3, 1, 5
        options.sizes = [128, 256]
    try:
        for name in ("num_envs", "repeats", "steps"):
            require_positive_int(name, getattr(options, name))
        require_range("seconds", options.seconds, 1e-3, 1e6)
        require_range("threads", options.threads, 0, 4096)
        if options.threads:
            torch.set_num_threads(options.threads)
        if options.json:
            options.json.parent.mkdir(parents=True, exist_ok=True)
        result = measure(options)
        if options.json:
            write_json(options.json, result)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(table(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
