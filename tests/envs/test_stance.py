"""Standing: the pose against MuJoCo's kinematics and statics, the feedback against a fall."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from cotap.envs import H1Env, H1EnvConfig
from cotap.envs.h1_env import ActionConfig
from cotap.envs.stance import StanceBalance
from cotap.robots.mjcf import build_model

UPRIGHT = torch.tensor([[0.0, 0.0, -1.0]])


@pytest.fixture(scope="module")
def model(spec):
    return build_model(spec, "feet", 0.01)


@pytest.fixture(scope="module")
def balance(spec, model):
    return StanceBalance(spec, model)


def without_feedback(spec, model) -> StanceBalance:
    first, second = (dataclasses.replace(g, gain=((0.0,) * 8,) * 3, bias=(0.0,) * 3) for g in spec.stance.gains)
    stance = dataclasses.replace(spec.stance, gains=(first, second))
    return StanceBalance(dataclasses.replace(spec, stance=stance), model)


def targets(balance: StanceBalance, height: float, joints: torch.Tensor, gravity: torch.Tensor = UPRIGHT):
    still = torch.zeros(1, joints.shape[1])
    return balance(torch.tensor([height]), joints, still, gravity, torch.zeros(1, 3))[0]


@pytest.mark.parametrize("offset", [0.0, -0.1, -0.2, -0.29])
def test_poses_are_upright_flat_footed_and_over_the_soles(spec, model, offset):
    balance = without_feedback(spec, model)
    place = -offset / 0.02
    row = int(place)
    pose = torch.lerp(balance._poses[row], balance._poses[row + 1], place - row).numpy()
    data = mujoco.MjData(model)
    data.qpos[:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *(j.default_rad for j in spec.joints)]
    for leg in balance.joints.tolist():
        data.qpos[[7 + i for i in leg]] = pose
    mujoco.mj_forward(model, data)
    for foot in spec.feet:
        body = model.body(foot.body).id
        rotation = data.xmat[body].reshape(3, 3)
        sole = data.xpos[body] + rotation @ foot.sole
        assert rotation[2, 2] > 0.9999
        torso = data.xpos[model.body(spec.torso_body).id]
        assert torso[2] - sole[2] == pytest.approx(spec.nominal_height_m + offset, abs=2e-3)
        assert data.subtree_com[0, 0] == pytest.approx(sole[0], abs=2e-3)


def test_pd_control_carries_the_weight(spec, model):
    """Feet held by welds at the soles, the base free: at the targets, legs neither sink nor sway."""
    balance = without_feedback(spec, model)
    for height, row in ((spec.nominal_height_m, 0), (spec.nominal_height_m - 0.2, 10)):
        joints = torch.tensor([[j.default_rad for j in spec.joints]])
        joints[:, balance.joints] = balance._poses[row]
        target = joints.clone()
        target[:, balance.joints] = targets(balance, height, joints)
        data = mujoco.MjData(model)
        data.qpos[:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *joints[0].tolist()]
        mujoco.mj_forward(model, data)
        kp = np.array([j.kp for j in spec.joints])
        torque = kp * (target - joints)[0].numpy()
        # Virtual work: any motion of base and legs that leaves both soles where they are does no work.
        rows = []
        for foot in spec.feet:
            body = model.body(foot.body).id
            linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            sole = data.xpos[body] + data.xmat[body].reshape(3, 3) @ foot.sole
            mujoco.mj_jac(model, data, linear, angular, sole, body)
            rows += [linear, angular]
        legs = [0, 2, 4, *(6 + i for i in balance.joints.flatten().tolist())]  # x, z, pitch and the pitch joints
        jacobian = np.concatenate(rows)[:, legs]
        _, sizes, basis = np.linalg.svd(jacobian)
        free = basis[(sizes > 1e-8 * sizes[0]).sum() :]
        assert len(free) >= 1
        force = (np.concatenate((np.zeros(6), torque)) - data.qfrc_bias)[legs]
        assert np.abs(free @ force).max() < 0.01 * np.abs(data.qfrc_bias[2])


def test_leaning_forward_presses_the_toes_down(spec, balance):
    joints = torch.tensor([[j.default_rad for j in spec.joints]])
    lean = torch.tensor([[0.05, 0.0, -1.0]])
    toes = targets(balance, spec.nominal_height_m, joints, lean) - targets(balance, spec.nominal_height_m, joints)
    assert float(toes[2]) > 0.05


def test_corrections_are_bounded_and_heights_beyond_the_table_are_its_ends(spec, balance):
    joints = torch.tensor([[j.default_rad for j in spec.joints]])
    far = torch.tensor([[0.7, 0.0, -0.7]])
    quiet = without_feedback(spec, build_model(spec, "feet", 0.01))
    moved = targets(balance, spec.nominal_height_m, joints, far) - targets(quiet, spec.nominal_height_m, joints)
    assert float(moved.abs().max()) <= 1.0 + 1e-5
    lowest = targets(quiet, spec.nominal_height_m - 0.3, joints)
    torch.testing.assert_close(targets(quiet, 0.2, joints), lowest, atol=1e-3, rtol=0)
    torch.testing.assert_close(targets(quiet, 2.0, joints), targets(quiet, spec.nominal_height_m, joints))


def test_feedback_is_linear_between_the_tuned_heights(spec, model):
    """By hand: ankle target 1 + 2 x tilt at nominal height, 3 + 6 x tilt at 0.2 m below; half way 2 + 4 x tilt."""
    gains = tuple(
        dataclasses.replace(g, gain=((0.0,) * 8, (0.0,) * 8, (2.0 * k,) + (0.0,) * 7), bias=(0.0, 0.0, 0.1 * k))
        for g, k in zip(spec.stance.gains, (1.0, 3.0), strict=True)
    )
    stance = dataclasses.replace(spec.stance, gains=gains)
    balance = StanceBalance(dataclasses.replace(spec, stance=stance), model)
    quiet = without_feedback(spec, model)
    joints = torch.zeros(1, 19)
    tilted = torch.tensor([[0.05, 0.0, -1.0]])
    for drop, expected in ((0.0, 0.2), (0.1, 0.4), (0.2, 0.6), (0.3, 0.6), (-0.1, 0.2)):
        height = spec.nominal_height_m - drop
        moved = targets(balance, height, joints, tilted) - targets(quiet, height, joints)
        assert moved.tolist() == pytest.approx([0.0, 0.0, expected], abs=1e-5)


def falls(share: float, seconds: float = 4.0) -> int:
    """Of 64 worlds told to stand with a policy that does nothing, how many fall."""
    cfg = H1EnvConfig(num_envs=64, num_threads=1, actions=ActionConfig(stance_balance=share))
    cfg.hand_forces.enabled = False
    cfg.commands.stand_probability = 1.0
    cfg.commands.resample_s = (1e3, 1e3)
    cfg.commands.height_offset = (0.0, 0.0)
    env = H1Env(cfg)
    fell = torch.zeros(64, dtype=torch.bool)
    for _ in range(round(seconds / env.dt)):
        fell |= env.step(torch.zeros(64, 19))[3]["falls"]
    return int(fell.sum())


def test_a_policy_that_does_nothing_stands():
    assert falls(1.0) <= 8
    assert falls(0.0) == 64


def test_walking_is_left_alone(make_env):
    targets_of = []
    for share in (0.0, 1.0):
        env = make_env(3, actions=ActionConfig(stance_balance=share))
        env.commands.override(torch.ones(3, 2), torch.zeros(3), torch.zeros(3), torch.full((3,), 1.0))
        env.reset()
        targets_of.append(env.target_from_action(torch.zeros(3, 19)))
    assert torch.equal(*targets_of)
