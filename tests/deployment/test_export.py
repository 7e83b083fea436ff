"""ONNX files: their numbers against torch and the environment, their metadata, what is refused."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from cotap.agents.actors import as_dict
from cotap.agents.checkpoint import CheckpointError, load_checkpoint, save_checkpoint, sha256
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES
from cotap.deployment import graph as graph_module
from cotap.deployment.controller import law_config, robot_of, termination_config
from cotap.deployment.graph import export_policy
from cotap.deployment.metadata import PolicyError
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.policy import main as timing
from cotap.envs import HumanoidEnv
from cotap.envs.actions import JointTargets
from cotap.envs.observations import ObservationConfig
from cotap.evaluation.policy import load_policy
from cotap.export import main as export
from cotap.robots import ROBOTS


@pytest.mark.parametrize("upper_mode", ["residual", "absolute"])
def test_targets_are_the_environments(robot, upper_mode, random_checkpoint, random_policy):
    """But for the arms' reference, which moves within the step: residual arms are sent to where it is at the end."""
    kind = {"robot": robot, "upper_mode": upper_mode, "output_gain": 0.3}
    policy, model = OnnxPolicy(random_policy(**kind)), load_policy(random_checkpoint(**kind))
    cfg = model.env_config
    cfg.num_envs, cfg.collision = 6, "feet"
    env = HumanoidEnv(cfg)
    obs = env.reset()
    for _ in range(20):
        before, seen = env.motions.current().position.double().numpy(), obs["policy"].numpy()
        obs, _, dones, _ = env.step(model(as_dict(obs)))
        after = env.motions.current().position.double().numpy()
        for i in (~dones).nonzero()[:, 0].tolist():
            targets = policy(seen[i])
            action = policy.action(targets, before[i])
            np.testing.assert_allclose(action, env.record.action[i].numpy(), atol=1e-5)
            targets += policy.offset(after[i]) - policy.offset(before[i])
            np.testing.assert_allclose(targets, env.actuation.current[i].numpy(), atol=1e-5)


def test_targets_are_those_of_clipped_actions(random_checkpoint, tmp_path):
    content = load_checkpoint(random_checkpoint(output_gain=0.3))
    content["config"]["training"]["env"]["actions"]["clip"] = 0.01
    save_checkpoint(tmp_path / "p.pt", content)
    export_policy(tmp_path / "p.pt", tmp_path / "p.onnx", checks=1)
    policy = OnnxPolicy(tmp_path / "p.onnx")
    reference = np.zeros(8)
    action = policy.action(policy(np.zeros(policy.metadata.observation_width)), reference)
    assert np.abs(action).max() == pytest.approx(0.01, rel=1e-3)


