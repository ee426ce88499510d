"""Levenberg-Marquardt for many small blocks of unknowns and a few shared ones, run by optimistix.

The pose of a frame is a block of six unknowns, coupled only with the shared ones: cameras, markers,
lenses. The blocks are eliminated one by one, which leaves a dense system of the shared unknowns.
Cost and memory grow in proportion to the number of frames.

Source: Brown (1958), "A solution to the general problem of multiple station analytical
stereotriangulation"; Triggs, McLauchlan, Hartley, Fitzgibbon (2000), "Bundle adjustment: a modern
synthesis", section 6; damping as in `jaxnav.core.linalg.levenberg_marquardt`.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxnav.core.linalg.levenberg_marquardt import Move, NielsenLM
from jaxnav.core.linalg.small_matrices import cholesky, solve_lower, solve_upper


class Blocks(eqx.Module):
    """Weighted J'J and J'r of F blocks of n unknowns and of R shared unknowns."""

    own: Float[Array, "F n n"]
    cross: Float[Array, "F n R"]
    shared: Float[Array, "R R"]
    own_gradient: Float[Array, "F n"]
    shared_gradient: Float[Array, " R"]


class ReducedSystem(eqx.Module):
    """The system of the shared unknowns after all blocks were eliminated.

        (S - sum_f C_f' B_f^-1 C_f) dx = -(g - sum_f C_f' B_f^-1 g_f)

    with B `own`, C `cross`, S `shared`, g_f `own_gradient` and g `shared_gradient` of `Blocks`.
    """

    system: Float[Array, "R R"]  # the shared unknowns' information; identity where one is fixed
    gradient: Float[Array, " R"]
    factor: Float[Array, "F n n"]  # lower, of the blocks
    carried: Float[Array, "F n R"]  # factor^-1 cross
    own: Float[Array, "F n"]  # factor^-1 own_gradient

    def back_substitute(self, shared: Float[Array, " R"]) -> Float[Array, "F n"]:
        """The move (F, n) of the blocks that belongs to a move (R,) of the shared unknowns."""
        return jax.vmap(solve_upper)(self.factor, -self.own - self.carried @ shared)


def reduce(blocks: Blocks, free: Bool[Array, " R"], damping: Float[Array, ""]) -> ReducedSystem:
    """Eliminate the blocks by Schur's complement.

    Args:
        blocks: normal equations of all unknowns.
        free: which shared unknowns may move.
        damping: lambda of (J'J + lambda diag(J'J)).
    """
    factor = jax.vmap(cholesky)(_damped(blocks.own, damping))
    carried = jax.vmap(solve_lower)(factor, jnp.where(free[None, None], blocks.cross, 0))
    own = jax.vmap(solve_lower)(factor, blocks.own_gradient)
    flat = carried.reshape(-1, carried.shape[-1])
    system = _damped(blocks.shared, damping) - flat.T @ flat
    gradient = blocks.shared_gradient - flat.T @ own.reshape(-1)
    both = free[:, None] & free[None]
    eye = jnp.eye(free.shape[0], dtype=system.dtype)
    return ReducedSystem(
        system=jnp.where(both, system, eye),
        gradient=jnp.where(free, gradient, 0),
        factor=factor,
        carried=carried,
        own=own,
    )


def _damped(A: Float[Array, "*batch n n"], damping: Array) -> Array:
    """A + damping * diag(A); a diagonal entry of 0, an unobserved parameter, becomes 1."""
    diagonal = jnp.diagonal(A, axis1=-2, axis2=-1)
    raised = jnp.where(diagonal > 0, damping * diagonal, 1)
    eye = jnp.eye(A.shape[-1], dtype=A.dtype).reshape((1,) * (A.ndim - 2) + (A.shape[-1],) * 2)
    return A + eye * raised[..., None]


class SchurLM(NielsenLM):
    """Levenberg-Marquardt that eliminates blocks of unknowns.

        (J'J + lambda diag(J'J)) move = -J'r

    The function's `aux` are the `Blocks`; `retract(y, own, shared)` moves y, any pytree, by the
    blocks' move (F, n) and the shared one (R,).
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Float[Array, ""]]
    retract: Callable[[PyTree, Float[Array, "F n"], Float[Array, " R"]], PyTree]
    free: Bool[Array, " R"]
    initial_damping: float = 1e-4  # of J'J's diagonal

    def solved(self, normal: Blocks, damping: Float[Array, ""]) -> Move:
        """The moves of the blocks and of the shared unknowns; none where they can't be solved."""
        damping = jnp.where(damping > 0, jnp.clip(damping, 1e-12, 1e12), self.initial_damping)
        reduced = reduce(normal, self.free, damping)
        factor = jax.scipy.linalg.cho_factor(reduced.system, lower=True)
        shared = -jax.scipy.linalg.cho_solve(factor, reduced.gradient)
        shared = jnp.where(self.free, shared, 0)
        own = reduced.back_substitute(shared)
        sound = jnp.all(jnp.isfinite(shared)) & jnp.all(jnp.isfinite(own))
        shared, own = jnp.where(sound, shared, 0), jnp.where(sound, own, 0)
        raised = damping * jnp.diagonal(normal.own, axis1=1, axis2=2) * own**2
        raised_shared = damping * jnp.diagonal(normal.shared) * shared**2
        promised = (
            jnp.sum(raised)
            + jnp.sum(raised_shared)
            - jnp.sum(own * normal.own_gradient)
            - jnp.sum(shared * normal.shared_gradient)
        )
        return Move((own, shared), jnp.where(sound, promised, jnp.inf), damping)

    def moved(self, y: PyTree, move: tuple[Float[Array, "F n"], Float[Array, " R"]]) -> PyTree:
        """The unknowns after a move."""
        return self.retract(y, *move)
