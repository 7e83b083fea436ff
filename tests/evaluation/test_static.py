"""The stiffness asked for is the stiffness felt at the hand: pelvis fixed, over poses, axes and stiffnesses."""

from __future__ import annotations

import json

import pytest
import torch

from cotap.compliance.laws import LawConfig
from cotap.envs import HumanoidEnv, HumanoidEnvConfig
from cotap.envs.upper_body import UpperBodyConfig
from cotap.evaluate import main
from cotap.evaluation.law_options import LawOptions, parse_law
from cotap.evaluation.rollout import idle
from cotap.evaluation.static import StaticResult, StaticStiffness, measure

# Condition numbers of the hand's Jacobian up to 5.
POSES = [
    (0.0, 0.0, 0.0, 0.3),
    (0.2, 0.2, 0.0, 0.0),
    (-0.4, 0.3, 0.3, 0.2),
    (0.3, 0.1, -0.3, -0.3),
    (-0.2, 0.5, 0.4, 0.4),
]


def run(pose, stiffness, force, **laws):
    protocol = StaticStiffness(num_envs=2, force=force, levels=2, arm_pose=pose, settle_seconds=5.0)
    return measured(protocol, LawOptions(method="cotap", stiffness=(stiffness,), **laws))


def prepared(protocol, laws) -> HumanoidEnv:
    cfg = protocol.configure(HumanoidEnvConfig(num_threads=1))
    cfg.upper_body = laws.configure()
    env = HumanoidEnv(cfg)
    protocol.prepare(env)
    return env


def measured(protocol, laws) -> StaticResult:
    env = prepared(protocol, laws)
    return measure(env, protocol, idle(env))


STIFFNESSES = (100.0, 300.0, 500.0, 800.0, 1000.0)


@pytest.mark.slow
@pytest.mark.parametrize(("error", "allowed"), [("joint", 0.05), ("task", 0.01)])
@pytest.mark.parametrize("pose", POSES)
def test_effective_stiffness_is_the_commanded_one(pose, error, allowed):
    """Every stiffness along every axis, in envs of their own, under loads that move the hand by 5 mm."""
    cases = [(axis, k) for axis in range(3) for k in STIFFNESSES]
    # Env 0 has no load; env i has its own.
    protocol = StaticStiffness(num_envs=16, force=(1.0, 1.0, 1.0), levels=16, arm_pose=pose, settle_seconds=12.0)
    env = prepared(protocol, LawOptions(method="cotap", error=error, null_stiffness=25.0))
    env.forces.scripted.amplitude_h[:] = 0.0
    for i, (axis, k) in enumerate(cases, start=1):
        env.forces.scripted.amplitude_h[i, 0, axis] = 0.005 * k
        env.upper_body.parameters.stiffness[i] = k
    result = measure(env, protocol, idle(env))
    assert result.condition <= 5.0
    assert not result.saturated
    for i, (axis, k) in enumerate(cases, start=1):
        felt = 0.005 * k / float(result.displacement[i, axis])
        assert felt == pytest.approx(k, rel=allowed), (axis, k)


@pytest.mark.parametrize(("error", "allowed"), [("joint", 0.05), ("task", 0.01)])
def test_one_pose_one_axis(error, allowed):
    result = run(POSES[0], 300.0, (0.0, 0.0, -1.5), error=error)
    assert result.effective_stiffness()[2] == pytest.approx(300.0, rel=allowed)
    assert result.effective_stiffness()[:2] == [None, None]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "expected"),
    [
        ("joint", {100.0: -0.137, 300.0: -0.127, 500.0: -0.115, 800.0: -0.071, 1000.0: -0.054}),
        ("task", {500.0: -0.1, 800.0: -0.0625, 1000.0: -0.05}),
    ],
)
def test_heavy_load(error, expected):
    """50 N on the left hand, 300 N/m along x and y, elbow at 0.3 rad, no torque limits: as another model of H1 gave."""
    n = 1 + len(expected)
    protocol = StaticStiffness(
        num_envs=n, force=(0.0, 0.0, -1.0), levels=n, settle_seconds=5.0, torque_limit_scale=100.0, arm_pose=POSES[0]
    )
    env = prepared(protocol, LawOptions(method="cotap", stiffness=(300.0,), error=error, null_stiffness=25.0))
    for i, vertical in enumerate(expected, start=1):
        env.forces.scripted.amplitude_h[i, 0, 2] = -50.0
        env.upper_body.parameters.stiffness[i, ..., 2] = vertical
    moved = measure(env, protocol, idle(env)).displacement[1:, 2]
    assert moved.tolist() == pytest.approx(list(expected.values()), rel=0.01)


@pytest.mark.slow
def test_an_asked_for_table_by_axis(checkpoint, tmp_path, capsys):
    out = tmp_path / "static.json"
    arguments = ["static-stiffness", "--checkpoint", str(checkpoint), "--num-envs", "4", "--arm-pose", "0", "0", "0",
                 "0.3", "--method", "cotap", "--stiffness", "200", "400", "800", "--error", "task",
                 "--force", "1", "-2", "4", "--levels", "3", "--settle-seconds", "4", "--threads", "1", "--json",
                 str(out), "--plot", str(tmp_path / "p.png")]  # fmt: skip
    assert main(arguments) == 0
    result = json.loads(out.read_text())
    stiffness = result["effective_stiffness"]
    assert stiffness["commanded"] == [200.0, 400.0, 800.0]
    assert stiffness["measured"] == pytest.approx([200.0, 400.0, 800.0], rel=0.02)
    assert result["displacement"] == pytest.approx([0.005, -0.005, 0.005], rel=0.02)
    assert len(result["curve"]["force"]) == 3
    assert (tmp_path / "p.png").stat().st_size > 5000
    assert "| x | 1 | 0.0050 | 200.0 |" in capsys.readouterr().out


