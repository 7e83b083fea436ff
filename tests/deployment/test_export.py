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
from cotap.agents.checkpoint import load_checkpoint, save_checkpoint, sha256
from cotap.configs import BASE_RECIPES, DISTILL_RECIPES
from cotap.deployment import graph as graph_module
from cotap.deployment.graph import export_policy
from cotap.deployment.metadata import PolicyError
from cotap.deployment.policy import OnnxPolicy, arm_advance
from cotap.deployment.policy import main as timing
from cotap.envs.actions import ActionConfig, JointTargets
from cotap.envs.commands import CommandConfig
from cotap.envs.observations import ObservationHistory, actor_terms
from cotap.evaluation.policy import load_policy, shipped_checkpoint
from cotap.export import main as export

FED_FORWARD = (
    "step_apart_m", "step_clear_m", "step_hold_back_m", "step_catch_lift", "step_roll_damping_s",
    "step_twist_damping_s", "step_straighten_rad", "waist_yield_s", "waist_damping_s",
)  # fmt: skip


@pytest.mark.parametrize(
    "fed_forward",
    [
        dict.fromkeys(FED_FORWARD, 0.0),
        dict(zip(FED_FORWARD, (0.04, 0.4, 0.45, 0.5, 0.02, 0.01, 0.01, 0.05, 0.04), strict=True)),
    ],
)
def test_targets_are_the_environments_while_walking_standing_and_crouching(fed_forward, make_env, tmp_path):
    """The graph must contain all that the environment feeds forward; the arms' advance is added outside."""
    content = load_checkpoint(shipped_checkpoint("base"))
    content["config"]["training"]["env"]["commands"].update(fed_forward)
    content["config"]["training"]["env"]["actions"]["reference_lead_s"] = ActionConfig().reference_lead_s
    save_checkpoint(tmp_path / "apart.pt", content)
    export_policy(tmp_path / "apart.pt", tmp_path / "apart.onnx", checks=20)
    policy = OnnxPolicy(tmp_path / "apart.onnx")
    env = make_env(6, collision="feet", commands=CommandConfig(**fed_forward))
    env.cfg.hand_forces.enabled = False
    env.commands.override(
        torch.tensor([[0.7, 0.0], [-0.4, 0.3], [0.0, 0.0], [0.0, 0.0], [0.3, -0.2], [0.0, 0.0]]),
        torch.tensor([0.0, 0.5, 0.0, 0.0, -0.7, 0.6]),
        torch.tensor([0.0, 0.0, 1.0, 1.0, 0.0, 0.0]),
        torch.tensor([1.02, 1.02, 1.0205, 0.85, 1.02, 1.02]),
    )
    model = load_policy(shipped_checkpoint("base"))
    obs = env.reset()
    stood = 0
    for _ in range(40):
        before = env.motions.current().position.numpy().astype(float)
        seen = obs["policy"].numpy()
        obs, *_ = env.step(model(as_dict(obs)))
        reference = env.motions.current()
        stood += int((env.commands.current().stand > 0.5).sum())
        for i in range(env.num_envs):
            if env.episode_length_buf[i] == 0:
                continue  # restarted within the step
            targets, action = policy(seen[i])
            targets[11:] += arm_advance(
                policy.metadata, before[i], reference.position[i].numpy(), reference.velocity[i].numpy()
            )
            np.testing.assert_allclose(targets, env.targets.current[i].numpy(), atol=1e-5)
            np.testing.assert_allclose(action, env.record.action[i].numpy(), atol=1e-5)
    assert 0 < stood < 40 * env.num_envs  # both were seen


