"""Losses and estimators against numbers worked out by hand, `torch.distributions`, and definitions written as sums."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from cotap.agents.losses import (
    adapt_learning_rate,
    clipped_surrogate,
    clipped_value_loss,
    gaussian_entropy,
    gaussian_kl,
    gaussian_log_prob,
    generalized_advantages,
)


def draw(rng: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def gaussian(mean: torch.Tensor, log_std: torch.Tensor) -> Independent:
    return Independent(Normal(mean, log_std.exp()), 1)


def test_log_prob_agrees_with_torch_distributions(rng):
    value, mean, log_std = draw(rng, 2, 7, 3), draw(rng, 2, 7, 3), draw(rng, 3)
    torch.testing.assert_close(gaussian_log_prob(value, mean, log_std), gaussian(mean, log_std).log_prob(value))


def test_log_prob_by_hand():
    # Two deviations of 1 and 2 standard deviations, standard deviations 1 and 2.
    value, mean = torch.tensor([1.0, 4.0]), torch.zeros(2)
    expected = -0.5 * (1.0 + 4.0) - math.log(2.0) - math.log(2.0 * math.pi)
    assert float(gaussian_log_prob(value, mean, torch.tensor([0.0, math.log(2.0)]))) == pytest.approx(expected)


def test_entropy_agrees_with_torch_distributions(rng):
    log_std = draw(rng, 2, 7, 5)
    torch.testing.assert_close(gaussian_entropy(log_std), gaussian(torch.zeros(5).double(), log_std).entropy())


def test_kl_agrees_with_torch_distributions_in_both_directions(rng):
    p, q = (draw(rng, 2, 7, 3), draw(rng, 3)), (draw(rng, 2, 7, 3), draw(rng, 3))
    torch.testing.assert_close(gaussian_kl(*p, *q), kl_divergence(gaussian(*p), gaussian(*q)))
    torch.testing.assert_close(gaussian_kl(*q, *p), kl_divergence(gaussian(*q), gaussian(*p)))
    assert not torch.allclose(gaussian_kl(*p, *q), gaussian_kl(*q, *p))


def test_kl_of_a_gaussian_from_itself_is_zero(rng):
    p = (draw(rng, 7, 3), draw(rng, 3))
    torch.testing.assert_close(gaussian_kl(*p, *p), torch.zeros(7).double(), atol=1e-14, rtol=0.0)


# With clip 0.2 the ratio is held to [0.8, 1.2], but only where that makes the objective smaller.
SURROGATE = [
    # ratio, advantage, loss, d loss / d log_prob
    (1.5, 2.0, -2.4, 0.0),  # already much likelier, and good: no more to gain
    (1.5, -2.0, 3.0, 3.0),  # much likelier, and bad: full push back
    (0.5, 2.0, -1.0, -1.0),  # much less likely, and good: full pull back
    (0.5, -2.0, 1.6, 0.0),  # already much less likely, and bad: no more to gain
    (1.1, 2.0, -2.2, -2.2),  # inside the range nothing is clipped
    (0.9, -2.0, 1.8, 1.8),
]


@pytest.mark.parametrize(("ratio", "advantage", "loss", "slope"), SURROGATE)
def test_clipped_surrogate_by_hand(ratio: float, advantage: float, loss: float, slope: float):
    old = torch.tensor([-3.0], dtype=torch.float64)
    new = (old + math.log(ratio)).requires_grad_()
    result = clipped_surrogate(new, old, torch.tensor([advantage], dtype=torch.float64), 0.2)
    assert float(result.detach()) == pytest.approx(loss)
    result.backward()
    assert float(new.grad) == pytest.approx(slope)


def test_clipped_surrogate_is_the_mean_over_samples():
    old = torch.zeros(4, dtype=torch.float64)
    new, advantage = torch.tensor([[math.log(r), a] for r, a, _, _ in SURROGATE[:4]], dtype=torch.float64).unbind(1)
    expected = sum(loss for *_, loss, _ in SURROGATE[:4]) / 4
    assert float(clipped_surrogate(new, old, advantage, 0.2)) == pytest.approx(expected)


VALUE = [
    # value, old value, target, loss; clip 0.2
    (1.0, 1.1, 2.0, 1.0),  # a small move: the squared error
    (1.0, 0.5, 2.0, 1.69),  # moved 0.5 towards the target: counted as a move of 0.2, to 0.7
    (3.0, 0.5, 2.0, 1.69),  # overshot: again as if at 0.7, which is further off than 3
    (0.0, 1.0, 2.0, 4.0),  # moved away: the whole error, not that of 0.8
    (0.0, 1.0, -2.0, 7.84),  # moved down towards the target: as if at 0.8
]


@pytest.mark.parametrize(("value", "old", "target", "loss"), VALUE)
def test_clipped_value_loss_by_hand(value: float, old: float, target: float, loss: float):
    arguments = [torch.tensor([x], dtype=torch.float64) for x in (value, old, target)]
    assert float(clipped_value_loss(*arguments, 0.2)) == pytest.approx(loss)


def test_clipped_value_loss_is_the_mean_over_samples():
    value, old, target, loss = torch.tensor(VALUE, dtype=torch.float64).unbind(1)
    torch.testing.assert_close(clipped_value_loss(value, old, target, 0.2), loss.mean())


def test_value_loss_without_clipping_is_the_mean_squared_error():
    value, old, target = torch.tensor([[1.0, -3.0], [0.0, 0.0], [3.0, -2.0]], dtype=torch.float64)
    assert float(clipped_value_loss(value, old, target, 0.0)) == pytest.approx((2.0**2 + 1.0**2) / 2)


def test_advantages_of_three_steps_by_hand():
    rewards, values = torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([[0.5], [1.0], [1.5]])
    last, going = torch.tensor([4.0]), torch.zeros(3, 1, dtype=torch.bool)
    # gamma 0.5, lambda 0.5. Temporal differences: 1 + 0.5 - 0.5 = 1; 2 + 0.75 - 1 = 1.75; 3 + 2 - 1.5 = 3.5.
    # From the end: 3.5; 1.75 + 0.25 * 3.5 = 2.625; 1 + 0.25 * 2.625 = 1.65625.
    result = generalized_advantages(rewards, values, last, going, 0.5, 0.5)
    torch.testing.assert_close(result.flatten(), torch.tensor([1.65625, 2.625, 3.5]))
    # The same, but the episode ends with the second step: its difference is 2 - 1 = 1, and nothing of the third
    # step reaches back beyond it.
    going[1] = True
    result = generalized_advantages(rewards, values, last, going, 0.5, 0.5)
    torch.testing.assert_close(result.flatten(), torch.tensor([1.25, 1.0, 3.5]))


def test_advantages_agree_with_their_definition_as_a_sum(rng):
    steps, envs, agents, gamma, lam = 9, 4, 2, 0.9, 0.8
    rewards, values = draw(rng, steps, envs, agents), draw(rng, steps, envs, agents)
    last = draw(rng, envs, agents)
    dones = torch.rand(steps, envs, 1, generator=rng) < 0.25
    result = generalized_advantages(rewards, values, last, dones, gamma, lam)
    assert bool(dones.any())
    for w in range(envs):
        for a in range(agents):
            for t in range(steps):
                total = 0.0
                for k in range(t, steps):
                    following = float(last[w, a] if k == steps - 1 else values[k + 1, w, a])
                    ended = bool(dones[k, w, 0])
                    delta = float(rewards[k, w, a]) + (0.0 if ended else gamma * following) - float(values[k, w, a])
                    total += (gamma * lam) ** (k - t) * delta
                    if ended:
                        break
                assert float(result[t, w, a]) == pytest.approx(total, abs=1e-12)


def test_each_agent_may_have_a_discount_of_its_own(rng):
    rewards, values, last = draw(rng, 6, 4, 2), draw(rng, 6, 4, 2), draw(rng, 4, 2)
    dones = torch.rand(6, 4, 1, generator=rng) < 0.25
    both = generalized_advantages(rewards, values, last, dones, torch.tensor([0.99, 0.5], dtype=torch.float64), 0.9)
    for a, gamma in enumerate((0.99, 0.5)):
        alone = generalized_advantages(rewards[..., a], values[..., a], last[..., a], dones[..., 0], gamma, 0.9)
        torch.testing.assert_close(both[..., a], alone)


def test_advantages_with_full_trace_are_discounted_returns_less_the_value(rng):
    rewards, values, last = draw(rng, 5, 3), draw(rng, 5, 3), draw(rng, 3)
    result = generalized_advantages(rewards, values, last, torch.zeros(5, 3, dtype=torch.bool), 0.9, 1.0)
    powers = 0.9 ** torch.arange(6, dtype=torch.float64)
    expected = (powers[:5, None] * rewards).sum(0) + powers[5] * last - values[0]
    torch.testing.assert_close(result[0], expected)


RATE = [
    # rate, kl, next; desired 0.01
    (9e-4, 0.021, 6e-4),  # moved too far
    (4e-4, 0.004, 6e-4),  # hardly moved
    (9e-4, 0.019, 9e-4),  # near enough, above
    (9e-4, 0.006, 9e-4),  # near enough, below
    (9e-4, 0.0, 9e-4),  # nothing was learned yet, which says nothing
    (1.2e-5, 1.0, 1e-5),  # never below the floor
    (0.9e-3, 0.001, 1e-3),  # nor above the ceiling
]


@pytest.mark.parametrize(("rate", "kl", "expected"), RATE)
def test_learning_rate_follows_the_policy_change(rate: float, kl: float, expected: float):
    assert adapt_learning_rate(rate, kl, 0.01) == pytest.approx(expected)
