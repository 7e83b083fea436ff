"""MuJoCo Warp, on its CPU device, against MuJoCo: the same envs, as far as float32 goes.

The first run compiles Warp's kernels, minutes on one core; they are kept in Warp's cache.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch
from batches import require_that_one_diverges_alone
from scipy.stats import ks_2samp

pytest.importorskip("mujoco_warp", reason="needs the extra warp")

from cotap.compliance.laws import LawConfig
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.randomization import Randomizer
from cotap.robots.mjcf import build_model
from cotap.sim import Simulation, make_simulation
from cotap.sim.warp_simulation import WarpSimulation

pytestmark = pytest.mark.slow
N = 6


def both(model, fields: tuple[str, ...] = Randomizer.FIELDS) -> tuple[Simulation, Simulation]:
    return make_simulation("mujoco", model, N, 2, 1, fields), WarpSimulation(model, N, 2, "cpu", fields)


def start(model, height: float, rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses and velocities that differ between envs."""
    qpos, qvel = torch.zeros(N, model.nq, dtype=torch.float64), torch.zeros(N, model.nv, dtype=torch.float64)
    qpos[:, 2], qpos[:, 3] = height, 1.0
    qpos[:, 7:] = 0.2 * torch.randn(N, model.nu, generator=rng)
    qvel[:, 6:] = 0.3 * torch.randn(N, model.nu, generator=rng)
    return qpos, qvel


def vary(sim: Simulation, rng: torch.Generator) -> None:
    """Masses, inertias, friction and gains of every env's own."""
    scale = 0.8 + 0.5 * torch.rand(N, sim.model.nbody, generator=rng, dtype=torch.float64)
    sim.field("body_mass").mul_(scale)
    sim.field("body_inertia").mul_(scale.unsqueeze(-1))
    sim.field("geom_friction")[:, :, 0] = 0.4 + torch.rand(N, 1, generator=rng)
    sim.field("actuator_biasprm")[:, :, 1:3].mul_(0.8 + 0.4 * torch.rand(N, 1, 1, generator=rng))
    sim.update_constants()


def everyone() -> torch.Tensor:
    return torch.ones(N, dtype=torch.bool)


def test_joints_agree_without_contact(spec, rng):
    """Held in the air, random targets, forces on a hand, bodies of every env's own; 50 control steps."""
    model = build_model(spec, fixed_base=True)
    qpos, qvel = start(model, spec.nominal_height_m + 0.3, rng)
    gain = torch.tensor([j.kp for j in spec.joints])
    targets = 0.3 * torch.randn(50, 2, N, model.nu, generator=rng)
    force = 20.0 * torch.randn(N, 3, generator=rng)
    wrench = torch.cat((force, torch.linalg.cross(torch.full((N, 3), 0.1), force)), 1)
    seen = []
    for sim in both(model):
        vary(sim, torch.Generator().manual_seed(1))
        sim.reset(everyone(), qpos, qvel)
        rows = []
        for step in range(50):
            sim.xfrc[:, model.body("left_elbow_link").id] = wrench
            sim.step(lambda k, step=step: gain * targets[step, k])
            rows.append(sim.qpos[:, 7:].double().clone())
        seen.append(torch.stack(rows))
    assert (seen[0] - seen[0][:, :1]).abs().max() > 0.1  # envs do differ
    assert (seen[0] - seen[1]).abs().max() < 1e-3


def test_every_field_acts_in_its_own_env(model, spec, rng):
    """One control step from the same state: accelerations follow what differs."""
    qpos, qvel = start(model, spec.nominal_height_m, rng)
    for name in Randomizer.FIELDS:
        velocities = []
        for sim in both(model):
            sim.field(name)[1] *= 1.5
            sim.update_constants()
            sim.reset(everyone(), qpos[:1].repeat(N, 1), qvel[:1].repeat(N, 1))
            for _ in range(10):
                sim.step(lambda _: torch.zeros(N, model.nu))
            velocities.append(sim.qvel.double().clone())
        changed = (velocities[0][1] - velocities[0][0]).abs().max()
        assert changed > 1e-3, name
        assert (velocities[1][1] - velocities[1][0]).abs().max() == pytest.approx(float(changed), rel=0.1), name
        assert torch.equal(velocities[1][2], velocities[1][0]), name


