"""The algebra of stiffness matrices, against closed forms, scipy and finite differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
import torch

from cotap.compliance import log_euclidean_mean, modulate_stiffness, spd_exp, spd_log

DOUBLE = torch.float64


def random_spd(rng, *shape: int, n: int = 4, spread: float = 3.0) -> torch.Tensor:
    """(*shape, n, n) with eigenvalues between e^-spread and e^spread, times 100."""
    q, _ = torch.linalg.qr(torch.randn(*shape, n, n, dtype=DOUBLE, generator=rng))
    values = 100.0 * torch.exp(spread * (2.0 * torch.rand(*shape, n, dtype=DOUBLE, generator=rng) - 1.0))
    return (q * values.unsqueeze(-2)) @ q.transpose(-1, -2)


def test_logarithm_and_exponential_against_scipy(rng):
    for matrix in random_spd(rng, 20):
        np.testing.assert_allclose(spd_log(matrix), scipy.linalg.logm(matrix.numpy()), atol=1e-10)
        small = spd_log(matrix)
        np.testing.assert_allclose(spd_exp(small), scipy.linalg.expm(small.numpy()), rtol=1e-9, atol=1e-8)


def test_each_undoes_the_other(rng):
    k = random_spd(rng, 50, 2)
    torch.testing.assert_close(spd_exp(spd_log(k)), k, rtol=1e-11, atol=1e-9)
    single = k.float()
    torch.testing.assert_close(spd_exp(spd_log(single)), single, rtol=2e-4, atol=1e-2)


def test_end_points_and_commuting_matrices(rng):
    a, b = random_spd(rng, 30), random_spd(rng, 30)
    torch.testing.assert_close(modulate_stiffness(a, b, 1.0), a, rtol=1e-10, atol=1e-9)
    torch.testing.assert_close(modulate_stiffness(a, b, 0.0), b, rtol=1e-10, atol=1e-9)
    x, y = torch.diag(torch.tensor([9.0, 4.0], dtype=DOUBLE)), torch.diag(torch.tensor([100.0, 1.0], dtype=DOUBLE))
    torch.testing.assert_close(
        modulate_stiffness(x, y, 0.5), torch.diag(torch.tensor([30.0, 2.0], dtype=DOUBLE)), rtol=1e-12, atol=1e-12
    )


def test_determinant_is_the_geometric_mean(rng):
    a, b = random_spd(rng, 200), random_spd(rng, 200)
    alpha = torch.rand(200, dtype=DOUBLE, generator=rng)
    blend = modulate_stiffness(a, b, alpha)
    expected = alpha * torch.logdet(a) + (1.0 - alpha) * torch.logdet(b)
    torch.testing.assert_close(torch.logdet(blend), expected, rtol=1e-10, atol=1e-10)
    # The average of the entries swells: never smaller, and larger here.
    straight = alpha[:, None, None] * a + (1.0 - alpha)[:, None, None] * b
    assert (torch.logdet(straight) >= expected - 1e-9).all()
    assert float((torch.logdet(straight) - expected).mean()) > 0.3


def test_mean_of_several_laws_does_not_depend_on_their_order_or_frame(rng):
    k = random_spd(rng, 10, 3)
    weights = torch.tensor([0.2, 0.5, 0.3], dtype=DOUBLE).expand(10, 3)
    mean = log_euclidean_mean(k, weights)
    torch.testing.assert_close(log_euclidean_mean(k[:, [2, 0, 1]], weights[:, [2, 0, 1]]), mean, rtol=1e-10, atol=1e-9)
    turn, _ = torch.linalg.qr(torch.randn(4, 4, dtype=DOUBLE, generator=rng))
    torch.testing.assert_close(
        log_euclidean_mean(turn @ k @ turn.T, weights), turn @ mean @ turn.T, rtol=1e-9, atol=1e-8
    )
    two = log_euclidean_mean(k[:, :2], torch.tensor([0.3, 0.7], dtype=DOUBLE).expand(10, 2))
    torch.testing.assert_close(two, modulate_stiffness(k[:, 0], k[:, 1], 0.3), rtol=1e-11, atol=1e-9)


def test_inverse_of_a_blend_is_the_blend_of_inverses(rng):
    """Stiffness and compliance are treated alike, which an average of entries does not do."""
    a, b = random_spd(rng, 20), random_spd(rng, 20)
    torch.testing.assert_close(
        torch.linalg.inv(modulate_stiffness(a, b, 0.4)),
        modulate_stiffness(torch.linalg.inv(a), torch.linalg.inv(b), 0.4), rtol=1e-9, atol=1e-12,
    )  # fmt: skip


@pytest.mark.parametrize("equal", [False, True])
def test_gradients_against_finite_differences(rng, equal):
    """Equal eigenvalues, as of any PD law, must not upset the derivative of the logarithm."""
    k = 100.0 * torch.eye(3, dtype=DOUBLE) if equal else random_spd(rng, n=3, spread=1.0)
    k = k.requires_grad_()

    def symmetric(m: torch.Tensor) -> torch.Tensor:
        return 0.5 * (m + m.transpose(-1, -2))

    assert torch.autograd.gradcheck(lambda m: spd_log(symmetric(m)), k, eps=1e-4, atol=1e-6)
    other = random_spd(rng, n=3, spread=1.0)
    alpha = torch.tensor(0.3, dtype=DOUBLE, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda m, a: modulate_stiffness(symmetric(m), other, a), (k, alpha), eps=1e-4, atol=1e-4, rtol=1e-4
    )


@pytest.mark.parametrize("function", [spd_log, spd_exp])
@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (torch.ones(3), r"matrix must have shape \(\.\.\., n, n\), got \(3,\)"),
        (torch.ones(2, 3), r"got \(2, 3\)"),
        (torch.eye(2, dtype=torch.int64), "must hold floating point numbers"),
        (torch.tensor([[1.0, math.nan], [math.nan, 1.0]]), "must be finite"),
        (torch.tensor([[2.0, 1.0], [0.5, 2.0]]), "must be symmetric, got entries that differ by 0.5"),
        (torch.ones(0, 0), "must not be empty"),
    ],
)
def test_bad_matrices_are_named(function, matrix, message):
    with pytest.raises(ValueError, match=message):
        function(matrix)


def test_other_bad_input_is_named(rng):
    k = random_spd(rng, 2)
    with pytest.raises(ValueError, match="matrix must be positive definite, got an eigenvalue of -1"):
        spd_log(torch.diag(torch.tensor([1.0, -1.0])))
    for alpha in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match=r"alpha must"):
            modulate_stiffness(k, k, alpha)
    with pytest.raises(ValueError, match=r"weights must sum to 1, got 0\.9"):
        log_euclidean_mean(k, torch.tensor([0.5, 0.4]))
    with pytest.raises(ValueError, match=r"weights must not be negative, got -0\.5"):
        log_euclidean_mean(k, torch.tensor([1.5, -0.5]))
    with pytest.raises(ValueError, match=r"weights must have shape \(\.\.\., 2\)"):
        log_euclidean_mean(k, torch.ones(3) / 3)
    with pytest.raises(ValueError, match=r"stiffness must have shape \(\.\.\., k, n, n\)"):
        log_euclidean_mean(k[0], torch.ones(1))