def test_it_runs_where_torch_cannot_be_imported(policy_file, policy):
    script = (
        "import sys; sys.modules['torch'] = None\n"
        "import numpy as np\n"
        "from cotap.deployment.policy import OnnxPolicy\n"
        "policy = OnnxPolicy(sys.argv[1])\n"
        "targets, action = policy(np.linspace(-1.0, 1.0, policy.metadata.observation_width))\n"
        "import json; print(json.dumps([targets.tolist(), action.tolist()]))\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(policy_file)], capture_output=True, text=True, check=True)
    expected = policy(np.linspace(-1.0, 1.0, 430))
    np.testing.assert_allclose(json.loads(done.stdout), np.array(expected), atol=1e-12)


def test_metadata_is_what_a_robot_needs(policy, policy_file, spec):
    m = policy.metadata
    assert m.joints == list(spec.joint_names)
    assert m.kp[m.joints.index("left_knee")] == 200.0
    assert m.kd[m.joints.index("torso")] == 6.0
    assert m.torque_limit_nm[m.joints.index("left_elbow")] == 18.0
    assert m.default_pose_rad[m.joints.index("right_ankle")] == -0.32
    assert m.action_scale_rad[m.joints.index("left_hip_yaw")] == pytest.approx(0.1)
    assert m.action_scale_rad[m.joints.index("left_knee")] == pytest.approx(0.25)
    assert m.control_dt == 0.02
    assert m.agents == {"lower": [0, 11], "upper": [11, 19]}
    assert m.observation_width == 430
    assert m.law["left"]["name"] == "pd"
    assert m.law["ranges"] is None
    assert m.checkpoint_sha256 == sha256(shipped_checkpoint("base"))
    proto = onnx.load(policy_file)
    assert {o.domain: o.version for o in proto.opset_import}[""] == m.opset
    assert [[d.dim_value for d in v.type.tensor_type.shape.dim] for v in proto.graph.input] == [[1, 430]]


def test_a_distilled_policy_says_in_which_ranges_its_law_was_trained(spec, model):
    training = DISTILL_RECIPES["default"](BASE_RECIPES["default"]())
    trained = load_policy(shipped_checkpoint("base"))
    history = ObservationHistory(actor_terms(19, 8), 1, 5)
    targets = JointTargets(training.env.actions, spec, model, training.env.commands)
    law = graph_module.describe(training.env, spec, targets, history, trained.model, "distill", "0" * 64).law
    assert law["left"]["name"] == "cotap"
    assert law["ranges"] == {"stiffness": [80.0, 1200.0], "null_stiffness": [24.0, 56.0], "alpha": [0.0, 1.0]}


def test_phase_is_recovered_at_every_angle(policy):
    """A file whose clock ran backwards, or half a stride late, would swing the wrong leg."""
    m = policy.metadata
    observation = np.zeros(430)
    index = {}
    start = 0
    for name, width, scale in m.observation["terms"]:
        start += width * m.observation["history"]
        index[name] = (start - width, scale)
    observation[index["command_height"][0]] = 2.0 * m.nominal_height_m
    lifts = []
    knees = [m.joints.index("left_knee"), m.joints.index("right_knee")]
    for phase in (0.1, 0.75, 0.29):
        observation[index["sin_phase"][0]] = math.sin(2.0 * math.pi * phase)
        observation[index["cos_phase"][0]] = math.cos(2.0 * math.pi * phase)
        targets, action = policy(observation)
        lifts.append((targets - np.array(m.default_pose_rad) - np.array(m.action_scale_rad) * action)[knees])

    # A foot swings for the last 0.42 of its stride and bends its knee by up to 0.7 rad; the right is half ahead.
    def bump(phase):
        return 0.7 * math.sin(math.pi * max(0.0, (phase % 1.0 - 0.58) / 0.42)) ** 2

    expected = [[bump(p), bump(p + 0.5)] for p in (0.1, 0.75, 0.29)]
    np.testing.assert_allclose(lifts, expected, atol=1e-5)
    assert expected[1][0] > 0.5 > expected[1][1]


def test_a_file_that_differs_from_torch_is_not_kept(policy_file, tmp_path, monkeypatch, capsys):
    def spoil(path, _graph, _metadata):
        proto = onnx.load(policy_file)
        largest = max(proto.graph.initializer, key=lambda t: np.prod(t.dims))
        values = onnx.numpy_helper.to_array(largest).copy()
        values[0] *= -1.0
        largest.CopyFrom(onnx.numpy_helper.from_array(values, largest.name))
        onnx.save(proto, path)

    monkeypatch.setattr(graph_module, "_write_onnx", spoil)
    assert export(["--output", str(tmp_path / "p.onnx"), "--checks", "20"]) == 1
    assert "differ from torch's" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--output", "p.pt"], "must end in .onnx"),
        (["--output", "nowhere/p.onnx"], "folder does not exist"),
        (["--output", "p.onnx", "--checkpoint", "missing.pt"], "'missing.pt' does not exist"),
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


def _widen(proto):
    proto.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 431


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
        (lambda p: _set(p, "format", '"cotap-policy-7"'), "this cotap reads 'cotap-policy-1'"),
        (lambda p: _set(p, "observation", "{}"), "observation lacks 'terms'"),
        (lambda p: _set(p, "joints", '["a"]'), "entries for 1 joints"),
        (lambda p: _set(p, "observation", '{"terms": [["a", 3, 1.0]], "history": 5}'), "its metadata asks for"),
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
        ("stage", None, "metadata stage must be a text"),
        ("joints", ["a"] * 19, "metadata joints must be a list of different names"),
        ("joints", {"a": 1}, "metadata joints must be a list of different names"),
        ("kp", 100.0, "metadata kp must be a list"),
        ("kd", [True] * 19, "kd holds what is not a finite number"),
        ("joint_range_rad", [[0.0]] * 19, r"joint_range_rad must be pairs \[low, high\]"),
        ("action_scale_rad", [9.0] * 19, "do not move by metadata action_scale_rad times"),
        ("action_clip", -1.0, "metadata action_clip must lie in"),
        ("nominal_height_m", "1", "metadata nominal_height_m must be a finite number"),
        ("control_dt", True, "metadata control_dt must be a finite number"),
        ("opset", 2.5, "metadata opset must be a positive integer"),
        ("agents", [0, 11], "metadata agents must be an object"),
        ("agents", {"lower": [11, 0]}, r"metadata agents.lower must be \[first, last \+ 1\]"),
        ("law", {"left": {}, "right": {}, "ranges": {"alpha": [1.0, 0.0]}}, r"law.ranges.alpha must be \[low, high\]"),
        ("law", {"left": {}, "right": {}, "ranges": 3}, "law.ranges must be an object or null"),
        ("commands", 3, "metadata commands must be an object"),
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
        ("arm_action", {"reference_lead_s": "x"}, "arm_action.reference_lead_s must be a finite number, got 'x'"),
        ("arm_action", {"reference_lead_s": -0.1}, "arm_action.reference_lead_s must lie in"),
        ("arm_action", {"mode": "sideways"}, "arm_action.mode 'sideways' is unknown"),
        ("arm_action", {"mode": ["residual"]}, "arm_action.mode .* is unknown"),
    ],
)
def test_a_part_of_another_kind_is_named(name, entries, message, policy, policy_file, tmp_path):
    value = json.dumps(getattr(policy.metadata, name) | entries)
    path = _changed(policy_file, tmp_path, lambda proto: _set(proto, name, value))
    with pytest.raises(PolicyError, match=f"(?s)changed.onnx.*{message}"):
        OnnxPolicy(path)


def test_rubbish_and_absence_are_told_apart(tmp_path):
    with pytest.raises(PolicyError, match="does not exist"):
        OnnxPolicy(tmp_path / "none.onnx")
    (tmp_path / "rubbish.onnx").write_bytes(b"not onnx at all")
    with pytest.raises(PolicyError, match="cannot be read as ONNX"):
        OnnxPolicy(tmp_path / "rubbish.onnx")


def test_one_command_times_inference_without_torch(policy_file, tmp_path, capsys):
    code = "import sys; sys.modules['torch'] = None; from cotap.deployment.policy import main; sys.exit(main())"
    found = subprocess.run([sys.executable, "-c", code, str(policy_file)], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    told = re.fullmatch(r".*base\.onnx: inference ([\d.]+) ms, 99 % within ([\d.]+) ms, one thread\n", found.stdout)
    assert told, found.stdout
    assert 0.0 < float(told[1]) <= float(told[2])  # that it measures and says so; how fast is the machine's affair
    assert timing([str(tmp_path / "no.onnx")]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert timing([]) == 2
