"""Serial chains against MuJoCo's kinematics and Jacobians."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from cotap.compliance.kinematics import SerialChains
from cotap.robots.chains import chains_between

ATOL = 2e-6  # float32 chains against float64 MuJoCo


@pytest.fixture(scope="module")
def poses(model):
    """Twenty random poses of the whole robot, the pelvis tumbling and the waist turned."""
    rng = np.random.default_rng(1)
    low, high = model.jnt_range[1:].T
    out = []
    for _ in range(20):
        data = mujoco.MjData(model)
        data.qpos[:3] = rng.normal(size=3)
        data.qpos[3:7] = rng.normal(size=4)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        data.qpos[7:] = rng.uniform(low, high)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        out.append(data)
    return out


@pytest.fixture(scope="module")
def arms(spec) -> SerialChains:
    return chains_between(spec, "torso_link", [("left_elbow_link", (0.3, 0, 0)), ("right_elbow_link", (0.3, 0, 0))])


def arm_angles(model, data) -> torch.Tensor:
    names = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
    return torch.tensor(
        [[[data.qpos[model.joint(f"{side}_{n}").qposadr[0]] for n in names] for side in ("left", "right")]],
        dtype=torch.float32,
    )


def in_torso(data, point_w) -> np.ndarray:
    torso = data.body("torso_link")
    return torso.xmat.reshape(3, 3).T @ (point_w - torso.xpos)


def test_positions_and_axes_in_the_torso_frame(model, poses, arms):
    links = ("shoulder_pitch_link", "shoulder_roll_link", "shoulder_yaw_link", "elbow_link")
    for data in poses:
        pose = arms.pose(arm_angles(model, data))
        rotation = data.body("torso_link").xmat.reshape(3, 3)
        for a, side in enumerate(("left", "right")):
            np.testing.assert_allclose(pose.tip[0, a], in_torso(data, data.site(f"{side}_hand").xpos), atol=ATOL)
            last = data.body(f"{side}_elbow_link").xmat.reshape(3, 3)
            np.testing.assert_allclose(pose.rotation[0, a], rotation.T @ last, atol=ATOL)
            for i, link in enumerate(links):
                anchor = in_torso(data, data.body(f"{side}_{link}").xpos)
                np.testing.assert_allclose(pose.anchors[0, a, i], anchor, atol=ATOL)
                joint = model.joint(f"{side}_{link.removesuffix('_link')}")
                np.testing.assert_allclose(pose.axes[0, a, i], rotation.T @ data.xaxis[joint.id], atol=ATOL)


def test_jacobian_is_mujocos(model, poses, arms):
    names = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
    jac = np.zeros((3, model.nv))
    for data in poses:
        jacobian = SerialChains.jacobian(arms.pose(arm_angles(model, data)))
        rotation = data.body("torso_link").xmat.reshape(3, 3)
        for a, side in enumerate(("left", "right")):
            body = model.body(f"{side}_elbow_link").id
            mujoco.mj_jac(model, data, jac, None, data.site(f"{side}_hand").xpos, body)
            columns = [model.joint(f"{side}_{n}").dofadr[0] for n in names]
            np.testing.assert_allclose(jacobian[0, a], rotation.T @ jac[:, columns], atol=ATOL)


def test_waist_carries_the_torso_in_the_base_frame(spec, model, poses):
    waist = chains_between(spec, "pelvis", [("torso_link", (0.1, 0.2, 0.3))])
    for data in poses:
        angle = torch.tensor([[[data.qpos[model.joint("torso").qposadr[0]]]]], dtype=torch.float32)
        pelvis, torso = data.body("pelvis"), data.body("torso_link")
        point = torso.xpos + torso.xmat.reshape(3, 3) @ [0.1, 0.2, 0.3]
        np.testing.assert_allclose(
            waist.pose(angle).tip[0, 0], pelvis.xmat.reshape(3, 3).T @ (point - pelvis.xpos), atol=ATOL
        )


def test_a_batch_is_its_rows(arms, rng):
    q = torch.randn(5, 2, 4, generator=rng)
    together = arms.pose(q)
    for i in range(5):
        alone = arms.pose(q[i : i + 1])
        torch.testing.assert_close(together.tip[i], alone.tip[0])
        torch.testing.assert_close(SerialChains.jacobian(together)[i], SerialChains.jacobian(alone)[0])
