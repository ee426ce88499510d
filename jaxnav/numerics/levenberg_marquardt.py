"""A Levenberg-Marquardt step for a handful of unknowns, as a solver that optimistix runs.

optimistix provides the loop, the bound on the steps and the result codes; this class defines a
step. Unlike `optimistix.LevenbergMarquardt` it forms J'J once a step, and it stops when no step can
lower the cost any more, not when y and every residual stop changing.
`benchmarks/bench_pair.py`: 1.6 times as fast at equal steps; compilation takes half
the time, and float32 works in a process that has float64 enabled.
"""

from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxnav.numerics.small_matrices import solve_positive

_FOUND = "found"
# For the gradient of many steps, `jax.checkpoint(step, policy=KEEP_FOUND)`: it stores the carry of
# a step and the minima of its searches, so the backward pass repeats no search.
KEEP_FOUND = jax.checkpoint_policies.save_only_these_names(_FOUND)


def mark_found(tree: PyTree) -> PyTree:
    """The tree with its arrays named as the result of a search, which `KEEP_FOUND` stores."""
    return jax.tree.map(
        lambda leaf: checkpoint_name(leaf, _FOUND) if eqx.is_array(leaf) else leaf, tree
    )


class NormalEquations(eqx.Module):
    """J'J and J'r of N problems with n unknowns each."""

    information: Float[Array, "n n N"]  # J'J
    gradient: Float[Array, "n N"]  # J'r


class LMState(eqx.Module):
    """Cost and normal equations at the accepted points, and the damping to try next."""

    cost: Float[Array, " N"]  # sum of squares
    normal: NormalEquations
    damping: Float[Array, " N"]  # lambda; 0: none yet
    growth: Float[Array, " N"]  # factor on lambda after a step that is not accepted
    steps: Int[Array, " N"]
    first: Bool[Array, ""]
    done: Bool[Array, " N"]


