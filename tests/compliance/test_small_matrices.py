"""Small matrices with the batch last, against the library that takes them one by one."""

import math

import pytest
import torch

from cotap.compliance.small_matrices import (
    batch_last,
    eigenvalues_3x3,
    geometric_mean,
    inverse,
    inverse_3x3,
    plus_diagonal,
    product,
)


def positive_definite(rng, n, decades, count=500):
    """Matrices (n, n, count) whose eigenvalues span so many decades."""
    basis = torch.linalg.qr(torch.randn(count, n, n, dtype=torch.float64, generator=rng))[0]
    values = 10.0 ** (decades * torch.rand(count, n, dtype=torch.float64, generator=rng))
    return batch_last(basis @ torch.diag_embed(values) @ basis.mT)


def test_the_batch_comes_last(rng):
    x = torch.randn(4, 2, 3, 5, generator=rng)
    last = batch_last(x)
    assert last.is_contiguous()
    torch.testing.assert_close(last[1, 4, 2 * 2 + 1], x[2, 1, 1, 4])


def test_products_and_shifts(rng):
    a, b = torch.randn(3, 4, 50, generator=rng), torch.randn(4, 7, 50, generator=rng)
    torch.testing.assert_close(product(a, b), torch.einsum("ijb,jkb->ikb", a, b))
    square, shift = torch.randn(3, 3, 50, generator=rng), torch.randn(50, generator=rng)
    torch.testing.assert_close(plus_diagonal(square, shift), square + torch.eye(3).unsqueeze(-1) * shift)


def test_closed_forms_of_three_by_three(rng):
    a = torch.randn(500, 3, 3, dtype=torch.float64, generator=rng)
    a = a @ a.mT
    a[:3] = torch.diag_embed(torch.tensor([[1.0, 1.0, 1.0], [2.0, 2.0, 5.0], [0.0, 3.0, 3.0]], dtype=torch.float64))
    last = batch_last(a)
    torch.testing.assert_close(eigenvalues_3x3(last).T, torch.linalg.eigvalsh(a), rtol=1e-7, atol=1e-7)
    one = product(inverse_3x3(last[..., 3:]), last[..., 3:])
    torch.testing.assert_close(one, torch.eye(3).double().unsqueeze(-1).expand_as(one), atol=1e-6, rtol=0)


@pytest.mark.parametrize("least", [1e-4, 1e-6, 1e-8, 1e-12, 0.0])
def test_a_small_eigenvalue_keeps_its_digits_beside_two_large_ones(rng, least):
    basis = torch.linalg.qr(torch.randn(500, 3, 3, dtype=torch.float64, generator=rng))[0]
    values = torch.tensor([least, 0.3, 1.0], dtype=torch.float64)
    found = eigenvalues_3x3(batch_last((basis * values) @ basis.mT))
    torch.testing.assert_close(found, values.unsqueeze(1).expand_as(found), rtol=1e-9, atol=1e-15)


def test_eigenvalues_of_rank_one(rng):
    """The others are rounding, of whatever sign, and no more than that."""
    x = torch.randn(5000, 3, 1, dtype=torch.float64, generator=rng)
    found = eigenvalues_3x3(batch_last(x @ x.mT))
    torch.testing.assert_close(found[2], x.square().sum((1, 2)))
    assert float((found[:2].abs() / found[2]).max()) < 1e-6


@pytest.mark.parametrize("n", [1, 2, 4, 7])
def test_inverses_and_determinants(rng, n):
    a = positive_definite(rng, n, 3.0)
    found, logarithm = inverse(a)
    first = a.permute(2, 0, 1)
    torch.testing.assert_close(found.permute(2, 0, 1), torch.linalg.inv(first), rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(logarithm, torch.linalg.slogdet(first).logabsdet)


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-8), (torch.float32, 1e-4)])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 7])
def test_geometric_mean(rng, n, dtype, atol):
    """`G a^-1 G = b`, by definition; and its mean with the other's inverse is 1."""
    a, b = positive_definite(rng, n, 3.0).to(dtype), 1e-3 * positive_definite(rng, n, 3.0).to(dtype)
    kept = a.clone(), b.clone()
    mean = geometric_mean(a, b)
    assert torch.equal(a, kept[0])
    assert torch.equal(b, kept[1])
    m, first, second = (x.double().permute(2, 0, 1) for x in (mean, a, b))
    error = (m @ torch.linalg.inv(first) @ m - second).abs().amax((1, 2)) / second.abs().amax((1, 2))
    assert float(error.max()) < atol
    one = geometric_mean(a, inverse(a)[0]).double()
    assert float((one - torch.eye(n).unsqueeze(-1)).abs().max()) < 10.0 * atol


def test_geometric_mean_by_hand():
    a, b = torch.diag(torch.tensor([4.0, 9.0])).unsqueeze(-1), torch.diag(torch.tensor([1.0, 16.0])).unsqueeze(-1)
    torch.testing.assert_close(geometric_mean(a, b)[..., 0], torch.diag(torch.tensor([2.0, 12.0])))
    large = 1e30 * torch.eye(7).unsqueeze(-1)
    torch.testing.assert_close(geometric_mean(large, large), large, rtol=1e-5, atol=0.0)
    assert math.isclose(float(inverse(large)[1]), 7.0 * math.log(1e30), rel_tol=1e-6)