def test_it_runs_where_torch_cannot_be_imported(policy_file, policy):
    script = (
        "import sys; sys.modules['torch'] = None\n"
        "import numpy as np\n"
        "from cotap.deployment.policy import OnnxPolicy\n"
        "policy = OnnxPolicy(sys.argv[1])\n"
        "targets = policy(np.linspace(-1.0, 1.0, policy.metadata.observation_width))\n"
        "import json; print(json.dumps(targets.tolist()))\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(policy_file)], capture_output=True, text=True, check=True)
    expected = policy(np.linspace(-1.0, 1.0, policy.metadata.observation_width))
    np.testing.assert_allclose(json.loads(done.stdout), expected, atol=1e-12)


def test_metadata_is_what_a_robot_needs(robot, random_checkpoint, random_policy):
    path, spec = random_policy(robot=robot), ROBOTS[robot]()
    cfg = load_policy(random_checkpoint(robot=robot)).env_config
    m, joints, lower = OnnxPolicy(path).metadata, len(spec.joints), len(spec.lower_joints)
    assert m.joints == list(spec.joint_names)
    for name, field in (("kp", "kp"), ("kd", "kd"), ("torque_limit_nm", "torque_limit_nm"),
                        ("default_pose_rad", "default_rad")):  # fmt: skip
        assert getattr(m, name) == [getattr(j, field) for j in spec.joints]
    legs = [0.6 * min(1.0, joint.torque_limit_nm / joint.kp) for joint in spec.joints[:lower]]
    scale = np.array(legs + [0.1] * (joints - lower), dtype=np.float32)
    np.testing.assert_allclose(m.action["scale_rad"], scale, rtol=0, atol=5e-10)  # nine decimals
    assert (m.action["clip"], m.action["upper_mode"]) == (20.0, "residual")
    assert (m.control_dt, m.gait["period_s"]) == (cfg.control_dt, cfg.gait.period_s)
    assert m.commands["acceleration"] == cfg.commands.acceleration
    assert m.nominal_height_m == spec.nominal_height_m
    fall = termination_config(m)  # as evaluations have it, however far training goes on
    assert (fall.min_height, fall.max_tilt_rad) == (0.5, 1.0)
    assert m.checkpoint_sha256 == sha256(random_checkpoint(robot=robot))
    proto = onnx.load(path)
    assert {o.domain: o.version for o in proto.opset_import}[""] == m.opset
    shapes = [[d.dim_value for d in v.type.tensor_type.shape.dim] for v in (*proto.graph.input, *proto.graph.output)]
    assert shapes == [[1, m.observation_width], [1, joints]]
    assert m.observation_width == 5 * (13 + 3 * joints + 2 * (joints - lower))


def test_metadata_says_what_each_term_of_the_observation_is(robot, random_checkpoint, random_policy):
    m, spec = OnnxPolicy(random_policy(robot=robot)).metadata, ROBOTS[robot]()
    c = load_policy(random_checkpoint(robot=robot)).env_config.commands
    about = m.observation["about"]
    assert list(about) == [name for name, _, _ in m.observation["terms"]]
    assert all(entry["what"] and entry["unit"] in ("rad", "rad/s", "m", "m/s", "Nm", "1") for entry in about.values())
    # The height is that of the torso link above the ground, not an offset.
    lowest, highest = about["command_height"]["range"]
    assert (lowest, highest) == pytest.approx([spec.nominal_height_m + offset for offset in c.height_offset])
    assert about["command_velocity"]["range"] == [
        [c.velocity_x[0], c.velocity_y[0]],
        [c.velocity_x[1], c.velocity_y[1]],
    ]
    for (name, width, _), entry in zip(m.observation["terms"], about.values(), strict=True):
        for bound in entry["range"] or ():
            assert not isinstance(bound, list) or len(bound) == width, name
    for name in ("projected_gravity", "sin_phase", "cos_phase"):
        assert about[name]["range"] == [-1.0, 1.0]
    assert (about["command_stand"]["range"], about["last_action"]["range"]) == ([0.0, 1.0], [-20.0, 20.0])
    speeds = [j.velocity_limit_rad_s for j in spec.joints]
    assert about["joint_velocity"]["range"] == [[-v for v in speeds], speeds]
    limits = [j.torque_limit_nm for j in spec.joints[len(spec.lower_joints) :]]
    assert about["arm_torque"]["range"] == [[-t for t in limits], limits]
    q = np.array(m.golden["readings"][0]["joint_pos"])
    low, high = (np.array(bound) for bound in about["joint_position"]["range"])
    assert ((low <= q - m.default_pose_rad) & (q - m.default_pose_rad <= high)).mean() > 0.9


def test_the_golden_pair_is_the_policys(random_checkpoint, random_policy):
    policy, model = OnnxPolicy(random_policy(output_gain=0.3)), load_policy(random_checkpoint(output_gain=0.3))
    golden = policy.metadata.golden
    np.testing.assert_allclose(policy(np.array(golden["observation"])), golden["joint_targets"], atol=1e-5)
    action = model({"policy": torch.tensor([golden["observation"]])})[0].numpy()
    reference = np.array(golden["readings"][-1]["arm_reference"])
    np.testing.assert_allclose(policy.action(np.array(golden["joint_targets"]), reference), action, atol=1e-5)
    assert np.abs(action).max() > 0.01


def test_golden_readings_are_such_as_a_robot_can_have(policy, spec):
    """A little off its default pose, moving and tilted, each by as much as is drawn; gravity has length 1."""
    for readings in policy.metadata.golden["readings"]:
        moved = np.array(readings["joint_pos"]) - [j.default_rad for j in spec.joints]
        rates, turn, tilt = readings["joint_vel"], readings["angular_velocity"], readings["gravity"][:2]
        for values, most in ((moved, 0.1), (rates, 0.5), (turn, 0.3), (tilt, 0.1)):
            assert 0.05 * most < np.abs(values).max() <= most + 1e-4
        for values in (moved, rates):
            assert np.min(values) < 0.0 < np.max(values)
        assert np.linalg.norm(readings["gravity"]) == pytest.approx(1.0, abs=1e-9)
        assert readings["gravity"][2] < 0.0


@pytest.mark.parametrize(("kind", "each"), [("alpha", 1), ("stiffness", 4)])
def test_a_policy_that_sets_the_laws_says_what_it_asks_of_them(kind, each, random_checkpoint, random_policy):
    """Alpha, and the logarithm of stiffness, as the law's own config and the scales of the actions have it."""
    made = {"output_gain": 1.0, "modulation": kind}
    policy, model = OnnxPolicy(random_policy(**made)), load_policy(random_checkpoint(**made))
    m, laws = policy.metadata, model.env_config.upper_body
    assert robot_of(m).name == "h1"
    assert [name.split()[0] for name in m.law_targets] == ["left"] * each + ["right"] * each
    assert law_config(m).modulation == laws.modulation
    out = policy(np.array(m.golden["observation"]))
    np.testing.assert_allclose(out, [*m.golden["joint_targets"], *m.golden["law_targets"]], atol=1e-5)
    action = model({"policy": torch.tensor([m.golden["observation"]])})[0, 19:].unflatten(0, (2, each))
    wanted = out[19:].reshape(2, each)
    for arm, law in enumerate((laws.left, laws.right)):
        assert wanted[arm, 0] == pytest.approx(law.alpha + 0.5 * float(action[arm, 0]), abs=1e-5)
        assert wanted[arm, 1:] == pytest.approx(
            [math.log(k) + float(a) for k, a in zip(law.stiffness, action[arm, 1:], strict=False)], abs=1e-5
        )
    assert float(action.abs().max()) > 0.02
    np.testing.assert_allclose(out[11:19], m.golden["readings"][-1]["arm_reference"], atol=1e-6)  # targets stay there
    about = m.observation["about"]
    assert about["law_alpha"]["range"] == [0.0, 1.0]
    assert ("law_log_stiffness" in about) == (kind == "stiffness")


def test_a_distilled_policy_says_in_which_ranges_its_law_was_trained(spec):
    training = DISTILL_RECIPES["default"](BASE_RECIPES["default"]())
    targets = JointTargets(training.env.actions, spec)
    metadata = graph_module.describe(training.env, spec, targets, "distill", "0" * 64, {})
    assert metadata.law["left"]["name"] == "cotap"
    assert metadata.law["sampling"]["enabled"]
    assert metadata.law["sampling"]["stiffness"] == [80.0, 1200.0]
    assert not law_config(metadata).sampling.enabled  # on the robot parameters are fixed


def test_arm_torque_may_be_the_critics_alone_but_goals_are_not_deployed(tmp_path, save_policy):
    save_policy(tmp_path / "p.pt", observations=ObservationConfig(arm_torque="critic"))
    export_policy(tmp_path / "p.pt", tmp_path / "p.onnx", checks=1)
    assert "arm_torque" not in [name for name, _, _ in OnnxPolicy(tmp_path / "p.onnx").metadata.observation["terms"]]
    save_policy(tmp_path / "p.pt", observations=ObservationConfig(goals=True))
    with pytest.raises(CheckpointError, match="another terms"):
        export_policy(tmp_path / "p.pt", tmp_path / "p.onnx", checks=1)


def test_a_file_that_differs_from_torch_is_not_kept(random_checkpoint, random_policy, tmp_path, monkeypatch, capsys):
    checkpoint, good = random_checkpoint(output_gain=0.3), random_policy(output_gain=0.3)

    def spoil(path, _graph, _metadata):
        proto = onnx.load(good)
        largest = max(proto.graph.initializer, key=lambda t: np.prod(t.dims))
        values = onnx.numpy_helper.to_array(largest).copy()
        values[0] *= -1.0
        largest.CopyFrom(onnx.numpy_helper.from_array(values, largest.name))
        onnx.save(proto, path)

    monkeypatch.setattr(graph_module, "_write_onnx", spoil)
    arguments = ["--output", str(tmp_path / "p.onnx"), "--checkpoint", str(checkpoint), "--checks", "20"]
    assert export(arguments) == 1
    assert "differ from torch's" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--output", "p.pt"], "must end in .onnx"),
        (["--output", "nowhere/p.onnx"], "folder does not exist"),
        (["--output", "p.onnx", "--checkpoint", "missing.pt"], "'missing.pt' does not exist"),
        (["--output", "p.onnx", "--robot", "h2"], "robot 'h2' is unknown"),
        (["--output", "p.onnx", "--checks", "0"], "checks must be a positive integer"),
    ],
)
@pytest.mark.usefixtures("in_tmp_path")
def test_bad_input_is_named(arguments, message, capsys):
    assert export(arguments) == 2
    assert message in capsys.readouterr().err


