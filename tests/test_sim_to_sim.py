"""The comparison of engines: its arithmetic by hand, and one whole small run."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from random_policy import save_random_policy

from cotap.compliance.laws import LawConfig
from cotap.deployment.controller import law_config
from cotap.deployment.engines import EngineConfig
from cotap.deployment.graph import export_policy
from cotap.deployment.policy import OnnxPolicy
from cotap.deployment.robot import Perturbations
from cotap.deployment.safety import SafetyConfig
from cotap.deployment.scenario import Scenario
from cotap.deployment.trial import Trial
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluation.policy import shipped_checkpoint
from cotap.robots import RobotSpec
from reports.paper import engines
from reports.paper.engines import (
    Comparison,
    compare,
    falls,
    figure,
    markdown,
    mean_pose,
    periodic,
    statics,
)
from reports.paper.workers import Workers


@pytest.fixture(scope="module")
def policy_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a policy that has learned nothing."""
    path = tmp_path_factory.mktemp("policy") / "policy.onnx"
    export_policy(save_random_policy(path.with_suffix(".pt")), path, checks=20)
    return path


@pytest.fixture(scope="module")
def policy(policy_file: Path) -> OnnxPolicy:
    return OnnxPolicy(policy_file)


def test_rates_of_falls_have_wilsons_interval():
    """2 of 100: 0.0055 to 0.0700; 0 of 20 still leaves 0.16 open."""
    two = falls([Trial(0.02, fell=i < 2) for i in range(100)])
    assert two["ci95"] == pytest.approx([0.0055, 0.0700], abs=1e-4)
    assert falls([Trial(0.02) for _ in range(20)])["ci95"] == pytest.approx([0.0, 0.1611], abs=1e-4)


def test_trials_that_fell_are_in_no_figure_of_the_hand(spec: RobotSpec):
    """Of two trials one falls, its hands far away: what is reported is that of the other; of none, nothing."""

    def result(*fell: bool) -> dict[str, Any]:
        def run(*asked: Any) -> list[Trial]:
            assert asked[-1].start_error > 0.0  # else all trials would be one
            return [stand(spec, down) for down in fell]

        return periodic(run, spec, Comparison(), UpperBodyConfig())

    one, two, none = result(False), result(False, True), result(True)
    for side, arm in one["arms"].items():
        for name, value in arm.items():
            assert two["arms"][side][name] == pytest.approx(value, rel=1e-5, abs=1e-7)
    assert one["arms"]["left"]["hand_swing_m"] == pytest.approx(0.05, rel=1e-3)
    assert [arm["elbow_torque_nm"] for arm in one["arms"].values()] == pytest.approx([6.0, 6.0], rel=1e-3)
    assert none["arms"]["left"]["hand_swing_m"] is None
    assert two["falls"] == none["falls"] == 1


def test_perturbations_are_what_their_labels_say():
    assert {label: tuple(vars(p).values()) for label, p in engines.PERTURBATIONS.items()} == {
        "none": ((0, 0), 0.0, 0.0, 0.0, 0.0, 0.0),
        "delay of 1 step": ((1, 1), 0.0, 0.0, 0.0, 0.0, 0.0),
        "delay of 2 steps": ((2, 2), 0.0, 0.0, 0.0, 0.0, 0.0),
        "5 % of readings lost": ((0, 0), 0.05, 0.0, 0.0, 0.0, 0.0),
        "encoder noise of 0.01 rad, 0.5 rad/s": ((0, 0), 0.0, 0.01, 0.5, 0.0, 0.0),
        "masses wrong by 20 %": ((0, 0), 0.0, 0.0, 0.0, 0.2, 0.0),
        "start off by 0.05 rad": ((0, 0), 0.0, 0.0, 0.0, 0.0, 0.05),
        "all at once, delay of 1 to 2 steps": ((1, 2), 0.05, 0.01, 0.5, 0.2, 0.05),
    }


def test_orientations_of_either_sign_are_averaged():
    half = math.sqrt(0.5)
    poses = np.array([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.2], [2.0, 0.0, 1.0, -half, 0.0, 0.0, -half, 0.4]])
    quarter = math.pi / 8.0  # the half of 45 degrees about z
    expected = [1.0, 0.0, 1.0, math.cos(quarter), 0.0, 0.0, math.sin(quarter), 0.3]
    np.testing.assert_allclose(mean_pose(poses), expected, atol=1e-12)


