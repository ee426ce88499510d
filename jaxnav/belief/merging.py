"""Hypotheses that become one: a Gaussian of the same two moments."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxnav.belief.bank import Bank
from jaxnav.numerics.small_matrices import product


def merge_heirs(
    bank: Bank,
    heir: Int[Array, " K"],
    difference: Callable[[Float[Array, " n"], Float[Array, " n"]], Float[Array, " d"]],
    moved: Callable[[Float[Array, " n"], Float[Array, " d"]], Float[Array, " n"]],
) -> Bank:
    """The bank with hypotheses of one heir replaced by one Gaussian of the same two moments.

    Args:
        bank: after the update, with the weights after it.
        heir: index of the hypothesis into which each one is merged.
        difference: (mean, from) -> error state (d,).
        moved: (mean, error state) -> mean.

    Source: Salmond (2009), "Mixture reduction algorithms for point and extended object tracking".
    """
    count = heir.shape[0]
    if count == 1:
        return bank
    mass = jnp.where(bank.initialised, jnp.exp(bank.log_weight), 0)
    member = (heir[None] == jnp.arange(count)[:, None]) & bank.initialised[None]
    total = jnp.sum(jnp.where(member, mass[None], 0), axis=1)
    share = jnp.where(member, mass[None] / jnp.where(total > 0, total, 1)[:, None], 0)
    alone = jnp.sum(member, axis=1) <= 1

    def common() -> tuple[Array, Array]:
        apart = jax.vmap(difference)(bank.mean, bank.mean[heir])
        shift = product(share, apart)
        spread = apart - shift[heir]
        second = bank.covariance + spread[:, :, None] * spread[:, None]
        covariance = product(share, second.reshape(count, -1)).reshape(second.shape)
        return jax.vmap(moved)(bank.mean, shift), covariance

    # Few frames merge anything.
    mean, covariance = jax.lax.cond(jnp.all(alone), lambda: (bank.mean, bank.covariance), common)
    stays = bank.initialised & (heir == jnp.arange(count))
    return dataclasses.replace(
        bank,
        mean=jnp.where(alone[:, None], bank.mean, mean),
        covariance=jnp.where(alone[:, None, None], bank.covariance, covariance),
        log_weight=jnp.where(stays, jnp.log(jnp.where(total > 0, total, 1)), bank.log_weight),
        initialised=stays,
    )
