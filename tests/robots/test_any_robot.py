"""What holds for every robot: its description against the MuJoCo model made of it, and against the laws of mirrors."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from robots.made_up import made_up

from cotap.compliance.dynamics import gravity_torque, joint_inertia
from cotap.robots.chains import arm_chains, arm_model
from cotap.robots.kinematics import body_frame, default_angles
from cotap.robots.mjcf import FIXED_BASE_LIFT_M, build_model, torso_inertia

SWAP = {"left": "right", "right": "left"}


def posed(model, angles, height=0.0, quat=(1.0, 0.0, 0.0, 0.0)) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:7] = (0.0, 0.0, height), quat
    data.qpos[7:] = angles
    mujoco.mj_forward(model, data)
    return data


def random_angles(spec, seed=0) -> np.ndarray:
    low, high = np.array([j.range_rad for j in spec.joints]).T
    return np.random.default_rng(seed).uniform(low, high)


def tumbling(model, spec, seed) -> mujoco.MjData:
    quat = np.random.default_rng(seed).normal(size=4)
    return posed(model, random_angles(spec, seed), 1.0, quat / np.linalg.norm(quat))


def in_frame(data, body, point_w) -> np.ndarray:
    return data.body(body).xmat.reshape(3, 3).T @ (point_w - data.body(body).xpos)


def arm_angles(spec, angles) -> torch.Tensor:
    return torch.tensor(angles[spec.indices(spec.upper_joints)]).reshape(1, len(spec.arms), -1)


def with_defaults(spec, **angles):
    joints = tuple(dataclasses.replace(j, default_rad=angles.get(j.name, j.default_rad)) for j in spec.joints)
    return dataclasses.replace(spec, joints=joints)


def test_order_is_mujocos(any_spec, any_model):
    count = len(any_spec.joints)
    assert any_model.nq == 7 + count
    assert tuple(any_model.joint(i + 1).name for i in range(count)) == any_spec.joint_names
    assert [any_model.joint(n).qposadr[0] for n in any_spec.joint_names] == list(range(7, 7 + count))
    assert tuple(any_model.actuator(i).name for i in range(count)) == any_spec.joint_names


def test_mass_is_the_models(any_spec, any_model):
    assert any_spec.mass_kg == pytest.approx(any_model.body_mass.sum(), abs=1e-9)
    assert any_spec.mass_kg == pytest.approx({"h1": 51.437, "g1": 33.341142, "made-up": 34.6}[any_spec.name], abs=1e-9)


def test_what_joints_have_of_their_own_reaches_the_model(any_spec, any_model):
    for joint in any_spec.joints:
        hinge, motor = any_model.joint(joint.name), any_model.actuator(joint.name)
        assert hinge.armature[0] == joint.armature_kg_m2
        assert hinge.damping[0] == joint.damping_nms_rad
        np.testing.assert_array_equal(motor.biasprm[:3], [0.0, -joint.kp, -joint.kd])
        np.testing.assert_array_equal(motor.forcerange, [-joint.torque_limit_nm, joint.torque_limit_nm])
    own = len({j.armature_kg_m2 for j in any_spec.joints})
    assert own == {"h1": 1, "g1": 5, "made-up": 15}[any_spec.name]


def test_body_frames_are_mujocos(any_spec, any_model):
    for seed in range(5):
        data = tumbling(any_model, any_spec, seed)
        base = data.body(any_spec.base_body)
        for body in any_spec.bodies:
            position, rotation = body_frame(any_spec, body.name, any_spec.base_body, data.qpos[7:])
            np.testing.assert_allclose(position, in_frame(data, base.name, data.body(body.name).xpos), atol=1e-7)
            expected = base.xmat.reshape(3, 3).T @ data.body(body.name).xmat.reshape(3, 3)
            np.testing.assert_allclose(rotation, expected, atol=1e-7)


def test_soles_and_hands_are_mujocos_sites(any_spec, any_model):
    data = tumbling(any_model, any_spec, 0)
    ends = [(f"{f.side}_foot", f.body, f.sole) for f in any_spec.feet]
    ends += [(f"{a.side}_hand", a.hand_body, a.hand_point) for a in any_spec.arms]
    for site, body, point in ends:
        position, rotation = body_frame(any_spec, body, any_spec.base_body, data.qpos[7:])
        seen = in_frame(data, any_spec.base_body, data.site(site).xpos)
        np.testing.assert_allclose(position + rotation @ point, seen, atol=1e-7)


def test_default_pose_has_its_soles_on_the_floor_and_the_torso_at_its_height(any_spec, any_model):
    data = posed(any_model, default_angles(any_spec), any_spec.base_height_m)
    assert data.body(any_spec.torso_body).xpos[2] == pytest.approx(any_spec.nominal_height_m, abs=1e-9)
    soles = [data.site(f"{foot.side}_foot") for foot in any_spec.feet]
    for sole in soles:
        assert abs(sole.xpos[2]) < 1e-3
        np.testing.assert_allclose(sole.xmat.reshape(3, 3)[:, 2], [0, 0, 1], atol=1e-6)
    assert any_spec.sole_distance_m == pytest.approx(soles[0].xpos[1] - soles[1].xpos[1], abs=1e-9)
    assert soles[0].xpos[1] > 0.05
    torso = data.body(any_spec.torso_body)
    assert any_spec.torso_ahead_m == pytest.approx(torso.xpos[0] - (soles[0].xpos[0] + soles[1].xpos[0]) / 2, abs=1e-9)


def test_a_bent_waist_counts_in_the_base_height():
    roll_pitches = {"waist_roll": {"axis": (0.0, 1.0, 0.0), "mirror_sign": 1.0, "default_rad": 0.5}}
    joints = tuple(dataclasses.replace(j, **roll_pitches.get(j.name, {})) for j in made_up().joints)
    spec = dataclasses.replace(made_up(), joints=joints)
    data = posed(build_model(spec), default_angles(spec), spec.base_height_m)
    assert data.body(spec.torso_body).xpos[2] == pytest.approx(spec.nominal_height_m, abs=1e-9)
    assert abs(spec.base_height_m - made_up().base_height_m) > 1e-3


def test_soles_of_spread_legs_are_as_far_apart_as_mujocos():
    spec = with_defaults(made_up(), left_hip_roll=0.4, right_hip_roll=-0.4)
    data = posed(build_model(spec), default_angles(spec))
    distance = data.site("left_foot").xpos[1] - data.site("right_foot").xpos[1]
    assert spec.sole_distance_m == pytest.approx(distance, abs=1e-9)


def test_base_and_torso_are_one_where_the_waist_does_not_lift_it(spec):
    assert spec.base_height_m == spec.nominal_height_m
    assert made_up().nominal_height_m - made_up().base_height_m > 0.05


def test_arms_are_mujocos(any_spec, any_model):
    """Hands, their Jacobians and the arms' inertia, rotors included, in the torso's frame."""
    arms = arm_model(any_spec, torch.float64)
    columns = np.eye(any_model.nv)
    for seed in range(5):
        data = tumbling(any_model, any_spec, seed)
        pose = arms.chains.pose(arm_angles(any_spec, data.qpos[7:]))
        jacobian, inertia = arms.chains.jacobian(pose), joint_inertia(arms.inertias, pose)
        full = np.zeros((any_model.nv, any_model.nv))
        for row, column in zip(full, columns, strict=True):
            mujoco.mj_mulM(any_model, data, row, column)
        torso = data.body(any_spec.torso_body).xmat.reshape(3, 3)
        for i, arm in enumerate(any_spec.arms):
            hand = data.site(f"{arm.side}_hand").xpos
            np.testing.assert_allclose(pose.tip[0, i], in_frame(data, any_spec.torso_body, hand), atol=1e-7)
            expected = np.zeros((3, any_model.nv))
            mujoco.mj_jac(any_model, data, expected, None, hand, any_model.body(arm.hand_body).id)
            dofs = [any_model.joint(n).dofadr[0] for n in arm.joints]
            np.testing.assert_allclose(jacobian[0, i], torso.T @ expected[:, dofs], atol=1e-7)
            np.testing.assert_allclose(inertia[0, i], full[np.ix_(dofs, dofs)], atol=1e-7)


def test_hands_feet_and_the_arms_weight_at_a_hundred_poses(any_spec, any_model):
    arms = arm_model(any_spec, torch.float64)
    for seed in range(100):
        data = tumbling(any_model, any_spec, seed)
        torso = data.body(any_spec.torso_body).xmat.reshape(3, 3)
        pose = arms.chains.pose(arm_angles(any_spec, data.qpos[7:]))
        weight = gravity_torque(arms.inertias, pose, torch.from_numpy(torso[2:].copy()))
        for i, arm in enumerate(any_spec.arms):
            hand = in_frame(data, any_spec.torso_body, data.site(f"{arm.side}_hand").xpos)
            np.testing.assert_allclose(pose.tip[0, i], hand, atol=1e-6)
            dofs = [any_model.joint(n).dofadr[0] for n in arm.joints]
            np.testing.assert_allclose(weight[0, i], data.qfrc_bias[dofs], atol=1e-6)
        for foot in any_spec.feet:
            position, rotation = body_frame(any_spec, foot.body, any_spec.base_body, data.qpos[7:])
            sole = in_frame(data, any_spec.base_body, data.site(f"{foot.side}_foot").xpos)
            np.testing.assert_allclose(position + rotation @ foot.sole, sole, atol=1e-6)


def test_arms_keep_their_joints_numbers_in_either_precision(any_spec):
    for dtype in (torch.float32, torch.float64):
        for arms in (arm_model(any_spec, dtype), arm_model(any_spec).to(dtype)):
            for i, arm in enumerate(any_spec.arms):
                own = [any_spec.joint(name) for name in arm.joints]
                expected = {"friction": [j.damping_nms_rad for j in own], "kp": [j.kp for j in own]}
                for name, values in expected.items():
                    torch.testing.assert_close(getattr(arms, name)[i], torch.tensor(values, dtype=dtype))
                rotors = torch.tensor([j.armature_kg_m2 for j in own], dtype=dtype)
                torch.testing.assert_close(arms.inertias.armature[i], rotors)
            pose = arms.chains.pose(torch.zeros_like(arms.kp).unsqueeze(0))
            assert joint_inertia(arms.inertias, pose).dtype == dtype


def test_mirrored_angles_give_the_mirror_image(any_spec, any_model):
    q = random_angles(any_spec)
    mirrored = np.array([j.mirror_sign * q[any_spec.indices([j.mirror_name])[0]] for j in any_spec.joints])
    plain, image = posed(any_model, q), posed(any_model, mirrored)
    flip = np.array([1.0, -1.0, 1.0])
    # The H1's published frames differ between left and right in the seventh digit, the G1's shoulders by 0.01 mm.
    atol = {"h1": 1e-6, "g1": 3e-5, "made-up": 1e-6}[any_spec.name]
    for body in any_spec.bodies:
        side = body.name.split("_")[0]
        other = body.name.replace(side, SWAP.get(side, side), 1)
        seen = image.body(other).xpos
        np.testing.assert_allclose(seen, plain.body(body.name).xpos * flip, atol=atol, err_msg=body.name)
    for site in ("hand", "foot"):
        for side, other in SWAP.items():
            seen = image.site(f"{other}_{site}").xpos
            np.testing.assert_allclose(seen, plain.site(f"{side}_{site}").xpos * flip, atol=atol)


def test_limits_and_the_default_pose_are_their_own_mirror_image(any_spec):
    for joint in any_spec.joints:
        other = any_spec.joint(joint.mirror_name)
        assert other.default_rad == pytest.approx(joint.mirror_sign * joint.default_rad)
        if joint is not other:
            assert other.range_rad == pytest.approx(tuple(sorted(joint.mirror_sign * v for v in joint.range_rad)))


def test_the_torsos_inertia_is_what_a_torque_on_it_meets(any_spec):
    model = build_model(any_spec)
    model.opt.gravity[:] = 0.0
    torso = model.body(any_spec.torso_body).id
    for axis, inertia in enumerate(torso_inertia(any_spec, model)):
        data = posed(model, default_angles(any_spec), any_spec.base_height_m + 1.0)
        data.ctrl[:] = [j.kp * j.default_rad for j in any_spec.joints]
        data.xfrc_applied[torso, 3 + axis] = 1.0
        mujoco.mj_forward(model, data)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, None, jacobian, torso)
        assert (jacobian @ data.qacc)[axis] == pytest.approx(1.0 / inertia, rel=1e-6)


def touching(model, data) -> set[frozenset[str]]:
    names = [model.body(b).name for b in range(model.nbody)]
    return {frozenset(names[model.geom_bodyid[g]] for g in pair) for pair in data.contact.geom}


def test_bodies_that_never_collide():
    spec = made_up()
    angles = default_angles(spec)
    hips = {frozenset(pair) for pair in spec.contact_excludes}
    free = build_model(dataclasses.replace(spec, contact_excludes=()), "full")
    kept = build_model(dataclasses.replace(spec, contact_excludes=spec.contact_excludes[:1]), "full")
    assert touching(free, posed(free, angles, 2.0)) == hips
    assert touching(kept, posed(kept, angles, 2.0)) == {frozenset(spec.contact_excludes[1])}
    full = build_model(spec, "full")
    assert touching(full, posed(full, angles, 2.0)) == set()
    angles[spec.indices(["left_hip_roll", "right_hip_roll"])] = -0.4, 0.4
    knees = frozenset({"left_knee_link", "right_knee_link"})
    assert knees in touching(full, posed(full, angles, 2.0))


@pytest.mark.parametrize("collision", ["feet", "full"])
def test_the_made_up_humanoid_stands_under_pd(collision):
    spec = made_up()
    model = build_model(spec, collision)
    default = default_angles(spec)
    data = posed(model, default, spec.base_height_m)
    data.ctrl[:] = [j.kp * j.default_rad for j in spec.joints]
    for _ in range(300):
        mujoco.mj_step(model, data)
    torso = data.body(spec.torso_body)
    assert torso.xpos[2] == pytest.approx(spec.nominal_height_m, abs=0.01)
    assert torso.xmat[8] > 0.99
    assert abs(data.qpos[7:] - default).max() < 0.08
    load = sum(data.sensor(f"{side}_foot_touch").data[0] for side in SWAP)
    assert load == pytest.approx(spec.mass_kg * 9.81, rel=0.02)


def test_a_held_base_stays_where_it_is_put(any_spec):
    model = build_model(any_spec, fixed_base=True)
    data = posed(model, default_angles(any_spec), any_spec.base_height_m + FIXED_BASE_LIFT_M)
    data.ctrl[:] = [j.kp * j.default_rad for j in any_spec.joints]
    for _ in range(200):
        mujoco.mj_step(model, data)
    expected = [0.0, 0.0, any_spec.base_height_m + FIXED_BASE_LIFT_M]
    np.testing.assert_allclose(data.body(any_spec.base_body).xpos, expected, atol=1e-3)


def test_arms_of_any_length_have_full_rank_in_the_default_pose(any_spec):
    chains = arm_chains(any_spec, torch.float64)
    jacobian = chains.jacobian(chains.pose(arm_angles(any_spec, default_angles(any_spec))))
    assert jacobian.shape[-1] == {"h1": 4, "g1": 7, "made-up": 7}[any_spec.name]
    assert float(torch.linalg.svdvals(jacobian).min()) > 0.02
