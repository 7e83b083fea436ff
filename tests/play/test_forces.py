"""Forces as people make them, against hand-worked numbers."""

from __future__ import annotations

import math

import torch

from cotap.play.forces import DRAG_N, DRAG_N_M, PUSHES, HandForces, Push

HANDS = torch.zeros(2, 2, 3)
UPRIGHT = torch.eye(3).repeat(2, 1, 1)


def test_a_push_acts_on_its_hand_of_every_robot_for_its_time():
    loads = HandForces(2, ("left", "right"), 0.02)
    loads.push(Push("right", (0.0, 30.0, 0.0), 0.1))
    forces = torch.stack([loads.step(HANDS, UPRIGHT) for _ in range(7)])
    assert torch.equal(forces[:5, :, 1], torch.tensor([0.0, 30.0, 0.0]).expand(5, 2, 3))
    assert not forces[5:].any()
    assert not forces[:, :, 0].any()


def test_held_loads_and_pushes_add_up_and_the_oldest_push_gives_way():
    loads = HandForces(1, ("left", "right"), 0.02)
    loads.held_h[0] = torch.tensor([0.0, 0.0, -10.0])
    for i in range(PUSHES + 1):
        loads.push(Push("left", (float(2**i), 0.0, 0.0), 1.0))
    force = loads.step(HANDS[:1], UPRIGHT[:1])
    assert force[0, 0].tolist() == [2.0 ** (PUSHES + 1) - 2.0, 0.0, -10.0]  # all but the first
    loads.clear()
    assert loads.step(HANDS[:1], UPRIGHT[:1])[0, 0].tolist() == [0.0, 0.0, -10.0]


def test_a_dragged_hand_is_pulled_to_where_it_is_dragged_in_its_own_frame_and_no_harder_than_allowed():
    loads = HandForces(2, ("left", "right"), 0.02)
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # heading along world y
    loads.drag_w[1][0] = (0.0, 0.1, 0.0)
    force = loads.step(HANDS, torch.stack((torch.eye(3), quarter)))
    assert torch.allclose(force[1, 0], torch.tensor([0.1 * DRAG_N_M, 0.0, 0.0]), atol=1e-5)
    assert not force[0].any()
    assert not force[1, 1].any()
    loads.drag_w[1][0] = (30.0, 40.0, 0.0)
    assert math.isclose(float(loads.step(HANDS, UPRIGHT)[1, 0].norm()), DRAG_N, rel_tol=1e-5)
