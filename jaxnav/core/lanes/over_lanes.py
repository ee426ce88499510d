"""Evaluate a function like `jax.vmap`, with the batch axis last, for thousands of small problems.

`vmap` puts the batch axis first: it computes a batch of 6 x 6 matrices six numbers at a time,
every branch of a `cond` for every lane, and a loop until the slowest of all lanes ends.
`over_lanes` evaluates the same jaxpr with the batch axis last: an operation on one number becomes
an operation on a row of lanes in vector registers, and products of small matrices are sums of rows.
A `cond` whose index differs between the lanes sorts them by branch: each branch runs over blocks of
its own lanes and costs only those blocks.

A lane's result does not depend on the other lanes. Derivatives are those of `vmap`.

The evaluation leans on internals of JAX (README.md has them). Where those of the installed JAX do
not fit, `vmap` itself is taken, with one warning.
"""

import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import PyTree

# LLVM's costly passes double the compile time and buy nothing.
_OPTIONS: dict[str, str | int] = {"xla_backend_optimization_level": 1}
# The first four move what they find by one operation a round: for them XLA goes through a large
# program 25 times, then gives up, not 4. Without barriers XLA for the CPU computes anew, at every
# use, the values that `over_lanes` writes to memory once; from jaxlib 0.12 on it can't compile them
# in a loop that it has hoisted.
_DISABLED = ",".join(
    (
        "reshape-mover",
        "simplify-while-loops",
        "while-loop-invariant-code-motion",
        "while-loop-constant-sinking",
        "cse_barrier_expander",
    )
)
_PASSES = _DISABLED, f"{_DISABLED},small-while-loop-hoisting"
# What an internal that is missing, or has other parameters, makes the evaluation raise.
_DOES_NOT_FIT = ImportError, AttributeError, LookupError, TypeError, ValueError, NotImplementedError


def over_lanes(fn: Callable[..., PyTree], block: int = 64) -> Callable[..., PyTree]:
    """`jax.vmap(fn, in_axes=-1, out_axes=-1)`, evaluated as the module docstring says.

    Args:
        fn: a pure function of pytrees of arrays.
        block: number of lanes in each block of a `cond`'s branch, however few lanes chose it.
    """

    def batched(*args: PyTree) -> PyTree:
        leaves, tree = jax.tree.flatten(args)
        one = [jax.ShapeDtypeStruct(leaf.shape[:-1], leaf.dtype) for leaf in leaves]
        closed, out = jax.make_jaxpr(
            lambda *a: fn(*jax.tree.unflatten(tree, a)), return_shape=True
        )(*one)

        @jax.custom_jvp
        def evaluated(consts: list[jax.Array], leaves: list[jax.Array]) -> list[jax.Array]:
            from jaxnav.core.lanes.evaluation import evaluate

            return evaluate(closed.jaxpr, consts, leaves, block)

        @evaluated.defjvp
        def _(primals: PyTree, tangents: PyTree) -> PyTree:
            return jax.jvp(
                jax.vmap(
                    lambda consts, leaves: jax.core.eval_jaxpr(closed.jaxpr, consts, *leaves),
                    in_axes=(None, -1),
                    out_axes=-1,
                ),
                primals,
                tangents,
            )

        try:  # `fn` itself has been traced: what fails now is the evaluation
            outs = evaluated(closed.consts, leaves)
        except _DOES_NOT_FIT as error:
            _warn(f"{type(error).__name__}: {error}")
            return jax.vmap(fn, in_axes=-1, out_axes=-1)(*args)
        return jax.tree.unflatten(jax.tree.structure(out), outs)

    return batched


@cache
def _warn(reason: str) -> None:
    """Warn once for each reason."""
    problem = f"jaxnav.core.lanes does not fit jax {jax.__version__} ({reason})"
    warnings.warn(f"{problem}: vmap takes its place, several times as slow", stacklevel=3)


@cache
def compiler_options() -> dict[str, str | int]:
    """Options for the `jit` around a function of `over_lanes`, by what this XLA can compile."""

    def loop(rows: jax.Array) -> jax.Array:  # of so many that jaxlib 0.10 does not hoist it
        return lax.fori_loop(0, 3, lambda _, rows: lax.optimization_barrier(jnp.sin(rows)), rows)

    for passes in _PASSES:
        options = _OPTIONS | {"xla_disable_hlo_passes": passes}
        with suppress(jax.errors.JaxRuntimeError):
            jax.jit(loop, compiler_options=options).lower(jnp.zeros(4096)).compile()
            return options
    return _OPTIONS


def lanes_last(tree: PyTree) -> PyTree:
    """Move the batch axis of every leaf from first to last: (L, ...) to (..., L)."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), tree)


def lanes_first(tree: PyTree) -> PyTree:
    """Move the batch axis of every leaf from last to first: (..., L) to (L, ...)."""
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), tree)
