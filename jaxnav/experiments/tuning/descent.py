"""Run an optimiser one step at a time, so that a person can watch, stop and resume it.

    descent = Smooth(loss) or Noisy(evaluate, learning_rate)
    state = descent.init(x)
    state = descent.step(state, batch, softness)       # until state.over

`loss(x, batch, softness)` is a scalar; x is a flat vector. `Smooth` is optimistix's BFGS, for a
loss that is the same function in every step; `Noisy` is optax's Adam, for a loss drawn anew.

No step is taken on a loss or gradient that is not finite: the state stays, with `finite` False.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from jaxnav.core.linalg.small_matrices import where

Loss = Callable[[Float[Array, " n"], PyTree, Float[Array, ""]], Float[Array, ""]]


class Descent(eqx.Module):
    """The state of an optimiser."""

    x: Float[Array, " n"]
    asked_x: Float[Array, " n"]  # where loss and gradient were last evaluated, finite or not
    loss: Float[Array, ""]  # at x, or of the batch that led to it; inf before the first step
    gradient: Float[Array, " n"]  # likewise
    finite: Bool[Array, ""]  # False: loss or gradient was not finite, and nothing moved
    over: Bool[Array, ""]  # no further step is worthwhile
    inner: PyTree  # the optimiser's own


class Smooth(eqx.Module):
    """BFGS with a backtracking line search; one step is one evaluation.

    Source: Nocedal, Wright (2006), "Numerical optimization", algorithm 6.1.
    """

    loss: Loss
    rtol: float = 1e-4
    atol: float = 1e-4

    @property
    def _solver(self) -> optx.BFGS:
        return optx.BFGS(self.rtol, self.atol)

    def _fn(self, x: Array, args: tuple[PyTree, Array]) -> tuple[Array, None]:
        return self.loss(x, *args), None

    @eqx.filter_jit
    def init(self, x: Float[Array, " n"], batch: PyTree, softness: Float[Array, ""]) -> Descent:
        """The state at x, before any evaluation."""
        scalar = jax.ShapeDtypeStruct((), x.dtype)
        state = self._solver.init(self._fn, x, (batch, softness), {}, scalar, None, frozenset())
        return _unknown(x, eqx.filter(state, eqx.is_array))

    @eqx.filter_jit
    def step(self, state: Descent, batch: PyTree, softness: Float[Array, ""]) -> Descent:
        """Evaluate once more; the point is kept if it lowers the loss enough."""
        solver, args, tags = self._solver, (batch, softness), frozenset[object]()
        scalar = jax.ShapeDtypeStruct((), state.x.dtype)
        form = solver.init(self._fn, state.x, args, {}, scalar, None, tags)
        before = eqx.combine(state.inner, eqx.filter(form, eqx.is_array, inverse=True))
        x, after, _ = solver.step(self._fn, state.x, args, {}, before, tags)
        over, _ = solver.terminate(self._fn, x, args, {}, after, tags)
        f, gradient = after.f_info.f, after.f_info.grad
        finite = jnp.all(jnp.isfinite(jnp.append(gradient, f)))
        moved = Descent(x, x, f, gradient, finite, over, eqx.filter(after, eqx.is_array))
        kept = Descent(state.x, x, state.loss, gradient, finite, finite, state.inner)
        return where(finite, moved, kept)


class Noisy(eqx.Module):
    """Adam with a clipped gradient norm and a decaying learning rate.

    Source: Kingma, Ba (2015), "Adam: a method for stochastic optimization", algorithm 1.
    """

    # (x, batch, softness) -> loss and gradient; not compiled here.
    evaluate: Callable[
        [Float[Array, " n"], PyTree, Float[Array, ""]], tuple[Float[Array, ""], Float[Array, " n"]]
    ]
    learning_rate: float = 0.05
    steps: int = 100  # the learning rate is a tenth after so many
    longest: float = 1.0  # the norm to which a longer gradient is clipped

    @property
    def _solver(self) -> optax.GradientTransformation:
        rate = optax.cosine_decay_schedule(self.learning_rate, self.steps, alpha=0.1)
        return optax.chain(optax.clip_by_global_norm(self.longest), optax.adam(rate, b2=0.99))

    def init(self, x: Float[Array, " n"], batch: PyTree, softness: Float[Array, ""]) -> Descent:
        """The state at x, before any evaluation."""
        return _unknown(x, self._solver.init(x))

    def step(self, state: Descent, batch: PyTree, softness: Float[Array, ""]) -> Descent:
        """Take one step along the gradient of this batch."""
        loss, gradient = self.evaluate(state.x, batch, softness)
        return _moved(self._solver, state, loss, gradient)


def _unknown(x: Array, inner: PyTree) -> Descent:
    yes, no = jnp.asarray(True), jnp.asarray(False)
    return Descent(x, x, jnp.full((), jnp.inf, x.dtype), jnp.zeros_like(x), yes, no, inner)


@eqx.filter_jit
def _moved(
    solver: optax.GradientTransformation, state: Descent, loss: Array, gradient: Array
) -> Descent:
    finite = jnp.all(jnp.isfinite(jnp.append(gradient, loss)))
    update, inner = solver.update(jnp.where(finite, gradient, 0), state.inner, state.x)
    no = jnp.asarray(False)
    x = optax.apply_updates(state.x, update)
    moved = Descent(x, state.x, loss, gradient, finite, no, inner)
    kept = Descent(state.x, state.x, state.loss, gradient, finite, no, state.inner)
    return where(finite, moved, kept)
