"""The algebra of stiffness matrices, against closed forms, scipy and finite differences."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import permutations

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


def test_derivatives_of_any_order_by_hand():
    """Of the logarithm of one number: 1/k, -1/k^2, 2/k^3, -6/k^4."""
    k = torch.tensor([[4.0]], requires_grad=True)
    derivative = spd_log(k).sum()
    for expected in (1 / 4, -1 / 16, 2 / 64, -6 / 256):
        (gradient,) = torch.autograd.grad(derivative.sum(), k, create_graph=True)
        assert float(gradient.detach()) == pytest.approx(expected, rel=1e-6)
        derivative = gradient
    one = torch.ones(1, 1)
    assert float(torch.autograd.functional.jvp(spd_log, k.detach(), one)[1]) == pytest.approx(0.25)
    forward = spd_log
    for expected in (1 / 4, -1 / 16, 2 / 64, -6 / 256):  # forward over forward
        forward = _along_one(forward)
        assert float(forward(k.detach())) == pytest.approx(expected, rel=1e-6)
    (slope,) = torch.autograd.grad(spd_log(k).sum(), k, create_graph=True)
    (gradient,) = torch.autograd.grad((k + slope.square()).sum(), k)
    assert float(gradient) == pytest.approx(1.0 - 2.0 / 64.0)


def _along_one(function: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda k: torch.func.jvp(function, (k,), (torch.ones(1, 1),))[1]


def few_eigenvalues(rng, *values: float) -> torch.Tensor:
    """(3, 3) with these three eigenvalues."""
    q, _ = torch.linalg.qr(torch.randn(3, 3, dtype=DOUBLE, generator=rng))
    return q @ torch.diag(torch.tensor(values, dtype=DOUBLE)) @ q.T


EIGENVALUES = [(0.5, 2.0, 7.0), (2.0, 2.0, 2.0), (2.0, 2.0, 5.0), (2.0, 2.0 * (1.0 + 1e-9), 5.0), (2.0, 2.0003, 5.0)]


@pytest.mark.parametrize("values", EIGENVALUES)
def test_second_derivatives_at_distinct_close_and_equal_eigenvalues(rng, values):
    """The trace of the logarithm is the logarithm of the determinant, whose derivatives have a closed form."""
    k = few_eigenvalues(rng, *values)
    inverse = torch.linalg.inv(k)
    closed = -0.5 * (torch.einsum("ik,jl->ijkl", inverse, inverse) + torch.einsum("il,jk->ijkl", inverse, inverse))

    def log_det(m: torch.Tensor) -> torch.Tensor:
        return spd_log(m).trace()

    of = torch.autograd.functional.hessian
    hessians = [
        of(log_det, k), of(log_det, k, vectorize=True),
        of(log_det, k, vectorize=True, outer_jacobian_strategy="forward-mode"),
    ]  # fmt: skip
    modes = (torch.func.jacrev, torch.func.jacfwd)
    hessians += [outer(inner(log_det))(k) for outer in modes for inner in modes]
    for hessian in hessians:
        torch.testing.assert_close(hessian, closed, rtol=1e-9, atol=1e-10)
    k = k.requires_grad_()
    other = few_eigenvalues(rng, 1.0, 1.0, 3.0)
    half = torch.tensor([0.5, 0.5], dtype=DOUBLE)
    assert torch.autograd.gradgradcheck(lambda m: spd_log(_symmetric(m)), k)
    assert torch.autograd.gradgradcheck(lambda m: modulate_stiffness(_symmetric(m), other, 0.3), k)
    assert torch.autograd.gradgradcheck(lambda m: log_euclidean_mean(torch.stack((_symmetric(m), other)), half), k)


def _symmetric(m: torch.Tensor) -> torch.Tensor:
    return 0.5 * (m + m.transpose(-1, -2))


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_a_singular_matrix_is_refused_in_any_order_of_rows_and_at_any_scale(rng, dtype):
    """Singular but for the rounding of its entries; and what has a condition number of 100,000 is not singular."""
    for rank in (1, 2):
        for factor in torch.randn(20, 3, rank, dtype=DOUBLE, generator=rng):
            for scale in (1e-6, 1e-2, 0.3, 1.0, 7.0, 1e3, 1e6):
                matrix = (scale * factor @ factor.T).to(dtype)
                for order in permutations(range(3)):
                    with pytest.raises(ValueError, match="matrix must be positive definite, got an eigenvalue of"):
                        spd_log(matrix[list(order)][:, list(order)])
    regular = few_eigenvalues(rng, 1e-5, 1e-2, 1.0).to(dtype)
    for order in permutations(range(3)):
        assert spd_log(regular[list(order)][:, list(order)]).isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_an_exponential_is_positive_definite_or_refused(rng, dtype):
    apart = -math.log(16.0 * torch.finfo(dtype).eps)  # 4 n eps, the rule for what is singular
    q, _ = torch.linalg.qr(torch.randn(500, 4, 4, dtype=DOUBLE, generator=rng))
    for spread, allowed in ((0.99 * apart, True), (1.01 * apart, False)):
        values = torch.tensor([0.0, 0.2, 0.9, 1.0], dtype=DOUBLE) * spread - 5.0
        matrices = _symmetric((q * values) @ q.transpose(-1, -2)).to(dtype)
        if allowed:
            assert float(torch.linalg.eigvalsh(spd_exp(matrices).double()).min()) > 0.0
            assert spd_log(spd_exp(matrices)).isfinite().all()
        else:
            with pytest.raises(ValueError, match=rf"less than {apart:.1f} apart, .* positive definite in {dtype}"):
                spd_exp(matrices)
    for much in (1000.0, -1000.0):
        with pytest.raises(ValueError, match="matrix must have eigenvalues from"):
            spd_exp(much * torch.eye(2, dtype=dtype))


def blend_of_three(k: torch.Tensor) -> torch.Tensor:
    """(3, n, n) through all functions of the module."""
    blend = modulate_stiffness(k, k.flip(0), torch.tensor([0.1, 0.5, 0.9]))
    mean = log_euclidean_mean(torch.stack((blend, k), 1), torch.full((3, 2), 0.5))
    return spd_exp(spd_log(mean))


def test_autocast_changes_nothing(rng):
    k = random_spd(rng, 3).float()
    with torch.autocast("cpu", torch.bfloat16):
        inside = blend_of_three(k)
    assert torch.equal(inside, blend_of_three(k))


def test_compiled_and_mapped_functions_are_the_plain_ones(rng):
    k = random_spd(rng, 3, spread=1.0).float().requires_grad_()
    compiled = torch.compile(blend_of_three, fullgraph=True, backend="aot_eager")(k)
    torch.testing.assert_close(compiled, blend_of_three(k))
    plain, traced = (torch.autograd.grad(out.sum(), k)[0] for out in (blend_of_three(k), compiled))
    torch.testing.assert_close(traced, plain)
    one = torch.tensor([[4.0]])
    hessian = torch.compile(torch.func.hessian(lambda m: spd_log(m).sum()), fullgraph=True, backend="aot_eager")
    assert float(hessian(one)) == pytest.approx(-1.0 / 16.0)
    eager = torch.compile(spd_log, fullgraph=True, backend="eager")
    assert float(torch.autograd.functional.jvp(eager, one, torch.ones(1, 1))[1]) == pytest.approx(0.25)
    k, alpha = k.detach(), torch.tensor([0.1, 0.5, 0.9])
    mapped = torch.vmap(lambda m, a: modulate_stiffness(m, k[0], a))(k, alpha)
    torch.testing.assert_close(mapped, modulate_stiffness(k, k[:1].expand(3, 4, 4), alpha))
    each = torch.vmap(torch.func.grad(lambda m: spd_log(m).trace()))(k)
    torch.testing.assert_close(each, torch.linalg.inv(k), rtol=1e-4, atol=1e-6)
    # Nobody looks at values in there.
    assert torch.vmap(spd_log)(-torch.eye(2).expand(3, 2, 2)).isnan().any()


@pytest.mark.parametrize("function", [spd_log, spd_exp])
@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (torch.ones(3), r"matrix must have shape \(\.\.\., n, n\), got \(3,\)"),
        (torch.ones(2, 3), r"got \(2, 3\)"),
        (torch.eye(2, dtype=torch.int64), "must hold float32 or float64 numbers, got torch.int64"),
        (torch.eye(2, dtype=torch.bfloat16), "must hold float32 or float64 numbers, got torch.bfloat16"),
        ([[1.0]], "matrix must be a tensor, got list"),
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
    for name, pair in (("k_comp", (-k, k)), ("k_pd", (k, -k))):
        with pytest.raises(ValueError, match=f"{name} must be positive definite"):
            modulate_stiffness(*pair, 0.5)


K = torch.eye(4).expand(5, 4, 4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((K.long(), K, 0.5), "k_comp must hold float32 or float64 numbers, got torch.int64"),
        ((K, K.long(), 0.5), "k_pd must have the dtype .* of k_comp, torch.float32 on cpu, got torch.int64"),
        ((K, K.double(), 0.5), "k_pd must have the dtype .* of k_comp, torch.float32 on cpu, got torch.float64"),
        (
            (K, K.to("meta"), 0.5),
            "k_pd must have .* the device of k_comp, torch.float32 on cpu, got torch.float32 on meta",
        ),
        ((K, K[:4], 0.5), r"k_pd must have the shape of k_comp, \(5, 4, 4\), got \(4, 4, 4\)"),
        ((K, K[0], 0.5), r"k_pd must have the shape of k_comp, \(5, 4, 4\), got \(4, 4\)"),
        ((K, K, torch.ones(5, 1)), r"alpha must be one number or, as k_comp, have shape \(5,\), got \(5, 1\)"),
        ((K, K, torch.ones(4)), r"alpha must .* have shape \(5,\), got \(4,\)"),
        (
            (K, K, torch.ones(5, dtype=torch.int64)),
            "alpha must have the dtype .* of k_comp, torch.float32 on cpu, got torch.int64",
        ),
        ((K, K, "much"), "alpha must be a finite number, got 'much'"),
    ],
)
def test_types_and_shapes_that_do_not_fit_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        modulate_stiffness(*arguments)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (torch.tensor([0.5, 0.4]), r"weights must sum to 1, got 0\.9"),
        (torch.tensor([1.5, -0.5]), r"weights must not be negative, got -0\.5"),
        (torch.ones(3) / 3, r"weights must have shape \(2,\), got \(3,\)"),
        (
            torch.ones(2, dtype=DOUBLE) / 2,
            "weights must have the dtype .* of stiffness, torch.float32 .* got torch.float64",
        ),
    ],
)
def test_bad_weights_are_named(weights, message):
    with pytest.raises(ValueError, match=message):
        log_euclidean_mean(K[:2], weights)
    with pytest.raises(ValueError, match=r"stiffness must have shape \(\.\.\., k, n, n\)"):
        log_euclidean_mean(K[0], torch.ones(1))
