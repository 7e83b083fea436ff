"""Every batch on the CPU against single MuJoCo envs and hand-worked numbers."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from batches import BATCHES, batch_named

from cotap.sim import BatchSimulation

N = 3
FREE_BODY = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body name="ball"><freejoint/>
<geom size="0.1" mass="2"/></body></worldbody></mujoco>
"""


FIELDS = ("body_mass", "body_inertia", "geom_friction")


@pytest.fixture(params=BATCHES)
def batch(request):
    return batch_named(request.param)


@pytest.fixture
def sim(model, batch) -> BatchSimulation:
    return BatchSimulation(batch, model, N, 2, 1, FIELDS)


def start(model, height=2.0) -> tuple[torch.Tensor, torch.Tensor]:
    qpos = torch.zeros(N, model.nq)
    qpos[:, 2], qpos[:, 3] = height, 1.0
    return qpos, torch.zeros(N, model.nv)


def everyone() -> torch.Tensor:
    return torch.ones(N, dtype=torch.bool)


def no_drive(sim):
    return lambda _: torch.zeros(sim.num_envs, sim.model.nu)


def test_matches_single_envs(sim, model, rng):
    qpos, qvel = start(model, 1.0)
    qpos[:, 7:] = 0.1 * torch.randn(N, 19, generator=rng)
    qvel += 0.3 * torch.randn(N, model.nv, generator=rng)
    targets = torch.randn(2, N, 19, generator=rng)
    sim.reset(everyone(), qpos, qvel)
    for _ in range(5):
        sim.step(lambda k: 30.0 * targets[k])
    for i in range(N):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        for _ in range(5):
            for k in range(2):
                data.ctrl[:] = 30.0 * targets[k, i]
                mujoco.mj_step(model, data)
        np.testing.assert_allclose(sim.qpos[i], data.qpos, atol=1e-9)
        np.testing.assert_allclose(sim.qvel[i], data.qvel, atol=1e-7)
        np.testing.assert_allclose(sim.sensors[i], data.sensordata, rtol=1e-4, atol=1e-4)


def test_step_lasts_substeps_times_timestep(sim, model):
    assert sim.dt == pytest.approx(0.02)
    sim.reset(everyone(), *start(model))
    sim.step(no_drive(sim))
    torch.testing.assert_close(sim.qvel[:, 2], torch.full((N,), -9.81 * 0.02, dtype=torch.float64), rtol=2e-2, atol=0)


def test_masked_reset_touches_only_its_envs(sim, model):
    sim.reset(everyone(), *start(model, 1.0))
    sim.xfrc[:, 1, 0] = 10.0
    for _ in range(3):
        sim.step(no_drive(sim))
    before = sim.snapshot()
    sim.xfrc[1, 1, 1], sim.ctrl[1, 0] = 20.0, 5.0
    mask = torch.tensor([False, True, False])
    qpos, qvel = (x[mask] for x in start(model, 5.0))
    qvel[:, 0] = 0.5
    sim.reset(mask, qpos, qvel)
    after = sim.snapshot()
    others = [0, 2]
    assert torch.equal(after.state[others], before.state[others])
    assert torch.equal(after.sensors[others], before.sensors[others])
    assert sim.qpos[1, 2] == 5.0
    assert sim.qvel[1, 0] == 0.5
    assert not sim.xfrc[1].any()
    assert not sim.ctrl[1].any()
    # Sensors are current right after a reset: the foot hangs 1.0 m and more below a pelvis at 5 m.
    assert 3.8 < float(sim.sensor("left_foot_pos")[1, 2]) < 4.1


def test_reset_of_no_env_changes_nothing(sim, model):
    sim.reset(everyone(), *start(model))
    before = sim.snapshot().state
    sim.reset(~everyone(), torch.zeros(0, model.nq), torch.zeros(0, model.nv))
    assert torch.equal(sim.snapshot().state, before)


def test_reset_refuses_a_mask_of_another_size(sim, model):
    with pytest.raises(ValueError, match=r"mask must have shape \(3,\), got \(4,\)"):
        sim.reset(torch.ones(4, dtype=torch.bool), *start(model))


def test_masses_differ_in_effect_between_envs(batch):
    model = mujoco.MjModel.from_xml_string(FREE_BODY)
    sim = BatchSimulation(batch, model, 2, 1, 1, ("body_mass", "body_inertia"))
    sim.field("body_mass")[1, 1] = 8.0
    sim.field("body_inertia")[1, 1] *= 4.0
    sim.update_constants()
    sim.xfrc[:, 1, 0] = 4.0
    sim.step(lambda _: torch.zeros(2, 0))
    np.testing.assert_allclose(sim.qvel[:, 0], [4 / 2 * 0.01, 4 / 8 * 0.01])


def test_update_constants_follows_masses(model, batch):
    sim = BatchSimulation(batch, model, 2, 1, 1, ("body_mass", "body_inertia", "body_subtreemass"))
    sim.field("body_mass")[1] *= 2.0
    sim.field("body_inertia")[1] *= 2.0
    sim.update_constants()
    np.testing.assert_allclose(sim.field("body_subtreemass")[:, 1], [51.437, 102.874])