class NormalEquationsLM(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt on dense normal equations with Nielsen's damping, N problems at once.

        (J'J + lambda I) move = -J'r

    The function maps unknowns (n, N) to residuals (m, N), problem by problem, and returns their
    `NormalEquations` as `aux`. A step is accepted where it lowers the cost |r|^2. A problem is done
    where the model promises to lower its cost by less than `rtol * cost + atol`; it then stays
    where it is, and the solver ends when all are done. `solution.state` holds `done` and `steps` of
    each problem.

    The unknowns should be scaled alike, since lambda * I damps them all, and few, since J'J squares
    the condition number.

    Source: Madsen, Nielsen, Tingleff (2004), "Methods for non-linear least squares problems",
    Algorithm 3.16.
    """

    rtol: float
    atol: float
    initial_damping: float = 1e-5  # times the largest diagonal entry of J'J
    norm: Callable[[PyTree], Array] = optx.max_norm

    def init(
        self,
        fn: Any,
        y: Array,
        args: PyTree,
        options: dict[str, Any],
        f_struct: PyTree,
        aux_struct: PyTree,
        tags: frozenset[object],
    ) -> LMState:
        """The state before the first step, which stays at y and evaluates the function there."""
        lanes = jnp.zeros(y.shape[1], y.dtype)
        return LMState(
            cost=lanes + jnp.inf,
            normal=NormalEquations(jnp.zeros((y.shape[0], *y.shape), y.dtype), jnp.zeros_like(y)),
            damping=lanes,  # the first point with a derivative chooses it
            growth=lanes + 2,
            steps=lanes.astype(int),
            first=jnp.asarray(True),
            done=lanes > 0,
        )

    def step(
        self,
        fn: Any,
        y: Array,
        args: PyTree,
        options: dict[str, Any],
        state: LMState,
        tags: frozenset[object],
    ) -> tuple[Array, LMState, PyTree]:
        """Try one damped step of every problem, accept it where the cost falls, adapt lambda."""
        information, gradient = state.normal.information, state.normal.gradient
        diagonal = jnp.stack([information[i, i] for i in range(y.shape[0])])
        largest = jnp.max(diagonal, axis=0)
        damping = jnp.where(
            state.damping > 0,
            jnp.maximum(state.damping, jnp.finfo(y.dtype).eps * largest),
            self.initial_damping * largest,
        )
        move = -solve_positive(information, gradient, damping)
        move = jnp.where(jnp.isfinite(move), move, 0)
        promised = jnp.sum(move * (damping[None] * move - gradient), axis=0)

        residual, normal = fn(y + move, args)
        cost = jnp.sum(residual**2, axis=0)
        accept = (cost < state.cost) & ~state.done
        gained = (state.cost - cost) / jnp.where(promised > 0, promised, 1)
        relaxed = jnp.maximum(1 / 3, 1 - (2 * gained - 1) ** 3)
        exhausted = promised <= self.rtol * state.cost + self.atol
        return (
            jnp.where(accept[None], y + move, y),
            LMState(
                cost=jnp.where(accept, cost, state.cost),
                normal=NormalEquations(
                    jnp.where(accept[None, None], normal.information, information),
                    jnp.where(accept[None], normal.gradient, gradient),
                ),
                damping=damping * jnp.where(accept, relaxed, state.growth),
                growth=jnp.where(accept, 2.0, 2 * state.growth),
                steps=state.steps + ~state.done,
                first=jnp.asarray(False),
                done=state.done | (~state.first & exhausted),
            ),
            normal,
        )

    def terminate(
        self,
        fn: Any,
        y: Array,
        args: PyTree,
        options: dict[str, Any],
        state: LMState,
        tags: frozenset[object],
    ) -> tuple[Array, optx.RESULTS]:
        """Whether all problems are done."""
        return jnp.all(state.done), cast(optx.RESULTS, optx.RESULTS.successful)

    def postprocess(
        self,
        fn: Any,
        y: Array,
        aux: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: LMState,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[Array, PyTree, dict[str, Any]]:
        """The accepted points as they are."""
        return y, aux, {}


class ImplicitGradient(optx.AbstractAdjoint):
    """Derivatives of N minima (n, N) by the implicit function theorem: dy = -H^-1 d(gradient).

    H is the Hessian of the cost, (n, n) for each problem. The result is that of
    `optimistix.ImplicitAdjoint`, without its check of the linear solve, which calls the host and
    raises there. The gradient comes from the function's `aux`, so it is differentiated once less.
    Where the Hessian is not positive definite the derivative is zero.
    """

    def apply(
        self,
        primal_fn: Callable[..., Any],
        rewrite_fn: Callable[..., Any],
        inputs: PyTree,
        tags: frozenset[object],
    ) -> PyTree:
        """The minimum and the solver's other results; only the minimum has derivatives."""
        fixed = jax.tree.map(
            lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, inputs
        )
        root, residual = mark_found(
            optx.ImplicitAdjoint().apply(primal_fn, rewrite_fn, fixed, tags)
        )
        return moving_with(root, inputs, gradient=_gradient, residual=residual), residual


def _gradient(y: Array, _: PyTree, inputs: PyTree) -> Array:
    fn, _, _, args, *_ = inputs  # as optimistix passes them to its own `rewrite_fn`
    _, normal = fn(y, args)
    return normal.gradient


@eqx.filter_custom_jvp
def moving_with(
    root: Array, inputs: PyTree, *, gradient: Callable[..., Array], residual: PyTree
) -> Array:
    """The root of gradient(root, residual, inputs) = 0, with its derivative by `inputs`."""
    return root


@moving_with.def_jvp
def _moving_with_jvp(
    primals: PyTree, tangents: PyTree, *, gradient: Callable[..., Array], residual: PyTree
) -> tuple[Array, Array]:
    (root, inputs), (_, t_inputs) = primals, tangents
    without = jax.tree.map(lambda t: t is None, t_inputs, is_leaf=lambda t: t is None)
    constant, varying = eqx.partition(inputs, without, is_leaf=lambda t: t is None)
    _, t_gradient = jax.jvp(
        lambda v: gradient(root, residual, eqx.combine(v, constant)), (varying,), (t_inputs,)
    )
    # Problems are independent: one direction for all of them yields a column of every Hessian.
    _, push_forward = jax.linearize(lambda y: gradient(y, residual, inputs), root)
    n, lanes = root.shape
    directions = jnp.broadcast_to(jnp.eye(n, dtype=root.dtype)[:, :, None], (n, n, lanes))
    columns = jax.vmap(push_forward)(directions)
    inverse = jax.vmap(solve_positive, in_axes=(None, 0))(columns, directions)
    solvable = jnp.all(jnp.isfinite(inverse), axis=(0, 1))
    inverse = jnp.where(solvable[None, None], inverse, 0)
    return root, -jnp.sum(inverse * t_gradient[:, None], axis=0)
