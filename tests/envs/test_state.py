"""The state reader against MuJoCo's own kinematics and velocities, on tumbling robots.

The made-up robot's torso is carried by three hinges, off the base's origin: no lever arm may be forgotten.
"""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch
from robots.joints import called

from cotap.envs.state import StateReader
from cotap.sim import make_simulation

N = 12


@pytest.fixture(scope="module")
def read(any_spec, any_model):
    """A state and the single robots that it must agree with."""
    model = any_model
    rng = torch.Generator().manual_seed(3)
    sim = make_simulation("mujoco", model, N, 2, 1)
    qpos = torch.zeros(N, model.nq, dtype=torch.float64)
    qpos[:, :3] = torch.randn(N, 3, generator=rng)
    qpos[:, 3:7] = torch.nn.functional.normalize(torch.randn(N, 4, generator=rng), dim=1)
    qpos[:, 7:] = 0.5 * torch.randn(N, model.nq - 7, generator=rng)
    qvel = torch.randn(N, model.nv, generator=rng).double()
    sim.reset(torch.ones(N, dtype=torch.bool), qpos, qvel)
    robots = []
    for i in range(N):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(model, data)
        robots.append(data)
    return StateReader(any_spec, sim).read(), robots


def check(actual: torch.Tensor, expected: list[np.ndarray], atol: float = 1e-5) -> None:
    np.testing.assert_allclose(actual, np.array(expected), atol=atol)


def velocity(model, data, body: str) -> tuple[np.ndarray, np.ndarray]:
    """Angular and linear velocity of a body's origin in the world frame."""
    out = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(body).id, out, 0)
    return out[:3], out[3:]


def heading(data, torso: str) -> np.ndarray:
    """Built from the angle, as the definition says: z up, x along the torso's yaw."""
    forward = data.body(torso).xmat.reshape(3, 3)[:, 0]
    yaw = math.atan2(forward[1], forward[0])
    return np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])


def test_joints(read):
    state, robots = read
    check(state.joint_pos, [d.qpos[7:] for d in robots])
    check(state.joint_vel, [d.qvel[6:] for d in robots])


def test_poses(read, any_spec):
    state, robots = read
    check(state.base_rotation_w, [d.body(any_spec.base_body).xmat.reshape(3, 3) for d in robots])
    check(state.torso_rotation_w, [d.body(any_spec.torso_body).xmat.reshape(3, 3) for d in robots])
    check(state.torso_pos_w, [d.body(any_spec.torso_body).xpos for d in robots])
    check(state.height, [d.body(any_spec.torso_body).xpos[2] for d in robots])
    check(state.heading_w, [heading(d, any_spec.torso_body) for d in robots])


def test_torso_velocities(read, any_spec, any_model):
    state, robots = read
    angular, linear = zip(*(velocity(any_model, d, any_spec.torso_body) for d in robots), strict=True)
    check(
        state.torso_angular_velocity_t,
        [d.body(any_spec.torso_body).xmat.reshape(3, 3).T @ w for d, w in zip(robots, angular, strict=True)],
    )
    check(state.yaw_rate, [w[2] for w in angular])
    check(
        state.torso_linear_velocity_h,
        [heading(d, any_spec.torso_body).T @ v for d, v in zip(robots, linear, strict=True)],
    )


def test_gravity_points_down(read, any_spec):
    state, robots = read
    down = np.array([0.0, 0.0, -1.0])
    check(state.projected_gravity_t, [d.body(any_spec.torso_body).xmat.reshape(3, 3).T @ down for d in robots])


def test_arms_reach_the_hands(read, any_spec):
    state, robots = read
    for a, arm in enumerate(any_spec.arms):
        check(state.hand_pos_w[:, a], [d.site(f"{arm.side}_hand").xpos for d in robots])


def test_feet(read, any_spec, any_model):
    state, robots = read
    for f, foot in enumerate(any_spec.feet):
        site = f"{foot.side}_foot"
        check(state.foot_pos_w[:, f], [d.site(site).xpos for d in robots])
        check(state.foot_up_w[:, f], [d.site(site).xmat.reshape(3, 3)[:, 2] for d in robots])
        check(state.foot_forward_w[:, f], [d.site(site).xmat.reshape(3, 3)[:, 0] for d in robots])
        expected = []
        for data in robots:
            angular, linear = velocity(any_model, data, foot.body)
            arm = data.site(site).xpos - data.body(foot.body).xpos
            expected.append(linear + np.cross(angular, arm))
        check(state.foot_velocity_w[:, f], expected)


def test_foot_force_and_contact(any_spec, any_model):
    """One foot on the floor carries the load that MuJoCo's contacts report; the other, lifted, none."""
    spec, model = any_spec, any_model
    sim = make_simulation("mujoco", model, 1, 2, 1)
    qpos = torch.zeros(1, model.nq)
    qpos[0, 2], qpos[0, 3] = spec.base_height_m - 0.003, 1.0
    qpos[0, 7:] = torch.tensor([j.default_rad for j in spec.joints])
    lifted = spec.indices(called(spec, "right_hip_pitch", "right_knee"))
    qpos[0, 7 + torch.tensor(lifted)] += torch.tensor([-0.5, 0.9])
    sim.reset(torch.ones(1, dtype=torch.bool), qpos, torch.zeros(1, model.nv))
    state = StateReader(spec, sim).read()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos[0]
    mujoco.mj_forward(model, data)
    wrench, total = np.zeros(6), 0.0
    for c in range(data.ncon):
        mujoco.mj_contactForce(model, data, c, wrench)
        total += wrench[0]
    assert total > 5.0
    assert float(state.foot_force[0, 0]) == pytest.approx(total, rel=1e-5)
    assert state.foot_contact.tolist() == [[True, False]]


def test_reading_some_is_reading_all(any_spec, any_model):
    """A state in which envs are replaced is the one that is read whole."""
    sim = make_simulation("mujoco", any_model, 5, 2, 1)
    everyone = torch.ones(5, dtype=torch.bool)
    rng = torch.Generator().manual_seed(4)

    def place(mask):
        n = int(mask.sum())
        qpos = torch.randn(n, any_model.nq, generator=rng).double()
        qpos[:, 3:7] = torch.nn.functional.normalize(qpos[:, 3:7], dim=1)
        sim.reset(mask, qpos, torch.randn(n, any_model.nv, generator=rng).double())

    place(everyone)
    reader = StateReader(any_spec, sim)
    before = reader.read()
    place(torch.tensor([False, True, False, True, False]))
    ids = torch.tensor([1, 3])
    mixed, whole = before.with_envs(ids, reader.read(ids)), reader.read()
    torch.testing.assert_close(dataclasses.asdict(mixed), dataclasses.asdict(whole), atol=0.0, rtol=0.0)
    assert not torch.equal(before.joint_pos, whole.joint_pos)
