"""Hypotheses that become one: a Gaussian of the same two moments."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int

from jaxnav.core.filter.bank import EVEN_LOG_WEIGHT, Bank
from jaxnav.core.linalg.small_matrices import cholesky, product, ranks, sandwich, solve_lower
from jaxnav.core.models.geometry import shift_and_turn


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


def find_heirs(
    T_world_vehicle: jaxlie.SE3,
    covariance: Float[Array, "K 6 6"],
    log_weight: Float[Array, " K"],
    linear: Float[Array, "K 6"],
    freedom: Float[Array, "6 d"],
    distance: Float[Array, ""] | float,
) -> Int[Array, " K"]:
    """Index of the hypothesis into which each one is merged; its own index where it stays.

    A hypothesis merges into the heaviest of those that are close: within `distance` sigmas of the
    receiver, where the sigma includes the shifts and turns in which it is linear.

    Args:
        T_world_vehicle: poses (K,).
        log_weight: -inf of those that are not alive.
        linear: m and rad, of each.
        freedom: directions in which the vehicle can move.
    """
    count, alive = log_weight.shape[0], log_weight > -jnp.inf
    wxyz_xyz = T_world_vehicle.wxyz_xyz
    apart = jax.vmap(jax.vmap(shift_and_turn, (None, 0)), (0, None))(wxyz_xyz, wxyz_xyz)
    apart = jax.vmap(lambda rows: product(rows, freedom))(apart)
    P = covariance + jax.vmap(jnp.diag)(linear**2)
    factor = jax.vmap(lambda P: cholesky(sandwich(freedom.T, P)))(P)
    whitened = jax.vmap(lambda L, a: solve_lower(L, a.T))(factor, apart)
    close = jnp.sum(whitened**2, axis=1) < distance**2  # [receiver, other]
    close = close & alive[:, None] & alive[None]
    # In steps: of two that weigh the same the first one is the heir, not the one of the last bit.
    rank = ranks(jnp.floor(log_weight / EVEN_LOG_WEIGHT))
    heavier = rank[:, None] < rank[None]
    # A hypothesis that receives others is not merged itself.
    takes = close & heavier
    takes = takes & ~jnp.any(takes, axis=0)[:, None]
    best_rank = jnp.where(takes, rank[:, None], count)
    return jnp.where(jnp.any(takes, axis=0), jnp.argmin(best_rank, axis=0), jnp.arange(count))
