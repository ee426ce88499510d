"""Parameters as numbers that may be anything: what an optimiser moves.

    space = Space.of(navigator, trainable={"motion.odometry_sigma": True, ...})
    navigator = with_parameters(navigator, space.values(x))    # at any vector x, as space.start is

Numbers that are positive each by itself are a softplus, in units of what is typical of them. A
covariance is log-Cholesky: L with exp on its diagonal, L L' scaled; where it is diagonal, the
logarithms of the diagonal alone. So no step leads out of what is allowed. What is 0 or infinite
starts at what is typical of it.

Source: Pinheiro, Bates (1996), "Unconstrained parametrizations for variance-covariance matrices",
section 2.2.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxnav.navigator import Navigator
from jaxnav.numerics.small_matrices import product
from jaxnav.parameters import TUNABLES, Tunable, parameters_of

# A logarithm of a ratio to what is typical stays within this, and what is no logarithm within as
# much: e^20 either way. Squares of that are numbers in float32.
_FARTHEST = 20.0
_MOST = float(np.exp(_FARTHEST))


class Space(eqx.Module):
    """Some parameters of a navigator, unconstrained."""

    free: dict[str, Float[Array, "*shape"]]  # name -> where tuning starts
    full: frozenset[str] = eqx.field(static=True)  # those that are whole matrices

    @staticmethod
    def of(
        navigator: Navigator, trainable: Mapping[str, bool], full: frozenset[str] = frozenset()
    ) -> "Space":
        """Where a navigator stands.

        Args:
            trainable: which of its parameters may move, by name; those left out may not.
            full: which of them are whole matrices, the others diagonal where they can be either.

        Raises:
            ValueError: a name that the navigator does not have, or that can't be a matrix.
        """
        known = parameters_of(navigator)
        free = {}
        for name in sorted(full | {name for name, moves in trainable.items() if moves}):
            if name not in known:
                raise ValueError(f"{name}: unknown: expected one of {', '.join(known)}")
            if name in full and TUNABLES[name].matrix is None:
                raise ValueError(f"{name}: is no covariance, and can't be a full one")
            if trainable.get(name, False):
                free[name] = _free(TUNABLES[name], known[name], name in full)
        return Space(free, full)

    @property
    def start(self) -> Float[Array, " n"]:
        """All of them as one vector, where tuning starts."""
        return ravel_pytree(self.free)[0]

    @property
    def labels(self) -> list[str]:
        """The name that each entry of the vector belongs to."""
        return [name for name in sorted(self.free) for _ in range(self.free[name].size)]

    def values(self, x: Float[Array, " n"]) -> dict[str, Float[Array, "*shape"]]:
        """What a navigator takes, from a vector that may be anything."""
        free = ravel_pytree(self.free)[1](x)
        return {
            name: _bound(TUNABLES[name], leaf, name in self.full) for name, leaf in free.items()
        }


def _free(tunable: Tunable, value: Array, full: bool) -> Array:
    if value.ndim == 2 and not full:
        value = jnp.diagonal(value)
        value = jnp.sqrt(value) if tunable.matrix == "sigma" else value
    if value.ndim < 2:
        known = jnp.isfinite(value) & (value > 0)
        ratio = jnp.where(known, value / tunable.typical, 1)
        if tunable.matrix is None:
            # The inverse of softplus, exact for small and for large ones.
            ratio = ratio * np.log(2)
            return jnp.clip(ratio + jnp.log(-jnp.expm1(-ratio)), -_FARTHEST, _MOST)
        if not full:
            return _log(ratio)
        L = jnp.diag(ratio if tunable.matrix == "sigma" else jnp.sqrt(ratio))
    else:
        L = jnp.linalg.cholesky(value) / _unit(tunable)
    return jnp.tril(L, -1) + jnp.diag(_log(jnp.diagonal(L)))


def _bound(tunable: Tunable, free: Array, full: bool) -> Array:
    if tunable.matrix is None:
        return tunable.typical * jax.nn.softplus(jnp.clip(free, -_FARTHEST, _MOST)) / np.log(2)
    if not full:
        return tunable.typical * _exp(free)
    diagonal = _exp(jnp.diagonal(free))
    L = _unit(tunable) * (jnp.tril(jnp.clip(free, -_MOST, _MOST), -1) + jnp.diag(diagonal))
    return product(L, L.T)


def _log(ratio: Array) -> Array:
    return jnp.clip(jnp.log(ratio), -_FARTHEST, _FARTHEST)


def _exp(free: Array) -> Array:
    return jnp.exp(jnp.clip(free, -_FARTHEST, _FARTHEST))


def _unit(tunable: Tunable) -> float:
    """Of a covariance's factor."""
    return tunable.typical if tunable.matrix == "sigma" else float(np.sqrt(tunable.typical))
