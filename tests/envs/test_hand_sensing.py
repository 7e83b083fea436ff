"""Forces on hands estimated from the arms' torques, against MuJoCo's own gravity, friction, inertia and Jacobian."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from env_tools import NOMINAL, mujoco_of

from cotap.compliance.force_estimation import FORCE_DAMPING_M2
from cotap.envs.hand_sensing import TIME_CONSTANT_S, HandSensors

SHARE = 1.0 - math.exp(-0.02 / TIME_CONSTANT_S)


@pytest.fixture
def leaning(make_env, robot):
    """Two robots that lean and have turned, arms in motion; sensors of their own that have felt nothing yet."""
    env = make_env(2, robot=robot, randomization=NOMINAL)
    rng = torch.Generator().manual_seed(4)
    quat = torch.tensor([[1.0, 0.15, -0.2, 0.5], [1.0, -0.2, 0.1, -0.7]]).double()
    env.sim.qpos[:, 3:7] = quat / quat.norm(dim=1, keepdim=True)
    arms = slice(env.num_lower, None)
    env.sim.qpos[:, 7:][:, arms] += 0.2 * torch.randn(env.sim.qpos[:, 7:][:, arms].shape, generator=rng)
    env.sim.qvel[:] = 0.0
    env.sim.qvel[:, 6:][:, arms] = 2.0 * torch.randn(env.sim.qvel[:, 6:][:, arms].shape, generator=rng).double()
    env.state = env.reader.read()
    return env, HandSensors(env.upper_body.arms, 2, env.dt, estimates=True)


def arms_of(env, index: int) -> dict[str, np.ndarray]:
    """By MuJoCo: gravity and friction torques (A, n), inertia (A, n, n), Jacobian (A, 3, n), the heading."""
    model, data = mujoco_of(env, index)
    rates = data.qvel.copy()
    data.qvel[:] = 0.0
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    parts: dict[str, list] = {"gravity": [], "friction": [], "inertia": [], "jacobian": [], "rates": []}
    for arm in env.spec.arms:
        dofs = [model.joint(name).dofadr[0] for name in arm.joints]
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, data.site(f"{arm.side}_hand").xpos, model.body(arm.hand_body).id)
        parts["gravity"].append(data.qfrc_bias[dofs])
        parts["friction"].append(model.dof_damping[dofs] * rates[dofs])
        parts["inertia"].append(mass[np.ix_(dofs, dofs)])
        parts["jacobian"].append(jacobian[:, dofs])
        parts["rates"].append(rates[dofs])
    x, y = data.body(env.spec.torso_body).xmat.reshape(3, 3)[:2, 0]
    cos, sin = np.array([x, y]) / np.hypot(x, y)
    return {k: np.array(v) for k, v in parts.items()} | {
        "heading": np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    }


def explained(jacobian: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """The force of damped least squares, (3,), for a torque (n,) and a Jacobian (3, n)."""
    return np.linalg.solve(jacobian @ jacobian.T + FORCE_DAMPING_M2 * np.eye(3), jacobian @ torque)


def sense(env, sensors: HandSensors, effort: np.ndarray, at_rest: bool = False) -> None:
    q, dq = (env.reader.arm_joints(x) for x in (env.state.joint_pos, env.state.joint_vel))
    sensors.sense(env.state, q, 0.0 * dq if at_rest else dq, torch.zeros(2, 2, 3), torch.from_numpy(effort).float())


def test_motors_that_hold_an_arm_and_overcome_friction_feel_nothing_else(leaning):
    """At steady rates motors give gravity and friction, less what the load does: the load is what is found."""
    env, sensors = leaning
    arms = [arms_of(env, i) for i in range(2)]
    load_w = np.array([[8.0, -5.0, -12.0], [0.0, 0.0, 0.0]])  # on the left hand
    effort = np.array([
        a["gravity"] + a["friction"] - np.einsum("aij,ai->aj", a["jacobian"], load_w) for a in arms
    ])  # fmt: skip
    for _ in range(200):
        sense(env, sensors, effort)
    for i, a in enumerate(arms):
        for hand in range(2):
            expected_w = explained(a["jacobian"][hand], a["jacobian"][hand].T @ load_w[hand])
            np.testing.assert_allclose(sensors.estimated[i, hand], a["heading"].T @ expected_w, atol=2e-2)
    of_friction = max(np.abs(explained(a["jacobian"][0], a["friction"][0])).max() for a in arms)
    assert of_friction > 1.0 or env.spec.name == "g1"  # whose joints have none


def test_what_speeds_an_arm_up_is_felt_as_its_inertia_times_that(leaning):
    """From rest to the present rates within a step, by motors that give no more than gravity and friction."""
    env, sensors = leaning
    arms = [arms_of(env, i) for i in range(2)]
    sense(env, sensors, np.array([a["gravity"] for a in arms]), at_rest=True)
    np.testing.assert_allclose(sensors.estimated, 0.0, atol=2e-2)
    sense(env, sensors, np.array([a["gravity"] + a["friction"] for a in arms]))
    for i, a in enumerate(arms):
        for hand in range(2):
            torque = SHARE * a["inertia"][hand] @ a["rates"][hand] / 0.02
            expected = a["heading"].T @ explained(a["jacobian"][hand], torque)
            np.testing.assert_allclose(sensors.estimated[i, hand], expected, atol=0.02, rtol=2e-3)
            assert np.abs(expected).max() > 5.0


def test_envs_that_begin_anew_have_felt_nothing(leaning):
    env, sensors = leaning
    for _ in range(3):
        sense(env, sensors, np.ones((2, *env.upper_body.arms.kp.shape)))
    kept = sensors.estimated[0].clone()
    sensors.reset(torch.tensor([False, True]))
    assert torch.equal(sensors.estimated[0], kept)
    assert kept.abs().max() > 1.0
    for name in sensors.STATE:
        assert not getattr(sensors, name)[1].any(), name
