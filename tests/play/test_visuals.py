"""What robots look like, and that it is where they are."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from cotap.play.visuals import RobotPose, menagerie_file, visual_model

TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_bodies_are_where_mujoco_has_them_and_standing_feet_touch_the_floor(any_spec, any_model, monkeypatch):
    spec, model = any_spec, any_model
    monkeypatch.setattr("cotap.play.visuals.menagerie_file", lambda _: None)
    visual, origin = visual_model(spec)
    assert origin == "cotap"
    assert mujoco.mj_name2id(visual, mujoco.mjtObj.mjOBJ_GEOM, "floor") == -1
    data = mujoco.MjData(model)
    data.qpos[2] = spec.base_height_m - 0.002
    data.qpos[3:7] = 0.6, 0.0, 0.0, 0.8
    data.qpos[7:] = [j.default_rad for j in spec.joints]
    mujoco.mj_forward(model, data)
    positions, rotations, contacts = RobotPose(spec, visual).of(data.qpos)
    for i in range(1, visual.nbody):
        body = data.body(visual.body(i).name)
        np.testing.assert_allclose(positions[i], body.xpos, atol=1e-12)
        np.testing.assert_allclose(rotations[i].ravel(), body.xmat, atol=1e-12)
    assert len(contacts) >= 2
    assert np.abs(contacts[:, 2]).max() < 0.02


def test_an_arm_that_touches_the_torso_is_a_contact(spec):
    pose = RobotPose(spec, visual_model(spec)[0])
    qpos = np.r_[0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0, [j.default_rad for j in spec.joints]]
    assert len(pose.of(qpos)[2]) == 0
    (roll,) = spec.indices(["left_shoulder_roll"])
    qpos[7 + roll] = spec.joints[roll].range_rad[0]
    contacts = pose.of(qpos)[2]
    assert len(contacts) > 0
    assert contacts[:, 2].min() > 5.0


def test_meshes_are_taken_from_menageries_cache_when_they_are_there(spec, tmp_path, monkeypatch):
    pytest.importorskip("mujoco_menagerie", reason="meshes need the mujoco-menagerie package")
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path / "empty"))
    assert menagerie_file(spec) is None
    folder = tmp_path / spec.menagerie
    folder.mkdir()
    (folder / "part.obj").write_text(TETRAHEDRON)
    (folder / "h1.xml").write_text(
        "<mujoco><asset><mesh name='part' file='part.obj'/></asset><worldbody><body name='pelvis'><freejoint/>"
        "<geom type='mesh' mesh='part'/><body name='torso_link'><joint name='torso'/><geom type='mesh' mesh='part'/>"
        "</body></body></worldbody></mujoco>"
    )
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    visual, origin = visual_model(spec)
    assert origin == "MuJoCo Menagerie"
    assert visual.nmesh == 1
    positions, _, _ = RobotPose(spec, visual).of(np.r_[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, np.zeros(19)])
    assert positions[visual.body("pelvis").id].tolist() == [0.0, 0.0, 1.0]
