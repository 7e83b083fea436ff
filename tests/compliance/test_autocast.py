"""Autocast multiplies float32 matrices with three digits. The library does not let it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from cotap.compliance.dynamics import critical_damping
from cotap.compliance.force_estimation import hand_force
from cotap.compliance.interface import ArmState, LawParameters
from cotap.compliance.laws import LAWS, LawConfig
from cotap.compliance.stiffness import project_compliance
from cotap.compliance.torso import chain_compliance, hand_base_compliance, parallel, torso_compliance
from cotap.robots.chains import arm_model


def spd(rng: torch.Generator, *shape: int) -> torch.Tensor:
    """(*shape, n, n) from a shape that ends in n."""
    factor = torch.randn(*shape, shape[-1], generator=rng)
    return factor @ factor.transpose(-1, -2) + torch.eye(shape[-1])


def require_the_same(function: Callable[..., torch.Tensor], *arguments: torch.Tensor) -> None:
    with torch.autocast("cpu", torch.bfloat16):
        inside = function(*arguments)
    assert torch.equal(inside, function(*arguments))


def test_autocast_does_not_change_what_laws_are_made_of(rng):
    require_the_same(critical_damping, spd(rng, 5, 4), spd(rng, 5, 4))
    require_the_same(hand_force, torch.randn(5, 3, 4, generator=rng), torch.randn(5, 4, generator=rng))
    require_the_same(lambda c: project_compliance(c, 2.0)[0], spd(rng, 5, 3))
    axes, anchors, gains, point = (torch.rand(5, *s, generator=rng) + 0.5 for s in ((6, 3), (6, 3), (6,), (3,)))
    require_the_same(chain_compliance, axes, anchors, gains, point)
    require_the_same(parallel, spd(rng, 5, 6), spd(rng, 5, 6))
    require_the_same(torso_compliance, spd(rng, 5, 2, 6), spd(rng, 5, 6), torch.ones(5, 2, dtype=torch.bool))
    require_the_same(hand_base_compliance, spd(rng, 5, 6), torch.randn(5, 2, 3, generator=rng))


@pytest.mark.parametrize("name", LAWS)
def test_autocast_does_not_change_a_law(spec, rng, name):
    arms = arm_model(spec)
    q = 0.5 * torch.randn(5, 2, 4, generator=rng)
    turn, _ = torch.linalg.qr(torch.randn(5, 3, 3, generator=rng))
    base = 1e-4 * torch.eye(3).expand(5, 2, 3, 3)
    fresh = torch.ones(5, 2, dtype=torch.bool)
    state = ArmState(q, 0.1 * q, q + 0.1, arms.chains.pose(q), turn, base, torch.ones(5, 2, 3), 0.1 * q, fresh)
    parameters = LawParameters(torch.full((5, 2, 3), 300.0), torch.full((5, 2), 25.0), torch.full((5, 2), 0.7))

    def torque(position: torch.Tensor) -> torch.Tensor:
        law, _ = LAWS[name](arms, LawConfig(name, error="task"))(state, parameters)
        return law.at(position, state.velocity)

    require_the_same(torque, q + 0.05)
