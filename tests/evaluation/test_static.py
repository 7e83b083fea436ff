"""The stiffness asked for is the stiffness felt at the hand: pelvis fixed, over poses, axes and stiffnesses."""

from __future__ import annotations

import json

import pytest
import torch

from cotap.envs import H1Env, H1EnvConfig
from cotap.evaluate import main
from cotap.evaluation.law_options import LawOptions, parse_law
from cotap.evaluation.static import StaticStiffness, measure

# Condition numbers of the hand's Jacobian up to 5.
POSES = [
    (0.0, 0.0, 0.0, 0.3),
    (0.2, 0.2, 0.0, 0.0),
    (-0.4, 0.3, 0.3, 0.2),
    (0.3, 0.1, -0.3, -0.3),
    (-0.2, 0.5, 0.4, 0.4),
]


def run(pose, stiffness, force, **laws):
    protocol = StaticStiffness(force=force, levels=2, arm_pose=pose, settle_seconds=12.0)
    cfg = protocol.configure(H1EnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(method="cotap", stiffness=(stiffness,), **laws).configure()
    return measure(H1Env(cfg), protocol, None)


STIFFNESSES = (100.0, 300.0, 500.0, 800.0, 1000.0)


@pytest.mark.slow
@pytest.mark.parametrize(("error", "allowed"), [("joint", 0.05), ("task", 0.01)])
@pytest.mark.parametrize("pose", POSES)
def test_effective_stiffness_is_the_commanded_one(pose, error, allowed):
    """Every stiffness along every axis, in worlds of their own, under loads that move the hand by 5 mm."""
    cases = [(axis, k) for axis in range(3) for k in STIFFNESSES]
    # World 0 has no load; world i has its own, which `measure` scales by i / 15.
    protocol = StaticStiffness(force=(1.0, 1.0, 1.0), levels=16, arm_pose=pose, settle_seconds=12.0)
    cfg = protocol.configure(H1EnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(method="cotap", error=error).configure()
    env = H1Env(cfg)
    env.scripted.amplitude_h[:] = 0.0
    for i, (axis, k) in enumerate(cases, start=1):
        env.scripted.amplitude_h[i, 0, axis] = 0.005 * k * 15.0 / i
        env.upper_body.parameters.stiffness[i] = k
    result = measure(env, protocol, None)
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


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        ("joint", {100.0: -0.137, 300.0: -0.127, 500.0: -0.115, 800.0: -0.071, 1000.0: -0.054}),
        ("task", {500.0: -0.1, 800.0: -0.0625, 1000.0: -0.05}),
    ],
)
def test_heavy_load(error, expected):
    """50 N on the left hand, 300 N/m along x and y, elbow at 0.3 rad, no torque limits: as another model of H1 gave."""
    protocol = StaticStiffness(
        force=(0.0, 0.0, -1.0), levels=1 + len(expected), settle_seconds=8.0, torque_limit_scale=100.0
    )
    cfg = protocol.configure(H1EnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(method="cotap", stiffness=(300.0,), error=error).configure()
    env = H1Env(cfg)
    for i, vertical in enumerate(expected, start=1):
        env.scripted.amplitude_h[i, 0, 2] = -50.0 * len(expected) / i  # `measure` scales world i by i / worlds
        env.upper_body.parameters.stiffness[i, ..., 2] = vertical
    moved = measure(env, protocol, None).displacement[1:, 2]
    assert moved.tolist() == pytest.approx(list(expected.values()), rel=0.01)


def test_an_asked_for_table_by_axis(tmp_path, capsys):
    out = tmp_path / "static.json"
    arguments = ["static-stiffness", "--method", "cotap", "--stiffness", "200", "400", "800", "--error", "task",
                 "--force", "1", "-2", "4", "--levels", "3", "--threads", "1", "--json", str(out),
                 "--plot", str(tmp_path / "p.png")]  # fmt: skip
    assert main(arguments) == 0
    result = json.loads(out.read_text())
    stiffness = result["effective_stiffness"]
    assert stiffness["commanded"] == [200.0, 400.0, 800.0]
    assert stiffness["measured"] == pytest.approx([200.0, 400.0, 800.0], rel=0.02)
    assert result["displacement"] == pytest.approx([0.005, -0.005, 0.005], rel=0.02)
    assert len(result["curve"]["force"]) == 3
    assert (tmp_path / "p.png").stat().st_size > 5000
    assert "| x | 1 | 0.0050 | 200.0 |" in capsys.readouterr().out


def test_the_right_arm_is_the_lefts_mirror_image():
    left = run_hand("left", (0.5, 1.0, -1.0))
    right = run_hand("right", (0.5, -1.0, -1.0))
    torch.testing.assert_close(
        left.displacement[-1] * torch.tensor([1.0, -1.0, 1.0]), right.displacement[-1], atol=2e-5, rtol=0
    )


def run_hand(hand, force):
    protocol = StaticStiffness(force=force, levels=2, hand=hand, settle_seconds=4.0)
    cfg = protocol.configure(H1EnvConfig(num_threads=1))
    cfg.upper_body = LawOptions(method="cotap").configure()
    return measure(H1Env(cfg), protocol, None)


def test_arms_have_laws_of_their_own():
    options = LawOptions(
        method="cotap", stiffness=(300.0,), alpha=0.9, right="pd", left="cotap:alpha=0.5,stiffness=1x2x3"
    )
    cfg = options.configure()
    assert (cfg.left.name, cfg.left.alpha, cfg.left.stiffness) == ("cotap", 0.5, (1.0, 2.0, 3.0))
    assert (cfg.right.name, cfg.right.alpha) == ("pd", 0.9)
    assert parse_law("left", "soft-pd:soft-gain=20", cfg.left).soft_gain == 20.0
    facet = parse_law("left", "facet:sensing=estimated,virtual-mass=2", cfg.left)
    assert (facet.name, facet.sensing, facet.virtual_mass, facet.stiffness) == (
        "facet",
        "estimated",
        2.0,
        (1.0, 2.0, 3.0),
    )
    shared = LawOptions("cotap+facet-matched", damping_ratio=0.5, reference_share=0.3, error="task").configure().right
    assert (shared.damping_ratio, shared.reference_share, shared.error) == (0.5, 0.3, "task")


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
    ],
)
def test_bad_options_are_named(arguments, message, capsys):
    assert main(["static-stiffness", *arguments]) == 2
    assert message in capsys.readouterr().err
