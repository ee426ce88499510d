"""Levenberg-Marquardt for many small blocks of unknowns and a few shared ones, run by optimistix.

The pose of a frame is a block of six unknowns, coupled only with the shared ones: cameras, markers,
lenses. The blocks are eliminated one by one, which leaves a dense system of the shared unknowns.
Cost and memory grow in proportion to the number of frames.

Source: Brown (1958), "A solution to the general problem of multiple station analytical
stereotriangulation"; Triggs, McLauchlan, Hartley, Fitzgibbon (2000), "Bundle adjustment: a modern
synthesis", section 6; damping as in `jaxnav.numerics.levenberg_marquardt`.
"""

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxnav.numerics.small_matrices import cholesky, solve_lower, solve_upper


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


class SchurState(eqx.Module):
    """Cost and normal equations at the accepted point, and the damping to try next."""

    cost: Float[Array, ""]
    blocks: Blocks
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    steps: Int[Array, ""]
    done: Bool[Array, ""]


class SchurLM(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt that eliminates blocks of unknowns.

        (J'J + lambda diag(J'J)) move = -J'r

    The function maps y, any pytree, to residuals, and returns their `Blocks` as `aux`;
    `retract(y, own, shared)` moves y by the blocks' move (F, n) and the shared one (R,). The search
    ends when the model promises to lower the cost by less than `rtol * cost + atol`.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Array]
    retract: Callable[[PyTree, Array, Array], PyTree]
    free: Bool[Array, " R"]
    initial_damping: float = 1e-4  # of J'J's diagonal

    def init(
        self,
        fn: Any,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        f_struct: PyTree,
        aux_struct: PyTree,
        tags: frozenset[object],
    ) -> SchurState:
        """The state at y: cost and normal equations there."""
        residual, blocks = fn(y, args)
        dtype = residual.dtype
        return SchurState(
            cost=jnp.sum(residual**2),
            blocks=blocks,
            damping=jnp.asarray(self.initial_damping, dtype),
            growth=jnp.asarray(2, dtype),
            steps=jnp.asarray(0),
            done=jnp.asarray(False),
        )

    def step(
        self,
        fn: Any,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: SchurState,
        tags: frozenset[object],
    ) -> tuple[PyTree, SchurState, PyTree]:
        """Try one damped step, accept it where the cost falls, and adapt lambda."""
        blocks, damping = state.blocks, state.damping
        reduced = reduce(blocks, self.free, damping)
        factor = jax.scipy.linalg.cho_factor(reduced.system, lower=True)
        shared = -jax.scipy.linalg.cho_solve(factor, reduced.gradient)
        shared = jnp.where(self.free, shared, 0)
        own = reduced.back_substitute(shared)
        sound = jnp.all(jnp.isfinite(shared)) & jnp.all(jnp.isfinite(own))
        shared, own = jnp.where(sound, shared, 0), jnp.where(sound, own, 0)
        raised = damping * jnp.diagonal(blocks.own, axis1=1, axis2=2) * own**2
        raised_shared = damping * jnp.diagonal(blocks.shared) * shared**2
        promised = (
            jnp.sum(raised)
            + jnp.sum(raised_shared)
            - jnp.sum(own * blocks.own_gradient)
            - jnp.sum(shared * blocks.shared_gradient)
        )

        tried = self.retract(y, own, shared)
        residual, tried_blocks = fn(tried, args)
        cost = jnp.sum(residual**2)
        accept = (cost < state.cost) & sound
        gained = (state.cost - cost) / jnp.where(promised > 0, promised, 1)
        relaxed = jnp.maximum(1 / 3, 1 - (2 * gained - 1) ** 3)
        exhausted = sound & (promised <= self.rtol * state.cost + self.atol)

        def chosen(new: PyTree, old: PyTree) -> PyTree:
            return jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, old)

        after = SchurState(
            cost=jnp.where(accept, cost, state.cost),
            blocks=chosen(tried_blocks, blocks),
            damping=jnp.clip(damping * jnp.where(accept, relaxed, state.growth), 1e-12, 1e12),
            growth=jnp.where(accept, 2.0, 2 * state.growth),
            steps=state.steps + 1,
            done=exhausted,
        )
        return chosen(tried, y), after, tried_blocks

    def terminate(
        self,
        fn: Any,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: SchurState,
        tags: frozenset[object],
    ) -> tuple[Array, optx.RESULTS]:
        """Whether the model promises no further gain."""
        return state.done, cast(optx.RESULTS, optx.RESULTS.successful)

    def postprocess(
        self,
        fn: Any,
        y: PyTree,
        aux: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: SchurState,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[PyTree, PyTree, dict[str, Any]]:
        """The accepted point as it is."""
        return y, aux, {}
