"""From somebody's MJCF to a robot: the documentation's own steps, MuJoCo's word for the result, what is refused."""

from __future__ import annotations

import json
import re
import runpy
import shlex
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from robots.third import mjcf

from cotap.agents.checkpoint import load_checkpoint
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.robots import ROBOTS
from cotap.robots.from_mjcf import _torque_limit, facts_of, facts_text, main
from cotap.robots.kinematics import default_angles
from cotap.robots.mjcf import build_mjspec, build_model

DOCS = Path(__file__).parents[2] / "docs"
EXAMPLE = DOCS.parent / "examples" / "own_robot.py"
NAME = "my-robot"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The third humanoid, brought in as the page says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(ROBOTS, NAME, None)  # so that what the example adds is taken out again
    Path("robot.xml").write_text(mjcf())
    for line in commands("from_mjcf"):
        assert main(line) == 0
    runpy.run_path(str(EXAMPLE))
    return ROBOTS[NAME]()


def commands(program: str) -> list[list[str]]:
    """Arguments of the page's commands that run `program`."""
    lines = re.findall(rf"^python .*\b{program}(?:\.py)? (.*)$", (DOCS / "robots.md").read_text(), re.M)
    return [shlex.split(line, comments=True) for line in lines]


def test_it_is_a_robot_like_any_other(own):
    assert own.name == NAME
    assert own.lower_joints[-1] == "waist"
    assert [own.joint(f"{s}_shoulder_roll").mirror_sign for s in "lr"] == [1.0, 1.0]  # its axis is turned about
    assert own.joint("l_shoulder_roll").mirror_name == "r_shoulder_roll"
    assert own.joint("waist").mirror_sign == -1.0
    limits = [own.joint(f"l_{part}").torque_limit_nm for part in ("hip_roll", "hip_pitch", "knee", "elbow")]
    assert limits == [120.0, 150.0, 140.0, 25.0]
    assert {j.velocity_limit_rad_s for j in own.joints} == {12.0}
    assert own.contact_excludes == (("hips", "chest"), ("hips", "l_thigh"), ("hips", "r_thigh"))  # the head is fixed
    assert {body.name for body in own.bodies}.isdisjoint({"head", "l_hand", "r_hand"})
    assert own.mass_kg == pytest.approx(6 + 14 + 2 + 2 * (0.8 + 0.7 + 0.9 + 0.6 + 0.3 + 1 + 4 + 2.5 + 1))


def test_it_moves_as_in_its_own_file(own):
    """Joint-space inertia, weight and forearms at random poses; MuJoCo reads the one file, cotap makes the other."""
    theirs, ours = mujoco.MjModel.from_xml_string(mjcf(base="<freejoint/>")), build_model(own)
    rng = np.random.default_rng(0)
    for _ in range(5):
        seen = []
        angles = {j.name: rng.uniform(*j.range_rad) for j in own.joints}
        for model in (theirs, ours):
            data = mujoco.MjData(model)
            data.qpos[:7] = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
            for name, angle in angles.items():
                data.joint(name).qpos[0] = angle
            mujoco.mj_forward(model, data)
            dofs = [*range(6), *(model.joint(j).dofadr[0] for j in own.joint_names)]
            columns = [np.zeros(model.nv) for _ in dofs]
            for dof, column in zip(dofs, columns, strict=True):
                mujoco.mj_mulM(model, data, column, np.eye(model.nv)[dof])
            forearms = [data.body(f"{s}_forearm").xpos for s in "lr"]
            seen.append((np.array(columns)[:, dofs], data.qfrc_bias[dofs], forearms))
        for a, b in zip(*seen, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)


def test_it_stands_steps_and_is_mirrored(own):
    env = HumanoidEnv(HumanoidEnvConfig(robot=NAME, num_envs=2, num_threads=1))
    for _ in range(10):
        _, reward, done, _ = env.step(torch.zeros(2, env.num_actions))
        assert torch.isfinite(reward).all()
        assert not done.any()
    action = torch.randn(2, len(own.joints), generator=torch.Generator().manual_seed(0))
    left, right = own.indices(["l_hip_roll", "r_hip_roll"])
    mirrored = env.symmetry.actions(action)
    assert torch.equal(mirrored[:, left], action[:, right])
    data = mujoco.MjData(build_model(own))
    data.qpos[2], data.qpos[7:] = own.base_height_m, default_angles(own)
    mujoco.mj_forward(build_model(own), data)
    assert data.site("left_foot").xpos[2] == pytest.approx(0.0, abs=1e-6)


def test_it_trains_as_the_page_says_and_is_evaluated(own, monkeypatch):  # noqa: ARG001
    (arguments,) = commands("own_robot")
    few = ["--env.num-envs", "4", "--runner.iterations", "1", "--threads", "1", "--ppo.steps", "4"]
    trained = "runs/my-robot/checkpoint_000001.pt"
    look = ["evaluate", "velocity-tracking", "--checkpoint", trained, "--num-envs", "2", "--episode-seconds", "5"]
    for line in ([*arguments, *few], [*look, "--threads", "1", "--json", "seen.json"]):
        monkeypatch.setattr("sys.argv", ["own_robot.py", *line])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(EXAMPLE), run_name="__main__")
        assert end.value.code == 0
    assert load_checkpoint(Path(trained))["layout"]["robot"] == NAME
    assert json.loads(Path("seen.json").read_text())["settings"]["env"]["robot"] == NAME


