"""Fidelity over poses: sums by hand, and arms alone against what statics says."""

from __future__ import annotations

import json

import pytest
import torch

from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.evaluate import main
from cotap.evaluation.fidelity import Fidelity, FidelityResult, conditions, library_poses, measure, plot, summary, table
from cotap.evaluation.law_options import LawOptions
from cotap.evaluation.rollout import idle


def result(**changes: torch.Tensor) -> FidelityResult:
    fields = {
        "axis": torch.tensor([0, 0, 1, 1, 2, 2]),
        "pose": torch.tensor([0, 1, 0, 1, 0, 1]),
        "stiffness": torch.full((6,), 200.0),
        "way": torch.tensor([1.0, 1.0, 0.5, 0.5, 1.0, 9.0]),
        "fell": torch.tensor([False] * 5 + [True]),
        "unholdable": torch.tensor([False] * 6),
        "touching": torch.tensor([False] * 6),
        "saturated": torch.tensor([True] + [False] * 5),
    }
    return FidelityResult(**(fields | changes))


def test_errors_by_hand():
    """Twice too stiff along y; who falls or could not hold the load does not count."""
    out = summary(result(), 0.8, Fidelity(stiffness_values=(200.0,)))
    assert [row["error"] for row in out["fidelity"]] == pytest.approx([0.0, 1.0, 0.0])
    assert [row["n"] for row in out["fidelity"]] == [2, 2, 1]
    assert out["largest_error"] == pytest.approx(1.0)
    assert out["metrics"]["stiffness_error"]["mean"] == pytest.approx(2.0 / 5.0)
    assert out["num_saturated"] == 1
    assert out["num_wrong_way"] == 0
    assert out["error_quantiles"] == {"50": 0.0, "95": pytest.approx(1.0)}
    out = summary(result(unholdable=torch.tensor([False, False, True, True, False, False])), 0.8,
                  Fidelity(stiffness_values=(200.0,)))  # fmt: skip
    assert out["fidelity"][1]["error"] is None
    assert out["fidelity"][1]["reason"] == "no env was counted"
    assert out["largest_error"] == 0.0  # of what was measured
    assert out["num_unholdable"] == 2
    content = out | {"num_falls": 1, "num_envs": 6, "protocol": "fidelity", "method": "cotap", "arms": "held"}
    assert "| y | 200 | - |" in table(content)


def test_hands_that_go_against_the_load_are_counted_and_shown(tmp_path):
    """One of two hands along x goes the wrong way, both along y do not move on the mean, z is as it was."""
    way = torch.tensor([1.5, -0.5, 0.5, -0.5, 1.0, 9.0])
    out = summary(result(way=way), 0.8, Fidelity(stiffness_values=(200.0,)))
    assert out["num_wrong_way"] == 2
    assert [row["wrong_way"] for row in out["fidelity"]] == [1, 1, 0]
    assert [row["error"] for row in out["fidelity"]][:2] == [None, None]
    assert out["largest_error"] is None
    mean = out["metrics"]["stiffness_error"]
    assert (mean["mean"], mean["n"]) == (None, 3)
    assert mean["reason"].startswith("2 of 5 hands")
    # Errors 0, 1/3, 1 and two without bound.
    assert out["error_quantiles"] == {"50": pytest.approx(1.0), "95": None}
    content = out | {"num_falls": 1, "num_envs": 6, "protocol": "fidelity", "method": "cotap", "arms": "held"}
    json.dumps(content, allow_nan=False)
    assert "| x | 200 | - | the hand did not go where the load is | 2 | 1 |" in table(content)
    assert "2 hands did not go where the load is" in table(content)
    plot(tmp_path / "plot.png", content)
    assert (tmp_path / "plot.png").stat().st_size > 5000


def test_hands_whose_arm_touches_the_body_are_left_out_and_counted():
    """The hand that is twice too stiff leans on the body: what is left is as it should be."""
    touching = torch.tensor([False, False, True, True, False, False])
    out = summary(result(touching=touching), 0.8, Fidelity(stiffness_values=(200.0,)))
    assert (out["num_touching"], out["largest_error"], out["error_quantiles"]["95"]) == (2, 0.0, 0.0)
    content = out | {"num_falls": 1, "num_envs": 6, "protocol": "fidelity", "method": "cotap", "arms": "held"}
    assert "2 hands whose arm touched the body, left out" in table(content)


