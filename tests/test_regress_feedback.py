"""The search over linear terms: what each term does to the legs, and that the regression finds what was put in."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import regress_feedback as rf

from cotap.envs import H1Env, H1EnvConfig
from cotap.envs.commands import Command, CommandConfig

N = 40


def env_with(**commands: float) -> H1Env:
    cfg = H1EnvConfig(num_envs=N, num_threads=1)
    cfg.commands = CommandConfig(**commands)
    return H1Env(cfg)


@pytest.fixture(scope="module")
def plain() -> H1Env:
    return env_with()


@pytest.fixture
def inputs(plain) -> tuple:
    """Random inputs of `JointTargets`, every second world walking, leaning by up to 0.2."""
    rng = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng)

    stand = (torch.arange(N) % 2).float()
    height = torch.full((N,), plain.spec.nominal_height_m)
    command = Command(0.5 * normal(N, 2), 0.3 * normal(N), stand, height, torch.rand(N, generator=rng))
    gravity = torch.nn.functional.normalize(torch.cat((0.1 * normal(N, 2), -torch.ones(N, 1)), 1), dim=1)
    joints = plain.joint_targets.default + 0.1 * normal(N, 19)
    return normal(N, 19), command, joints, normal(N, 19), gravity, normal(N, 3), 0.1 * normal(N, 8)


def change(plain: H1Env, inputs: tuple, values: dict[str, float]) -> torch.Tensor:
    """What terms with these values in all worlds add to the joint targets, (N, J)."""
    terms = rf.terms_of(plain)
    names = [t.name for t in terms]
    z = torch.zeros(N, len(terms))
    for name, value in values.items():
        z[:, names.index(name)] = value
    return rf.Perturbed(plain, terms, z)(*inputs) - plain.joint_targets(*inputs)


def test_terms_of_nothing_are_nothing(plain, inputs):
    assert not change(plain, inputs, {}).any()


def test_standing_robots_and_arms_are_left_alone(plain, inputs):
    terms = rf.terms_of(plain)
    assert len({t.name for t in terms}) == len(terms) == 31
    z = torch.randn(N, len(terms), generator=torch.Generator().manual_seed(2))
    z[:, [t.kind for t in terms].index("waist")] = 0.0
    added = rf.Perturbed(plain, terms, z)(*inputs) - plain.joint_targets(*inputs)
    stands = inputs[1].stand > 0.5
    assert not added[stands].any()
    assert not added[:, 10:].any()
    assert (added[~stands][:, :10] != 0.0).all()


@pytest.mark.parametrize(
    ("term", "field", "deviation"),
    [
        ("damping hip_roll", "step_roll_damping_s", rf.DAMPING_S),
        ("damping hip_yaw", "step_twist_damping_s", rf.DAMPING_S),
        ("feet apart", "step_apart_m", rf.APART_M),
        ("held back", "step_hold_back_m", rf.HOLD_BACK_M),
        ("lift under a lean", "step_catch_lift", rf.CATCH_LIFT),
        ("offset knee", "step_straighten_rad", -rf.OFFSET_RAD),
    ],
)
def test_a_term_is_what_the_setting_of_its_name_does(plain, inputs, term, field, deviation):
    """Settings come with code of their own; a value found here is set there."""
    size = 1.0 if deviation > 0.0 else -1.0
    expected = env_with(**{field: abs(deviation)}).joint_targets(*inputs) - plain.joint_targets(*inputs)
    assert expected.abs().max() > 1e-4
    torch.testing.assert_close(change(plain, inputs, {term: size}), expected, atol=1e-6, rtol=0)


def test_gains_scale_actions_and_the_waist_follows_the_spin(plain, inputs):
    action, command, *_, rate, _ = inputs
    added = change(plain, inputs, {"gain knee": 2.0, "waist wz": 1.0})
    knee, waist = plain.spec.indices(["left_knee", "right_knee"]), plain.spec.indices(["torso"])[0]
    walks = 1.0 - command.stand
    torch.testing.assert_close(
        added[:, knee], walks[:, None] * 2.0 * rf.GAIN * 0.25 * action[:, knee], atol=1e-6, rtol=0
    )
    torch.testing.assert_close(added[:, waist], rf.WAIST_S * (rate[:, 2] - command.yaw_rate), atol=1e-6, rtol=0)


def test_feedback_goes_to_the_leg_that_it_names(plain, inputs):
    _, command, _, _, gravity, *_ = inputs
    standing = change(plain, inputs, {"standing ankle gx": 1.0})
    swinging = change(plain, inputs, {"swinging ankle gx": 1.0})
    ankles = plain.spec.indices(["left_ankle", "right_ankle"])
    walks = command.stand < 0.5
    both = (standing + swinging)[walks][:, ankles]
    expected = (rf.PER_TILT_RAD * gravity[walks, :1]).expand(-1, 2)
    torch.testing.assert_close(both, expected, atol=1e-6, rtol=0)
    # Left and right are half a stride apart; in the last tenth of the stride the first foot swings.
    late = walks & (command.phase > 0.9)
    assert late.any()
    assert swinging[late][:, ankles[0]].abs().min() > 0.0
    assert not standing[late][:, ankles[0]].any()
    assert not swinging[late][:, ankles[1]].any()


def test_the_regression_finds_what_was_put_in():
    rng = np.random.default_rng(0)
    z = rng.standard_normal((20000, 3))
    y = 0.3 + 0.02 * z[:, 0] - 0.01 * z[:, 1] ** 2 + 0.1 * rng.standard_normal(20000)
    y[::7] = np.nan
    fit = rf.regress(z, y)
    assert fit.at_zero == pytest.approx(0.3, abs=5e-3)
    np.testing.assert_allclose(fit.linear, [0.02, 0.0, 0.0], atol=4 * fit.linear_error.max())
    np.testing.assert_allclose(fit.squared, [0.0, -0.01, 0.0], atol=4 * fit.squared_error.max())
    # The error of a mean over 17,143 numbers that spread by 0.1; of squares, by the root of two less.
    np.testing.assert_allclose(fit.linear_error, 0.1 / np.sqrt(17142), rtol=0.03)
    np.testing.assert_allclose(fit.squared_error, 0.1 / np.sqrt(2 * 17142), rtol=0.05)


def test_too_few_worlds_are_refused_by_name():
    with pytest.raises(ValueError, match="7 coefficients take more worlds than 6"):
        rf.regress(np.ones((6, 3)), np.ones(6))


@pytest.mark.parametrize("trials", ["impact", "commands"])
def test_from_the_command_line(trials, tmp_path, capsys):
    out = tmp_path / "found.json"
    force = ["--hand-force", "20"] if trials == "commands" else []
    args = ["--trials", trials, *force, "--worlds", "40", "--runs", "2", "--seconds", "5", "--threads", "1"]
    assert rf.main([*args, "--output", str(out)]) == 0
    shown = capsys.readouterr()
    assert "80 worlds" in shown.out
    assert "| lift under a lean | 0.25 |" in shown.out
    assert "after 1 of 2 batches: 63 coefficients take more worlds than 40" in shown.err
    found = json.loads(out.read_text())
    assert found["worlds"] == 80
    assert len(found["terms"]) == len(found["fits"]["falls"]["linear"]) == 31
    assert set(found["fits"]) == {"falls"} | (set(rf.MEASURES) if trials == "commands" else set())
