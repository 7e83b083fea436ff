"""Arms that are led by hand: motions chosen by name."""

from __future__ import annotations

import pytest
import torch

from cotap.motions.reference import REST, ReferenceConfig, ReferenceMotion

DT = 0.02


def led(m: ReferenceMotion, motion: str, rng: torch.Generator, steps: int = 300) -> torch.Tensor:
    """Positions (T, N, U) of `steps` control steps under the lead of `motion`."""
    m.lead(motion)
    positions = []
    for _ in range(steps):
        m.step(rng)
        positions.append(m.current().position.clone())
    return torch.stack(positions)


def test_arms_are_led_into_a_clip_and_back_without_a_jump(spec, rng):
    m = ReferenceMotion(ReferenceConfig(), spec, 2, DT)
    m.hold(m.default)
    m.step(rng)
    m.reset(torch.tensor([True, False]), rng)
    assert torch.equal(m.current().position, m.default.expand(2, -1))
    clip = m.clips.names[0]
    there = led(m, clip, rng)
    assert torch.allclose(there[-1], m.clips.current(), atol=1e-4)
    assert (there[-1] - m.default).abs().max() > 0.1
    back = led(m, REST, rng)
    assert torch.allclose(back[-1], m.default.expand(2, -1), atol=1e-4)
    assert torch.cat((there, back)).diff(dim=0).abs().max() / DT < 20.0
    m.lead(clip)
    m.reset(torch.tensor([True, False]), rng)
    assert torch.allclose(m.current().position[0], m.clips.current()[0])
    assert m.clips.clip.tolist() == [0, 0]


def test_any_robot_is_led_to_rest_and_an_unknown_motion_is_refused(any_spec, rng):
    m = ReferenceMotion(ReferenceConfig(), any_spec, 3, DT)
    m.reset(torch.ones(3, dtype=torch.bool), rng)
    assert not torch.allclose(m.current().position, m.default.expand(3, -1), atol=0.05)
    assert torch.allclose(led(m, REST, rng)[-1], m.default.expand(3, -1), atol=1e-4)
    with pytest.raises(ValueError, match=r"known: .*rest"):
        m.lead("moonwalk")
