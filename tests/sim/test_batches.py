"""All that steps envs on the CPU computes the same, bit for bit: with MuJoCo alone as with mjbatch."""

from __future__ import annotations

import copy
import json

import pytest
import torch
from batches import BATCHES, batch_named, require_that_one_diverges_alone
from random_policy import save_random_policy

from cotap.compliance.laws import LawConfig
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.randomization import Randomizer
from cotap.evaluate import main as evaluate
from cotap.robots.mjcf import build_model
from cotap.sim import BatchSimulation
from cotap.sim.loop_batch import LoopBatch

N = 5
SCENES = {
    "full": {"collision": "full"},
    "feet": {"collision": "feet"},
    "uneven": {"collision": "full", "unevenness_m": 0.06},
    "held": {"collision": "full", "fixed_base": True},
}


@pytest.fixture(params=BATCHES[:-1])
def native(request):
    """What does not loop in Python."""
    return batch_named(request.param)


def everyone() -> torch.Tensor:
    return torch.ones(N, dtype=torch.bool)


def start(spec, n: int, rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Robots that stand about as they should, each in a pose of its own, and move."""
    qpos = torch.zeros(n, 7 + len(spec.joints), dtype=torch.float64)
    qpos[:, 2], qpos[:, 3] = spec.base_height_m, 1.0
    qpos[:, 7:] = torch.tensor([j.default_rad for j in spec.joints]) + 0.1 * torch.randn(
        n, len(spec.joints), generator=rng
    )
    return qpos, 0.3 * torch.randn(n, 6 + len(spec.joints), generator=rng).double()


def vary(sim: BatchSimulation, rng: torch.Generator) -> None:
    """Masses, inertias, friction and gains of every env's own."""
    scale = 0.8 + 0.5 * torch.rand(N, sim.model.nbody, generator=rng, dtype=torch.float64)
    sim.field("body_mass").mul_(scale)
    sim.field("body_inertia").mul_(scale.unsqueeze(-1))
    sim.field("geom_friction")[:, :, 0] = 0.4 + torch.rand(N, 1, generator=rng)
    sim.field("actuator_biasprm")[:, :, 1:3].mul_(0.8 + 0.4 * torch.rand(N, 1, 1, generator=rng))
    sim.update_constants()


def run(sim: BatchSimulation, spec, rng: torch.Generator) -> list[torch.Tensor]:
    """States and sensors of 40 control steps under random motors and forces; two envs restart on the way."""
    rows = []
    sim.reset(everyone(), *start(spec, N, rng))
    gain = torch.tensor([j.kp for j in spec.joints])
    for step in range(40):
        sim.field("actuator_biasprm")[:, :, 1].mul_(0.99)  # as laws of the arms do at every step
        sim.xfrc[:, 3] = 20.0 * torch.randn(N, 6, generator=rng)
        if step == 20:
            sim.reset(torch.arange(N) % 2 == 1, *start(spec, N // 2, rng))
        sim.step(lambda _: gain * 0.3 * torch.randn(N, len(gain), generator=rng))
        rows.append(torch.cat((sim.snapshot().state, sim.sensors), 1))
    return rows


@pytest.mark.parametrize("scene", SCENES)
def test_native_batches_and_the_loop_agree_bit_for_bit(any_spec, native, scene):
    model = build_model(any_spec, **SCENES[scene])
    seen = []
    for batch in (native, LoopBatch):
        sim = BatchSimulation(batch, model, N, 2, 1, Randomizer.FIELDS)
        vary(sim, torch.Generator().manual_seed(1))
        seen.append(torch.stack(run(sim, any_spec, torch.Generator().manual_seed(2))))
    assert torch.equal(*seen)
    assert (seen[0][-1, 0] - seen[0][-1, 1]).abs().max() > 0.1  # envs do differ
    assert scene == "held" or seen[0][..., -model.nsensordata :].abs().max() > 100.0  # feet touch the ground


@pytest.mark.parametrize("threads", [2, 3, 9])
def test_the_loops_numbers_do_not_depend_on_its_threads(spec, model, threads):
    seen = []
    for n in (1, threads):
        sim = BatchSimulation(LoopBatch, model, N, 2, n, Randomizer.FIELDS)
        vary(sim, torch.Generator().manual_seed(1))
        seen.append(torch.stack(run(sim, spec, torch.Generator().manual_seed(2))))
    assert torch.equal(*seen)


@pytest.mark.parametrize("name", BATCHES)
def test_an_env_that_diverges_takes_no_other_along(spec, model, name, rng, in_tmp_path):  # noqa: ARG001
    sims = [BatchSimulation(batch_named(name), model, N, 2, 1) for _ in range(2)]
    qpos, qvel = start(spec, N, rng)
    require_that_one_diverges_alone(sims, qpos, qvel)


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_a_thread_of_the_loop_is_raised(model, threads):
    batch = LoopBatch(model, N, threads)
    batch.state = batch.state[:, 1:].copy()
    with pytest.raises(TypeError, match="state size"):
        batch.step()


@pytest.fixture
def cpu_backends() -> tuple[str, str]:
    batch_named("mjbatch")
    return "mjbatch", "mujoco"


def environments(backends: tuple[str, str], **fields) -> list[HumanoidEnv]:
    """One on each backend, with everything on that differs between envs."""
    out = []
    for backend in backends:
        cfg = HumanoidEnvConfig(num_envs=N, num_threads=1, backend=backend, unevenness_m=0.04)
        cfg.forces.hand_loads.enabled = True
        cfg.upper_body.left = cfg.upper_body.right = LawConfig(name="cotap")
        for name, value in fields.items():
            setattr(cfg, name, value)
        out.append(HumanoidEnv(cfg))
    return out


@pytest.mark.parametrize("robot", ["h1", "g1"])
def test_environments_agree_bit_for_bit(cpu_backends, robot, rng):
    envs = environments(cpu_backends, robot=robot)
    falls = 0
    for _ in range(80):
        action = 0.5 * torch.randn(N, envs[0].num_actions, generator=rng)
        (obs, reward, done, extras), (other_obs, other_reward, other_done, _) = (env.step(action) for env in envs)
        for group in obs.keys():  # noqa: SIM118 - a TensorDict iterates over envs
            assert torch.equal(obs[group], other_obs[group])
        assert torch.equal(reward, other_reward)
        assert torch.equal(done, other_done)
        falls += int(extras["falls"].sum())
    assert falls > 0  # restarts agree, too


def test_what_one_saved_the_other_goes_on_from_bit_for_bit(cpu_backends, rng):
    env, other = environments(cpu_backends)
    for _ in range(5):
        env.step(torch.zeros(N, env.num_actions))
    other.load_state_dict(copy.deepcopy(env.state_dict()))
    for _ in range(20):
        action = 0.3 * torch.randn(N, env.num_actions, generator=rng)
        env.step(action)
        other.step(action)
    assert torch.equal(env.sim.snapshot().state, other.sim.snapshot().state)


@pytest.mark.slow
def test_an_evaluation_measures_the_same(cpu_backends, tmp_path):
    policy = str(save_random_policy(tmp_path / "policy.pt"))
    results = []
    for backend in cpu_backends:
        file = tmp_path / f"{backend}.json"
        args = ["--checkpoint", policy, "--backend", backend, "--num-envs", "3", "--threads", "1", "--json", str(file)]
        assert evaluate(["impact", "--method", "cotap", *args]) == 0
        results.append(json.loads(file.read_text()))
        assert results[-1]["settings"]["env"]["backend"] == backend
    first, second = (result["metrics"] for result in results)
    assert first == second
