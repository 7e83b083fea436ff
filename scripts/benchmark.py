"""How fast: physics, environment and training on this machine, as ratios within one run, beside its peers.

The physics reference is fixed: control steps of four 5 ms `mj_step` of H1 with feet-only contacts in plain mjbatch,
from the states and with the torques of a recorded rollout of the shipped base policy, and nothing else. All figures
are control steps (20 ms) per second.
"""

from __future__ import annotations

import argparse
import json
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
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from mjbatch import Batch
from mujoco import rollout

from cotap.agents.actors import as_dict
from cotap.agents.checkpoint import write_json
from cotap.agents.dual_ppo import DualPPO
from cotap.agents.runner import layout_of
from cotap.configs import BASE_RECIPES, BaseTraining
from cotap.envs import H1Env, H1EnvConfig
from cotap.evaluation.policy import Policy, load_policy, shipped_checkpoint
from cotap.robots import h1
from cotap.robots.mjcf import build_model

PEER_ENVS = 32
SUBSTEPS, TIMESTEP_S = 4, 0.005


@dataclass(frozen=True)
class Recording:
    """States before, and torques during, K control steps of N worlds."""

    qpos: np.ndarray
    qvel: np.ndarray
    torque: np.ndarray


def reference_model() -> mujoco.MjModel:
    """H1 at 5 ms with feet-only contacts, whose controls are torques."""
    model = build_model(h1(), "feet", TIMESTEP_S)
    model.actuator_biasprm[:] = 0.0
    return model


def full_env(num_envs: int) -> H1Env:
    """Everything on, as in training after the gantry is gone."""
    cfg = H1EnvConfig(num_envs=num_envs)
    cfg.hand_forces.curriculum_start = 1.0
    return H1Env(cfg)


def record(env: H1Env, policy: Policy, warm_up: int, steps: int) -> Recording:
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

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.batch = Batch(reference_model(), recording.qpos.shape[1])
        self.qpos, self.qvel, self.ctrl = (self.batch.bind(name) for name in ("qpos", "qvel", "ctrl"))

    def run(self) -> float:
        r, spent = self.recording, 0.0
        for qpos, qvel, torque in zip(r.qpos, r.qvel, r.torque, strict=True):
            self.qpos[:], self.qvel[:], self.ctrl[:] = qpos, qvel, torque
            start = time.perf_counter()
            self.batch.step(nstep=SUBSTEPS)
            spent += time.perf_counter() - start
        return r.qpos.shape[0] * r.qpos.shape[1] / spent


class EnvStepping:
    """`H1Env.step` with everything on; the policy's own time is not counted."""

    def __init__(self, env: H1Env, policy: Policy, steps: int) -> None:
        self.env, self.policy, self.steps = env, policy, steps

    def run(self) -> float:
        obs, spent = self.env.get_observations(), 0.0
        for _ in range(self.steps):
            actions = self.policy(as_dict(obs))
            start = time.perf_counter()
            obs, *_ = self.env.step(actions)
            spent += time.perf_counter() - start
        return self.steps * self.env.num_envs / spent


class Training:
    """Whole iterations: collecting and learning."""

    def __init__(self, env: H1Env, training: BaseTraining) -> None:
        self.env = env
        self.alg = DualPPO(layout_of(env), env.num_envs, training.ppo)

    def run(self) -> float:
        alg, env = self.alg, self.env
        start = time.perf_counter()
        obs = as_dict(env.get_observations())
        for _ in range(alg.cfg.steps):
            obs, _, dones, extras = env.step(alg.act(obs))
            obs = as_dict(obs)
            alg.process_step(extras["group_rewards"], dones, extras["time_outs"])
        alg.compute_returns(obs)
        alg.update()
        return alg.cfg.steps * env.num_envs / (time.perf_counter() - start)


class PlainEnv(gymnasium.Env):
    """Bare `mj_step` of the same model behind Gymnasium's interface."""

    def __init__(self) -> None:
        self.model = reference_model()
        self.data = mujoco.MjData(self.model)
        size = self.model.nq + self.model.nv
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.model.nu,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed, options=options)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[2] = 1.04
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


