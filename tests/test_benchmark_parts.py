"""benchmarks.training: its parts run, step after step, and do what they are to time."""

from __future__ import annotations

import pytest
import torch

from benchmarks import training
from cotap.compliance.laws import LAWS


def run(part: training.Compliance, steps: int) -> None:
    for _ in range(steps):
        part.once()


@pytest.mark.parametrize("law", LAWS)
def test_every_law_can_be_timed(law):
    part = training.Compliance(3, 0.0, law)
    run(part, 3)
    assert part.step == 3
    assert not part.fresh.any()


@pytest.mark.parametrize("kind", [training.InverseKinematics, training.LiteralCompliance])
def test_what_laws_are_compared_with_can_be_timed(kind):
    run(kind(3, 0.0), 2)


def test_stores_that_are_timed_hold_changes_back():
    part = training.Compliance(32, 0.0, passive=True)
    run(part, 60)
    assert 0.01 < part.held / part.step < 0.5
    spread = part.stiffness.amax(0) / part.stiffness.amin(0)
    torch.testing.assert_close(spread, torch.full_like(spread, 16.0), rtol=0.05, atol=0)
