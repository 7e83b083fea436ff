"""The state reader against MuJoCo's own kinematics and velocities, on tumbling robots."""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch

from cotap.envs.state import StateReader
from cotap.robots import RobotSpec
from cotap.robots.mjcf import build_model
from cotap.sim import BatchSimulation

N = 12


def with_two_waist_joints(spec: RobotSpec) -> RobotSpec:
    """A robot whose torso is carried by two hinges, off the pelvis' origin: no lever arm may be forgotten."""
    torso = spec.body("torso_link")
    waist = dataclasses.replace(
        torso, name="waist_link", pos=(0.02, 0.03, 0.1), mass_kg=1.0, diaginertia=(0.01,) * 3, joint="waist_roll",
        collision=(), visual=(),
    )  # fmt: skip
    at = spec.bodies.index(torso)
    upper = dataclasses.replace(torso, parent="waist_link", pos=(0.1, -0.05, 0.2))
    yaw = spec.indices(["torso"])[0]
    roll = dataclasses.replace(spec.joints[yaw], name="waist_roll", axis=(1.0, 0.0, 0.0), mirror_name="waist_roll")
    return dataclasses.replace(
        spec,
        bodies=(*spec.bodies[:at], waist, upper, *spec.bodies[at + 1 :]),
        joints=(*spec.joints[:yaw], roll, *spec.joints[yaw:]),
    )


@pytest.fixture(scope="module", params=["h1", "two waist joints"])
def robot(request, spec):
    return spec if request.param == "h1" else with_two_waist_joints(spec)


@pytest.fixture(scope="module")
def tumbling_model(robot):
    return build_model(robot)


@pytest.fixture(scope="module")
def read(robot, tumbling_model):
    """A state and the single worlds that it must agree with."""
    model = tumbling_model
    rng = torch.Generator().manual_seed(3)
    sim = BatchSimulation(model, N, 2, 1)
    qpos = torch.zeros(N, model.nq, dtype=torch.float64)
    qpos[:, :3] = torch.randn(N, 3, generator=rng)
    qpos[:, 3:7] = torch.nn.functional.normalize(torch.randn(N, 4, generator=rng), dim=1)
    qpos[:, 7:] = 0.5 * torch.randn(N, model.nq - 7, generator=rng)
    qvel = torch.randn(N, model.nv, generator=rng).double()
    sim.reset(torch.ones(N, dtype=torch.bool), qpos, qvel)
    worlds = []
    for i in range(N):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(model, data)
        worlds.append(data)
    return StateReader(robot, sim).read(), worlds


def check(actual: torch.Tensor, expected: list[np.ndarray], atol: float = 1e-5) -> None:
    np.testing.assert_allclose(actual, np.array(expected), atol=atol)


def velocity(model, data, body: str) -> tuple[np.ndarray, np.ndarray]:
    """Angular and linear velocity of a body's origin in the world frame."""
    out = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(body).id, out, 0)
    return out[:3], out[3:]


def heading(data) -> np.ndarray:
    """Built from the angle, as the definition says: z up, x along the torso's yaw."""
    forward = data.body("torso_link").xmat.reshape(3, 3)[:, 0]
    yaw = math.atan2(forward[1], forward[0])
    return np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])


def test_joints(read):
    state, worlds = read
    check(state.joint_pos, [d.qpos[7:] for d in worlds])
    check(state.joint_vel, [d.qvel[6:] for d in worlds])


def test_poses(read):
    state, worlds = read
    check(state.base_rotation_w, [d.body("pelvis").xmat.reshape(3, 3) for d in worlds])
    check(state.torso_rotation_w, [d.body("torso_link").xmat.reshape(3, 3) for d in worlds])
    check(state.torso_pos_w, [d.body("torso_link").xpos for d in worlds])
    check(state.height, [d.body("torso_link").xpos[2] for d in worlds])
    check(state.heading_w, [heading(d) for d in worlds])


def test_torso_velocities(read, tumbling_model):
    state, worlds = read
    angular, linear = zip(*(velocity(tumbling_model, d, "torso_link") for d in worlds), strict=True)
    check(
        state.torso_angular_velocity_t,
        [d.body("torso_link").xmat.reshape(3, 3).T @ w for d, w in zip(worlds, angular, strict=True)],
    )
    check(state.yaw_rate, [w[2] for w in angular])
    check(state.torso_linear_velocity_h, [heading(d).T @ v for d, v in zip(worlds, linear, strict=True)])


def test_gravity_points_down(read):
    state, worlds = read
    down = np.array([0.0, 0.0, -1.0])
    check(state.projected_gravity_t, [d.body("torso_link").xmat.reshape(3, 3).T @ down for d in worlds])


def test_arms_reach_the_hands(read):
    state, worlds = read
    for a, side in enumerate(("left", "right")):
        check(state.hand_pos_w[:, a], [d.site(f"{side}_hand").xpos for d in worlds])


def test_feet(read, tumbling_model):
    state, worlds = read
    for f, side in enumerate(("left", "right")):
        site = f"{side}_foot"
        check(state.foot_pos_w[:, f], [d.site(site).xpos for d in worlds])
        check(state.foot_up_w[:, f], [d.site(site).xmat.reshape(3, 3)[:, 2] for d in worlds])
        check(state.foot_forward_w[:, f], [d.site(site).xmat.reshape(3, 3)[:, 0] for d in worlds])
        expected = []
        for data in worlds:
            angular, linear = velocity(tumbling_model, data, f"{side}_ankle_link")
            arm = data.site(site).xpos - data.body(f"{side}_ankle_link").xpos
            expected.append(linear + np.cross(angular, arm))
        check(state.foot_velocity_w[:, f], expected)


def test_foot_force_and_contact(spec, model):
    """One foot on the floor carries the load that MuJoCo's contacts report; the other, lifted, none."""
    sim = BatchSimulation(model, 1, 2, 1)
    qpos = torch.zeros(1, model.nq)
    qpos[0, 2], qpos[0, 3] = spec.nominal_height_m - 0.003, 1.0
    qpos[0, 7:] = torch.tensor([j.default_rad for j in spec.joints])
    lifted = spec.indices(["right_hip_pitch", "right_knee"])
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
