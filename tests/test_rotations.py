"""Rotations against MuJoCo's."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch

from cotap import rotations


@pytest.fixture
def quats(rng) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(50, 4, generator=rng, dtype=torch.float64), dim=-1)


def mujoco_matrix(quat: torch.Tensor) -> torch.Tensor:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quat.double().numpy())
    return torch.from_numpy(out.reshape(3, 3))


def test_matrix_from_quat(quats):
    expected = torch.stack([mujoco_matrix(q) for q in quats])
    torch.testing.assert_close(rotations.matrix_from_quat(quats), expected)


def test_quat_about_z_turns_x_towards_y():
    quarter = rotations.matrix_from_quat(rotations.quat_about_z(torch.tensor([math.pi / 2])))[0]
    torch.testing.assert_close(quarter @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))


def test_rotate_and_its_inverse(quats, rng):
    vector = torch.randn(50, 3, generator=rng, dtype=torch.float64)
    matrix = rotations.matrix_from_quat(quats)
    expected = np.zeros(3)
    for i in range(50):
        mujoco.mju_rotVecQuat(expected, vector[i].numpy(), quats[i].numpy())
        torch.testing.assert_close(rotations.rotate(matrix, vector)[i], torch.from_numpy(expected))
        mujoco.mju_rotVecQuat(expected, vector[i].numpy(), (quats[i] * torch.tensor([1, -1, -1, -1])).numpy())
        torch.testing.assert_close(rotations.rotate_inverse(matrix, vector)[i], torch.from_numpy(expected))


@pytest.mark.parametrize("yaw", [-3.0, -0.4, 0.0, 1.2, 2.8])
def test_heading_keeps_yaw_and_drops_pitch_and_roll(yaw):
    quat = np.zeros(4)
    mujoco.mju_euler2Quat(quat, np.array([yaw, 0.5, -0.7]), "zyx")  # intrinsic: yaw, then pitch, then roll
    heading = rotations.heading_matrix(mujoco_matrix(torch.from_numpy(quat)))
    c, s = math.cos(yaw), math.sin(yaw)
    torch.testing.assert_close(heading, torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64))


def test_quat_from_matrix_inverts_matrix_from_quat(quats):
    back = rotations.quat_from_matrix(rotations.matrix_from_quat(quats))
    torch.testing.assert_close(back, torch.where(quats[:, :1] < 0, -quats, quats))


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8)])
@pytest.mark.parametrize("angle", [0.0, 1e-4, math.pi - 1e-4, math.pi])
def test_quat_from_matrix_is_accurate_at_every_angle(axis, angle):
    half = angle / 2
    quat = torch.tensor([math.cos(half), *(math.sin(half) * a for a in axis)])
    back = rotations.quat_from_matrix(rotations.matrix_from_quat(quat))
    assert abs(float(back @ quat)) == pytest.approx(1.0, abs=1e-6)
    torch.testing.assert_close(rotations.matrix_from_quat(back), rotations.matrix_from_quat(quat), atol=1e-6, rtol=0)