def stand(spec: RobotSpec, falls: bool) -> Trial:
    """A robot that stands for 15 s, its hands swinging by 5 cm from 3 s on; or falls at 5 s, its hands 1 m off."""
    trial, arms, joints = Trial(0.02, fell=falls), len(spec.arms), len(spec.upper_joints)
    pose = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, *(j.default_rad for j in spec.joints)])
    for k in range(750):
        down = falls and k >= 250
        height = -0.05 if k >= 150 and k < 350 else 0.05 * math.sin(2.0 * math.pi * 0.02 * k / 4.0) * (k >= 350)
        offset = torch.zeros(1, arms, 3, dtype=torch.float64)
        offset[..., 2] = -1.0 if down else height
        row = {name: torch.zeros(1) for name in ("height", "height_command", "path_error")}
        row["stand"] = torch.zeros(1, dtype=torch.bool)
        row |= {name: torch.zeros(1, 3) for name in ("velocity", "command")}
        row |= {name: torch.zeros(1, joints) for name in ("arm_error", "arm_velocity", "arm_static_torque")}
        row["torque_share"] = torch.zeros(1, len(spec.joints))
        row["arm_torque"] = torch.full((1, joints), 6.0 * math.sin(2.0 * math.pi * 0.02 * k / 4.0))
        row |= {name: torch.zeros(1, 2) for name in ("position", "foot_speed", "foot_height")}
        row |= {"foot_contact": torch.ones(1, 2, dtype=torch.bool), "fell": torch.tensor([down])}
        trial.rows.append(row | {"hand_offset": offset, "hand_error": offset.norm(dim=2)})
        trial.qpos.append(pose)
    return trial


def test_statics_is_jacobian_transpose_and_compliance(any_spec, any_model):
    """PD: `J^T F` at the elbow, wherever it is in the arm, and `J kp^-1 J^T` at the hand, by MuJoCo's Jacobian."""
    spec, model = any_spec, any_model
    qpos = np.array([0.0, 0.0, 1.02, 1.0, 0.0, 0.0, 0.0, *(j.default_rad for j in spec.joints)])
    qpos[-5:] += 0.3
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    for arm, (torque, moved) in zip(spec.arms, statics(spec, UpperBodyConfig(), qpos, 30.0), strict=True):
        hand, jacobian = data.body(arm.hand_body), np.zeros((3, model.nv))
        point = hand.xpos + hand.xmat.reshape(3, 3) @ arm.hand_point
        mujoco.mj_jac(model, data, jacobian, None, point, hand.id)
        row = jacobian[2, [model.joint(name).dofadr[0] for name in arm.joints]]
        kp = np.array([spec.joint(name).kp for name in arm.joints])
        assert torque == pytest.approx(30.0 * abs(row[arm.joints.index(spec.body(arm.elbow_body).joint)]), rel=1e-6)
        assert moved == pytest.approx(30.0 * float(row @ (row / kp)), rel=1e-6)


@pytest.mark.slow
def test_a_small_comparison_is_written_whole(tmp_path, monkeypatch):
    policy = tmp_path / "h1-base.onnx"
    export_policy(shipped_checkpoint("h1-base"), policy, checks=20)
    monkeypatch.setattr(engines, "PERTURBATIONS", {"late": Perturbations(delay_steps=(1, 1))})
    cfg = Comparison(("mujoco",), 1, 1, 3, episode_seconds=2.0, timestep=0.01)
    result = json.loads(json.dumps(compare(policy, cfg, 1, tmp_path)))
    load = result["engines"]["mujoco"]["periodic-load"]["arms"]["right"]
    assert load["elbow_torque_nm"] == pytest.approx(load["elbow_torque_statics_nm"], rel=0.1)
    assert "| late | 0 of 1" in markdown(result)
    figure(result, tmp_path / "report.png")
    assert (tmp_path / "report.png").read_bytes().startswith(b"\x89PNG")
    # Again, from what was kept; with another seed, anew.
    monkeypatch.setattr(engines, "periodic", None)
    assert json.loads(json.dumps(compare(policy, cfg, 1, tmp_path))) == result
    with pytest.raises(TypeError):
        compare(policy, replace(cfg, seed=1), 1, tmp_path)


def test_parts_are_run_as_they_ask_and_otherwise_as_the_policy_was_trained(policy, policy_file, tmp_path, monkeypatch):
    asked = []

    class Recorder:
        def __init__(self, *_):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def trials(self, *arguments):
            asked.append(arguments)
            return []

    wrong, laws = Perturbations(drop=0.1), UpperBodyConfig(LawConfig("cotap"))

    def parts(policy, cfg, run):
        del policy, cfg
        return {"a": lambda: {"ran": run(Scenario(1.0), 3)}, "b": lambda: {"ran": run(Scenario(2.0), 4, laws, wrong)}}

    monkeypatch.setattr(engines, "Workers", Recorder)
    monkeypatch.setattr(engines, "_parts", parts)
    result = compare(policy_file, Comparison(engines=("mujoco",), seed=7, timestep=0.002), 1, tmp_path)
    engine, safety = EngineConfig("mujoco", 0.002), SafetyConfig()
    assert asked == [
        ((law_config(policy.metadata), engine, Perturbations(), safety, Scenario(1.0)), 3, 7),
        ((laws, engine, wrong, safety, Scenario(2.0)), 4, 7),
    ]
    assert result["engines"] == {"mujoco": {"a": {"ran": []}, "b": {"ran": []}}}


