"""The second pose of one prediction: where it spans both poses of a marker, it has two posteriors.

Near the frontal view the two poses meet and a bank merges them; further on they part again. Beside
the posterior next to the prediction, an empty slot takes the one of the prediction and another
candidate, both as Gaussians.

Source: Alspach, Sorenson (1972), "Nonlinear Bayesian estimation using Gaussian sum approximations".
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.ambiguity import PoseBelief
from jaxnav.core.linalg.small_matrices import cholesky, log_det, matvec, sandwich, solve_lower
from jaxnav.core.models.geometry import inverse_cayley
from jaxnav.core.pose.candidates import Candidates


class SecondPoses(NamedTuple):
    """The candidates that one predicted hypothesis may have meant as well."""

    wanted: Bool[Array, " N"]
    xi: Float[Array, "N d"]  # along `freedom`, from the prediction


class Branches(NamedTuple):
    """The empty slots that take a candidate."""

    taken: Bool[Array, " K"]
    xi: Float[Array, "K d"]  # along `freedom`, from the prediction; 0 where none is taken


def second_poses(
    bank: PoseBelief,
    index: Int[Array, ""] | int,
    candidates: Candidates,
    least_log_weight: Float[Array, ""] | float,
) -> SecondPoses:
    """The candidates that prediction and corners leave possible beside the nearest.

    The nearest one is where the search from the prediction leads.

    Args:
        bank: predicted.
        index: of the hypothesis whose prediction it is.
        candidates: N poses of this observation.
        least_log_weight: of a candidate, beside the most probable one.
    """
    freedom = bank.freedom
    T_prior = jaxlie.SE3(bank.T_world_vehicle.wxyz_xyz[index])
    P = sandwich(freedom.T, bank.covariance[index])
    eye = jnp.eye(freedom.shape[1], dtype=P.dtype)

    def one(
        T_vehicle_world: jaxlie.SE3, covariance: Array, valid: Array
    ) -> tuple[Array, Array, Array]:
        xi = matvec(freedom.T, inverse_cayley(T_prior.inverse() @ T_vehicle_world.inverse()))
        S = P + sandwich(freedom.T, covariance)
        usable = valid & jnp.all(jnp.isfinite(S)) & jnp.all(jnp.isfinite(xi))
        xi, S = jnp.where(usable, xi, 0), jnp.where(usable, S, eye)
        root = cholesky(S)
        away = jnp.sum(solve_lower(root, xi) ** 2)
        return xi, jnp.where(usable, away, jnp.inf), log_det(root)

    xi, away, volume = jax.vmap(one)(
        candidates.T_vehicle_world, candidates.covariance, candidates.valid
    )
    cost = jnp.where(candidates.valid, candidates.cost, jnp.inf)
    log_weight = -(cost + away + volume) / 2
    probable = log_weight > jnp.max(log_weight) + least_log_weight
    nearest = jnp.arange(away.shape[0]) == jnp.argmin(away)
    return SecondPoses(probable & ~nearest & bank.initialised[index], xi)


def give_slots(second: SecondPoses, empty: Bool[Array, " K"]) -> Branches:
    """Each second pose in an empty slot of its own, as long as there are any."""
    wanted = second.wanted
    in_order = jnp.cumsum(empty)[:, None] == jnp.cumsum(wanted)[None]
    taken = in_order & empty[:, None] & wanted[None]
    xi = jnp.sum(jnp.where(taken[..., None], second.xi[None], 0), axis=1)
    return Branches(jnp.any(taken, axis=1), xi)
