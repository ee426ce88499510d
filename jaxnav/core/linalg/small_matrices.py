"""Linear algebra for a handful of unknowns, unrolled, without calls of LAPACK.

Under vmap every scalar below is an array over the batch, so thousands of 3 x 3 systems are solved
side by side in vector registers. XLA's batched LAPACK calls on the CPU cost several times more,
and with some thousand matrices inside a scan they have been seen to deadlock (jaxlib 0.10, two
cores).

`where` for trees of arrays, and a module under another class.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

# Up to here comparing every value with every other is faster than a sort.
_FEW = 32


def product(A: Float[Array, "n k"], B: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """The matrix product A B, (n, m), as a sum over an axis.

    XLA's batched calls take ten times as long, and XLA computes a chain of additions anew for every
    product that uses the result.
    """
    return jnp.sum(A[:, :, None] * B[None], axis=1)


def matvec(A: Float[Array, "n k"], x: Float[Array, " k"]) -> Float[Array, " n"]:
    """The product A x, (n,), as a sum over an axis."""
    return jnp.sum(A * x[None], axis=1)


def gram(J: Float[Array, "n m ..."]) -> Float[Array, "n n ..."]:
    """J J', (n, n), for all lanes along the trailing axes."""
    return jnp.sum(J[:, None] * J[None], axis=2)


def sandwich(A: Float[Array, "n k"], P: Float[Array, "k k"]) -> Float[Array, "n n"]:
    """The congruence A P A', (n, n)."""
    return product(product(A, P), A.T)


@jax.custom_jvp
def cholesky(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The lower L of A = L L'. NaN where A is not positive definite.

    Source: Golub, Van Loan (2013), algorithm 4.2.1.
    """
    n = A.shape[0]
    zero = jnp.zeros_like(A[0, 0])
    L: list[list[Array]] = [[zero] * n for _ in range(n)]
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot = pivot - L[j][k] * L[j][k]
        inverse = jax.lax.rsqrt(pivot)
        L[j][j] = pivot * inverse
        for i in range(j + 1, n):
            rest = A[i, j]
            for k in range(j):
                rest = rest - L[i][k] * L[j][k]
            L[i][j] = rest * inverse
    return jnp.stack([jnp.stack(row) for row in L])


@cholesky.defjvp
def _cholesky_slope(at: tuple[Array], moves: tuple[Array]) -> tuple[Array, Array]:
    """L' = L F(L^-1 A' L^-T), A' symmetric; F takes the lower half, and half of the diagonal.

    Source: Murray (2016), "Differentiation of the Cholesky decomposition", Eq. 8.
    """
    ((A,), (A_dot,)) = at, moves
    L = cholesky(A)
    both = solve_lower(L, solve_lower(L, A_dot).T)
    return L, product(L, jnp.tril(both) - jnp.diag(jnp.diagonal(both)) / 2)


def _times(A: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    return matvec(A, b) if b.ndim == 1 else product(A, b)


@jax.custom_jvp
def solve_lower(L: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """L^-1 b, for a lower triangular L; b is (n,) or (n, m)."""
    inverse = 1 / jnp.diagonal(L)
    x: list[Array] = []
    for i in range(L.shape[0]):
        rest = b[i]
        for k in range(i):
            rest = rest - L[i, k] * x[k]
        x.append(rest * inverse[i])
    return jnp.stack(x)


@solve_lower.defjvp
def _lower_slope(at: tuple[Array, Array], moves: tuple[Array, Array]) -> tuple[Array, Array]:
    (L, b), (L_dot, b_dot) = at, moves
    x = solve_lower(L, b)
    return x, solve_lower(L, b_dot - _times(jnp.tril(L_dot), x))


@jax.custom_jvp
def solve_upper(L: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """L'^-1 b, for a lower triangular L; b is (n,) or (n, m)."""
    n = L.shape[0]
    inverse = 1 / jnp.diagonal(L)
    x: list[Array] = [b[0]] * n
    for i in reversed(range(n)):
        rest = b[i]
        for k in range(i + 1, n):
            rest = rest - L[k, i] * x[k]
        x[i] = rest * inverse[i]
    return jnp.stack(x)


@solve_upper.defjvp
def _upper_slope(at: tuple[Array, Array], moves: tuple[Array, Array]) -> tuple[Array, Array]:
    (L, b), (L_dot, b_dot) = at, moves
    x = solve_upper(L, b)
    return x, solve_upper(L, b_dot - _times(jnp.tril(L_dot).T, x))


