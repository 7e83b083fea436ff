"""Losses and estimators of clipped-surrogate PPO, as pure functions of tensors."""

from __future__ import annotations

import math

import torch


def gaussian_log_prob(value: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """Log density (...) of a diagonal Gaussian, summed over the last dimension."""
    z = (value - mean) * torch.exp(-log_std)
    return (-0.5 * z.square() - log_std - 0.5 * math.log(2.0 * math.pi)).sum(-1)


def gaussian_entropy(log_std: torch.Tensor) -> torch.Tensor:
    """Entropy (...) of a diagonal Gaussian [nat]."""
    return (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum(-1)


def gaussian_kl(
    mean_p: torch.Tensor, log_std_p: torch.Tensor, mean_q: torch.Tensor, log_std_q: torch.Tensor
) -> torch.Tensor:
    """KL(p || q) (...) of diagonal Gaussians [nat]."""
    variance_ratio = torch.exp(2.0 * (log_std_p - log_std_q))
    distance = (mean_p - mean_q).square() * torch.exp(-2.0 * log_std_q)
    return (log_std_q - log_std_p + 0.5 * (variance_ratio + distance - 1.0)).sum(-1)


def clipped_surrogate(
    log_prob: torch.Tensor, old_log_prob: torch.Tensor, advantage: torch.Tensor, clip: float
) -> torch.Tensor:
    """Mean clipped surrogate loss (scalar), to be minimised (Schulman et al. 2017, eq. 7)."""
    ratio = torch.exp(log_prob - old_log_prob)
    return -torch.minimum(ratio * advantage, ratio.clamp(1.0 - clip, 1.0 + clip) * advantage).mean()


def clipped_value_loss(value: torch.Tensor, old_value: torch.Tensor, target: torch.Tensor, clip: float) -> torch.Tensor:
    """Mean squared value error (scalar), pessimistic about moves of more than `clip`; 0 for any move."""
    if clip == 0.0:
        return (value - target).square().mean()
    clipped = old_value + (value - old_value).clamp(-clip, clip)
    return torch.maximum((value - target).square(), (clipped - target).square()).mean()


def generalized_advantages(
    rewards: torch.Tensor, values: torch.Tensor, last_value: torch.Tensor, dones: torch.Tensor,
    gamma: torch.Tensor | float, lam: float,
) -> torch.Tensor:  # fmt: skip
    """Generalised advantage estimates (T, ...) of a rollout.

    Args:
        rewards: (T, ...), with the bootstrap of time-outs already added.
        values: (T, ...) of the states acted in.
        last_value: (...) of the state after the last step.
        dones: (T, ...) bool, broadcastable: the episode ended with that step.
        gamma: Discount, one number or of each of the last dimension.
        lam: Trace decay.
    """
    advantages = torch.empty_like(rewards)
    following = torch.zeros_like(last_value)
    next_value = last_value
    for t in reversed(range(rewards.shape[0])):
        go_on = (~dones[t]).to(rewards.dtype)
        delta = rewards[t] + gamma * go_on * next_value - values[t]
        following = delta + gamma * lam * go_on * following
        advantages[t] = following
        next_value = values[t]
    return advantages


LOWEST_RATE = 1e-5
"""Adam's steps at this rate hardly move a policy, whatever the gradient."""
_HIGHEST_RATE, _RATE_FACTOR = 1e-3, 1.5
"""A policy whose actions hardly pay reaches the highest; at 3e-3 such a one was found with all hidden units stuck."""


def adapt_learning_rate(rate: float, kl: float, desired_kl: float) -> float:
    """Next learning rate: down when the policy moved more than twice `desired_kl`, up when less than half."""
    if kl > 2.0 * desired_kl:
        return max(LOWEST_RATE, rate / _RATE_FACTOR)
    if 0.0 < kl < 0.5 * desired_kl:
        return min(_HIGHEST_RATE, rate * _RATE_FACTOR)
    return rate
