"""Our robots against MuJoCo Menagerie's files, as MuJoCo itself and `from_mjcf` read them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cotap.play.visuals import menagerie_file
from cotap.robots import ROBOTS, RobotSpec
from cotap.robots.from_mjcf import facts_of
from cotap.robots.mjcf import build_model

pytestmark = pytest.mark.slow

POSES = 100
STEP_S = 0.001
INERTIA = {"h1": 3e-6, "g1": 1e-6}
"""How far inertias may differ, of the largest entry: the facts of H1 have seven decimals."""


@pytest.fixture(params=["h1/h1.xml", "g1/g1.xml", "g1/g1_mjx.xml"])
def published(request) -> tuple[RobotSpec, Path]:
    robot, name = request.param.split("/")
    spec = ROBOTS[robot]()
    file = menagerie_file(spec)
    if file is None:
        pytest.skip(
            f"{spec.menagerie} is not in the cache of mujoco-menagerie: install the extra meshes, then "
            f"python -c \"import mujoco_menagerie as m; m.prefetch(['{spec.menagerie}'])\""
        )
    return spec, file.with_name(name)


def models(spec: RobotSpec, file: Path) -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """Theirs and ours, bodies and joints in one order, without contacts, limits, dry friction and actuators; RK4."""
    theirs, ours = mujoco.MjModel.from_xml_path(str(file)), build_model(spec, "feet", STEP_S)
    assert [theirs.joint(1 + i).name for i in range(len(spec.joints))] == list(spec.joint_names)
    assert [theirs.body(i).name for i in range(theirs.nbody)] == [ours.body(i).name for i in range(ours.nbody)]
    for model in (theirs, ours):
        model.opt.disableflags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_ACTUATION
        model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, STEP_S
    return theirs, ours


def random_pose(spec: RobotSpec, rng: np.random.Generator) -> np.ndarray:
    turn = rng.normal(size=4)
    joints = [rng.uniform(*joint.range_rad) for joint in spec.joints]
    return np.r_[rng.uniform(-1.0, 1.0, 3), turn / np.linalg.norm(turn), joints]


def test_masses_and_inertias_are_the_published_ones(published):
    spec, file = published
    theirs = facts_of(file)["bodies"]
    assert [body["name"] for body in theirs] == [body.name for body in spec.bodies]
    assert spec.mass_kg == pytest.approx(sum(body["mass"] for body in theirs), rel=1e-9)
    ours = build_model(spec)
    for body in theirs:
        own = ours.body(body["name"])
        assert own.mass[0] == pytest.approx(body["mass"], rel=1e-6)
        np.testing.assert_allclose(own.ipos, body["com"], atol=1e-6)
        inertia = tensor(body["inertia_quat"], body["diaginertia"])
        np.testing.assert_allclose(
            tensor(own.iquat, own.inertia), inertia, rtol=0.0, atol=INERTIA[spec.name] * inertia.max()
        )


def tensor(quat: Sequence[float], principal: Sequence[float]) -> np.ndarray:
    """Inertia about the centre of mass, in the body's frame [kg m^2]."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.asarray(quat))
    return turn.reshape(3, 3) @ np.diag(principal) @ turn.reshape(3, 3).T


def test_joints_have_the_published_limits(published):
    spec, file = published
    theirs = {body["joint"]["name"]: body["joint"] for body in facts_of(file)["bodies"] if body["joint"]}
    for joint in spec.joints:
        entry = theirs[joint.name]
        assert tuple(entry["range_rad"]) == pytest.approx(joint.range_rad, abs=1e-9)
        assert entry["torque_limit_nm"] == joint.torque_limit_nm
        assert (entry["mirror"], entry["mirror_sign"]) == (joint.mirror_name, joint.mirror_sign)
        if file.name != "g1.xml":  # which has 0.01 for every joint, where the facts have each motor's own
            assert entry["armature"] == pytest.approx(joint.armature_kg_m2, rel=1e-6)


def test_bodies_hands_and_feet_are_where_they_are_to_a_micrometre(published):
    spec, file = published
    theirs, ours = models(spec, file)
    a, b, rng = mujoco.MjData(theirs), mujoco.MjData(ours), np.random.default_rng(0)
    for _ in range(POSES):
        a.qpos[:] = b.qpos[:] = random_pose(spec, rng)
        mujoco.mj_kinematics(theirs, a)
        mujoco.mj_kinematics(ours, b)
        np.testing.assert_allclose(b.xpos[1:], a.xpos[1:], atol=1e-6)
        np.testing.assert_allclose(b.xmat[1:], a.xmat[1:], atol=1e-6)
        ends = {f"{arm.side}_hand": (arm.hand_body, arm.hand_point) for arm in spec.arms}
        ends |= {f"{foot.side}_foot": (foot.body, foot.sole) for foot in spec.feet}
        for site, (body, point) in ends.items():
            place = a.body(body).xpos + a.body(body).xmat.reshape(3, 3) @ point
            np.testing.assert_allclose(b.site(site).xpos, place, atol=1e-6)


def test_weight_asks_the_same_torque_to_a_micronewtonmetre(published):
    spec, file = published
    theirs, ours = models(spec, file)
    a, b, rng = mujoco.MjData(theirs), mujoco.MjData(ours), np.random.default_rng(1)
    for _ in range(POSES):
        a.qpos[:] = b.qpos[:] = random_pose(spec, rng)
        mujoco.mj_forward(theirs, a)
        mujoco.mj_forward(ours, b)
        np.testing.assert_allclose(b.qfrc_bias, a.qfrc_bias, atol=1e-6)


def test_a_second_of_free_motion_is_the_same_to_a_millionth(published):
    """Random torques, held for 50 ms each, up to 3 % of the limits: larger ones spin joints without ranges so fast that
    the motion is chaotic. Rotors and damping of the one are taken for both."""
    spec, file = published
    theirs, ours = models(spec, file)
    theirs.dof_armature[:], theirs.dof_damping[:] = ours.dof_armature, ours.dof_damping
    a, b, rng = mujoco.MjData(theirs), mujoco.MjData(ours), np.random.default_rng(2)
    a.qpos[:] = b.qpos[:] = random_pose(spec, rng)
    limits = np.array([joint.torque_limit_nm for joint in spec.joints])
    for step in range(round(1.0 / STEP_S)):
        if step % 50 == 0:
            a.qfrc_applied[6:] = b.qfrc_applied[6:] = 0.03 * limits * rng.uniform(-1.0, 1.0, len(limits))
        mujoco.mj_step(theirs, a)
        mujoco.mj_step(ours, b)
    assert np.abs(b.qvel).max() > 1.0
    np.testing.assert_allclose(b.qpos, a.qpos, atol=1e-6)
