"""Why compliance does more on one arm than on another: how near to singular it is, and where its compliance lies."""

from __future__ import annotations

import torch

from cotap.compliance.small_matrices import eigenvalues_3x3, inverse_3x3, plus_diagonal
from cotap.compliance.stiffness import RANK_TOLERANCE
from cotap.envs import HumanoidEnv
from cotap.evaluation.metrics import masked_mean

WORST_CONDITION = 1.0 / RANK_TOLERANCE
"""What larger condition numbers count as: the one from which on pseudo-inverses are damped."""


class ArmWatch:
    """Follows the arms of N envs through the measured steps of a rollout."""

    def __init__(self) -> None:
        self._conditions: list[torch.Tensor] = []
        self._null_shares: list[torch.Tensor] = []
        self._jacobian = torch.zeros(0)
        self._threshold = torch.zeros(0)

    def see(self, env: HumanoidEnv, step: int, measured: range) -> None:
        """Look at the arms just before a step, if it is in `measured` or just behind, where its last step is over."""
        if not measured.start <= step <= measured.stop:
            return
        if step == measured.start:
            self._conditions, self._null_shares = [], []
            cfg = env.cfg.upper_body
            laws = [cfg.built(cfg.of(arm.side)) for arm in env.spec.arms]
            self._threshold = torch.tensor([law.condition_threshold for law in laws])
        else:  # the law has answered to the arms as they were seen last
            self._null_shares.append(null_share(self._jacobian, env.arm_stiffness()).cpu())
        self._jacobian = env.upper_body.arms.chains.jacobian(env.state.arms)
        if step < measured.stop:
            self._conditions.append(condition_number(self._jacobian).cpu())

    def measures(self, alive: torch.Tensor, arms: list[int], suffix: str = "") -> dict[str, torch.Tensor]:
        """Means over these arms and the steps up to a fall, (N,) each; none where nothing was seen.

        Args:
            alive: (T, N) bool: has not fallen, in the measured steps.
            arms: Their indices.
            suffix: Of the measures' names.

        Returns:
            `condition_number` of the hand's Jacobian, at most `WORST_CONDITION`; `singular_share`, the share of time in
            which it is above the law's threshold; `null_share`, see there.
        """
        if not self._null_shares:
            return {}
        condition, share = torch.stack(self._conditions)[..., arms], torch.stack(self._null_shares)[..., arms]
        above = (condition > self._threshold[arms]).float()
        return {
            f"{name}{suffix}": masked_mean(values.mean(2), alive[: len(values)])
            for name, values in (("condition_number", condition), ("singular_share", above), ("null_share", share))
        }


def condition_number(jacobian: torch.Tensor) -> torch.Tensor:
    """Condition number (...) of Jacobians (..., 3, n), at most `WORST_CONDITION`; in closed form, for many at once."""
    j = jacobian.double()
    smallest, _, largest = eigenvalues_3x3((j @ j.mT).movedim((-2, -1), (0, 1)))
    return (largest / smallest.maximum(largest / WORST_CONDITION**2)).sqrt().float()


def null_share(jacobian: torch.Tensor, stiffness: torch.Tensor) -> torch.Tensor:
    """Share (...) of the joints' compliance, the trace of its matrix, that is in motion that leaves the hand where it
    is.

    Args:
        jacobian: (..., 3, n) of the hand's position [m/rad].
        stiffness: (..., n, n) of the joints, positive definite [Nm/rad].
    """
    j = jacobian.double()
    compliance = torch.linalg.inv_ex(stiffness.double()).inverse
    gram = (j @ j.mT).movedim((-2, -1), (0, 1))
    inverse = inverse_3x3(plus_diagonal(gram, 1e-14 * gram.diagonal().sum(-1))).movedim((0, 1), (-2, -1))
    # J# J is the projector on motion that moves the hand.
    of_hand = (inverse * (j @ compliance @ j.transpose(-1, -2))).sum((-1, -2))
    return (1.0 - of_hand / torch.diagonal(compliance, dim1=-2, dim2=-1).sum(-1)).float()
