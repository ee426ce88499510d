"""Levenberg-Marquardt with Nielsen's damping, as solvers that optimistix runs.

optimistix provides the loop, the bound on the steps and the result codes. `NielsenLM` damps and
accepts steps; a subclass solves the damped equations in their own shape: `NormalEquationsLM` here
for a handful of unknowns, `SchurLM` in `calibrate.schur` for blocks. Unlike
`optimistix.LevenbergMarquardt` they form J'J once a step, and stop when no step can lower the cost
any more, not when y and every residual stop changing.
`benchmarks/bench_pair.py`: 1.6 times as fast at equal steps; compilation takes half
the time, and float32 works in a process that has float64 enabled.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int, PyTree

from jaxnav.core.linalg.small_matrices import solve_positive

_FOUND = "found"
# For the gradient of many steps, `jax.checkpoint(step, policy=KEEP_FOUND)`: it stores the carry of
# a step and the minima of its searches, so the backward pass repeats no search.
KEEP_FOUND = jax.checkpoint_policies.save_only_these_names(_FOUND)


def mark_found(tree: PyTree) -> PyTree:
    """Name arrays as the result of a search, so that `KEEP_FOUND` stores them."""
    return jax.tree.map(
        lambda leaf: checkpoint_name(leaf, _FOUND) if eqx.is_array(leaf) else leaf, tree
    )


class LMState(eqx.Module):
    """Cost and normal equations at the accepted points, and the damping to try next.

    Every array has the axes of the problems last: (N,), or none for a single problem.
    """

    cost: Float[Array, "*N"]  # sum of squares
    normal: PyTree  # the function's `aux`
    damping: Float[Array, "*N"]  # lambda; 0: none yet
    growth: Float[Array, "*N"]  # factor on lambda after a step that is not accepted
    steps: Int[Array, "*N"]
    first: Bool[Array, ""]
    done: Bool[Array, "*N"]


class Move(eqx.Module):
    """The damped step from the accepted points."""

    move: PyTree
    promised: Float[Array, "*N"]  # by how much the model lowers the cost
    damping: Float[Array, "*N"]  # with which it was solved


class LanewiseSolver(optx.AbstractLeastSquaresSolver):
    """A solver of many problems at once, whose accepted points are its result."""

    def postprocess(
        self,
        fn: Any,
        y: PyTree,
        aux: PyTree,
        args: Any,
        options: Any,
        state: Any,
        tags: Any,
        result: optx.RESULTS,
    ) -> tuple[PyTree, PyTree, dict[str, Any]]:
        """The accepted points as they are."""
        return y, aux, {}


class NielsenLM(LanewiseSolver):
    """Levenberg-Marquardt with Nielsen's damping.

    The function maps y to residuals (m, *N), N problems or a single one, and returns its normal
    equations as `aux`. A step is accepted where it lowers the cost |r|^2. A problem is done where
    the model promises to lower its cost by less than `rtol * cost + atol`; it then stays where it
    is, and the solver ends when all are done. `solution.state` holds `done` and `steps` of each.

    Source: Madsen, Nielsen, Tingleff (2004), "Methods for non-linear least squares problems",
    Algorithm 3.16.
    """

    @abstractmethod
    def solved(self, normal: PyTree, damping: Float[Array, "*N"]) -> Move:
        """The step that solves the damped normal equations; a damping of 0 is none yet."""

    @abstractmethod
    def moved(self, y: PyTree, move: PyTree) -> PyTree:
        """The unknowns after a move."""

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: PyTree, tags: Any
    ) -> LMState:
        """The state before the first step, which stays at y and evaluates the function there."""
        problems = jnp.zeros(f_struct.shape[1:], f_struct.dtype)
        return LMState(
            cost=problems + jnp.inf,
            normal=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), aux_struct),
            damping=problems,  # the first point with a derivative chooses it
            growth=problems + 2,
            steps=problems.astype(int),
            first=jnp.asarray(True),
            done=problems > 0,
        )

    def step(
        self, fn: Any, y: PyTree, args: PyTree, options: Any, state: LMState, tags: Any
    ) -> tuple[PyTree, LMState, PyTree]:
        """Try one damped step of every problem, accept it where the cost falls, adapt lambda."""
        solution = self.solved(state.normal, state.damping)
        tried = self.moved(y, solution.move)
        residual, normal = fn(tried, args)
        cost = jnp.sum(residual**2, axis=0)
        accept = (cost < state.cost) & ~state.done
        gained = (state.cost - cost) / jnp.where(solution.promised > 0, solution.promised, 1)
        exhausted = solution.promised <= self.rtol * state.cost + self.atol
        damping, growth = adapted(solution.damping, state.growth, accept, gained)

        def chosen(new: PyTree, old: PyTree) -> PyTree:
            return jax.tree.map(lambda a, b: jnp.where(_for_leaf(accept, a), a, b), new, old)

        after = LMState(
            cost=jnp.where(accept, cost, state.cost),
            normal=chosen(normal, state.normal),
            damping=jnp.where(state.first, 0, damping),
            growth=growth,
            steps=state.steps + ~state.done,
            first=jnp.asarray(False),
            done=state.done | (~state.first & exhausted),
        )
        return chosen(tried, y), after, normal

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: LMState, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Whether all problems are done."""
        return jnp.all(state.done), cast(optx.RESULTS, optx.RESULTS.successful)


