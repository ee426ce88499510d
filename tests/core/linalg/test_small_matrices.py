"""Unrolled linear algebra against LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.linalg import small_matrices
from tests.derivatives import check_derivatives
from tests.helpers.compiling import jitted

small = jitted(small_matrices, in_order="count")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [1, 6])
def test_a_batch_of_systems_is_solved_as_lapack_does(n, dtype):
    rng = np.random.default_rng(n)
    roots = rng.normal(size=(50, n, n + 2))
    A = (roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(n)).astype(dtype)
    b = rng.normal(size=(50, n, 2)).astype(dtype)

    @jax.jit
    @jax.vmap
    def solve(A, b):
        L = small.cholesky(A)
        return L, small.cho_solve(L, b), small.cho_solve(L, b[:, 0]), small.log_det(L)

    L, x, x0, log_det = solve(jnp.asarray(A), jnp.asarray(b))
    assert L.dtype == dtype
    tolerance = 1e-9 if dtype == np.float64 else 2e-3
    np.testing.assert_allclose(
        L, np.linalg.cholesky(A.astype(float)), atol=tolerance, rtol=tolerance
    )
    expected = np.linalg.solve(A.astype(float), b)
    np.testing.assert_allclose(x, expected, atol=tolerance, rtol=tolerance)
    np.testing.assert_allclose(x0, expected[..., 0], atol=tolerance, rtol=tolerance)
    np.testing.assert_allclose(log_det, np.linalg.slogdet(A)[1], atol=tolerance)


@pytest.mark.parametrize("shape", [(3, 12, 5), (2, 1, 4)])
def test_products(shape):
    n, k, m = shape
    rng = np.random.default_rng(2)
    A, B, P = rng.normal(size=(n, k)), rng.normal(size=(k, m)), rng.normal(size=(k, k))
    np.testing.assert_allclose(small.product(jnp.asarray(A), jnp.asarray(B)), A @ B, atol=1e-12)
    sandwich = small.sandwich(jnp.asarray(A), jnp.asarray(P))
    np.testing.assert_allclose(sandwich, A @ P @ A.T, atol=1e-12)


def test_an_indefinite_matrix_has_no_factor():
    A = jnp.asarray([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert not np.all(np.isfinite(small.cholesky(A)))


def test_gradients_are_those_of_lapack():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 5))
    A, b = jnp.asarray(root @ root.T), jnp.asarray(rng.normal(size=3))
    ours = np.asarray(jax.jit(jax.grad(lambda A: b @ small.cho_solve(small.cholesky(A), b)))(A))
    x = np.linalg.solve(A, b)
    # Of A and its transpose together: of a symmetric matrix no more is defined.
    expected = -np.outer(x, x)
    np.testing.assert_allclose(ours + ours.T, expected + expected.T, rtol=1e-9)


@pytest.mark.parametrize("n", [1, 3])
def test_derivatives_are_those_of_differences(n):
    """Of each of the four, with one right side, with several, and of lanes that share a matrix."""
    rng = np.random.default_rng(n)
    root, many = rng.normal(size=(n, n + 2)), jnp.asarray(rng.normal(size=(n, 4)))
    A = jnp.asarray(root @ root.T + np.eye(n))

    def all_of(A, b, ridge):
        A = (A + A.T) / 2
        L = small.cholesky(A)
        lanes = jnp.stack([A, 2 * A], axis=-1)
        return (
            L,
            small.solve_lower(L, b),
            small.solve_upper(L, b),
            small.solve_lower(L, b[:, 0]),
            small.solve_upper(L, b[:, 0]),
            small.solve_positive(A, b, ridge),
            small.solve_positive(A, b[:, 0]),
            small.solve_positive(lanes[:, :, None], b[:, :, None], ridge),
        )

    check_derivatives(all_of, A, many, jnp.asarray(0.3))


@pytest.mark.parametrize("n", [1, 6])
def test_many_positive_systems_side_by_side(n):
    rng = np.random.default_rng(n)
    roots = rng.normal(size=(20, n, n + 2))
    A, b = roots @ np.swapaxes(roots, 1, 2), rng.normal(size=(20, n))
    x = small.solve_positive(jnp.asarray(np.moveaxis(A, 0, -1)), jnp.asarray(b.T))
    np.testing.assert_allclose(x.T, np.linalg.solve(A, b[..., None])[..., 0], rtol=1e-6, atol=1e-8)
    assert not np.any(np.isfinite(small.solve_positive(-jnp.eye(n), jnp.ones(n))))


@pytest.mark.parametrize("n", [1, 11])
def test_elimination_solves_for_all_right_sides_like_lapack(n):
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n + 2)) * np.geomspace(1, 1e3, n)[:, None]
    A, B = root @ root.T, rng.normal(size=(n, 4))
    X = jax.jit(small.eliminate)(A, B)
    np.testing.assert_allclose(X, np.linalg.solve(A, B), rtol=1e-6, atol=1e-10)
    assert not np.all(np.isfinite(small.eliminate(jnp.zeros((n, n)), jnp.ones((n, 1)))))


@pytest.mark.parametrize(
    "values",
    [[3.0, 1.0, 2.0], [1.0, 1.0, 1.0], [-np.inf, 5.0, -np.inf, 5.0], [-np.inf, 5.0, 1.0, 5.0] * 9],
)
def test_ranks_are_those_of_a_stable_sort(values):
    order = np.argsort(-np.asarray(values), kind="stable")
    np.testing.assert_array_equal(small.ranks(jnp.asarray(values))[order], np.arange(len(values)))
    for count in (1, 2, 3):
        np.testing.assert_array_equal(small.in_order(jnp.asarray(values), count), order[:count])


def test_of_values_that_are_equal_but_for_rounding_the_first_is_the_highest():
    below = 1 - 1e-9
    for values, index in [
        ([0.0, below, 1.0], 1), ([0.0, 1.0, below], 1), ([0.0, 0.9, 1.0], 2),
        ([-np.inf] * 3, 0), ([-np.inf, 2.0, -np.inf], 1),
    ]:  # fmt: skip
        assert small.first_highest(jnp.asarray(values), 1e-6) == index
