"""Punches on the arms: one in every stretch of time, of exact impulse."""

from __future__ import annotations

import pytest
import torch

from cotap.envs.punches import PunchConfig, Punches

DT = 0.02


def impulses(cfg: PunchConfig, num_envs: int, seconds: float, seed: int = 0) -> torch.Tensor:
    """Forces (T, N, J, 3) over time."""
    punches, rng = Punches(cfg, num_envs, 8, DT), torch.Generator().manual_seed(seed)
    punches.reset(torch.ones(num_envs, dtype=torch.bool), rng)
    rows = []
    for _ in range(round(seconds / DT)):
        rows.append(punches.current())
        punches.step(rng)
    return torch.stack(rows)


def test_one_punch_per_segment_of_its_length_on_one_joint():
    force = impulses(PunchConfig(600.0, 0.08, 1.0), 50, 4.0)
    for segment in force.split(50):
        on = segment.norm(dim=3) > 0.0
        assert (on.any(0).sum(1) == 1).all()  # one joint
        assert ((on.any(2).sum(0) == 4) | (on.any(2).sum(0) == 5)).all()  # 0.08 s, wherever it begins
        impulse = DT * segment.sum((0, 2)).norm(dim=1)
        assert float(impulse.max()) <= 600.0 * 0.08 + 1e-3


def test_impulses_are_uniform_and_directions_isotropic():
    force = impulses(PunchConfig(600.0, 0.08, 1.0), 3000, 1.0)
    impulse = DT * force.sum((0, 2))
    assert float(impulse.norm(dim=1).mean()) == pytest.approx(24.0, rel=0.05)
    unit = torch.nn.functional.normalize(impulse, dim=1)
    assert float(unit.mean(0).norm()) < 0.05
    assert unit.square().mean(0).tolist() == pytest.approx([1 / 3] * 3, abs=0.03)
    struck = (force.abs().sum((0, 3)) > 0.0).float().mean(0)
    assert struck.tolist() == pytest.approx([1 / 8] * 8, abs=0.03)


def test_no_force_no_punches():
    assert not impulses(PunchConfig(), 5, 1.0).any()


@pytest.mark.parametrize(("field", "value"), [("force_n", -1.0), ("duration_s", -0.1), ("segment_s", 0.05)])
def test_bad_fields_are_named(field, value):
    with pytest.raises(ValueError, match=rf"punches\.{field}"):
        Punches(PunchConfig(**{field: value}), 1, 8, DT)
