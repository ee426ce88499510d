"""Check derivatives in three ways: forward mode, reverse mode, central differences."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

# Gradients that are finite in the smaller range of float32 are finite in float64; one compilation
# less of what takes longest.
in_float32 = pytest.mark.parametrize("precision", ["float32"], indirect=True)


def check_derivatives(
    function: Callable, *args, rtol: float = 1e-6, atol: float = 1e-6, step: float = 1e-5
) -> None:
    """Holds the derivatives of `function` at `args` against each other along random directions.

    Args:
        function: of pytrees of floats, to a pytree of floats.
        step: of the differences, in the arguments' own units.
    """
    x, unravel = ravel_pytree(args)
    directions = jnp.asarray(np.random.default_rng(0).normal(size=(3, x.size)), x.dtype)

    def flat(x):
        return ravel_pytree(function(*unravel(x)))[0]

    @jax.jit
    def three_ways(x, directions):
        # One after the other: mapped all at once they take minutes and gigabytes to compile.
        value, pull = jax.vjp(flat, x)
        cotangents = jnp.cos(jnp.arange(3 * value.size, dtype=x.dtype)).reshape(3, -1)
        forward = jax.lax.map(lambda d: jax.jvp(flat, (x,), (d,))[1], directions)
        reverse = jax.lax.map(lambda c: pull(c)[0], cotangents)
        steps = step * jnp.concatenate([directions, -directions])
        ahead, behind = jnp.split(jax.lax.map(lambda d: flat(x + d), steps), 2)
        return forward, reverse, cotangents, (ahead - behind) / (2 * step)

    forward, reverse, cotangents, numeric = map(np.asarray, three_ways(x, directions))
    assert np.all(np.isfinite(forward))
    assert np.all(np.isfinite(reverse))
    np.testing.assert_allclose(forward, numeric, rtol=rtol, atol=atol)
    scale = np.abs(forward).sum(axis=1).max()
    np.testing.assert_allclose(
        reverse @ np.asarray(directions).T, cotangents @ forward.T, rtol=1e-8, atol=1e-11 * scale
    )
