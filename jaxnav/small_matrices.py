"""Linear algebra for a handful of unknowns, unrolled: no LAPACK call, nothing to wait for.

Under vmap every scalar below is an array over the batch, so thousands of 3 x 3 systems are solved
side by side in vector registers. XLA's batched LAPACK calls on the CPU cost several times more,
and with some thousand matrices inside a scan they have been seen to wait for each other for
ever (jaxlib 0.10, two cores).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def product(A: Float[Array, "n k"], B: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """A B as a sum of outer products: under vmap a tenth of the time of XLA's batched calls."""
    total = A[:, :1] * B[:1]
    for k in range(1, A.shape[1]):
        total = total + A[:, k : k + 1] * B[k : k + 1]
    return total


def sandwich(A: Float[Array, "n k"], P: Float[Array, "k k"]) -> Float[Array, "n n"]:
    """A P A'."""
    return product(product(A, P), A.T)


def cholesky(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower L of A = L L'. NaN where A is not positive definite.

    Source: Golub, Van Loan (2013), algorithm 4.2.2 (outer products).
    """
    n = A.shape[0]
    columns = []
    for j in range(n):
        column = A[:, :1] * jax.lax.rsqrt(A[:1, :1])
        columns.append(jnp.pad(column, ((j, 0), (0, 0))))
        A = A[1:, 1:] - column[1:] * column[1:].T
    return jnp.concatenate(columns, axis=1)


def solve_lower(L: Float[Array, "n n"], b: Array) -> Array:
    """L^-1 b, for a lower L."""
    inverse = 1 / jnp.diagonal(L)
    x: list[Array] = []
    for i in range(L.shape[0]):
        rest = b[i]
        for k in range(i):
            rest = rest - L[i, k] * x[k]
        x.append(rest * inverse[i])
    return jnp.stack(x)


def solve_upper(L: Float[Array, "n n"], b: Array) -> Array:
    """L'^-1 b, for a lower L."""
    n = L.shape[0]
    inverse = 1 / jnp.diagonal(L)
    x: list[Array] = [b[0]] * n
    for i in reversed(range(n)):
        rest = b[i]
        for k in range(i + 1, n):
            rest = rest - L[k, i] * x[k]
        x[i] = rest * inverse[i]
    return jnp.stack(x)


def cho_solve(L: Float[Array, "n n"], b: Array) -> Array:
    """A^-1 b, from L with A = L L'."""
    return solve_upper(L, solve_lower(L, b))


def log_det(L: Float[Array, "n n"]) -> Float[Array, ""]:
    """log |A|, from L with A = L L'."""
    return 2 * jnp.sum(jnp.log(jnp.diagonal(L)))
