"""URDF against MuJoCo, which reads both: the same links, inertias, hinges and kinematics."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from cotap.robots.mjcf import build_model
from cotap.robots.spec import GeomSpec
from cotap.robots.urdf import urdf


@pytest.fixture(scope="module")
def read(any_spec):
    mj = mujoco.MjSpec.from_string(urdf(any_spec))
    mj.compiler.fusestatic = False
    mj.compiler.balanceinertia = True
    return mj.compile()


def test_links_and_hinges_are_the_models(read, any_model, any_spec):
    for name in any_spec.joint_names:
        np.testing.assert_allclose(read.joint(name).range, any_model.joint(name).range)
        np.testing.assert_allclose(read.joint(name).damping, any_model.joint(name).damping)
        most = any_spec.joint(name).torque_limit_nm
        np.testing.assert_allclose(read.jnt_actfrcrange[read.joint(name).id], [-most, most])
    bodies = any_spec.bodies[1:]
    ours, theirs = (sum(m.body_mass[m.body(b.name).id] for b in bodies) for m in (any_model, read))
    assert theirs == pytest.approx(ours)


def test_poses_agree_at_random_joint_angles(read, any_model, any_spec):
    rng = np.random.default_rng(0)
    a, b = mujoco.MjData(any_model), mujoco.MjData(read)
    a.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    angles = rng.uniform(-1.0, 1.0, len(any_spec.joints))
    for name, q in zip(any_spec.joint_names, angles, strict=True):
        a.joint(name).qpos[0] = b.joint(name).qpos[0] = q
    mujoco.mj_kinematics(any_model, a)
    mujoco.mj_kinematics(read, b)
    for body in any_spec.bodies[1:]:
        np.testing.assert_allclose(b.body(body.name).xpos, a.body(body.name).xpos, atol=1e-6)
        np.testing.assert_allclose(b.body(body.name).xmat, a.body(body.name).xmat, atol=1e-6)
        np.testing.assert_allclose(b.body(body.name).xipos, a.body(body.name).xipos, atol=1e-6)
        frames = [d.body(body.name).ximat.reshape(3, 3) for d in (a, b)]
        moments = [m.body(body.name).inertia for m in (any_model, read)]
        tensors = [f @ np.diag(i) @ f.T for f, i in zip(frames, moments, strict=True)]
        np.testing.assert_allclose(tensors[1], tensors[0], atol=2e-5)


def test_a_second_in_the_air_is_the_models(any_spec):
    """Limbs in motion, motors off, nothing touching; rotors, which URDF lacks, given back."""
    mj = mujoco.MjSpec.from_string(urdf(any_spec))
    mj.compiler.fusestatic = False
    mj.compiler.balanceinertia = True
    mj.option.timestep, mj.option.integrator = 0.002, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    mj.body(any_spec.base_body).add_freejoint()
    rng = np.random.default_rng(0)
    low, high = np.array([j.range_rad for j in any_spec.joints]).T
    angles = 0.5 * (low + high) + 0.1 * (high - low) * rng.uniform(-1.0, 1.0, len(low))
    attitude, rates = rng.normal(size=4), 0.5 * rng.normal(size=len(low))
    ends = []
    for model in (build_model(any_spec, timestep_s=0.002), mj.compile()):
        model.geom_contype[:] = model.geom_conaffinity[:] = 0
        model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
        for joint in any_spec.joints:
            model.dof_armature[model.joint(joint.name).dofadr[0]] = joint.armature_kg_m2
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        data.qpos[2], data.qpos[3:7] = 3.0, attitude / np.linalg.norm(attitude)
        for name, angle, rate in zip(any_spec.joint_names, angles, rates, strict=True):
            data.joint(name).qpos[0], data.joint(name).qvel[0] = angle, rate
        for _ in range(500):
            mujoco.mj_step(model, data)
        ends.append((*data.qpos[:7], *(data.joint(name).qpos[0] for name in any_spec.joint_names)))
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-6)
    assert np.abs(np.array(ends[0])[7:] - angles).max() > 0.2


def test_a_shape_that_urdf_lacks_is_named(spec):
    odd = dataclasses.replace(spec.bodies[-1], collision=(GeomSpec("ellipsoid", (0.1, 0.2, 0.3)),))
    with pytest.raises(ValueError, match=r"right_elbow_link.*'ellipsoid'"):
        urdf(dataclasses.replace(spec, bodies=(*spec.bodies[:-1], odd)))
