"""Run a loop of `over_lanes` one strip of lanes at a time, in a single kernel.

XLA for the CPU makes a kernel of every fused operation, and each kernel passes over all lanes of a
block before the next one starts: by then its operands have left the first-level cache. XLA compiles
a call with the attribute `xla_cpu_small_call` to one function, loops included. A strip iterates
until its own slowest lane ends, not the slowest of the block.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core
from jaxtyping import Shaped

from jaxnav.core.lanes.rules import ELEMENTWISE, RULES
from jaxnav.core.lanes.values import Lane, Value, one_kernel, rows_of

STRIP = 32  # lanes; LLVM does not vectorise loops over 16, and 64 leave the first-level cache
CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}
_LOOPS = {"while": ("cond_jaxpr", "body_jaxpr"), "scan": ("jaxpr",)}
# Primitives that neither sort lanes nor call a library.
_FITTING = ELEMENTWISE | RULES.keys() | {"iota", "select_if_vmap"}


def by_itself(eqn: core.JaxprEqn) -> bool:
    """Whether an equation can become part of a single kernel on this backend."""
    name, params = eqn.primitive.name, eqn.params
    inner = _LOOPS.get(name, (CALLS[name],) if name in CALLS else ())
    if not inner:
        return name in _FITTING
    on_cpu = jax.default_backend() == "cpu"
    return on_cpu and all(by_itself(eqn) for part in inner for eqn in params[part].jaxpr.eqns)


def in_strips(
    loop: Callable[[list[Value]], list[Value]],
    fixed: Sequence[Value],
    start: list[Shaped[jax.Array, "... L"]],
) -> list[Shaped[jax.Array, "... L"]]:
    """Run a loop `STRIP` lanes at a time; the last strip repeats lanes if they don't divide evenly.

    Args:
        loop: from `fixed` and the initial carry to the final carry.
        start: (..., L), the initial carry, computed outside: XLA aborts on some initial constants.
    """
    lanes = start[0].shape[-1]
    varying = [arg.rows for arg in fixed if isinstance(arg, Lane)]
    shared = [arg for arg in fixed if not isinstance(arg, (Lane, np.ndarray))]

    def kernel(
        varying: list[jax.Array], shared: list[jax.Array], start: list[jax.Array]
    ) -> list[jax.Array]:
        def strip(number: jax.Array, outs: list[jax.Array]) -> list[jax.Array]:
            first = jnp.minimum(number * STRIP, lanes - STRIP)

            def here(row: jax.Array) -> Lane:
                return Lane(lax.dynamic_slice_in_dim(row, first, STRIP, row.ndim - 1))

            rows, others = map(here, varying), iter(shared)

            def take(arg: Value) -> Value:
                if isinstance(arg, Lane):
                    return next(rows)
                return arg if isinstance(arg, np.ndarray) else next(others)

            ends = loop([*map(take, fixed), *map(here, start)])
            return [
                lax.dynamic_update_slice_in_dim(out, rows_of(end, STRIP), first, out.ndim - 1)
                for out, end in zip(outs, ends, strict=True)
            ]

        # Inside the kernel only the barriers carry attributes.
        with one_kernel(), set_xla_metadata(inlineable=None, xla_cpu_small_call=None):
            return lax.fori_loop(0, -(-lanes // STRIP), strip, [jnp.zeros_like(s) for s in start])

    with set_xla_metadata(inlineable="false", xla_cpu_small_call="true"):
        return list(jax.jit(kernel)(varying, shared, start))
