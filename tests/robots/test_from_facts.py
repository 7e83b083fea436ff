"""Robots of files of facts: gains by name, the height of the torso, the order of bodies, what is refused."""

from __future__ import annotations

import json

import pytest

from cotap.robots.from_facts import Gains, robot_from_facts, shipped_facts


@pytest.fixture
def make(spec, tmp_path):
    """The H1 from its facts, after `change` has had them."""

    def made(change=None, gains=None, **fields):
        content = json.loads(shipped_facts("h1").read_text())
        if change:
            change(content)
        path = tmp_path / "facts.json"
        path.write_text(json.dumps(content))
        gains = gains or {"": Gains(100.0, 2.0)}
        return robot_from_facts(path, "own", gains, spec.torso_body, spec.arms, spec.feet, **fields)

    return made


def test_the_longest_part_of_a_joints_name_counts(make):
    gains = {"": Gains(1.0, 0.1), "hip": Gains(2.0, 0.2), "hip_pitch": Gains(3.0, 0.3, -0.4), "left_elbow": Gains(4, 0)}
    own = make(gains=gains)
    assert [own.joint(f"left_{part}").kp for part in ("knee", "hip_yaw", "hip_pitch", "elbow")] == [1.0, 2.0, 3.0, 4.0]
    assert own.joint("right_hip_pitch").default_rad == -0.4
    assert own.joint("right_elbow").kp == 1.0


def test_a_joint_without_gains_is_named(make):
    with pytest.raises(ValueError, match="joint 'torso' has no gains; there are gains of left, right"):
        make(gains={"left": Gains(1.0, 0.1), "right": Gains(1.0, 0.1)})


def test_the_torso_is_as_high_as_puts_the_soles_on_the_ground(make, spec):
    gains = {j.name: Gains(j.kp, j.kd, j.default_rad) for j in spec.joints}
    assert make(gains=gains).nominal_height_m == pytest.approx(spec.nominal_height_m, abs=1e-4)
    assert make(gains=gains, nominal_height_m=1.5).nominal_height_m == 1.5


def test_bodies_are_seen_as_they_collide_unless_told_otherwise(make, spec):
    assert all(body.visual == body.collision for body in make().bodies)
    shapes = {body.name: body.visual for body in spec.bodies}
    assert make(visuals=shapes.get).bodies[-1].visual == spec.bodies[-1].visual


def test_arms_may_come_first(make, spec):
    """As they do in many files; right before left, too."""

    def turn(content):
        content["bodies"].sort(key=lambda entry: entry["parent"] != "world" and "elbow" not in entry["name"])
        content["bodies"][1:] = content["bodies"][:0:-1]

    assert make(turn).joint_names[-8:] == spec.joint_names[-8:]
    assert make(turn).upper_joints == spec.upper_joints


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.pop("bodies"), "these are no facts of a robot: 'bodies' is missing"),
        (lambda content: content["bodies"][3].pop("mass"), "'mass' is missing"),
        (lambda content: content["bodies"][1]["joint"].pop("armature"), "'armature' is missing"),
        (lambda content: content.update(bodies=3), "these are no facts of a robot: 'int' object"),
        (
            lambda content: content["bodies"][5].update(parent="nothing"),
            "the parents of left_ankle_link do not lead to",
        ),
        (lambda content: content["bodies"][5].update(joint=None), "without a joint, .*, got pelvis, left_ankle_link"),
    ],
)
def test_what_are_no_facts_is_refused(make, change, message):
    with pytest.raises(ValueError, match=f"facts.json: .*{message}"):
        make(change)


def test_files_that_are_not_there_or_no_json(tmp_path, spec):
    gains = {"": Gains(100.0, 2.0)}
    with pytest.raises(ValueError, match=r"none\.json' does not exist"):
        robot_from_facts(tmp_path / "none.json", "own", gains, spec.torso_body, spec.arms, spec.feet)
    rubbish = {
        b"\xff{": "' is no text in UTF-8", b"{": ": these are no facts of a robot, not even JSON",
        b"[" * 100_000: ": these are no facts of a robot, not even JSON",
        b"9" * 5000: ": these are no facts of a robot, not even JSON",
        b"[3]": ": these are no facts of a robot: list indices",
    }  # fmt: skip
    for data, message in rubbish.items():
        (tmp_path / "rubbish.json").write_bytes(data)
        with pytest.raises(ValueError, match=rf"rubbish\.json{message}"):
            robot_from_facts(tmp_path / "rubbish.json", "own", gains, spec.torso_body, spec.arms, spec.feet)
    (tmp_path / "rubbish.json").unlink()
    (tmp_path / "rubbish.json").symlink_to("/dev/zero")
    with pytest.raises(ValueError, match=r"rubbish\.json' is no file but a device"):
        robot_from_facts(tmp_path / "rubbish.json", "own", gains, spec.torso_body, spec.arms, spec.feet)
