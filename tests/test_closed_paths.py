"""Work around closed paths of a hand: springs with a known curl, laws with an energy, and the law that has none."""

from __future__ import annotations

import json
import math

import pytest
import torch

from cotap.compliance.laws import LawConfig
from cotap.robots.chains import arm_model
from reports import closed_paths as script
from reports.led_hands import circles, lead, spring_of

SOFT = (300.0, 300.0, 300.0)


@pytest.fixture
def arms(spec):
    return arm_model(spec).to(torch.float64)


@pytest.fixture
def target(rng) -> torch.Tensor:
    home = torch.tensor([0.1, 0.3, 0.2, 0.3, 0.1, -0.3, -0.2, 0.3], dtype=torch.float64).reshape(1, 2, 4)
    return home + 0.1 * torch.randn(2, 2, 4, generator=rng, dtype=torch.float64)


def led(arms, law, target, rng, radius=0.03, offset=0.02, points=16, reverse=False):
    path = circles(arms.chains.pose(target).tip, radius, offset, points, rng)
    return lead(spring_of(law, arms, target), arms, target, path.flip(0) if reverse else path)


def test_circles_are_closed_round_and_where_they_should_be(rng):
    center = torch.randn(5, 2, 3, generator=rng, dtype=torch.float64)
    path = circles(center, 0.05, 0.1, 12, rng)
    torch.testing.assert_close(path[-1], path[0])
    middle = path[:-1].mean(0)
    torch.testing.assert_close((path - middle).norm(dim=-1), torch.full((13, 5, 2), 0.05, dtype=torch.float64))
    torch.testing.assert_close((middle - center).norm(dim=-1), torch.full((5, 2), 0.1, dtype=torch.float64))