def test_intervals_are_over_poses():
    """Twelve equal hands of each of two poses are two figures: a sample has one of them, or both."""
    error = torch.tensor([0.1, 0.5]).repeat_interleave(12)
    way, pose = 1.0 / (1.0 + error), torch.arange(2).repeat_interleave(12)
    fields = {"axis": torch.arange(24) % 3, "stiffness": torch.full((24,), 200.0), "way": way, "pose": pose}
    none = {name: torch.zeros(24, dtype=torch.bool) for name in ("fell", "unholdable", "touching", "saturated")}
    out = summary(result(**fields, **none), 0.8, Fidelity(stiffness_values=(200.0,)))
    assert out["metrics"]["stiffness_error"]["mean"] == pytest.approx(0.3)
    assert out["metrics"]["stiffness_error"]["ci95"] == pytest.approx([0.1, 0.5])
    assert out["error_quantiles_ci95"] == {"50": pytest.approx([0.1, 0.5]), "95": pytest.approx([0.1, 0.5])}


def test_a_quantile_s_interval_is_that_of_order_statistics():
    """Of 400 poses with one hand each: the 95th percentile lies between the 371st and the 388th error, by the
    binomial distribution (380 +- 1.96 x 4.36)."""
    n = 400
    fields = {"axis": torch.zeros(n), "pose": torch.arange(n), "stiffness": torch.full((n,), 200.0),
              "way": 1.0 / (1.0 + torch.arange(1, n + 1) / n)}  # fmt: skip
    none = {name: torch.zeros(n, dtype=torch.bool) for name in ("fell", "unholdable", "touching", "saturated")}
    out = summary(result(**fields, **none), 0.8, Fidelity(stiffness_values=(200.0,)))
    assert out["error_quantiles_ci95"]["95"] == pytest.approx([371.5 / n, 388.5 / n], abs=2.0 / n)


@pytest.mark.slow
@pytest.mark.parametrize(("collision", "touching"), [("full", True), ("feet", False)])
def test_an_arm_inside_the_body_is_found(collision, touching, monkeypatch):
    """A pose of the motion library in which the forearm leans on the pelvis."""
    pose = torch.tensor([[0.11, 0.0, -1.07, 0.16, 0.31, -0.14, 0.65, 0.56]])
    monkeypatch.setattr("cotap.evaluation.fidelity.library_poses", lambda *_: pose)
    protocol = Fidelity(num_envs=3, stiffness_values=(100.0,), pelvis="fixed", settle_seconds=2.0)
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1, collision=collision))
    cfg.upper_body = LawOptions(method="cotap").configure()
    env = HumanoidEnv(cfg)
    found, _ = measure(env, protocol, idle(env))
    assert found.touching.tolist() == [touching] * 3


def test_condition_numbers_are_those_of_mujocos_jacobian(model, spec):
    import mujoco
    import numpy as np

    poses = library_poses(spec)[::2000]
    found = conditions(poses, spec)
    data = mujoco.MjData(model)
    for i, pose in enumerate(poses.numpy()):
        data.qpos[3] = 1.0
        for name, angle in zip(spec.upper_joints, pose, strict=True):
            data.joint(name).qpos[0] = angle
        mujoco.mj_forward(model, data)
        for a, arm in enumerate(spec.arms):
            jac = np.zeros((3, model.nv))
            site = data.site(f"{arm.side}_hand").xpos
            mujoco.mj_jac(model, data, jac, None, site, model.body(arm.hand_body).id)
            expected = np.linalg.cond(jac[:, [model.joint(j).dofadr[0] for j in arm.joints]])
            assert float(found[i, a]) == pytest.approx(expected, rel=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize(("error", "allowed"), [("joint", 0.12), ("task", 0.02)])
def test_arms_alone_are_as_stiff_as_they_are_asked_to_be(error, allowed):
    protocol = Fidelity(num_envs=24, stiffness_values=(300.0,), displacement=0.01, pelvis="fixed")
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(method="cotap", error=error).configure()
    env = HumanoidEnv(cfg)
    found, coverage = measure(env, protocol, idle(env))
    assert 0.3 < coverage <= 1.0
    assert found.counted.sum() >= 4
    assert found.pose.tolist() == [pose for pose in range(8) for _ in range(3)]
    out = summary(found, coverage, protocol)
    assert out["largest_error"] < allowed


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--displacement", "0.2"], "displacement"), (["--num-envs", "0"], "num_envs"),
     (["--method", "pd"], "fidelity needs"),
     (["--library", "nowhere.npz"], "nowhere.npz"), (["--stiffness-values", "0"], "stiffness_values[0]"),
     (["--hand", "both"], "hand 'both' is unknown"), (["--condition", "1.0"], "no pose")],
)  # fmt: skip
def test_bad_options_are_named(options, message, capsys, shipped):  # noqa: ARG001
    assert main(["fidelity", *(["--num-envs", "1"] if "--num-envs" not in options else []), *options]) == 2
    assert message in capsys.readouterr().err