def adapted(
    damping: Float[Array, "*N"] | float,
    growth: Float[Array, "*N"] | float,
    accept: Bool[Array, "*N"] | bool,
    gained: Float[Array, "*N"] | float,
) -> tuple[Float[Array, "*N"], Float[Array, "*N"]]:
    """Adapt lambda for the next step, and the factor on it should that one not be accepted.

    Args:
        damping: lambda of this step.
        growth: the factor on it if this step is not accepted.
        accept: whether it lowers the cost,
        gained: and by how much, over what the model promised.
    """
    relaxed = jnp.maximum(1 / 3, 1 - (2 * gained - 1) ** 3)
    return damping * jnp.where(accept, relaxed, growth), jnp.where(accept, 2.0, 2 * growth)


def _for_leaf(accept: Array, leaf: Array) -> Array:
    """The mask of the problems with axes for a leaf's own numbers before it."""
    return jnp.expand_dims(accept, tuple(range(leaf.ndim - accept.ndim)))


class NormalEquations(eqx.Module):
    """J'J and J'r of N problems, or of a single one, with n unknowns each."""

    information: Float[Array, "n n ..."]  # J'J
    gradient: Float[Array, "n ..."]  # J'r


class NormalEquationsLM(NielsenLM):
    """Levenberg-Marquardt on dense normal equations, N problems at once.

        (J'J + lambda I) move = -J'r

    The unknowns (n, N) should be scaled alike, since lambda * I damps them all, and few, since J'J
    squares the condition number. The function's `aux` are `NormalEquations`.
    """

    rtol: float
    atol: float
    initial_damping: float = 1e-5  # times the largest diagonal entry of J'J
    norm: Callable[[PyTree], Float[Array, ""]] = optx.max_norm

    def solved(self, normal: NormalEquations, damping: Float[Array, " N"]) -> Move:
        """The step of every problem; none where its equations can't be solved."""
        information, gradient = normal.information, normal.gradient
        diagonal = jnp.stack([information[i, i] for i in range(gradient.shape[0])])
        largest = jnp.max(diagonal, axis=0)
        damping = jnp.where(
            damping > 0,
            jnp.maximum(damping, jnp.finfo(gradient.dtype).eps * largest),
            self.initial_damping * largest,
        )
        move = -solve_positive(information, gradient, damping)
        move = jnp.where(jnp.isfinite(move), move, 0)
        return Move(move, jnp.sum(move * (damping[None] * move - gradient), axis=0), damping)

    def moved(self, y: Float[Array, "n N"], move: Float[Array, "n N"]) -> Float[Array, "n N"]:
        """The unknowns after a move."""
        return y + move


class ImplicitGradient(optx.AbstractAdjoint):
    """Derivatives of N minima (n, N) by the implicit function theorem: dy = -H^-1 d(gradient).

    H is the Hessian of the cost, (n, n) for each problem. The result is that of
    `optimistix.ImplicitAdjoint`, without its check of the linear solve, which calls the host and
    raises there. The gradient comes from the function's `aux`, so it is differentiated once less.
    Where the Hessian is not positive definite the derivative is zero.
    """

    def apply(
        self,
        primal_fn: Callable[..., PyTree],
        rewrite_fn: Callable[..., PyTree],
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
        return implicit_root(root, inputs, gradient=_gradient, residual=residual), residual


def _gradient(y: Array, _: PyTree, inputs: PyTree) -> Array:
    fn, _, _, args, *_ = inputs  # as optimistix passes them to its own `rewrite_fn`
    _, normal = fn(y, args)
    return normal.gradient


@eqx.filter_custom_jvp
def implicit_root(
    root: Float[Array, "n N"],
    inputs: PyTree,
    *,
    gradient: Callable[..., Float[Array, "n N"]],
    residual: PyTree,
) -> Float[Array, "n N"]:
    """The root of gradient(root, residual, inputs) = 0, with its derivative by `inputs`."""
    return root


@implicit_root.def_jvp
def _implicit_root_jvp(
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