def test_what_cotap_makes_of_a_robot_gives_its_facts_back(any_spec, tmp_path):
    path = tmp_path / "robot.xml"
    mj = build_mjspec(any_spec, "full")
    mj.compile()
    path.write_text(mj.to_xml())
    facts = facts_of(path)
    assert [entry["name"] for entry in facts["bodies"]] == [body.name for body in any_spec.bodies]
    assert {frozenset(pair) for pair in facts["contact_excludes"]} == {*map(frozenset, any_spec.contact_excludes)}
    for entry, body in zip(facts["bodies"], any_spec.bodies, strict=True):
        assert entry["mass"] == pytest.approx(body.mass_kg)
        np.testing.assert_allclose(entry["pos"], body.pos, atol=1e-9)
        np.testing.assert_allclose(entry["diaginertia"], body.diaginertia, rtol=1e-5)  # the XML has six digits
        assert len(entry["collision_geoms"]) == len(body.collision)
        for shape, own in zip(entry["collision_geoms"], body.collision, strict=True):
            assert shape["type"] == own.type
            used = {"sphere": 1, "capsule": 2, "cylinder": 2}.get(own.type, 3)
            np.testing.assert_allclose(shape["size"][:used], own.size[:used], atol=1e-6)
            np.testing.assert_allclose(shape["pos"], own.pos, atol=1e-6)
            assert abs(np.dot(shape["quat"], own.quat)) == pytest.approx(np.linalg.norm(own.quat), abs=1e-5)
        if body.joint:
            joint, own = entry["joint"], any_spec.joint(body.joint)
            assert (joint["mirror"], joint["mirror_sign"]) == (own.mirror_name, own.mirror_sign)
            assert joint["torque_limit_nm"] == own.torque_limit_nm
            assert tuple(joint["range_rad"]) == pytest.approx(own.range_rad)
            assert joint["damping"] == pytest.approx(own.damping_nms_rad)
            assert joint["armature"] == pytest.approx(own.armature_kg_m2, rel=1e-5)


def test_a_mesh_that_collides_keeps_its_own_mass(tmp_path):
    """A tetrahedron is a third of a half of the box around it, and its centre of mass is elsewhere."""
    corners = '"0 0 0 0.2 0 0 0 0.1 0 0 0 0.1"'
    foot = '<inertial mass="1" pos="0.03 0 -0.03" diaginertia="0.001 0.003 0.003"/>\n        <joint name="l_ankle"'
    text = mjcf().replace('name="sole" vertex="', f'name="other" vertex={corners}/><mesh name="sole" vertex="')
    assert foot in text
    text = text.replace(foot, '<geom type="mesh" mesh="other"/><joint name="l_ankle"')
    (tmp_path / "robot.xml").write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    (entry,) = [body for body in facts_of(tmp_path / "robot.xml")["bodies"] if body["name"] == "l_foot"]
    theirs = model.body("l_foot")
    assert entry["mass"] == pytest.approx(theirs.mass[0])
    np.testing.assert_allclose(entry["com"], theirs.ipos, atol=1e-9)
    np.testing.assert_allclose(entry["diaginertia"], theirs.inertia, rtol=1e-9)
    assert [shape["type"] for shape in entry["collision_geoms"]] == ["box", "box"]


def test_a_vector_has_a_line():
    assert facts_text({"a": [1.0, 2.0], "b": [{"c": [[0, 1], [2, 3]]}], "d": []}) == (
        '{\n "a": [1.0, 2.0],\n "b": [\n  {\n   "c": [\n    [0, 1],\n    [2, 3]\n   ]\n  }\n ],\n "d": []\n}\n'
    )


