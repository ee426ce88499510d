"""Elimination of blocks by Schur's complement, against the whole system solved at once."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.calibrate.schur import Blocks, reduce


def test_eliminating_blocks_solves_the_whole_system():
    rng = np.random.default_rng(0)
    F, n, R = 5, 6, 7
    J = rng.normal(size=(200, F * n + R))
    # No residual is about two frames.
    of = rng.integers(F, size=200)
    for f in range(F):
        J[of != f, n * f : n * f + n] = 0
    r = rng.normal(size=200)
    whole, gradient = J.T @ J, J.T @ r
    free = np.ones(R, bool)
    free[2] = False
    frames = [slice(n * f, n * f + n) for f in range(F)]
    blocks = Blocks(
        own=jnp.asarray(np.stack([whole[s, s] for s in frames])),
        cross=jnp.asarray(np.stack([whole[s, F * n :] for s in frames])),
        shared=jnp.asarray(whole[F * n :, F * n :]),
        own_gradient=jnp.asarray(gradient[: F * n].reshape(F, n)),
        shared_gradient=jnp.asarray(gradient[F * n :]),
    )

    @jax.jit
    def found(blocks, free):
        reduced = reduce(blocks, free, jnp.zeros(()))
        shared = -jnp.linalg.solve(reduced.system, reduced.gradient)
        return reduced.system, shared, reduced.back_substitute(shared)

    system, shared, own = found(blocks, jnp.asarray(free))
    kept = np.concatenate([np.ones(F * n, bool), free])
    expected = np.zeros(F * n + R)
    expected[kept] = -np.linalg.solve(whole[np.ix_(kept, kept)], gradient[kept])
    np.testing.assert_allclose(shared, expected[F * n :], atol=1e-9)
    np.testing.assert_allclose(np.ravel(own), expected[: F * n], atol=1e-9)
    inverse = np.linalg.inv(whole[np.ix_(kept, kept)])[F * n :, F * n :]
    got = np.linalg.inv(system)[np.ix_(free, free)]
    np.testing.assert_allclose(got, inverse, atol=1e-9)
