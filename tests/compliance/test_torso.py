"""The torso on its legs as springs, against a hinge worked by hand and MuJoCo's kinematics."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from cotap.compliance.torso import chain_compliance, hand_base_compliance, parallel, torso_compliance
from cotap.envs.upper_body import TorsoComplianceConfig, _TorsoModel

DOUBLE = torch.float64


def test_one_hinge_by_hand():
    """An ankle of 40 Nm/rad 0.9 m below: a push of 1 N moves the body by 0.9^2 / 40 m and turns it by 0.9 / 40 rad."""
    c = chain_compliance(
        torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([[0.0, 0.0, -0.9]]), torch.tensor([40.0]), torch.zeros(3)
    )
    assert float(c[0, 0]) == pytest.approx(0.81 / 40.0)
    assert float(c[4, 0]) == pytest.approx(0.9 / 40.0)
    assert float(c[4, 4]) == pytest.approx(1.0 / 40.0)
    others = [1, 2, 3, 5]
    assert not c[others].any()


def test_parallel_springs():
    a, b = torch.diag(torch.tensor([2.0, 4.0], dtype=DOUBLE)), torch.diag(torch.tensor([2.0, 0.0], dtype=DOUBLE))
    torch.testing.assert_close(parallel(a, b), torch.diag(torch.tensor([1.0, 0.0], dtype=DOUBLE)), atol=1e-9, rtol=0)


def test_parallel_of_regular_springs_adds_their_stiffness(rng):
    a, b = (torch.randn(20, 6, 6, dtype=DOUBLE, generator=rng) for _ in range(2))
    a, b = (m @ m.transpose(1, 2) + 0.1 * torch.eye(6, dtype=DOUBLE) for m in (a, b))
    expected = torch.linalg.inv(torch.linalg.inv(a) + torch.linalg.inv(b))
    torch.testing.assert_close(parallel(a, b), expected, rtol=1e-6, atol=1e-9)


def test_support_decides(rng):
    legs = torch.randn(4, 2, 6, 6, dtype=DOUBLE, generator=rng)
    legs = legs @ legs.transpose(-1, -2) + 0.1 * torch.eye(6, dtype=DOUBLE)
    waist = 0.01 * torch.eye(6, dtype=DOUBLE).expand(4, 6, 6)
    contact = torch.tensor([[True, True], [True, False], [False, True], [False, False]])
    c = torso_compliance(legs, waist, contact)
    torch.testing.assert_close(c[0], parallel(legs[0, 0], legs[0, 1]) + waist[0])
    torch.testing.assert_close(c[1], legs[1, 0] + waist[1])
    torch.testing.assert_close(c[2], legs[2, 1] + waist[2])
    assert not c[3].any()  # in flight nothing holds the torso against the ground
    # Two legs are stiffer than either, in every direction.
    for one in (0, 1):
        assert float(torch.linalg.eigvalsh(legs[0, one] + waist[0] - c[0]).min()) > -1e-9


def test_hands_move_with_a_torso_that_turns():
    """A torso that yields 0.01 rad/Nm about z: a hand 0.5 m ahead, pushed sideways, moves 0.5^2 * 0.01 m/N."""
    torso = torch.zeros(1, 6, 6)
    torso[0, 5, 5] = 0.01
    c = hand_base_compliance(torso, torch.tensor([[[0.5, 0.0, 0.2], [0.0, -0.3, 0.0]]]))
    torch.testing.assert_close(c[0, 0], torch.diag(torch.tensor([0.0, 0.0025, 0.0])))
    torch.testing.assert_close(c[0, 1], torch.diag(torch.tensor([0.0009, 0.0, 0.0])))


def test_hands_move_as_the_body_that_a_force_on_them_turns(rng):
    """A force f at r is a wrench (f, r x f) on the torso; what moves there by v and turns by w moves by v + w x r."""
    torso = torch.randn(5, 6, 6, dtype=DOUBLE, generator=rng)
    torso = torso @ torso.transpose(1, 2)
    lever, force = torch.randn(2, 5, 2, 3, dtype=DOUBLE, generator=rng)
    wrench = torch.cat((force, torch.linalg.cross(lever, force)), -1)
    v, w = (torso.unsqueeze(1) @ wrench.unsqueeze(-1)).squeeze(-1).split(3, -1)
    moved = (hand_base_compliance(torso, lever) @ force.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(moved, v + torch.linalg.cross(w, lever))


@pytest.mark.parametrize("foot", [0, 1])
def test_support_model_against_finite_differences_in_mujoco(make_env, robot, foot):
    """On one foot: every joint of leg and waist is a spring, and turns the torso against the sole as MuJoCo has it."""
    env = make_env(1, robot=robot)
    spec, model, s = env.spec, env.sim.model, replace(env.state, foot_force=1e3 * torch.eye(2)[[foot]])
    sole, torso = spec.feet[foot], model.body(spec.torso_body).id
    leg = [body.joint for body in spec.chain(sole.body, spec.base_body)]
    heading = s.heading_w[0].double().numpy()

    def pose(name: str, angle: float) -> tuple[np.ndarray, np.ndarray]:
        """The torso's origin and rotation, as the sole sees them, carried to where the sole was."""
        data = mujoco.MjData(model)
        data.qpos[:] = env.sim.qpos[0].numpy()
        data.qpos[model.joint(name).qposadr[0]] += angle
        mujoco.mj_kinematics(model, data)
        ground = data.body(sole.body)
        turn = ground.xmat.reshape(3, 3)
        return turn.T @ (data.xpos[torso] - ground.xpos), turn.T @ data.xmat[torso].reshape(3, 3)

    data = mujoco.MjData(model)
    data.qpos[:] = env.sim.qpos[0].numpy()
    mujoco.mj_kinematics(model, data)
    to_heading = heading.T @ data.body(sole.body).xmat.reshape(3, 3)
    expected = np.zeros((6, 6))
    gains = {joint.name: joint.kp for joint in spec.joints}
    for name in (*leg, *spec.waist_joints):
        (p0, r0), (p1, r1) = pose(name, -1e-5), pose(name, 1e-5)
        turned = (r1 - r0) @ r0.T / 2e-5
        rate = np.array([turned[2, 1], turned[0, 2], turned[1, 0]])
        twist = np.concatenate((to_heading @ (p1 - p0) / 2e-5, to_heading @ rate))
        expected += np.outer(twist, twist) / gains[name]
    found = _TorsoModel(TorsoComplianceConfig(model="support"), spec)._support(s)[0].numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())