def test_a_spring_with_a_known_curl(arms, target, rng):
    """A hand that is pulled by `([w] + even)(x_target - x)`: around a circle with normal m, `2 pi r^2 w . m`."""
    even = torch.diag(torch.tensor([200.0, 300.0, 500.0], dtype=torch.float64))
    w = torch.tensor([20.0, -30.0, 50.0], dtype=torch.float64)
    curl = torch.linalg.cross(w.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
    tip = arms.chains.pose(target).tip

    def spring(q):
        pose = arms.chains.pose(q)
        jacobian = arms.chains.jacobian(pose)
        force = ((even + curl) @ (tip - pose.tip).unsqueeze(-1)).squeeze(-1)
        null = torch.linalg.pinv(jacobian) @ jacobian
        held = 30.0 * (target - q)
        held = held - (null @ held.unsqueeze(-1)).squeeze(-1)
        return (jacobian.transpose(-1, -2) @ force.unsqueeze(-1)).squeeze(-1) + held

    path = circles(tip, 0.03, 0.02, 24, rng)
    loop = lead(spring, arms, target, path)
    assert loop.found.all()
    torch.testing.assert_close(loop.hand, path, atol=1e-9, rtol=0)
    radius = path - path[:-1].mean(0)
    area = 0.5 * torch.linalg.cross(radius[:-1], radius[1:]).sum(0)  # of the polygon that the trapezoidal rule sees
    torch.testing.assert_close(loop.work(), 2.0 * (area * w).sum(-1), rtol=1e-7, atol=1e-9)
    assert float(area.norm(dim=-1).mean()) == pytest.approx(math.pi * 0.03**2, rel=0.02)
    expected = float(2.0 * curl.norm() / (2.0 * even.norm()))
    torch.testing.assert_close(loop.asymmetry, torch.full_like(loop.asymmetry, expected), rtol=1e-4, atol=0)


@pytest.mark.slow
def test_laws_with_an_energy_give_nothing_away(arms, target, rng):
    for law in (
        LawConfig("pd"), LawConfig("hmc", SOFT, alpha=0.5),
        LawConfig("cotap", SOFT, error="task", condition_threshold=1e9), LawConfig("cotap", SOFT, alpha=0.0),
    ):  # fmt: skip
        loop = led(arms, law, target, rng)
        assert loop.found.all(), law
        assert float(loop.work().abs().max()) < 1e-5, law
        assert float(loop.stored().min()) > 0.01
        assert float(loop.asymmetry.max()) < 1e-4


@pytest.mark.slow
def test_stiffness_on_joint_errors_has_no_energy(arms, target, rng):
    """What is drawn one way is put in the other way, and grows as the area that the path goes around."""
    law = LawConfig("cotap", SOFT)
    state = rng.get_state()
    loop = led(arms, law, target, rng, points=16)
    rng.set_state(state)
    back = led(arms, law, target, rng, points=16, reverse=True)
    rng.set_state(state)
    half = led(arms, law, target, rng, radius=0.015, points=16)
    assert loop.found.all()
    assert float(loop.work().abs().mean()) > 0.01
    torch.testing.assert_close(back.work(), -loop.work(), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(
        loop.work() / half.work(), torch.full((2, 2), 4.0, dtype=torch.float64), rtol=0.2, atol=0
    )
    # The same work in the joints: the spring's torque along them.
    spring = spring_of(law, arms, target)
    torque = torch.stack([spring(q) for q in loop.joints])
    joints = -(0.5 * (torque[1:] + torque[:-1]) * loop.joints.diff(dim=0)).sum((0, -1))
    torch.testing.assert_close(joints, loop.work(), rtol=2e-2, atol=1e-4)


def test_the_task_error_has_the_stiffness_of_the_conservative_congruence(arms, target):
    """`J^T K J - dJ^T/dq f` (Chen and Kao 2000), with next to no stiffness of the null space."""
    law = LawConfig("cotap", SOFT, null_stiffness=0.1, error="task", condition_threshold=1e9)
    q, spring = target + 0.1, spring_of(law, arms, target)
    force = 300.0 * (arms.chains.pose(target).tip - arms.chains.pose(q).tip)
    jacobian = arms.chains.jacobian(arms.chains.pose(q))
    found, geometric = [], []
    for i in range(4):
        for column, of in ((found, spring), (geometric, lambda at: _transposed(arms, at, force))):
            ends = []
            for sign in (-1.0, 1.0):
                moved = q.clone()
                moved[..., i] += sign * 1e-5
                ends.append(of(moved))
            column.append((ends[1] - ends[0]) / 2e-5)
    stiffness, changing = -torch.stack(found, -1), torch.stack(geometric, -1)
    expected = 300.0 * jacobian.transpose(-1, -2) @ jacobian - changing
    torch.testing.assert_close(stiffness, expected, atol=0.3, rtol=0)
    assert float(changing.abs().max()) > 3.0
    torch.testing.assert_close(changing, changing.transpose(-1, -2), atol=1e-6, rtol=1e-6)


def _transposed(arms, q, force):
    jacobian = arms.chains.jacobian(arms.chains.pose(q))
    return (jacobian.transpose(-1, -2) @ force.unsqueeze(-1)).squeeze(-1)


def test_a_path_out_of_reach_is_not_found(arms, target, rng):
    loop = led(arms, LawConfig("pd"), target, rng, radius=0.6, points=12)
    assert not loop.found.any()


def test_paths_that_no_arm_can_follow_are_named(tmp_path, capsys):
    assert script.main(["--poses", "1", "--points", "8", "--radius", "0.5", "--output", str(tmp_path)]) == 2
    assert "PD: no arm comes to rest all along its path" in capsys.readouterr().err


def test_arms_of_every_robot_are_led(monkeypatch):
    monkeypatch.setattr(script, "ROWS", {"PD": LawConfig("pd")})
    options = script.Options(robot="g1", poses=2, points=8, radius=0.02, offset=0.01)
    row = script.measure(options)["rows"]["PD"]
    assert row["drawn"]["n"] > 0
    assert row["largest"] < 1e-3


@pytest.mark.slow
def test_the_script_writes_its_table(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(script, "ROWS", {k: v for k, v in script.ROWS.items() if k == "PD" or "joint error, 300" in k})
    assert script.main(["--poses", "2", "--points", "8", "--radius", "0.02", "--output", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "closed_paths.json").read_text())
    assert content["rows"]["PD"]["largest"] < 1e-3 < content["rows"]["CoTaP, joint error, 300 N/m"]["largest"]
    assert (tmp_path / "closed_paths.md").read_text() == capsys.readouterr().out
    assert script.main(["--points", "3"]) == 2
    assert "points must lie in" in capsys.readouterr().err
    assert script.main(["--robot", "h2"]) == 2
    assert "robot 'h2' is unknown" in capsys.readouterr().err
