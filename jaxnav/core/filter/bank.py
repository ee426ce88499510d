"""A bank of weighted hypotheses, and the bookkeeping of its slots."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.linalg.small_matrices import first_highest
from jaxnav.core.linalg.trees import where

# A pause without any pose contradicts nothing: at most this much of it counts, the time after which
# a missing marker is flagged (docs/promises.md, Missing data).
_PAUSE_S = 1.0
# Hypotheses that a mirror exchanges weigh the same but for rounding, 1e-4 after a second of frames
# in float32; what tells them apart in truth soon tells more than this.
EVEN_LOG_WEIGHT = 1e-3
# A time is up where less than this is left: it adds up from intervals, and has their rounding.
_NO_TIME_S = 1e-3


class Rejections(eqx.Module):
    """Measured poses in a row that contradict the prediction (docs/design.md, Restart)."""

    count: Int[Array, "*K"]  # how many of the last rejections agree with each other
    last: Float[Array, "*K m"]  # whitened innovation of the last rejection
    duration_s: Float[Array, "*K"]  # of the row, with poses taken by an inflated gate
    waited_s: Float[Array, "*K"]  # time since a pose was last offered, over all predictions


class Bank(eqx.Module):
    """K hypotheses: means as the motion model stores them, covariances, weights."""

    mean: Float[Array, "*K n"]
    covariance: Float[Array, "*K d d"]
    log_weight: Float[Array, "*K"]
    initialised: Bool[Array, "*K"]
    rejections: Rejections
    number: Int[Array, "*K"]  # identity of a hypothesis, kept when it changes its slot
    # Velocity, in the vehicle's axes, less its mean over the last moments; zero without odometry.
    velocity_lead: Float[Array, "*K m"]
    parent: Int[Array, "*K"]  # slot at the last observation; -1: it has started at this one


def empty_bank(
    mean: Float[Array, " n"], covariance: Float[Array, "d d"], pose_states: int, hypotheses: int
) -> Bank:
    """K hypotheses that have seen nothing."""
    return Bank(
        mean=jnp.tile(mean, (hypotheses, 1)),
        covariance=jnp.tile(covariance, (hypotheses, 1, 1)),
        log_weight=jnp.zeros(hypotheses, mean.dtype),
        initialised=jnp.zeros(hypotheses, bool),
        number=jnp.arange(hypotheses),
        rejections=Rejections(
            jnp.zeros(hypotheses, int),
            jnp.zeros((hypotheses, pose_states), mean.dtype),
            jnp.zeros(hypotheses, mean.dtype),
            jnp.zeros(hypotheses, mean.dtype),
        ),
        velocity_lead=jnp.zeros((hypotheses, pose_states), mean.dtype),
        parent=-jnp.ones(hypotheses, int),
    )


def heaviest(bank: Bank) -> Int[Array, ""]:
    """Index of the most probable hypothesis; the first of those that weigh the same."""
    log_weight = jnp.where(bank.initialised, bank.log_weight, -jnp.inf)
    return first_highest(log_weight, EVEN_LOG_WEIGHT)


def known_to(
    bank: Bank, apart_rad: Float[Array, " K"], variance: Float[Array, " K"]
) -> Float[Array, ""]:
    """Second moment of an angle over a bank, about the reported hypothesis, rad^2.

    Args:
        apart_rad: of each hypothesis from the reported one.
        variance: of each hypothesis, rad^2.
    """
    mass = jnp.where(bank.initialised, jnp.exp(bank.log_weight), 0)
    total = jnp.sum(mass)
    share = mass / jnp.where(total > 0, total, 1)
    return jnp.sum(share * (variance + apart_rad**2))


def mixture_log_mean(bank: Bank, log_values: Float[Array, " K"]) -> Float[Array, ""]:
    """log (sum_k w_k exp(log_value_k) / sum_k w_k) over initialised hypotheses; 0 without any."""
    lives = bank.initialised
    log_weight = jnp.where(lives, bank.log_weight, 0)
    total = jax.nn.logsumexp(log_weight, where=lives)
    value = jax.nn.logsumexp(log_weight + jnp.where(lives, log_values, 0), where=lives)
    any_lives = jnp.any(lives)
    return jnp.where(any_lives, value, 0) - jnp.where(any_lives, total, 0)


def forget_lost(bank: Bank, lost: Bool[Array, " K"], dt_s: Float[Array, ""] | float) -> Bank:
    """The predicted bank without those that are `lost`, which a pose starts anew.

    Every slot continues itself.

    Args:
        dt_s: time since the last observation of any kind, added to `waited_s` of the others.
    """
    waited_s = jnp.minimum(bank.rejections.waited_s + dt_s, _PAUSE_S)
    rejections = dataclasses.replace(bank.rejections, waited_s=waited_s.astype(bank.mean.dtype))
    return eqx.tree_at(
        lambda b: (b.initialised, b.rejections, b.parent),
        bank,
        (bank.initialised & ~lost, cleared(rejections, lost), jnp.arange(lost.shape[0])),
    )


def contradicted(
    bank: Bank, max_count: int, max_duration_s: Float[Array, ""] | float
) -> Bool[Array, " K"]:
    """Whether `max_count` rejections in a row agree, or they have lasted `max_duration_s`."""
    rejections = bank.rejections
    lasted = rejections.duration_s >= max_duration_s - _NO_TIME_S
    return (rejections.count >= max_count) | lasted


def cleared(rejections: Rejections, over: Bool[Array, "*K"]) -> Rejections:
    """The rejections, forgotten where they are over."""
    return where(over, jax.tree.map(jnp.zeros_like, rejections), rejections)


def branched(bank: Bank, parent: Int[Array, " K"]) -> Bank:
    """The bank whose slots continue their parents; a copy of another slot gets a new number."""
    copied = parent != jnp.arange(parent.shape[0])
    anew = jnp.max(jnp.where(bank.initialised, bank.number, -1)) + jnp.cumsum(copied)
    number = jnp.where(copied, anew, bank.number)
    copies: Bank = jax.tree.map(lambda leaf: leaf[parent], bank)
    return dataclasses.replace(copies, number=number)


def first_hypotheses(bank: Bank, count: int) -> Bank:
    """The bank cut to its first `count` hypotheses."""
    first: Bank = jax.tree.map(lambda leaf: leaf[:count], bank)
    return first


def fill_slots(first: Bank, empty: Bank) -> Bank:
    """The bank `empty` with its first slots replaced by the hypotheses of `first`."""
    kept = first.initialised.shape[0]
    bank: Bank = jax.tree.map(lambda a, b: jnp.concatenate([a, b[kept:]]), first, empty)
    return bank


def survivors_first(bank: Bank) -> Bank:
    """The bank sorted: initialised hypotheses first, each group in its old order."""
    count = bank.initialised.shape[0]
    if count == 1:
        return bank
    lives = bank.initialised.astype(int)
    place = jnp.where(
        bank.initialised,
        jnp.cumsum(lives) - 1,
        jnp.sum(lives) + jnp.cumsum(1 - lives) - 1,
    )
    order = jnp.argmax(place[None] == jnp.arange(count)[:, None], axis=1)
    sorted_bank: Bank = jax.tree.map(lambda leaf: leaf[order], bank)
    return sorted_bank


def renumber_if_empty(bank: Bank) -> Bank:
    """The bank with numbers 0 to K - 1 where no hypothesis is initialised; else unchanged."""
    anew = jnp.arange(bank.number.shape[0])
    number = jnp.where(jnp.any(bank.initialised), bank.number, anew)
    return dataclasses.replace(bank, number=number)


def restart_broken(bank: Bank, start: Bank) -> Bank:
    """The bank with `start` in place of hypotheses whose mean or covariance is not finite."""
    hypotheses = (bank.mean, bank.covariance.reshape(*bank.mean.shape[:1], -1))
    finite = jnp.all(jnp.isfinite(jnp.concatenate(hypotheses, axis=1)), axis=1)
    return dataclasses.replace(where(finite, bank, start), number=bank.number)