@pytest.mark.slow
def test_the_right_arm_is_the_lefts_mirror_image():
    left = run_hand("left", (0.5, 1.0, -1.0))
    right = run_hand("right", (0.5, -1.0, -1.0))
    torch.testing.assert_close(
        left.displacement[-1] * torch.tensor([1.0, -1.0, 1.0]), right.displacement[-1], atol=2e-5, rtol=0
    )


def run_hand(hand, force):
    protocol = StaticStiffness(num_envs=2, force=force, levels=2, hand=hand, settle_seconds=2.0)
    return measured(protocol, LawOptions(method="cotap"))


def test_arms_of_any_robot_give_way_to_a_load(robot):
    protocol = StaticStiffness(num_envs=4, force=(0.0, 0.0, -5.0), levels=2, settle_seconds=3.0)
    env = HumanoidEnv(protocol.configure(HumanoidEnvConfig(robot, num_threads=1)))
    protocol.prepare(env)
    result = protocol.evaluate(env, idle(env))
    assert result["effective_stiffness"]["commanded"] is None
    assert result["curve"]["displacement"][0] == pytest.approx([0.0] * 3, abs=1e-4)
    assert result["displacement"][2] < -0.002


def test_arms_have_laws_of_their_own():
    options = LawOptions(method="hmc", stiffness=(300.0,), alpha=0.9, left="cotap:alpha=0.5,stiffness=1x2x3")
    cfg = options.configure()
    assert (cfg.left.name, cfg.left.alpha, cfg.left.stiffness) == ("cotap", 0.5, (1.0, 2.0, 3.0))
    assert (cfg.right.name, cfg.right.alpha, cfg.right.stiffness) == ("hmc", 0.9, (300.0,) * 3)
    assert parse_law("left", "soft-pd:soft-gain=20", cfg.left).soft_gain == 20.0
    facet = parse_law("left", "facet:sensing=estimated,virtual-mass=2", cfg.left)
    assert (facet.name, facet.sensing, facet.virtual_mass, facet.stiffness) == (
        "facet",
        "estimated",
        2.0,
        (1.0, 2.0, 3.0),
    )
    matched = "cotap+facet-matched:damping_ratio=0.5,reference_share=0.3"
    shared = LawOptions(error="task", left="cotap", right=matched).configure().right
    assert (shared.damping_ratio, shared.reference_share, shared.error) == (0.5, 0.3, "task")


def test_arms_are_as_trained_unless_options_say_otherwise():
    trained = UpperBodyConfig(LawConfig("cotap", null_stiffness=33.0, damping="pd"), LawConfig("cotap", alpha=0.3))
    trained.torso.model, trained.singularity_ratio, trained.sampling.enabled = "constant", False, True
    kept = LawOptions().configure(trained)
    assert (kept.left, kept.right) == (trained.left, trained.right)
    assert (kept.torso.model, kept.singularity_ratio, kept.sampling.enabled) == ("constant", False, False)
    changed = LawOptions(stiffness=(500.0,), torso_compliance="none", singularity_ratio=True).configure(trained)
    assert (changed.left.stiffness, changed.left.null_stiffness) == ((500.0,) * 3, 33.0)
    assert (changed.torso.model, changed.singularity_ratio) == ("none", True)
    assert LawOptions("cotap").configure(UpperBodyConfig()).left == LawConfig("cotap")  # trained under PD
    assert LawOptions("cotap+facet").configure(trained).left == LawConfig(
        "cotap+facet", null_stiffness=33.0, damping="pd"
    )
    assert LawOptions("hmc").configure(trained).right == LawConfig("hmc", alpha=0.3)
    assert LawOptions(left="cotap:alpha=0.5").configure(trained).left.damping == "pd"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "jazz"], "upper_body.left.name 'jazz' is unknown"),
        (["--left", "jazz"], "--left 'jazz' is unknown"),
        (["--left", "cotap:tempo=3"], "--left field 'tempo' is unknown"),
        (["--left", "cotap:alpha"], "alpha needs a value"),
        (["--left", "cotap:alpha=high"], "alpha must be a number, got 'high'"),
        (["--left", "cotap:alpha=0.1x0.2"], "alpha must be one number"),
        (["--stiffness", "1", "2"], "stiffness must be one number or three"),
        (["--stiffness", "-5"], "stiffness[0] must lie in"),
        (["--alpha", "2"], "upper_body.left.alpha must lie in"),
        (["--force", "0", "0", "0"], "force must not be zero"),
        (["--pelvis", "glued"], "pelvis 'glued' is unknown"),
        (["--hand", "both"], "hand 'both' is unknown"),
        (["--levels", "1"], "levels must lie in"),
        (["--num-envs", "5"], "num_envs must be at least levels"),
        (["--arm-pose", "0", "0"], "arm_pose must have 4 numbers"),
    ],
)
def test_bad_options_are_named(arguments, message, capsys, shipped):  # noqa: ARG001
    assert main(["static-stiffness", *arguments]) == 2
    assert message in capsys.readouterr().err
