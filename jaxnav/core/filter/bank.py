"""What is believed: weighted hypotheses, the gate that a measured pose passes, and merging.

See docs/design.md, Gate. Source of the merging: Salmond (2009), "Mixture reduction algorithms for
point and extended object tracking".
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.linalg.small_matrices import (
    cholesky,
    first_highest,
    product,
    ranks,
    sandwich,
    solve_lower,
    where,
)
from jaxnav.core.models.geometry import shift_and_turn

# A pause without any pose contradicts nothing: at most this much of it counts, the time after which
# a missing marker is flagged (docs/promises.md, Missing data).
_PAUSE_S = 1.0
# Hypotheses that a mirror exchanges weigh the same but for rounding, 1e-4 after a second of frames
# in float32; what tells them apart in truth soon tells more than this.
EVEN_LOG_WEIGHT = 1e-3


class CameraErrors(eqx.Module):
    """The prediction of all cameras' errors by K hypotheses."""

    mean: Float[Array, "*K e"]
    covariance: Float[Array, "*K e e"]
    cross: Float[Array, "*K 6 e"]  # with xi in T_world_vehicle * exp(xi)

    def fresh(self) -> "CameraErrors":
        """Errors of which nothing is known but the prior."""
        eye = jnp.eye(self.mean.shape[-1], dtype=self.mean.dtype)
        return CameraErrors(
            jnp.zeros_like(self.mean),
            jnp.broadcast_to(eye, self.covariance.shape),
            jnp.zeros_like(self.cross),
        )


class PoseBelief(eqx.Module):
    """The filter's prediction: K weighted hypotheses about the pose of the vehicle."""

    T_world_vehicle: jaxlie.SE3  # batch axis (K,)
    covariance: Float[Array, "K 6 6"]  # of xi in T_world_vehicle * exp(xi)
    log_weight: Float[Array, " K"]
    initialised: Bool[Array, " K"]  # False before the first pose
    freedom: Float[Array, "6 d"]  # the directions of xi in which the vehicle can move
    # Directions of xi that the filter does not estimate, times their sigma: xi = nuisance @ N(0,1):
    # a car rolls, pitches and bounces, and its cameras deviate from their calibration.
    nuisance: Float[Array, "6 t"]
    # The filter rejects measured poses whose NIS exceeds this.
    gate_nis: Float[Array, ""] | float
    errors: CameraErrors | None = None  # None: the filter keeps no errors of cameras


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


def normalise(log_weight: Float[Array, " K"]) -> Float[Array, " K"]:
    """Log-weights shifted so that the weights sum to 1; unchanged where none is finite."""
    highest = jnp.max(log_weight)
    any_finite = jnp.isfinite(highest)
    shifted = jnp.where(any_finite, log_weight - jnp.where(any_finite, highest, 0), 0)
    return jnp.where(any_finite, shifted - jnp.log(jnp.sum(jnp.exp(shifted))), log_weight)


def heaviest(bank: Bank) -> Int[Array, ""]:
    """Index of the most probable hypothesis; the first of those that weigh the same."""
    log_weight = jnp.where(bank.initialised, bank.log_weight, -jnp.inf)
    return first_highest(log_weight, EVEN_LOG_WEIGHT)


def known_to(
    bank: Bank, apart_rad: Float[Array, " K"], variance: Float[Array, " K"]
) -> Float[Array, ""]:
    """How well a bank knows an angle: its second moment about the reported hypothesis, rad^2.

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
    """Drop the hypotheses that are `lost` from a predicted bank; a pose starts them anew.

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


def cleared(rejections: Rejections, over: Bool[Array, "*K"]) -> Rejections:
    """Forget the rejections that are over."""
    return where(over, jax.tree.map(jnp.zeros_like, rejections), rejections)


def branched(bank: Bank, parent: Int[Array, " K"]) -> Bank:
    """Copy each slot's parent into it; a copy of another slot gets a new number."""
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
    """Start hypotheses anew whose mean or covariance is not finite."""
    hypotheses = (bank.mean, bank.covariance.reshape(*bank.mean.shape[:1], -1))
    finite = jnp.all(jnp.isfinite(jnp.concatenate(hypotheses, axis=1)), axis=1)
    return dataclasses.replace(where(finite, bank, start), number=bank.number)


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
    rejections = _and_another(bank.rejections, offered, offer.innovation)
    after = dataclasses.replace(
        bank,
        mean=mean,
        covariance=covariance,
        initialised=bank.initialised | valid,
        rejections=cleared(rejections, agrees | starts),
        parent=jnp.where(starts, -1, bank.parent),
    )
    return after, jnp.where(offered, nis, 0), accepted | starts


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


def merge_hypotheses(
    bank: Bank,
    merged_into: Int[Array, " K"],
    difference: Callable[[Float[Array, " n"], Float[Array, " n"]], Float[Array, " d"]],
    moved: Callable[[Float[Array, " n"], Float[Array, " d"]], Float[Array, " n"]],
) -> Bank:
    """Merge hypotheses into one Gaussian of the same two moments.

    Args:
        bank: after the update, with the weights after it.
        merged_into: index of the hypothesis into which each one is merged.
        difference: (mean, from) -> error state (d,).
        moved: (mean, error state) -> mean.

    Source: Salmond (2009), "Mixture reduction algorithms for point and extended object tracking".
    """
    count = merged_into.shape[0]
    if count == 1:
        return bank
    mass = jnp.where(bank.initialised, jnp.exp(bank.log_weight), 0)
    member = (merged_into[None] == jnp.arange(count)[:, None]) & bank.initialised[None]
    total = jnp.sum(jnp.where(member, mass[None], 0), axis=1)
    share = jnp.where(member, mass[None] / jnp.where(total > 0, total, 1)[:, None], 0)
    alone = jnp.sum(member, axis=1) <= 1

    def common() -> tuple[Array, Array]:
        apart = jax.vmap(difference)(bank.mean, bank.mean[merged_into])
        shift = product(share, apart)
        spread = apart - shift[merged_into]
        second = bank.covariance + spread[:, :, None] * spread[:, None]
        covariance = product(share, second.reshape(count, -1)).reshape(second.shape)
        return jax.vmap(moved)(bank.mean, shift), covariance

    # Few frames merge anything.
    mean, covariance = jax.lax.cond(jnp.all(alone), lambda: (bank.mean, bank.covariance), common)
    stays = bank.initialised & (merged_into == jnp.arange(count))
    return dataclasses.replace(
        bank,
        mean=jnp.where(alone[:, None], bank.mean, mean),
        covariance=jnp.where(alone[:, None, None], bank.covariance, covariance),
        log_weight=jnp.where(stays, jnp.log(jnp.where(total > 0, total, 1)), bank.log_weight),
        initialised=stays,
    )


def find_merges(
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
    # In steps: of two that weigh the same the first one stays, not the one of the last bit.
    rank = ranks(jnp.floor(log_weight / EVEN_LOG_WEIGHT))
    heavier = rank[:, None] < rank[None]
    # A hypothesis that receives others is not merged itself.
    takes = close & heavier
    takes = takes & ~jnp.any(takes, axis=0)[:, None]
    best_rank = jnp.where(takes, rank[:, None], count)
    return jnp.where(jnp.any(takes, axis=0), jnp.argmin(best_rank, axis=0), jnp.arange(count))
