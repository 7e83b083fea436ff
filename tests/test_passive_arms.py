"""The bench on which adversaries try the energy store: its arms move by Lagrange's equation and keep their energy."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from cotap.compliance.dynamics import joint_inertia
from cotap.compliance.interface import TorqueLaw
from cotap.compliance.laws import LawConfig
from cotap.robots import ROBOTS
from cotap.robots.chains import arm_model
from reports import passive_arms
from reports.arm_motion import Motion, Pulled, rates


@pytest.fixture(params=sorted(ROBOTS))
def pulled(request, rng):
    """Arms of a robot, under a stiff law and a force on each hand, already moving."""
    spec = ROBOTS[request.param]()
    arms = arm_model(spec).to(torch.float64)
    shape = (3, *arms.kp.shape)
    root = torch.randn(*shape, shape[-1], generator=rng, dtype=torch.float64)
    eye = torch.eye(shape[-1], dtype=torch.float64)
    stiffness = 2.0 * root @ root.transpose(-1, -2) + 5.0 * eye
    angle = 0.4 + 0.2 * torch.randn(shape, generator=rng, dtype=torch.float64)
    law = TorqueLaw(
        angle, 99.0 * torch.ones_like(angle), 2.0 * torch.randn(shape, generator=rng, dtype=torch.float64), stiffness,
        0.005 * stiffness,
    )  # fmt: skip
    force = 15.0 * torch.randn(*shape[:2], 3, generator=rng, dtype=torch.float64)
    speed = torch.randn(shape, generator=rng, dtype=torch.float64)
    return arms, law, force, Motion(angle, _times(inertia(arms, angle), speed))


def inertia(arms, angle):
    return joint_inertia(arms.inertias, arms.chains.pose(angle))


def _times(matrix, vector):
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def acceleration(arms, law, force, angle, speed):
    """By `M q'' + M' q' - 1/2 d(q'^T M q')/dq = tau`, derivatives of M by central differences."""
    step, along, gradient = 1e-5, torch.zeros_like(inertia(arms, angle)), torch.zeros_like(angle)
    for joint in range(angle.shape[-1]):
        nudge = torch.zeros_like(angle)
        nudge[..., joint] = step
        slope = (inertia(arms, angle + nudge) - inertia(arms, angle - nudge)) / (2.0 * step)
        along = along + speed[..., joint, None, None] * slope
        gradient[..., joint] = 0.5 * (speed * _times(slope, speed)).sum(-1)
    jacobian = arms.chains.jacobian(arms.chains.pose(angle))
    torque = law.elastic - _times(law.stiffness, angle - law.anchor) - _times(law.damping, speed)
    torque = torque + _times(jacobian.transpose(-1, -2), force)
    return torch.linalg.solve(inertia(arms, angle), torque + gradient - _times(along, speed))


def by_runge_kutta(arms, law, force, angle, speed, seconds, steps):
    h = seconds / steps
    for _ in range(steps):
        k, slopes = (torch.zeros_like(angle), torch.zeros_like(speed)), []
        for share in (0.0, 0.5, 0.5, 1.0):
            at = angle + share * h * k[0], speed + share * h * k[1]
            k = at[1], acceleration(arms, law, force, *at)
            slopes.append(k)
        angle, speed = (
            x + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
            for x, (a, b, c, d) in zip((angle, speed), zip(*slopes, strict=True), strict=True)
        )
    return angle, speed


def test_arms_move_by_lagranges_equation(pulled):
    """And the error falls fourfold with half the step."""
    arms, law, force, start = pulled
    angle, speed = by_runge_kutta(arms, law, force, start.angle, rates(arms, start), 0.02, 40)
    off = []
    for steps in (20, 40):
        motion = start
        for _ in range(steps):
            motion = Pulled(arms, law, force).after(motion, 0.02 / steps)
        off.append(float((motion.angle - angle).abs().max()))
    assert off[1] < 5e-5
    assert off[1] < 0.35 * off[0]
    torch.testing.assert_close(rates(arms, motion), speed, rtol=0, atol=5e-3)
    assert float((angle - start.angle).abs().max()) > 0.01


@pytest.mark.parametrize("seconds", [0.02, 0.005])
def test_energy_changes_by_the_work_of_force_and_damping_alone(pulled, seconds):
    arms, law, force, motion = pulled
    tip = arms.chains.pose(motion.angle).tip
    for _ in range(8):
        after = Pulled(arms, law, force).after(motion, seconds)
        moved = after.angle - motion.angle
        lost = (moved * _times(law.damping, moved)).sum(-1) / seconds
        reached = arms.chains.pose(after.angle).tip
        work = (force * (reached - tip)).sum(-1)
        torch.testing.assert_close(own_energy(arms, law, after), own_energy(arms, law, motion) + work - lost,
                                   rtol=0, atol=1e-10)  # fmt: skip
        assert float(work.abs().max()) > 1e-3
        motion, tip = after, reached


def own_energy(arms, law, motion):
    """(N, A) of motion and spring."""
    speed, error = rates(arms, motion), law.anchor + torch.linalg.solve(law.stiffness, law.elastic) - motion.angle
    kinetic = 0.5 * (speed * _times(inertia(arms, motion.angle), speed)).sum(-1)
    rest = torch.linalg.solve(law.stiffness, law.elastic)
    return kinetic + 0.5 * (error * _times(law.stiffness, error)).sum(-1) - 0.5 * (rest * law.elastic).sum(-1)


def test_a_step_that_cannot_be_solved_is_said(pulled):
    arms, law, force, motion = pulled
    with pytest.raises(ArithmeticError, match="steps of 5 s are too long for this arm: raise --substeps"):
        Pulled(arms, law, force).after(motion, 5.0)


@pytest.mark.parametrize(("factor", "met"), [(1.0, 1.0), (0.2, 1.0), (5.0, 0.0)])
def test_the_rate_condition_allows_to_soften_and_not_to_stiffen_at_once(pulled, factor, met):
    arms, law, _, motion = pulled
    bench = passive_arms.Bench(arms, LawConfig("cotap"), motion.angle, passive_arms.Options())
    after = replace(law, stiffness=factor * law.stiffness)
    assert bench._meets(arms.chains.pose(motion.angle), after, law).tolist() == [met] * law.anchor[..., 0].numel()


def test_a_step_too_long_ends_the_report_with_what_was_measured(tmp_path, monkeypatch, capsys):
    def measure(robot, damping, options):
        if damping == "critical":
            raise ArithmeticError("steps are too long")
        return {"robot": robot, "exciters": options.exciters}

    monkeypatch.setattr(passive_arms, "measure", measure)
    assert passive_arms.main(["--robots", "h1", "--dampings", "pd", "critical", "--output", str(tmp_path)]) == 2
    assert "error: steps are too long" in capsys.readouterr().err
    content = json.loads((tmp_path / "passive_arms.json").read_text())
    assert content["rows"] == {"H1, pd": {"robot": "h1", "exciters": 2000}}
    assert "output" not in content["settings"]


@pytest.mark.slow
def test_the_store_holds_and_without_it_the_same_exciters_draw_more(tmp_path):
    args = ["--robots", "h1", "--dampings", "pd", "--exciters", "60", "--generations", "2", "--seconds", "1.6"]
    assert passive_arms.main([*args, "--output", str(tmp_path)]) == 0
    row = json.loads((tmp_path / "passive_arms.json").read_text())["rows"]["H1, pd"]
    assert row["joints"] == 4
    assert row["episodes"] == 120
    assert row["lowest_store"] >= 0.0
    assert 0.0 < row["largest"] <= row["first_filling"] + 1e-9
    assert row["largest_without"] > max(2.0 * row["largest"], row["first_filling"])
    assert row["by_command"]["constant"]["largest_without"] < 0.2 * row["largest_without"]
    assert 0.5 < row["rate_condition_met"] < 1.0
    assert "| H1, pd | 120 |" in (tmp_path / "passive_arms.md").read_text()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--robots", "h2"), "robots 'h2' is unknown"),
        (("--dampings", "none"), "dampings 'none' is unknown"),
        (("--exciters", "3"), "exciters must"),
        (("--generations", "0"), "generations must"),
        (("--seconds", "0"), "seconds must"),
    ],
)
def test_bad_options_are_named_and_nothing_is_written(tmp_path, capsys, args, message):
    assert passive_arms.main([*args, "--output", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