def _changed(policy_file: Path, tmp_path: Path, change) -> Path:
    proto = onnx.load(policy_file)
    change(proto)
    path = tmp_path / "changed.onnx"
    onnx.save(proto, path)
    return path


def _set(proto, name, value):
    next(p for p in proto.metadata_props if p.key == name).value = value


def _narrow(proto):
    golden = next(p for p in proto.metadata_props if p.key == "golden")
    _set(proto, "golden", json.dumps(json.loads(golden.value) | {"observation": [0.0] * 15}))
    _set(proto, "observation", '{"terms": [["a", 3, 1.0]], "history": 5}')


def _widen(proto):
    proto.graph.input[0].type.tensor_type.shape.dim[1].dim_value += 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p.ClearField("metadata_props"), "lacks the metadata format, robot"),
        (lambda p: _set(p, "kp", "[1.0, 2.0]"), "kp has 2 entries for 19 joints"),
        (lambda p: _set(p, "kp", "oops"), "kp is not JSON"),
        (lambda p: _set(p, "kp", "[" * 100_000), "kp is not JSON"),
        (lambda p: _set(p, "kp", f"[{', '.join(19 * [str(10**400)])}]"), "kp holds what is not a finite number"),
        (lambda p: _set(p, "observation", json.dumps({"terms": [["a", 3, 10**400]], "history": 5})), "scale"),
        (lambda p: _set(p, "observation", '{"terms": [["a", 3, "1"]], "history": 5}'), "scale"),
        (lambda p: _set(p, "observation", '{"terms": [["a", 3]], "history": 5}'), r"scale\): \['a', 3\]"),
        (lambda p: _set(p, "control_dt", "-1"), "control_dt must lie in"),
        (lambda p: _set(p, "format", '"cotap-policy-7"'), "this cotap reads 'cotap-policy-4'"),
        (lambda p: _set(p, "observation", "{}"), "observation lacks 'terms'"),
        (lambda p: _set(p, "joints", '["a"]'), "entries for 1 joints"),
        (_narrow, "its metadata asks for"),
        (_widen, "cannot be read as ONNX: .*Incompatible dimensions"),
    ],
)
def test_files_that_are_no_policy_are_refused_by_name(change, message, policy_file, tmp_path):
    path = _changed(policy_file, tmp_path, change)
    with pytest.raises(PolicyError, match=f"(?s)changed.onnx.*{message}"):
        OnnxPolicy(path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("robot", 3, "metadata robot must be a text, got 3"),
        ("checkpoint_sha256", 3, "metadata checkpoint_sha256 must be a text, got 3"),
        ("cotap_version", None, "metadata cotap_version must be a text, got None"),
        ("stage", None, "metadata stage None is unknown; known: base, distill"),
        ("joints", ["a"] * 19, "metadata joints must be a list of different names"),
        ("joints", {"a": 1}, "metadata joints must be a list of different names"),
        ("joints", [*range(19)], "metadata joints must be a list of different names"),
        ("joints", [], "metadata joints must be a list of different names"),
        ("kp", 100.0, "metadata kp must be a list"),
        ("golden", {"observation": [1.0], "joint_targets": []}, "golden.observation has 1 entries for 430 numbers"),
        ("golden", {}, "golden.observation must be a list, got None"),
        ("kd", [True] * 19, "kd holds what is not a finite number"),
        ("nominal_height_m", "1", "metadata nominal_height_m must be a finite number"),
        ("control_dt", True, "metadata control_dt must be a finite number"),
        ("control_dt", 1.001, "metadata control_dt must lie in"),
        ("control_dt", 9e-5, "metadata control_dt must lie in"),
        ("nominal_height_m", -0.01, "metadata nominal_height_m must lie in"),
        ("nominal_height_m", 100.1, "metadata nominal_height_m must lie in"),
        ("opset", 2.5, "metadata opset must be a positive integer"),
        ("commands", 3, "metadata commands must be an object"),
        ("law", 3, "metadata law must be an object"),
        ("action", {"scale_rad": [1.0]}, "metadata action lacks 'clip'"),
    ],
)
def test_metadata_of_another_kind_is_named(name, value, message, policy_file, tmp_path):
    path = _changed(policy_file, tmp_path, lambda proto: _set(proto, name, json.dumps(value)))
    with pytest.raises(PolicyError, match=f"(?s)changed.onnx.*{message}"):
        OnnxPolicy(path)