def rollout_rate(recording: Recording) -> float:
    """Control steps per second of `mujoco.rollout` on the recording, from its states with its torques."""
    model = reference_model()
    threads = os.cpu_count() or 1
    data = [mujoco.MjData(model) for _ in range(threads)]
    k, n = recording.qpos.shape[:2]
    pool = rollout.Rollout(nthread=threads)
    state = np.zeros((n, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    spent = 0.0
    for i in range(k):
        state[:, 1 : 1 + model.nq] = recording.qpos[i]
        state[:, 1 + model.nq : 1 + model.nq + model.nv] = recording.qvel[i]
        control = np.repeat(recording.torque[i][:, None], SUBSTEPS, 1)
        start = time.perf_counter()
        pool.rollout(model, data, state, control)
        spent += time.perf_counter() - start
    pool.close()
    return k * n / spent


def rounds(parts: dict[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """Run all parts in turn, `repeats` times over after one round of warming up."""
    results: dict[str, list[float]] = {name: [] for name in parts}
    for i in range(repeats + 1):
        for name, run in parts.items():
            rate = run()
            if i:
                results[name].append(rate)
    return results


def ratio(results: dict[str, list[float]], part: str, to: str = "physics") -> float:
    """Median of the ratios within rounds."""
    return statistics.median(a / b for a, b in zip(results[part], results[to], strict=True))


def peak_memory_mib(num_envs: int) -> float:
    """Peak resident memory of a training of two iterations, in a process of its own [MiB]."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "cotap.train", "base", "--num-envs", str(num_envs), "--iterations", "2"]
        subprocess.run([*command, "--run-dir", f"{folder}/run"], check=True, capture_output=True)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0


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
        "torch": torch.__version__,
        "mujoco": mujoco.__version__,
    }


def measure(num_envs: int, repeats: int, steps: int, sizes: list[int], checkpoint: Path) -> dict[str, Any]:
    """Everything that goes into the JSON."""
    torch.manual_seed(0)
    memory = peak_memory_mib(num_envs)  # first, while this process is small
    policy = load_policy(checkpoint)
    env = full_env(num_envs)
    recording = record(env, policy, warm_up=50, steps=steps)
    parts: dict[str, Callable[[], float]] = {
        "physics": PhysicsReference(recording).run,
        "env": EnvStepping(env, policy, steps).run,
        "train": Training(env, BASE_RECIPES["default"]()).run,
        "train_paper": Training(env, BASE_RECIPES["paper"]()).run,
        "mujoco_rollout": lambda: rollout_rate(recording),
    }
    results = rounds(parts, repeats)
    median = {name: statistics.median(rates) for name, rates in results.items()}
    makers = [PlainEnv] * PEER_ENVS
    by_size = {str(n): EnvStepping(full_env(n), policy, max(10, steps * num_envs // n // 2)).run() for n in sizes}
    return {
        "num_envs": num_envs,
        "physics_steps_per_s": median["physics"],
        "env_steps_per_s": median["env"],
        "train_steps_per_s": median["train"],
        "train_paper_steps_per_s": median["train_paper"],
        "env_over_physics": ratio(results, "env"),
        "train_over_physics": ratio(results, "train"),
        "train_paper_over_physics": ratio(results, "train_paper"),
        "env_steps_per_s_by_num_envs": by_size,
        "compliance_ms": None,
        "compliance_over_physics": None,
        "compliance_note": "not measured: this release has no compliance law",
        "peak_rss_mib": memory,
        "peers": {
            "mujoco_rollout": median["mujoco_rollout"],
            "gymnasium_async": gymnasium_rate(gymnasium.vector.AsyncVectorEnv(makers), 3.0),
            "gymnasium_sync": gymnasium_rate(gymnasium.vector.SyncVectorEnv(makers), 3.0),
        },
        "rounds": results,
        "machine": machine(),
    }


def main() -> int:
    """Parse, measure, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=3, help="rounds; medians are reported")
    parser.add_argument("--steps", type=int, default=20, help="control steps per measurement")
    parser.add_argument("--sizes", type=int, nargs="*", default=[512, 1024, 2048, 4096, 8192])
    parser.add_argument("--checkpoint", type=Path, default=shipped_checkpoint("base"))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    result = measure(options.num_envs, options.repeats, options.steps, options.sizes, options.checkpoint)
    if options.json:
        write_json(options.json, result)
    print(json.dumps({k: v for k, v in result.items() if k != "rounds"}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