def test_friction_differs_in_effect_between_envs(spec, model, batch):
    sim = BatchSimulation(batch, model, 2, 2, 1, ("geom_friction",))
    sim.field("geom_friction")[0, :, 0] = 0.05
    sim.field("geom_friction")[1, :, 0] = 1.0
    qpos = torch.zeros(2, model.nq)
    qpos[:, 2], qpos[:, 3] = spec.nominal_height_m, 1.0
    default = torch.tensor([j.default_rad for j in spec.joints])
    qpos[:, 7:] = default
    sim.reset(torch.ones(2, dtype=torch.bool), qpos, torch.zeros(2, model.nv))
    gain = torch.tensor([j.kp for j in spec.joints])
    slid = torch.zeros(2)
    for _ in range(15):
        sim.xfrc[:, model.body("pelvis").id, 0] = 60.0
        before = sim.sensor("left_foot_pos")[:, 0].clone()
        sim.step(lambda _: (gain * default).repeat(2, 1))
        slid += sim.sensor("left_foot_pos")[:, 0] - before
    assert abs(slid[0]) > 0.02
    assert abs(slid[1]) < 0.01


def test_undeclared_fields_are_refused(sim):
    with pytest.raises(ValueError, match="'actuator_gear' was not declared; declared: body_mass, body_inertia"):
        sim.field("actuator_gear")


def test_a_wrench_at_the_centre_of_mass_is_mj_apply_ft(model, batch, rng):
    """A force at the hand, with its moment, moves the robot as the generalised force that MuJoCo computes does."""
    sim = BatchSimulation(batch, model, N, 1, 1)
    qpos, qvel = start(model)
    qpos[:, 3:7] = torch.nn.functional.normalize(torch.randn(N, 4, generator=rng), dim=1)
    qpos[:, 7:] = 0.5 * torch.randn(N, 19, generator=rng)
    force = 40.0 * torch.randn(N, 3, generator=rng)
    body = model.body("left_elbow_link").id
    sim.reset(everyone(), qpos, qvel)
    levers, references = [], []
    for i in range(N):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos[i]
        mujoco.mj_forward(model, data)
        point = data.site("left_hand").xpos.copy()
        levers.append(point - data.xipos[body])
        generalised = np.zeros(model.nv)
        mujoco.mj_applyFT(model, data, force[i].double().numpy(), np.zeros(3), point, body, generalised)
        data.qfrc_applied[:] = generalised
        mujoco.mj_step(model, data)
        references.append(data.qvel.copy())
    sim.xfrc[:, body, :3] = force
    sim.xfrc[:, body, 3:] = torch.linalg.cross(torch.tensor(np.array(levers), dtype=torch.float32), force)
    sim.step(no_drive(sim))
    np.testing.assert_allclose(sim.qvel, references, atol=1e-4)
    assert np.abs(references).max() > 1.0


def test_snapshot_and_restore_reproduce_the_future_bit_for_bit(sim, model, batch, rng):
    sim.field("body_mass").mul_(torch.tensor([0.9, 1.0, 1.2]).double()[:, None])
    sim.update_constants()
    sim.reset(everyone(), *start(model, 1.0))
    drives = 20.0 * torch.randn(20, 2, N, 19, generator=rng)

    def run(first: int) -> torch.Tensor:
        for t in range(first, first + 10):
            sim.xfrc[:, 1, 1] = float(t)
            sim.step(lambda k, t=t: drives[t, k])
        return torch.cat((sim.qpos, sim.qvel, sim.sensors.double()), 1)

    run(0)
    snapshot = sim.snapshot()
    future = run(10)
    # Everything is disturbed before the return, fields too.
    sim.field("body_mass").mul_(2.0)
    sim.field("geom_friction").fill_(0.1)
    sim.update_constants()
    sim.reset(everyone(), *start(model, 3.0))
    run(0)
    sim.restore(snapshot)
    assert torch.equal(sim.sensors, snapshot.sensors)
    assert torch.equal(run(10), future)
    stranger = BatchSimulation(batch, model, N, 2, 1, FIELDS)
    sim.restore(snapshot)
    stranger.restore(snapshot)
    sim = stranger
    assert torch.equal(run(10), future)


def test_restore_refuses_other_sizes_and_fields(sim, model, batch):
    snapshot = BatchSimulation(batch, model, N + 1, 2, 1).snapshot()
    with pytest.raises(ValueError, match=r"snapshot\.state must have shape"):
        sim.restore(snapshot)
    snapshot = BatchSimulation(batch, model, N, 2, 1).snapshot()
    with pytest.raises(ValueError, match=r"snapshot has fields \[\], not \['body_inertia'"):
        sim.restore(snapshot)


@pytest.mark.parametrize("bad", [{"num_envs": 0}, {"substeps": -1}])
def test_sizes_must_be_positive(model, batch, bad):
    with pytest.raises(ValueError, match=rf"{next(iter(bad))} must be a positive integer"):
        BatchSimulation(batch, model, **{"num_envs": 1, "substeps": 1, **bad})