def test_constants_follow_masses_as_mujoco_has_it(model, rng):
    derived = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")
    seed = int(torch.randint(1000, (1,), generator=rng))
    found = []
    for sim in both(model, (*Randomizer.FIELDS, *derived)):
        vary(sim, torch.Generator().manual_seed(seed))
        found.append({name: sim.field(name).double().clone() for name in derived})
    for name in derived:
        torch.testing.assert_close(found[1][name], found[0][name], rtol=2e-3, atol=1e-5)
        assert not torch.equal(found[1][name][0], found[1][name][1])


def test_sensors_agree_and_lag_alike(model, spec, rng):
    qpos, qvel = start(model, spec.nominal_height_m, rng)
    sims = both(model)
    for sim in sims:
        sim.reset(everyone(), qpos, qvel)
    for after in range(3):
        a, b = (sim.sensors.double() for sim in sims)
        torch.testing.assert_close(b, a, rtol=1e-3 if after == 0 else 0.02, atol=2e-3)
        for sim in sims:
            sim.step(lambda _: torch.zeros(N, model.nu))


def test_masked_reset_touches_only_its_envs(model, rng):
    sim = WarpSimulation(model, N, 2, "cpu", Randomizer.FIELDS)
    sim.reset(everyone(), *start(model, 1.0, rng))
    sim.xfrc[:, 1, 0] = 10.0
    for _ in range(3):
        sim.step(lambda _: torch.zeros(N, model.nu))
    before = sim.snapshot()
    mask = torch.arange(N) == 1
    qpos, qvel = (x[mask] for x in start(model, 5.0, rng))
    sim.reset(mask, qpos, qvel)
    after = sim.snapshot()
    assert torch.equal(after.state[~mask], before.state[~mask])
    assert torch.equal(after.sensors[~mask], before.sensors[~mask])
    assert sim.qpos[1, 2] == 5.0
    assert not sim.xfrc[1].any()
    assert 3.8 < float(sim.sensor("left_foot_pos")[1, 2]) < 4.4


def test_a_snapshot_goes_on_bit_for_bit(model, rng):
    sim, other = (WarpSimulation(model, N, 2, "cpu", Randomizer.FIELDS) for _ in range(2))
    vary(sim, rng)
    sim.reset(everyone(), *start(model, 1.0, rng))

    def go_on(s: Simulation) -> torch.Tensor:
        for _ in range(5):
            s.step(lambda _: torch.ones(N, model.nu))
        return torch.cat((s.qpos, s.qvel, s.sensors), 1).clone()

    go_on(sim)
    snapshot = sim.snapshot()
    first = go_on(sim)
    other.restore(snapshot)
    assert torch.equal(go_on(other), first)
    sim.restore(snapshot)
    assert torch.equal(go_on(sim), first)


@pytest.mark.parametrize("forwards", [True, False])
def test_one_backend_goes_on_from_the_other(model, rng, forwards):
    sims = both(model)
    a, b = sims if forwards else sims[::-1]
    vary(a, rng)
    a.reset(everyone(), *start(model, 1.5, rng))
    a.xfrc[:, 1, :3] = torch.tensor([5.0, -3.0, 2.0])
    a.step(lambda _: torch.ones(N, model.nu))
    b.restore(a.snapshot())
    for sim in sims:
        for _ in range(5):
            sim.step(lambda _: torch.ones(N, model.nu))
    torch.testing.assert_close(b.xfrc[:, 1].double(), a.xfrc[:, 1].double())
    torch.testing.assert_close(b.qpos.double(), a.qpos.double(), rtol=0, atol=1e-4)