def a_result() -> dict[str, Any]:
    """Of one engine, made up."""
    fell = {"trials": 20, "falls": 2, "ci95": [0.028, 0.301]}
    some = {"mean": 0.25, "ci95": [0.2, 0.3125]}
    arms = {
        "left": {"elbow_torque_nm": 6.0, "elbow_torque_statics_nm": 5.0, "hand_swing_m": 0.05,
                 "hand_swing_statics_m": None, "torque": [1.0, 3.0]},
        "right": dict.fromkeys(engines.SWINGS),
    }  # fmt: skip
    one = {
        "velocity-tracking": fell | {"metrics": {"e_lin": some}}, "periodic-load": {"time": [0.0, 0.02], "arms": arms},
        "perturbations": {"late": fell},
    }  # fmt: skip
    return {"settings": {"motion": "mixture"}, "engines": {"mujoco": one}}


def test_the_report_has_every_number_in_its_place():
    shown = "0.250 (0.200 to 0.312)"
    rows = [line for line in markdown(a_result()).splitlines() if line and not line.startswith("|---")]
    assert rows == [
        "## Velocity tracking, arms moving (mixture)", "| measure | mujoco |",
        "| trials that fell | 2 of 20 (3 to 30 %) |",
        f"| e_lin | {shown} |",
        "## Periodic load of 30 N, 4 s, both hands, arms held: left alpha 0.7 at 500 N/m, right PD",
        "| engine | arm | elbow torque [Nm] | of it statics | hand swing [m] | of it statics |",
        "| mujoco | left | 6.000 | 5.000 | 0.050 | - |", "| mujoco | right | - | - | - | - |",
        "## Perturbations, arms moving (mixture)", "| what is wrong, fell | mujoco |", "| late | 2 of 20 (3 to 30 %) |",
    ]  # fmt: skip


def test_the_report_says_that_arms_are_held():
    held = markdown(a_result() | {"settings": {"motion": "none"}})
    assert held.count("arms held") == held.count("## ") == 3


def test_arms_move_but_under_the_load(policy):
    counts = {"velocity-tracking": 3, "periodic-load": 5, "perturbations": 4}

    class Asked(Exception):
        pass

    def run(scenario, count, *_, **__):
        raise Asked(scenario.arms.clip, count)

    for motion, clip in (("mixture", "mixture"), ("punch", "punch"), ("none", "")):
        cfg = Comparison(motion=motion, trials=3, perturbed_trials=4, load_trials=5)
        for part, count in counts.items():
            with pytest.raises(Asked) as asked:
                engines._parts(policy, cfg, run)[part]()
            assert asked.value.args == ("" if part.endswith("-load") else clip, count), part


def test_the_figure_draws_torques_about_statics(tmp_path, monkeypatch):
    import matplotlib.pyplot as plt

    result, kept, close = a_result(), [], plt.close
    right = result["engines"]["mujoco"]["periodic-load"]["arms"]["right"]
    right |= {"torque": [0.0, 2.0], "elbow_torque_statics_nm": 7.0}
    monkeypatch.setattr(plt, "close", kept.append)
    figure(result, tmp_path / "x.png")
    (periodic_load,) = kept[0].axes
    drawn = [line.get_ydata() for line in periodic_load.lines]
    np.testing.assert_allclose(drawn, [[0.0, 2.0], [-6.0] * 2, [8.0] * 2, [1.0, 3.0], [-3.0] * 2, [7.0] * 2])
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
    assert periodic_load.get_ylim() == (-13.0, 17.0)
    right["elbow_torque_statics_nm"] = 40.0  # of a stronger robot
    figure(result, tmp_path / "x.png")
    low, high = kept[1].axes[0].get_ylim()
    assert low < -39.0
    assert high > 41.0
    for drawn in kept:
        close(drawn)


@pytest.mark.slow
def test_trials_do_not_depend_on_the_number_of_processes(policy_file):
    wrong = Perturbations(drop=0.1)
    options = (UpperBodyConfig(), EngineConfig(timestep=0.01), wrong, SafetyConfig(), Scenario(0.1))
    found = []
    for jobs in (1, 2):
        with Workers(policy_file, jobs) as workers:
            found.append(workers.trials(options, 3, 5))
    assert len(found[0]) == 3
    for one, other in zip(*found, strict=True):
        assert np.array_equal(one.qpos, other.qpos)
        torch.testing.assert_close(one.rows, other.rows, rtol=0.0, atol=0.0, equal_nan=True)
    assert not np.array_equal(found[0][0].qpos, found[0][1].qpos)


@pytest.mark.parametrize(
    ("fields", "message"),
    [({"engines": ("newton",)}, "engine 'newton' is unknown"), ({"engines": ()}, "at least one engine"),
     ({"trials": 0}, "trials must be a positive integer"), ({"episode_seconds": 1.0}, "episode_seconds must lie in")],
)  # fmt: skip
def test_bad_comparisons_are_named(fields, message):
    with pytest.raises(ValueError, match=message):
        Comparison(**fields).check()


def test_what_trials_cannot_begin_with_is_named(policy_file, tmp_path):
    with pytest.raises(ValueError, match="jobs must lie in"):
        compare(policy_file, Comparison(), -1, tmp_path)
    with pytest.raises(ValueError, match="no clip is called 'moonwalk'"):
        compare(policy_file, Comparison(motion="moonwalk"), 1, tmp_path)
