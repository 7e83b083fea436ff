"""What one control step looks like: the row of a trajectory, and what the page draws beside it."""

from __future__ import annotations

import math

import numpy as np
import torch

from cotap.compliance.laws import WITHOUT_STIFFNESS
from cotap.envs import HumanoidEnv
from cotap.evaluation.rollout import trajectory_row

Sample = dict[str, np.ndarray]
"""One step of N robots, (N, ...) each, by the names of `Trajectory` and of `recording.SCENE`."""


def take_sample(
    env: HumanoidEnv, fell: torch.Tensor, laws: list[list[str]], force_h: torch.Tensor, before: Sample
) -> Sample:
    """The step that `env` has just made.

    Of a robot that fell, or whose simulation diverged, it is the step before: the robot stands anew already.

    Args:
        env: N envs.
        fell: (N,) bool from the step's extras.
        laws: [N][H] names of the arms' laws.
        force_h: (N, H, 3) what pulled on the hands [N].
        before: The step before; empty if there was none.
    """
    state = env.record.state
    reference_t = env.record.key_points_reference_t[:, : len(env.spec.arms)]
    jacobian_h = state.torso_to_heading.unsqueeze(1) @ env.reader.arm_chains.jacobian(state.arms)
    stiffness = env.arm_stiffness()
    stiffness = torch.where(fell[:, None, None, None], torch.eye(stiffness.shape[-1]), stiffness)
    jacobian_h = jacobian_h.masked_fill(fell[:, None, None, None], 0.0)  # it may not be finite
    none = [[law in WITHOUT_STIFFNESS for law in row] for row in laws]
    commanded = env.upper_body.parameters.stiffness.masked_fill(torch.tensor(none).unsqueeze(-1), math.nan)
    eigenvalues = torch.linalg.eigvalsh(stiffness)
    scene = {
        "qpos": env.sim.qpos.clone(),
        "hand_w": state.hand_pos_w,
        "hand_reference_w": state.torso_pos_w.unsqueeze(1) + reference_t @ state.torso_rotation_w.transpose(1, 2),
        "hand_force_w": (state.heading_w.unsqueeze(1) @ force_h.unsqueeze(-1)).squeeze(-1),
        "heading_w": state.heading_w,
        "commanded_stiffness": commanded,
        "effective_stiffness": effective_stiffness(jacobian_h, stiffness),
        "stiffness_eigenvalues": eigenvalues[..., [0, -1]],
    }
    absent = torch.full_like(stiffness[..., 0, 0], math.nan)
    scene |= {name: env.upper_body.report.get(name, absent).clone() for name in ("store_energy", "held_back")}
    sample = {name: value.numpy() for name, value in (trajectory_row(env, fell) | scene).items()}
    down = fell.numpy()
    for name in before.keys() - {"fell"} if down.any() else ():
        sample[name] = np.where(down.reshape(-1, *[1] * (sample[name].ndim - 1)), before[name], sample[name])
    return sample


def effective_stiffness(jacobian: torch.Tensor, joint_stiffness: torch.Tensor) -> torch.Tensor:
    """Static stiffness `(J K^-1 J^T)^-1` (..., 3, 3) that a force at the hand meets [N/m], gravity aside.

    Args:
        jacobian: (..., 3, n) of the hand [m/rad].
        joint_stiffness: (..., n, n) symmetric positive definite [Nm/rad].
    """
    j, k = jacobian.double(), joint_stiffness.double()
    compliance = j @ torch.linalg.solve(k, j.transpose(-1, -2))
    # A straight arm does not give along itself at all; a micrometre per newton stands for that.
    rigid = 1e-6 * torch.eye(3, dtype=torch.float64)
    return torch.linalg.inv(compliance + rigid).float()