def test_a_env_that_diverges_takes_no_other_along(model, rng):
    sims = [WarpSimulation(model, N, 2, "cpu", Randomizer.FIELDS) for _ in range(2)]
    qpos, qvel = start(model, 1.0, rng)
    require_that_one_diverges_alone(sims, qpos, qvel)


def environments(
    num_envs: int, seeds: tuple[int, int], change: Callable[[HumanoidEnvConfig], None]
) -> list[HumanoidEnv]:
    """One on each backend."""
    out = []
    for backend, seed in zip(("mujoco", "warp"), seeds, strict=True):
        cfg = HumanoidEnvConfig(num_envs=num_envs, num_threads=1, backend=backend, seed=seed)
        change(cfg)
        out.append(HumanoidEnv(cfg))
    return out


@pytest.mark.parametrize("law", ["pd", "cotap"])
def test_environments_agree_without_contact(law, rng):
    """Held in the air: states and rewards over 50 steps, with hand loads, randomised bodies and the arms' laws."""

    def change(cfg: HumanoidEnvConfig) -> None:
        cfg.fixed_base, cfg.forces.hand_loads.enabled = True, True
        cfg.upper_body.left, cfg.upper_body.right = LawConfig(name=law), LawConfig(name=law)

    envs = environments(N, (0, 0), change)
    for _ in range(50):
        action = 0.5 * torch.randn(N, 19, generator=rng)
        (_, _, done, extras), (_, _, other_done, other_extras) = (env.step(action) for env in envs)
        torch.testing.assert_close(envs[1].state.joint_pos, envs[0].state.joint_pos, rtol=0, atol=1e-4)
        # Squared accelerations are the least exact of all terms.
        torch.testing.assert_close(other_extras["group_rewards"], extras["group_rewards"], rtol=1e-3, atol=2e-3)
        assert torch.equal(other_done, done)


def test_robots_on_the_ground_are_distributed_alike():
    """Default pose under the wrench that assists first steps, for 1.5 s of standing in as many envs each, seeds
    apart: two-sample tests."""
    num_envs = 96

    def change(cfg: HumanoidEnvConfig) -> None:
        cfg.commands.stand_probability, cfg.assist.enabled = 1.0, True
        cfg.motions.clips.share = 0.0

    measures: list[dict[str, np.ndarray]] = []
    for env in environments(num_envs, (1, 2), change):
        total, fell = torch.zeros(num_envs), torch.zeros(num_envs, dtype=torch.bool)
        for _ in range(75):
            _, reward, _, extras = env.step(torch.zeros(num_envs, env.num_actions))
            total += reward
            fell |= extras["falls"]
        assert fell.float().mean() < 0.1
        s = env.state
        measures.append(
            {
                "reward": total.numpy(),
                "height": s.height.numpy(),
                "speed": s.torso_linear_velocity_h[:, :2].norm(dim=1).numpy(),
                "tilt": s.projected_gravity_t[:, :2].norm(dim=1).numpy(),
                "foot force": s.foot_force.sum(1).numpy(),
                "joint rate": s.joint_vel.norm(dim=1).numpy(),
                "torque": env.torque.norm(dim=1).numpy(),
            }
        )
    for name in measures[0]:
        # With seven measures, two backends that are alike fail once in 140 choices of seeds.
        assert ks_2samp(measures[0][name], measures[1][name]).pvalue > 1e-3, name


def test_a_checkpointed_environment_changes_its_backend(make_env):
    """What an environment saved on one backend, one on the other takes over."""
    env = make_env(N)
    for _ in range(3):
        env.step(torch.zeros(N, 19))
    other = make_env(N, backend="warp")
    other.load_state_dict(copy.deepcopy(env.state_dict()))
    torch.testing.assert_close(other.state.joint_pos, env.state.joint_pos)
    for _ in range(3):
        env.step(torch.zeros(N, 19))
        other.step(torch.zeros(N, 19))
    torch.testing.assert_close(other.state.joint_pos, env.state.joint_pos, rtol=0, atol=5e-3)
