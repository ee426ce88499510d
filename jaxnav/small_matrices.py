"""Linear algebra for a handful of unknowns, unrolled: no LAPACK call, nothing to wait for.

Under vmap every scalar below is an array over the batch, so thousands of 3 x 3 systems are solved
side by side in vector registers. XLA's batched LAPACK calls on the CPU cost several times more,
and with some thousand matrices inside a scan they have been seen to wait for each other for
ever (jaxlib 0.10, two cores).
"""

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

    Source: Golub, Van Loan (2013), algorithm 4.2.1.
    """
    n = A.shape[0]
    zero = jnp.zeros_like(A[0, 0])
    L = [[zero] * n for _ in range(n)]
    for j in range(n):
        L[j][j] = jnp.sqrt(A[j, j] - sum((L[j][k] ** 2 for k in range(j)), zero))
        for i in range(j + 1, n):
            rest = A[i, j] - sum((L[i][k] * L[j][k] for k in range(j)), zero)
            L[i][j] = rest / L[j][j]
    return jnp.stack([jnp.stack(row) for row in L])


def solve_lower(L: Float[Array, "n n"], b: Array) -> Array:
    """L^-1 b, for a lower L."""
    x: list[Array] = []
    for i in range(L.shape[0]):
        rest = b[i]
        for k in range(i):
            rest = rest - L[i, k] * x[k]
        x.append(rest / L[i, i])
    return jnp.stack(x)


def solve_upper(L: Float[Array, "n n"], b: Array) -> Array:
    """L'^-1 b, for a lower L."""
    n = L.shape[0]
    x: list[Array] = [b[0]] * n
    for i in reversed(range(n)):
        rest = b[i]
        for k in range(i + 1, n):
            rest = rest - L[k, i] * x[k]
        x[i] = rest / L[i, i]
    return jnp.stack(x)


def cho_solve(L: Float[Array, "n n"], b: Array) -> Array:
    """A^-1 b, from L with A = L L'."""
    return solve_upper(L, solve_lower(L, b))


def log_det(L: Float[Array, "n n"]) -> Float[Array, ""]:
    """log |A|, from L with A = L L'."""
    return 2 * jnp.sum(jnp.log(jnp.diagonal(L)))


def inverse_3(A: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse of any regular 3 x 3 matrix: its rows' cross products over the determinant."""
    columns = jnp.stack(
        [jnp.cross(A[1], A[2]), jnp.cross(A[2], A[0]), jnp.cross(A[0], A[1])], axis=1
    )
    return columns / (A[0] @ columns[:, 0])


def inverse_of_blocks(A: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """Inverse of [[J, Q], [0, J]]: what the Jacobians of SE(3) look like."""
    J = inverse_3(A[:3, :3])
    return jnp.block([[J, -product(product(J, A[:3, 3:]), J)], [jnp.zeros_like(J), J]])