@pytest.mark.parametrize(
    ("name", "entries", "message"),
    [
        ("observation", {"history": 5.0}, "metadata observation.history must be a positive integer, got 5.0"),
        ("observation", {"history": True}, "metadata observation.history must be a positive integer"),
        ("observation", {"terms": 3}, "metadata observation.terms must be a list"),
        ("observation", {"terms": [["a", 1.0, 1.0]]}, "width of a must be a positive integer"),
        ("action", {"scale_rad": [0.0] * 19}, "metadata action.scale_rad must lie in"),
        ("action", {"scale_rad": [0.1] * 18 + [1001.0]}, "metadata action.scale_rad must lie in"),
        ("action", {"scale_rad": [0.1]}, "action.scale_rad has 1 entries for 19 joints"),
        ("action", {"clip": -1.0}, "metadata action.clip must lie in"),
        ("action", {"upper_mode": "sideways"}, "action.upper_mode 'sideways' is unknown"),
        ("action", {"law_targets": [3]}, "metadata action.law_targets must be a list of texts"),
        ("action", {"law_targets": ["left alpha"]}, "golden.law_targets must be a list, got None"),
        ("action", {"upper_mode": ["residual"]}, "action.upper_mode .* is unknown"),
    ],
)
def test_a_part_of_another_kind_is_named(name, entries, message, policy, policy_file, tmp_path):
    value = json.dumps(getattr(policy.metadata, name) | entries)
    path = _changed(policy_file, tmp_path, lambda proto: _set(proto, name, value))
    with pytest.raises(PolicyError, match=f"(?s)changed.onnx.*{message}"):
        OnnxPolicy(path)


def test_rubbish_and_absence_are_distinguished(tmp_path):
    with pytest.raises(PolicyError, match="does not exist"):
        OnnxPolicy(tmp_path / "none.onnx")
    for rubbish in (b"not onnx at all", b"", bytes(100)):
        (tmp_path / "rubbish.onnx").write_bytes(rubbish)
        with pytest.raises(PolicyError, match=r"cannot be read as ONNX: it is damaged or no ONNX file$"):
            OnnxPolicy(tmp_path / "rubbish.onnx")


def test_one_command_times_inference_without_torch(policy_file, tmp_path, capsys):
    code = "import sys; sys.modules['torch'] = None; from cotap.deployment.policy import main; sys.exit(main())"
    found = subprocess.run([sys.executable, "-c", code, str(policy_file)], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    shown = re.fullmatch(r".*\.onnx: inference ([\d.]+) ms, 99 % within ([\d.]+) ms, one thread\n", found.stdout)
    assert shown, found.stdout
    assert 0.0 < float(shown[1]) <= float(shown[2])  # that it measures and says so; how fast is the machine's affair
    assert timing([str(tmp_path / "no.onnx")]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert timing([]) == 2