def cho_solve(L: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """A^-1 b, from L with A = L L'."""
    return solve_upper(L, solve_lower(L, b))


def log_det(L: Float[Array, "n n"]) -> Float[Array, ""]:
    """log |A|, from L with A = L L'."""
    return 2 * jnp.sum(jnp.log(jnp.diagonal(L)))


def solve_positive(
    A: Float[Array, "n n ..."], b: Float[Array, "n ..."], ridge: Float[Array, "..."] | float = 0
) -> Float[Array, "n ..."]:
    """(A + ridge I)^-1 b for all lanes along the trailing axes; NaN if not positive definite.

    Its derivative x' solves A x' = b' - A' x, so that none of the factor's entries is derived.

    Source: Golub, Van Loan (2013), algorithm 4.2.1; Giles (2008), "An extended collection of matrix
    derivative results", section 2.2.
    """
    lanes = max(A.ndim - 2, b.ndim - 1)
    A = A.reshape(*A.shape[:2], *(1,) * (lanes - A.ndim + 2), *A.shape[2:])
    b = b.reshape(b.shape[0], *(1,) * (lanes - b.ndim + 1), *b.shape[1:])
    return _solve_positive(A, b, jnp.asarray(ridge, A.dtype))


@jax.custom_jvp
def _solve_positive(
    A: Float[Array, "n n ..."], b: Float[Array, "n ..."], ridge: Float[Array, "..."]
) -> Float[Array, "n ..."]:
    """As `solve_positive`, of as many trailing axes.

    Every entry is an array of its own: in matrices XLA would compute each column of the factor anew
    for every entry that uses it.
    """
    n = A.shape[0]
    L: list[list[Array]] = [[] for _ in range(n)]  # the factor, its diagonal inverted
    y: list[Array] = []
    for i in range(n):
        for j in range(i):
            rest = A[i, j]
            for k in range(j):
                rest = rest - L[i][k] * L[j][k]
            L[i].append(rest * L[j][j])
        pivot, right = A[i, i] + ridge, b[i]
        for k in range(i):
            pivot = pivot - L[i][k] * L[i][k]
            right = right - L[i][k] * y[k]
        L[i].append(jax.lax.rsqrt(pivot))
        y.append(right * L[i][i])
    x: list[Array] = [b[0]] * n
    for i in reversed(range(n)):
        rest = y[i]
        for k in range(i + 1, n):
            rest = rest - L[k][i] * x[k]
        x[i] = rest * L[i][i]
    return jnp.stack(x)


@_solve_positive.defjvp
def _positive_slope(
    at: tuple[Array, Array, Array], moves: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    (A, b, ridge), (A_dot, b_dot, ridge_dot) = at, moves
    x = _solve_positive(A, b, ridge)
    moved = jnp.sum(A_dot * x[None], axis=1) + (ridge_dot[None] if ridge.ndim else ridge_dot) * x
    return x, _solve_positive(A, b_dot - moved, ridge)


def eliminate(A: Float[Array, "n n"], B: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """A^-1 B for a positive definite A; NaN or inf where a pivot is 0.

    For more unknowns than are worth unrolling: a loop with one kernel for each pivot.

    Source: Golub, Van Loan (2013), section 4.2: elimination without pivoting, Gauss and Jordan's.
    """
    rows = jnp.arange(A.shape[0])[:, None]

    def pivoted(k: Int[Array, ""], rest: Array) -> Array:
        row = rest[k] / rest[k, k]
        return jnp.where(rows == k, row[None], rest - rest[:, k][:, None] * row[None])

    both = jnp.concatenate([A, B], axis=1)
    return jax.lax.fori_loop(0, A.shape[0], pivoted, both)[:, A.shape[0] :]


def ranks(values: Float[Array, " n"]) -> Int[Array, " n"]:
    """Rank of each value, 0 for the highest; equal values rank in their order.

    Equals `argsort(argsort(-values))`, without a call of XLA's sort.
    """
    index = jnp.arange(values.shape[0])
    earlier = index[None] < index[:, None]
    # Of every pair one is before the other, whatever the compiler computes twice and rounds anew.
    not_lower = values[None] >= values[:, None]
    return jnp.sum(jnp.where(earlier, not_lower, ~not_lower.T), axis=1)


def in_order(values: Float[Array, " n"], count: int) -> Int[Array, " count"]:
    """Indices of the `count` highest values, the highest first.

    Not by `top_k`: it calls a library, and such programs can't be kept.
    """
    if values.shape[0] > _FEW:
        return jnp.argsort(values, descending=True)[:count]
    return jnp.argmax(ranks(values)[None] == jnp.arange(count)[:, None], axis=1)


def first_highest(values: Float[Array, " n"], within: Float[Array, ""] | float) -> Int[Array, ""]:
    """Index of the highest value; of those that equal it within a margin, the first.

    Where values are equal by construction, `argmax` is the choice of the machine's rounding.
    """
    return jnp.argmax(values >= jnp.max(values) - within)


_Tree = TypeVar("_Tree")
_Module = TypeVar("_Module")


def where(condition: Bool[Array, "*rows"], yes: _Tree, no: _Tree) -> _Tree:
    """`jnp.where` of every leaf; the condition's axes are the leaves' leading ones."""

    def choose(a: ArrayLike, b: ArrayLike) -> Array:
        shape = condition.shape + (1,) * (jnp.ndim(a) - condition.ndim)
        return jnp.where(condition.reshape(shape), a, b)

    chosen: _Tree = jax.tree.map(choose, yes, no)
    return chosen


def as_class(cls: type[_Module], module: object, **changes: object) -> _Module:
    """An instance of a class, which may override methods, with the fields of another module.

    Args:
        changes: fields that get another value, also static ones.
    """
    other = object.__new__(cls)
    for name, part in (vars(module) | changes).items():
        object.__setattr__(other, name, part)
    return other
