"""The gate: whether a hypothesis takes a measured pose, and the count of those that it does not.

See docs/design.md, Gate.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter.bank import Bank, Rejections, cleared
from jaxnav.core.linalg.trees import where

Moments = tuple[Float[Array, " n"], Float[Array, "d d"]]  # mean and covariance


class Offer(NamedTuple):
    """One hypothesis as a measured pose would correct it; `apply_gate` chooses."""

    innovation: Float[Array, " m"]  # of the pose, whitened
    posterior: Moments  # where the hypothesis takes the pose
    gate_nis: Float[Array, ""] | float  # a larger NIS is a contradiction, and counted
    log_likelihood: Float[Array, ""]  # of what was measured given the prediction
    inflation: Float[Array, ""] | float = 1.0  # a NIS above inflation * gate_nis is not fused


def apply_gate(
    bank: Bank,
    offer: Offer,
    first: Moments,
    valid: Bool[Array, ""],
) -> tuple[Bank, Float[Array, ""], Bool[Array, ""]]:
    """One hypothesis after the gate, the NIS of its pose, and whether the pose was accepted.

    The hypothesis becomes `first` where it is not initialised, `posterior` where
    NIS = |innovation|^2 <= gate_nis * inflation, and stays as predicted otherwise. The NIS is 0
    where there was nothing to compare.

    Args:
        bank: a bank without its leading axis.
        offer: what the pose makes of it.
        first: what the pose starts.
        valid: whether there is a pose at all.
    """
    nis = jnp.sum(offer.innovation**2)
    offered = valid & bank.initialised
    starts, agrees = valid & ~bank.initialised, offered & (nis <= offer.gate_nis)
    accepted = offered & (nis <= offer.gate_nis * offer.inflation)
    predicted = (bank.mean, bank.covariance)
    mean, covariance = where(accepted, offer.posterior, where(starts, first, predicted))
    return (
        Bank(
            mean,
            covariance,
            bank.log_weight,
            bank.initialised | valid,
            cleared(_and_another(bank.rejections, offered, offer.innovation), agrees | starts),
            bank.number,
            bank.velocity_lead,
            jnp.where(starts, -1, bank.parent),
        ),
        jnp.where(offered, nis, 0),
        accepted | starts,
    )


def _and_another(
    rejections: Rejections, rejected: Bool[Array, ""], innovation: Array
) -> Rejections:
    """Count a rejection; it agrees with the last one if they lie within 60 degrees."""
    both = jnp.sum(innovation**2) * jnp.sum(rejections.last**2)
    along = jnp.sum(innovation * rejections.last)
    agrees = (along > 0) & (along**2 > both / 4)
    return Rejections(
        jnp.where(rejected, jnp.where(agrees, rejections.count, 0) + 1, rejections.count),
        jnp.where(rejected, innovation, rejections.last),
        rejections.duration_s + jnp.where(rejected, rejections.waited_s, 0),
        jnp.where(rejected, 0, rejections.waited_s),
    )


def excess_of(chi2: Float[Array, ""], freedom: Float[Array, ""]) -> Float[Array, ""]:
    """Ratio of a sum of squares to its chi-square's mean plus three sigmas; 1 below it.

    Source: Birge (1932), "The calculation of errors by the method of least squares".
    """
    return jnp.maximum(chi2 / (freedom + 3 * jnp.sqrt(2 * freedom)), 1)
