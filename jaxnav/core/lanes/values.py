"""Represent the values of `over_lanes`: those that differ between lanes, and those that don't."""

import contextvars
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Int, Shaped

UNROLLED = 32  # the most terms of a sum, or rows of a table, that are written out
# Operations per number: the most worth computing twice, and those worth a pass over memory.
CHEAP, DEAR = 2, 24


# XLA makes one kernel of a loop that touches fewer bytes, and can't compile barriers in it.
_SMALL_LOOP_BYTES = 1024
_in_kernel = contextvars.ContextVar("in_kernel", default=False)
_in_small_loop = contextvars.ContextVar("in_small_loop", default=False)


@contextmanager
def _within(flag: contextvars.ContextVar[bool]) -> Iterator[None]:
    token = flag.set(True)
    try:
        yield
    finally:
        flag.reset(token)


def one_kernel() -> AbstractContextManager[None]:
    """Trace the block as part of one kernel: see `strips.py`."""
    return _within(_in_kernel)


def loop_over(carry: Sequence[Shaped[jax.Array, "..."]]) -> AbstractContextManager[None]:
    """Trace the block as a loop with this carry: without barriers where it may be small."""
    small = sum(rows.size * rows.dtype.itemsize for rows in carry) < _SMALL_LOOP_BYTES
    return _within(_in_small_loop) if small else nullcontext()


def barrier(rows: Shaped[jax.Array, "*shape"]) -> Shaped[jax.Array, "*shape"]:
    """The same rows, computed once and not anew at every use.

    Inside a kernel XLA knows no barriers; a call, which LLVM makes a copy, serves as one there.
    In a small loop the rows stay as they are.
    """
    if not _in_kernel.get():
        return rows if _in_small_loop.get() else lax.optimization_barrier(rows)
    with set_xla_metadata(inlineable="false"):
        return jax.jit(_same)(rows)


def _same(rows: jax.Array) -> jax.Array:
    return rows


def join_rows(rows: list[Shaped[jax.Array, "..."]], axis: int) -> "Lane":
    """Concatenate rows along an existing axis.

    Inside a kernel it is kept unfused: fused, it would look up the source of every single number.
    """
    if not _in_kernel.get():
        return Lane(lax.concatenate(rows, axis), DEAR)
    return Lane(barrier(lax.concatenate([barrier(r) for r in rows], axis)))


class Lane:
    """A value that differs between the lanes, (*shape, L).

    `work` counts the operations per number since the value was last written to memory. With `at`
    the value is some lanes of a longer row, fetched when `rows` is first read.
    """

    def __init__(
        self,
        source: Shaped[jax.Array, "... L"],
        work: int = 0,
        at: Int[jax.Array, " M"] | None = None,
    ):
        self.source, self.work, self.at = source, work, at

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one lane's value."""
        return self.source.shape[:-1]

    @property
    def rows(self) -> Shaped[jax.Array, "... L"]:
        """The array (*shape, L)."""
        if self.at is not None:
            fetched = self.source.at[..., self.at].get(mode="promise_in_bounds")
            self.source, self.at = barrier(fetched), None
        return self.source


# A value that differs between lanes; one that does not; one that is known at trace time.
Value = Lane | jax.Array | np.ndarray
Params = Mapping[str, Any]  # of a primitive, by JAX's names
Combine = Callable[
    [Shaped[jax.Array, "*shape"], Shaped[jax.Array, "*shape"]], Shaped[jax.Array, "*shape"]
]


def write_out(value: Value, cheap: int) -> Value:
    """The value written to memory, for its users to read, if it cost more than `cheap`."""
    if not isinstance(value, Lane) or value.work <= cheap:
        return value
    return Lane(barrier(value.rows))


def known(value: Any) -> Value:
    """A small constant as a NumPy array, so that it can select rows at trace time."""
    if isinstance(value, jax.core.Tracer) or not hasattr(value, "dtype"):
        return value if isinstance(value, jax.core.Tracer) else np.asarray(value)
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key) or value.size > 4096:
        return value
    return np.asarray(value)


def rows_of(value: Value, lanes: int) -> Shaped[jax.Array, "... L"]:
    """The value broadcast to (*shape, L), whether or not the lanes differ."""
    if isinstance(value, Lane):
        return value.rows
    value = jnp.asarray(value)
    return lax.broadcast_in_dim(value, (*value.shape, lanes), tuple(range(value.ndim)))


def at_place(rows: Shaped[jax.Array, "..."], index: Mapping[int, int]) -> Shaped[jax.Array, "..."]:
    """The rows at one index along each of some axes, which are dropped."""
    start = [index.get(axis, 0) for axis in range(rows.ndim)]
    stop = [index[a] + 1 if a in index else size for a, size in enumerate(rows.shape)]
    return lax.squeeze(lax.slice(rows, start, stop), tuple(index))


def scan_rows(
    rows: Shaped[jax.Array, "*shape"], axis: int, combine: Combine, neutral: int, reverse: bool
) -> Shaped[jax.Array, "*shape"]:
    size, step = rows.shape[axis], 1
    while step < size:
        config = [(0, 0, 0)] * rows.ndim
        config[axis] = (-step, step, 0) if reverse else (step, -step, 0)
        shifted = lax.pad(rows, jnp.asarray(neutral, rows.dtype), config)
        rows = barrier(combine(rows, shifted))
        step *= 2
    return rows
