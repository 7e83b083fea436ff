"""G1 against numbers typed from its published parameters."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from cotap.robots import ROBOTS, g1
from cotap.robots.kinematics import default_angles
from cotap.robots.mjcf import build_model

LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
LOWER = (*(f"{side}_{part}_joint" for side in ("left", "right") for part in LEG),
         "waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint")  # fmt: skip
UPPER = tuple(f"{side}_{part}_joint" for side in ("left", "right") for part in ARM)


@pytest.fixture(scope="module")
def spec():
    return g1()


@pytest.fixture(scope="module")
def model(spec):
    return build_model(spec)


def standing(spec, model, lift=0.0) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, spec.base_height_m + lift, 1, 0, 0, 0]
    data.qpos[7:] = default_angles(spec)
    mujoco.mj_forward(model, data)
    return data


def test_is_registered(spec):
    assert ROBOTS["g1"]() is spec


def test_the_page_says_how_many_lines_it_takes():
    root = Path(__file__).parents[2]
    lines = [
        (root / "src/cotap/robots" / name).read_text(encoding="utf-8").count("\n")
        for name in ("facts/g1.json", "g1.py")
    ]
    page = (root / "docs/robots.md").read_text(encoding="utf-8")
    assert "`robots/facts/` (G1: {} lines), a file like `robots/g1.py` ({})".format(*lines) in page


def test_joints_and_whose_they_are(spec, model):
    assert (spec.lower_joints, spec.upper_joints) == (LOWER, UPPER)
    assert tuple(model.joint(i + 1).name for i in range(29)) == LOWER + UPPER


def test_total_mass(model):
    assert model.body_mass.sum() == pytest.approx(33.341142, abs=1e-9)


@pytest.mark.parametrize(
    ("body", "mass", "inertia"),
    [
        ("pelvis", 3.813, (0.010549, 0.0093089, 0.0079184)),
        ("left_hip_pitch_link", 1.35, (0.00181517, 0.00153422, 0.00116212)),
        ("right_hip_yaw_link", 1.702, (0.00776166, 0.00717575, 0.00160139)),
        ("left_knee_link", 1.932, (0.0113804, 0.0112778, 0.00146458)),
        ("right_knee_link", 1.932, (0.011374, 0.0112843, 0.00146452)),
        ("left_ankle_pitch_link", 0.074, (1.89e-05, 1.40805e-05, 6.9195e-06)),
        ("right_ankle_roll_link", 0.608, (0.00167218, 0.0016161, 0.000217621)),
        ("waist_roll_link", 0.086, (8.245e-06, 7.079e-06, 6.339e-06)),
        ("torso_link", 7.818, (0.121847, 0.109825, 0.0273735)),
        ("left_shoulder_roll_link", 0.643, (0.000691311, 0.000618011, 0.000388977)),
        ("right_elbow_link", 0.6, (0.000443035, 0.000421612, 0.000259353)),
        ("left_wrist_yaw_link", 0.254576, (0.000646113, 0.000559993, 0.000147566)),
    ],
)
def test_masses_and_inertias(model, body, mass, inertia):
    assert model.body(body).mass[0] == pytest.approx(mass, rel=1e-12)
    np.testing.assert_allclose(model.body(body).inertia, inertia, rtol=1e-6)


@pytest.mark.parametrize(
    ("joint", "low", "high", "torque", "velocity", "armature"),
    [
        ("left_hip_pitch", -2.5307, 2.8798, 88, 32, 0.01017752),
        ("left_hip_roll", -0.5236, 2.9671, 139, 20, 0.025101925),
        ("right_hip_roll", -2.9671, 0.5236, 139, 20, 0.025101925),
        ("right_knee", -0.087267, 2.8798, 139, 20, 0.025101925),
        ("left_ankle_pitch", -0.87267, 0.5236, 50, 37, 0.00721945),
        ("right_ankle_roll", -0.2618, 0.2618, 50, 37, 0.00721945),
        ("waist_yaw", -2.618, 2.618, 88, 32, 0.01017752),
        ("waist_pitch", -0.52, 0.52, 50, 37, 0.00721945),
        ("right_shoulder_roll", -2.2515, 1.5882, 25, 37, 0.003609725),
        ("left_elbow", -1.0472, 2.0944, 25, 37, 0.003609725),
        ("left_wrist_roll", -1.97222, 1.97222, 25, 37, 0.003609725),
        ("right_wrist_yaw", -1.61443, 1.61443, 5, 22, 0.00425),
    ],
)
def test_limits_and_rotors(spec, model, joint, low, high, torque, velocity, armature):
    name = f"{joint}_joint"
    assert spec.joint(name).velocity_limit_rad_s == velocity
    assert tuple(model.joint(name).range) == (low, high)
    assert tuple(model.actuator(name).forcerange) == (-torque, torque)
    assert model.joint(name).armature[0] == pytest.approx(armature, rel=1e-6)


def test_mirror_images(spec):
    """Joints about y keep their sign, those about x and z lose it."""
    for joint in spec.joints:
        side, _, part = joint.name.partition("_")
        other = {"left": f"right_{part}", "right": f"left_{part}"}.get(side, joint.name)
        turns = "roll" in joint.name or "yaw" in joint.name
        assert (joint.mirror_name, joint.mirror_sign) == (other, -1.0 if turns else 1.0)


def test_hands_are_the_palms(spec, model):
    data = standing(spec, model)
    for side in ("left", "right"):
        wrist = data.body(f"{side}_wrist_yaw_link")
        palm = wrist.xmat.reshape(3, 3).T @ (data.site(f"{side}_hand").xpos - wrist.xpos)
        np.testing.assert_allclose(palm, [0.08, 0.0, 0.0], atol=1e-9)


def test_default_pose_has_its_mass_over_its_soles(spec, model):
    data = standing(spec, model)
    soles = [data.site(f"{side}_foot").xpos for side in ("left", "right")]
    np.testing.assert_allclose(data.subtree_com[0][:2], np.mean(soles, 0)[:2], atol=1e-3)
    assert spec.nominal_height_m == pytest.approx(0.8287, abs=1e-4)
    assert spec.nominal_height_m - spec.base_height_m == pytest.approx(0.044, abs=1e-9)


def test_default_pose_stands_on_its_weight(spec, model):
    data, load = standing(spec, model), []
    for step in range(50):
        data.ctrl[:] = [j.kp * j.default_rad for j in spec.joints]
        mujoco.mj_step(model, data)
        if step >= 25:
            load.append(sum(data.sensor(f"{side}_foot_touch").data[0] for side in ("left", "right")))
    assert data.body("torso_link").xpos[2] == pytest.approx(0.8287, abs=0.02)
    assert data.body("torso_link").xmat[8] > 0.99
    assert np.mean(load) == pytest.approx(33.341142 * 9.81, rel=0.1)


def test_nothing_touches_in_the_default_pose_but_legs_that_cross_do(spec):
    full = build_model(spec, "full")
    data = standing(spec, full, lift=1.0)
    assert data.ncon == 0
    for joint, angle in (("left_hip_roll_joint", -0.5), ("right_hip_roll_joint", 0.5)):
        data.joint(joint).qpos[0] = angle
    mujoco.mj_forward(full, data)
    assert data.ncon > 0
