"""H1 against numbers typed from its published parameters."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from cotap.robots import ROBOTS
from cotap.robots.mjcf import build_model

JOINTS = (
    "left_hip_yaw", "left_hip_roll", "left_hip_pitch", "left_knee", "left_ankle",
    "right_hip_yaw", "right_hip_roll", "right_hip_pitch", "right_knee", "right_ankle", "torso",
    "left_shoulder_pitch", "left_shoulder_roll", "left_shoulder_yaw", "left_elbow",
    "right_shoulder_pitch", "right_shoulder_roll", "right_shoulder_yaw", "right_elbow",
)  # fmt: skip


def default_qpos(spec, model) -> np.ndarray:
    qpos = model.qpos0.copy()
    qpos[:7] = [0, 0, spec.base_height_m, 1, 0, 0, 0]
    qpos[7:] = [j.default_rad for j in spec.joints]
    return qpos


def test_is_registered(spec):
    assert ROBOTS["h1"]() is spec


def test_joint_order(spec, model):
    assert spec.joint_names == JOINTS
    assert tuple(model.joint(i + 1).name for i in range(19)) == JOINTS
    assert tuple(model.actuator(i).name for i in range(19)) == JOINTS
    assert spec.lower_joints == JOINTS[:11]
    assert spec.upper_joints == JOINTS[11:]


def test_total_mass(model):
    assert model.body_mass.sum() == pytest.approx(51.437, abs=1e-9)


@pytest.mark.parametrize(
    ("body", "mass", "inertia"),
    [
        ("pelvis", 5.39, (0.0490211, 0.0445821, 0.00824619)),
        ("torso_link", 17.789, (0.487315, 0.409628, 0.127837)),
        ("left_hip_pitch_link", 4.152, (0.0829503, 0.0821457, 0.00510909)),
        ("right_knee_link", 1.721, (0.0125237, 0.0123104, 0.0019428)),
        ("right_elbow_link", 0.669, (0.00601829, 0.00600579, 0.0004083)),
    ],
)
def test_masses_and_inertias(model, body, mass, inertia):
    assert model.body(body).mass[0] == pytest.approx(mass, abs=1e-12)
    np.testing.assert_allclose(model.body(body).inertia, inertia, rtol=1e-12)


@pytest.mark.parametrize(
    ("joint", "low", "high", "torque", "velocity"),
    [
        ("left_hip_yaw", -0.43, 0.43, 200, 23),
        ("left_knee", -0.26, 2.05, 300, 14),
        ("right_ankle", -0.87, 0.52, 40, 9),
        ("torso", -2.35, 2.35, 200, 23),
        ("left_shoulder_roll", -0.34, 3.11, 40, 9),
        ("right_shoulder_roll", -3.11, 0.34, 40, 9),
        ("right_shoulder_yaw", -4.45, 1.3, 18, 20),
        ("left_elbow", -1.25, 2.61, 18, 20),
    ],
)
def test_limits(spec, model, joint, low, high, torque, velocity):
    described = spec.joints[spec.indices([joint])[0]]
    assert described.velocity_limit_rad_s == velocity
    assert described.torque_limit_nm == torque
    assert tuple(model.joint(joint).range) == (low, high)
    assert tuple(model.actuator(joint).forcerange) == (-torque, torque)


@pytest.mark.parametrize(
    ("joint", "kp", "kd"),
    [
        ("left_hip_roll", 150, 2),
        ("right_knee", 200, 4),
        ("left_ankle", 40, 2),
        ("torso", 300, 6),
        ("left_elbow", 100, 2),
    ],
)
def test_actuator_is_a_clipped_pd_law(spec, model, joint, kp, kd):
    limit = spec.joints[spec.indices([joint])[0]].torque_limit_nm
    data = mujoco.MjData(model)
    address, dof = model.joint(joint).qposadr[0], model.joint(joint).dofadr[0]
    for target, angle, rate in ((0.1, -0.02, 0.3), (-0.1, 0.05, 2.0), (9.0, 0.0, 0.0), (-9.0, 0.0, 0.0)):
        data.qpos[:] = default_qpos(spec, model)
        data.qpos[address], data.qvel[dof] = angle, rate
        data.ctrl[model.actuator(joint).id] = kp * target
        mujoco.mj_forward(model, data)
        expected = np.clip(kp * (target - angle) - kd * rate, -limit, limit)
        assert data.actuator_force[model.actuator(joint).id] == pytest.approx(expected)
        assert data.qfrc_actuator[dof] == pytest.approx(expected)


def test_passive_joint_parameters(model):
    np.testing.assert_array_equal(model.dof_damping[6:], 1.0)
    np.testing.assert_array_equal(model.dof_armature[6:], 0.1)


def test_default_pose_has_its_soles_on_the_floor(spec, model):
    data = mujoco.MjData(model)
    data.qpos[:] = default_qpos(spec, model)
    mujoco.mj_forward(model, data)
    assert data.body("torso_link").xpos[2] == pytest.approx(1.0205)
    for foot in ("left_foot", "right_foot"):
        assert abs(data.site(foot).xpos[2]) < 2e-3
        np.testing.assert_allclose(data.site(foot).xmat.reshape(3, 3)[:, 2], [0, 0, 1], atol=1e-6)
    assert data.site("left_foot").xpos[1] > 0.1 > -0.1 > data.site("right_foot").xpos[1]


def test_default_pose_stands_on_its_weight(spec, model):
    data = mujoco.MjData(model)
    data.qpos[:] = default_qpos(spec, model)
    load = []
    for step in range(50):
        data.ctrl[:] = [j.kp * j.default_rad for j in spec.joints]
        mujoco.mj_step(model, data)
        if step >= 25:
            load.append(sum(data.sensor(f"{side}_foot_touch").data[0] for side in ("left", "right")))
    assert data.qpos[2] == pytest.approx(1.0205, abs=0.045)  # PD legs sag a little
    assert data.body("torso_link").xmat.reshape(3, 3)[2, 2] > 0.98
    assert np.mean(load) == pytest.approx(51.437 * 9.81, rel=0.1)


def test_hand_point_is_30_cm_along_the_forearm(model):
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for side in ("left", "right"):
        elbow = data.body(f"{side}_elbow_link")
        offset = elbow.xmat.reshape(3, 3).T @ (data.site(f"{side}_hand").xpos - elbow.xpos)
        np.testing.assert_allclose(offset, [0.3, 0, 0], atol=1e-9)
        # The L-shape: the forearm points forward at zero angles.
        assert data.site(f"{side}_hand").xpos[0] - elbow.xpos[0] > 0.25


def contacts(model, qpos) -> set[frozenset[str]]:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    names = [model.body(b).name for b in range(model.nbody)]
    return {frozenset(names[model.geom_bodyid[g]] for g in pair) for pair in data.contact.geom}


def test_collision_settings(spec, model):
    full = build_model(spec, "full")
    assert full.nq == model.nq
    crossed = default_qpos(spec, model)
    crossed[2] += 1.0
    for joint, angle in (("left_hip_roll", -0.43), ("right_hip_roll", 0.43)):
        crossed[model.joint(joint).qposadr[0]] = angle
    assert contacts(model, crossed) == set()
    assert frozenset({"left_knee_link", "right_knee_link"}) in contacts(full, crossed)
    lying = default_qpos(spec, model)
    lying[2:7] = [0.1, np.sqrt(0.5), 0, np.sqrt(0.5), 0]
    assert frozenset({"world", "torso_link"}) in contacts(full, lying)
    assert all(pair <= {"world", "left_ankle_link", "right_ankle_link"} for pair in contacts(model, lying))
    standing = default_qpos(spec, model)
    standing[2] -= 0.005
    feet = {frozenset({"world", "left_ankle_link"}), frozenset({"world", "right_ankle_link"})}
    assert contacts(model, standing) == contacts(full, standing) == feet


def test_the_foots_friction_is_the_contacts(spec):
    slippery = build_model(spec)
    for g in range(slippery.ngeom):
        if slippery.body(slippery.geom_bodyid[g]).name.endswith("ankle_link"):
            slippery.geom_friction[g, 0] = 0.3
    data = mujoco.MjData(slippery)
    data.qpos[:] = default_qpos(spec, slippery)
    data.qpos[2] -= 0.005
    mujoco.mj_forward(slippery, data)
    assert data.ncon >= 4
    np.testing.assert_allclose(data.contact.friction[:, 0], 0.3)


def test_unknown_names_are_refused_with_the_known_ones(spec):
    with pytest.raises(ValueError, match=r"h1 has no joint 'left_wrist'; joints: left_hip_yaw, .*right_elbow"):
        spec.indices(["left_wrist"])
    with pytest.raises(ValueError, match="h1 has no body 'head'; bodies: pelvis"):
        spec.body("head")
    with pytest.raises(ValueError, match="'pelvis' is not below 'torso_link'"):
        spec.chain("pelvis", "torso_link")
    with pytest.raises(ValueError, match="collision 'none' is unknown; known: feet, full"):
        build_model(spec, "none")
