"""Map a navigator's parameters to unconstrained numbers, which an optimiser moves.

    space = Space.from_navigator(navigator, trainable={"motion.odometry_sigma": True, ...})
    navigator = with_parameters(navigator, space.values(x))    # at any vector x, as space.start is

A positive scalar is a softplus, in units of its typical value. A covariance is log-Cholesky: L with
exp on its diagonal, L L' scaled; a diagonal covariance only the logarithms of its diagonal. So no
step leaves the allowed values. A parameter that is 0 or infinite starts at its typical value.

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

from jaxnav.core.linalg.small_matrices import product
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import TUNABLES, Tunable, parameters_of

# Bound on a logarithm of a ratio to the typical value; other numbers stay within e^20 likewise.
# The squares of such numbers are finite in float32.
_FARTHEST = 20.0
_MOST = float(np.exp(_FARTHEST))


class Space(eqx.Module):
    """The unconstrained space of some parameters of a navigator."""

    free: dict[str, Float[Array, "*shape"]]  # name -> where tuning starts
    full: tuple[str, ...] = eqx.field(static=True)  # those that are whole matrices

    @staticmethod
    def from_navigator(
        navigator: Navigator, trainable: Mapping[str, bool], full: frozenset[str] = frozenset()
    ) -> "Space":
        """The space that starts at a navigator's own parameters.

        Args:
            trainable: parameter name -> whether it may move; names left out may not.
            full: names of the covariances that are full matrices; the others are diagonal.

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
        return Space(free, tuple(sorted(full)))

    @property
    def start(self) -> Float[Array, " n"]:
        """The vector at which tuning starts."""
        return ravel_pytree(self.free)[0]

    @property
    def labels(self) -> list[str]:
        """The parameter name of each entry of the vector."""
        return [name for name in sorted(self.free) for _ in range(self.free[name].size)]

    def values(self, x: Float[Array, " n"]) -> dict[str, Float[Array, "*shape"]]:
        """The navigator's parameter values at any vector x."""
        free = ravel_pytree(self.free)[1](x)
        return {
            name: _bound(TUNABLES[name], leaf, name in self.full) for name, leaf in free.items()
        }


def _free(tunable: Tunable, value: Array, full: bool) -> Array:
    if value.ndim == 2 and not (full or tunable.rows):
        value = jnp.diagonal(value)
        value = jnp.sqrt(value) if tunable.matrix == "sigma" else value
    if value.ndim < 2 or tunable.rows:
        known = jnp.isfinite(value) & (value > 0)
        ratio = jnp.where(known, value / tunable.typical, 1)
        if tunable.matrix is None:
            # The inverse of softplus, exact for small and for large ratios.
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
        value = tunable.typical * jax.nn.softplus(jnp.clip(free, -_FARTHEST, _MOST)) / np.log(2)
        return jnp.minimum(value, tunable.largest(value.shape))
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
    """The unit of a covariance's Cholesky factor."""
    return tunable.typical if tunable.matrix == "sigma" else float(np.sqrt(tunable.typical))