TWO_JOINTS = '<body name="odd"><joint name="a" axis="0 1 0"/><joint name="b" axis="0 0 1"/><geom size="0.1"/></body>'
MESH = mjcf('<geom type="mesh" mesh="limb"/>').replace("<asset>", '<asset><mesh file="limb.stl"/>')
EQUAL = '<equality><joint joint1="l_knee" joint2="l_ankle"/></equality><actuator>'
TENDON = '<tendon><fixed stiffness="100"><joint joint="l_knee" coef="1"/></fixed></tendon><actuator>'
LONE = '<body name="odd"><joint name="odd" axis="0 1 0" range="-9 9" actuatorfrcrange="-1 1"/><geom size="0.1"/></body>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            mjcf(base=TWO_JOINTS.replace("/>", ' range="-9 9" actuatorfrcrange="-1 1"/>', 2)),
            "'odd' must be moved by one",
        ),
        (mjcf(base=LONE.replace(' range="-9 9"', "")), "joint 'odd' needs a range"),
        (mjcf(base=LONE.replace(' actuatorfrcrange="-1 1"', "")), "joint 'odd' needs a torque limit"),
        (
            mjcf(base=LONE.replace("<joint", '<joint stiffness="40"')),
            "joint 'odd' must have no spring, got stiffness 40",
        ),
        (mjcf(base=LONE.replace("<joint", '<joint pos="0 0 0.1"')), "'odd' must lie in its body's origin"),
        (
            mjcf(base=LONE.replace("<joint", '<joint ref="5"')),
            "'odd' must lie in its body's origin and count from zero",
        ),
        (mjcf(base=LONE.replace('name="odd"', "")), "bodies and joints need names; below 'hips'"),
        (
            mjcf(base=LONE.replace('<body name="odd"', '<body name="odd" pos="0 1 0"')),
            "joint 'odd' needs one mirror image at zero angles, found none",
        ),
        (
            mjcf().replace("</worldbody>", f"{LONE}</worldbody>"),
            "one body of the world must carry the robot, got hips, odd",
        ),
        (mjcf().replace('"box"', '"plane"'), "plane"),
        (mjcf().replace("<actuator>", EQUAL), "equality constraints cannot be expressed, got 1"),
        (mjcf().replace("<actuator>", TENDON), "tendons cannot be expressed, got 1"),
        (
            mjcf().replace('<body name="chest"', '<body name="chest" gravcomp="1"'),
            "bodies with gravcomp cannot be .* 1",
        ),
        ("<mujoco/>", "one body of the world must carry the robot, got none"),
        ("rubbish", r"robot\.xml' cannot be read: .*XML"),
        ("version https://git-lfs.github.com/spec/v1\n", r"MJCF '.*robot\.xml' is a Git LFS pointer"),
        (MESH, r"robot\.xml': mesh .*limb\.stl is a Git LFS pointer"),
        (MESH.replace("limb", "none"), r"robot\.xml' cannot be read: .*none\.stl"),
        (mjcf(base=LONE.replace(' range="-9 9"', "").replace("odd", "o" * 100_000)), r"^.{,3000}$"),
    ],
)
def test_what_cannot_be_a_robot_is_named(text, message, tmp_path, capsys):
    (tmp_path / "robot.xml").write_text(text)
    (tmp_path / "limb.stl").write_text("version https://git-lfs.github.com/spec/v1\n")
    assert main(["--mjcf", str(tmp_path / "robot.xml"), "--output", str(tmp_path / "robot.json")]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "robot.json").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--mjcf", "none.xml", "--output", "robot.json"], "MJCF 'none.xml' does not exist"),
        (["--mjcf", ".", "--output", "robot.json"], "MJCF '.' is no file but a folder"),
        (["--mjcf", "none.xml", "--output", "robot.xml"], "--output must end in .json, got 'robot.xml'"),
        (["--mjcf", "none.xml", "--output", "no/robot.json"], "its folder does not exist"),
        (["--mjcf", "none.xml", "--output", "robot.json", "--velocity-limit", "0"], "velocity_limit must lie in"),
    ],
)
@pytest.mark.usefixtures("in_tmp_path")
def test_bad_input_is_named(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_what_is_no_file_or_names_what_a_terminal_obeys_is_refused_in_words(tmp_path, capsys):
    path, out = tmp_path / "robot.xml", str(tmp_path / "o.json")
    path.symlink_to("/dev/zero")
    assert main(["--mjcf", str(path), "--output", out]) == 2
    assert "is no file but a device or pipe" in capsys.readouterr().err
    path.unlink()
    two = '<body name="a\x1b[2J{0}"><joint/><geom size="1"/></body>'
    path.write_text(f"<mujoco><worldbody>{''.join(two.format(k) for k in range(2000))}</worldbody></mujoco>")
    assert main(["--mjcf", str(path), "--output", out]) == 2
    said = capsys.readouterr().err
    assert "one body of the world must carry the robot" in said
    assert "\x1b" not in said
    assert len(said) < 3500


@pytest.mark.parametrize(
    ("of_joint", "actuator", "limit"),
    [('actuatorfrcrange="-80 80"', 'forcerange="-25 25"', 25.0),
     ('actuatorfrcrange="-20 20"', 'forcerange="-25 25"', 20.0),
     ("", 'forcerange="-5 5" gear="3"', 15.0), ("", 'ctrlrange="-7 7" gear="2"', 14.0),
     ("", 'forcerange="-5 5"/><motor joint="a" ctrlrange="-7 7" gear="2"', 19.0),
     ('actuatorfrcrange="-9 9"', 'forcerange="-5 5"/><motor joint="a"', 9.0)],
)  # fmt: skip
def test_the_least_of_all_torque_limits_counts(of_joint, actuator, limit):
    """MuJoCo applies both: that of each actuator, which add up, then that of the joint."""
    text = f"""<mujoco><worldbody><body><joint name="a" axis="0 1 0" {of_joint}/><geom size="0.1"/></body></worldbody>
    <actuator><motor joint="a" {actuator}/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    assert _torque_limit(model, 0) == pytest.approx(limit)
    data = mujoco.MjData(model)
    data.ctrl[:] = 1e3
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[0] == pytest.approx(limit)
