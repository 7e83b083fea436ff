"""How far a hand moves because its torso does: the legs as springs between the ground and the torso.

The paper subtracts this from the compliance asked for at the hand, `C_hat = C_ee - J_eb K_torso^-1 J_eb^T`, and leaves
`K_torso` open. Here it follows from the legs' PD gains: each leg whose foot is on the ground is a chain of springs from
its sole to the pelvis, the legs act in parallel, the waist in series. Feet are taken to stay where they are.
"""

from __future__ import annotations

import torch

from cotap.compliance.arguments import full_precision, symmetric_part


@full_precision
def chain_compliance(
    axes: torch.Tensor, anchors: torch.Tensor, gains: torch.Tensor, point: torch.Tensor
) -> torch.Tensor:
    """Compliance (..., 6, 6) of a chain of hinges: linear [m/N], angular [rad/Nm], of a body at its end, at `point`.

    Args:
        axes: (..., n, 3) joint axes.
        anchors: (..., n, 3) points on them [m].
        gains: (..., n) position gains [Nm/rad].
        point: (..., 3) where the body's velocity is taken [m]; all in one frame.
    """
    arm = point.unsqueeze(-2) - anchors
    twist = torch.cat((torch.linalg.cross(axes, arm), axes), -1)  # (..., n, 6)
    return twist.transpose(-1, -2) @ (twist / gains.unsqueeze(-1))


@full_precision
def parallel(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Compliance (..., k, k) of two springs between the same bodies; either may be rigid in some directions."""
    total = a + b
    # Directions that neither yields in stay rigid.
    size = torch.diagonal(total, dim1=-2, dim2=-1).mean(-1)[..., None, None]
    inverse = torch.linalg.pinv(total / size, rtol=1e-6, hermitian=True) / size
    return symmetric_part(a @ inverse @ b)


def torso_compliance(legs: torch.Tensor, waist: torch.Tensor, contact: torch.Tensor) -> torch.Tensor:
    """Compliance (N, 6, 6) of the torso against the ground, for robots with two legs.

    Args:
        legs: (N, 2, 6, 6) of each leg from its sole to the pelvis, taken at the torso's origin.
        waist: (N, 6, 6) of the waist, likewise.
        contact: (N, 2) bool, which feet are on the ground.

    In flight nothing holds the torso, and no stiffness against the ground exists: the result is zero there, which makes
    the hand's stiffness one against the torso.
    """
    left, right = contact[:, 0, None, None], contact[:, 1, None, None]
    one = torch.where(left, legs[:, 0], legs[:, 1])
    support = torch.where(left & right, parallel(legs[:, 0], legs[:, 1]), one) + waist
    return torch.where(left | right, support, torch.zeros_like(support))


@full_precision
def hand_base_compliance(torso: torch.Tensor, lever: torch.Tensor) -> torch.Tensor:
    """`J_eb C_torso J_eb^T`, (N, A, 3, 3): how far hands move with the torso that carries them [m/N].

    Args:
        torso: (N, 6, 6) the torso's compliance at its origin.
        lever: (N, A, 3) [m], in the same frame.
    """
    x, y, z = lever.unbind(-1)
    zero = torch.zeros_like(x)
    # v + w x r = v - [r] w
    minus_skew = torch.stack((zero, z, -y, -z, zero, x, y, -x, zero), -1).unflatten(-1, (3, 3))
    eye = torch.eye(3, dtype=lever.dtype, device=lever.device).expand_as(minus_skew)
    jacobian = torch.cat((eye, minus_skew), -1)
    return jacobian @ torso.unsqueeze(1) @ jacobian.transpose(-1, -2)
