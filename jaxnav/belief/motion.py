"""Motion models: how the belief moves, and how a pose and the odometry correct it.

All share one interface, so that `step` and the selectors know nothing of the state:

    belief = motion.init(hypotheses)
    belief = motion.predict(belief, obs)                         # dt, and odometry where there is
    prior  = motion.poses(belief)                                # what a selector sees
    belief, nis, log_likelihood = motion.update(belief, selection, obs)
    covariance = motion.error_covariance(belief, best)           # of the pose that is reported

A belief is a bank of K hypotheses along the leading axis of every leaf. `bicycle_kalman.py` is for
cars, `constant_velocity.py` for everything else.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.belief import kalman
from jaxnav.belief.ambiguity import PoseBelief, PoseMeasurement, PosePosterior, Selection
from jaxnav.models.geometry import inverse_cayley, inverse_cayley_jacobian
from jaxnav.numerics.small_matrices import (
    applied,
    cho_solve,
    cholesky,
    gram,
    product,
    sandwich,
    solve_lower,
)
from jaxnav.numerics.trees import where
from jaxnav.pose.observation import Observation

# A pause without any pose contradicts nothing: of it no more than this counts (RELIABILITY R4's
# flag for a marker that is missing).
_PAUSE_S = 1.0


class Rejections(eqx.Module):
    """Measured poses in a row that contradict the prediction (RELIABILITY R1 to R3)."""

    count: Int[Array, "*K"]  # of the last ones, which agree with each other
    last: Float[Array, "*K m"]  # whitened innovation of the last one
    duration_s: Float[Array, "*K"]  # of all of them, those that were taken nevertheless included
    waited_s: Float[Array, "*K"]  # since a pose was last offered, however often it was predicted


class Belief(eqx.Module):
    """K hypotheses: means as the motion model stores them, covariances, weights."""

    mean: Float[Array, "*K n"]
    covariance: Float[Array, "*K d d"]
    log_weight: Float[Array, "*K"]
    initialised: Bool[Array, "*K"]
    rejections: Rejections
    number: Int[Array, "*K"]  # stays with a hypothesis wherever it stands in the bank


class Offer(NamedTuple):
    """What a pose would make of one hypothesis."""

    innovation: Float[Array, " m"]  # of the pose, whitened
    first: tuple[Array, Array]  # mean and covariance, if it starts here
    posterior: tuple[Array, Array]  # mean and covariance, if it takes the pose
    gate_nis: Float[Array, ""] | float  # a larger NIS is a contradiction, and counted
    log_likelihood: Float[Array, ""]  # of what was measured given the prediction
    inflation: Float[Array, ""] | float = 1.0  # times the gate, NIS is kept out


class Motion(eqx.Module):
    """What `Navigator` asks of a motion model, and what all models do alike."""

    @abc.abstractmethod
    def init(self, hypotheses: int = 1) -> Belief:
        """Hypotheses that have seen nothing."""

    @abc.abstractmethod
    def predict(self, belief: Belief, obs: Observation) -> Belief:
        """The belief at this observation, before its corners are looked at."""

    @abc.abstractmethod
    def lost(self, belief: Belief) -> Bool[Array, " K"]:
        """Hypotheses that the gate has contradicted too often or too long: `predict` drops them."""

    @abc.abstractmethod
    def poses(self, belief: Belief) -> PoseBelief:
        """What a selector sees of it."""

    @abc.abstractmethod
    def measure(self, belief: Belief, measured: PoseMeasurement, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has chosen a candidate."""

    @abc.abstractmethod
    def follow(self, belief: Belief, measured: PosePosterior, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has corrected its pose."""

    @abc.abstractmethod
    def difference(self, mean: Float[Array, " n"], base: Float[Array, " n"]) -> Float[Array, " d"]:
        """The error state that leads from one mean to another."""

    @abc.abstractmethod
    def moved(self, base: Float[Array, " n"], error: Float[Array, " d"]) -> Float[Array, " n"]:
        """The mean to which an error state leads."""

    def update(
        self, belief: Belief, selection: Selection, obs: Observation
    ) -> tuple[Belief, Float[Array, " K"], Float[Array, " K"]]:
        """The posterior of every hypothesis (Eqs. 10 and 11), equal ones merged; their NIS, and the
        log-likelihood of what each was offered given what it predicted, up to a constant.

        A measured pose starts a hypothesis that has not been, and is otherwise kept out where its
        NIS is above the gate. Without a pose, or without a prediction of it, both numbers are 0.
        """
        belief = eqx.tree_at(
            lambda b: (b.log_weight, b.initialised), belief, (selection.log_weight, selection.kept)
        )
        measured = selection.measured
        offer = self.follow if isinstance(measured, PosePosterior) else self.measure

        def one(before: Belief, measured: Any) -> tuple[Belief, Array, Array]:
            offered = offer(before, measured, obs)
            after, nis = gated(before, offered, measured.taken)
            compared = measured.taken & before.initialised
            return after, nis, jnp.where(compared, offered.log_likelihood, 0)

        belief, nis, log_likelihood = jax.vmap(one)(belief, measured)
        return merged(belief, selection.heir, self.difference, self.moved), nis, log_likelihood

    def error_covariance(self, belief: Belief, index: Int[Array, ""]) -> Float[Array, "d d"]:
        """What is to be expected of a hypothesis' error: the spread of the whole bank about it.

        Source: Bar-Shalom, Li, Kirubarajan (2001), section 1.4.16 (moments of a mixture).
        """
        mass = jnp.where(belief.initialised, jnp.exp(belief.log_weight), 0)
        total = jnp.sum(mass)
        share = jnp.where(total > 0, mass / jnp.where(total > 0, total, 1), 0)
        share = jnp.where(total > 0, share, jnp.arange(mass.shape[0]) == index)
        apart = jax.vmap(lambda mean: self.difference(mean, belief.mean[index]))(belief.mean)
        apart = jnp.where((share > 0)[:, None], apart, 0)
        squared = apart[:, :, None] * apart[:, None]
        return jnp.sum(share[:, None, None] * (belief.covariance + squared), axis=0)


def unstarted(
    mean: Float[Array, " n"], error_states: int, pose_states: int, hypotheses: int
) -> Belief:
    """K hypotheses that have seen nothing."""
    return Belief(
        mean=jnp.tile(mean, (hypotheses, 1)),
        covariance=jnp.tile(jnp.eye(error_states, dtype=mean.dtype), (hypotheses, 1, 1)),
        log_weight=jnp.zeros(hypotheses, mean.dtype),
        initialised=jnp.zeros(hypotheses, bool),
        number=jnp.arange(hypotheses),
        rejections=Rejections(
            jnp.zeros(hypotheses, int),
            jnp.zeros((hypotheses, pose_states), mean.dtype),
            jnp.zeros(hypotheses, mean.dtype),
            jnp.zeros(hypotheses, mean.dtype),
        ),
    )


def forgotten(belief: Belief, lost: Bool[Array, " K"], dt_s: Float[Array, ""] | float) -> Belief:
    """The prediction without the hypotheses that are lost: their next pose starts them anew.

    Args:
        dt_s: since the last observation, of whatever kind: for the others time goes on.
    """
    waited_s = jnp.minimum(belief.rejections.waited_s + dt_s, _PAUSE_S)
    rejections = dataclasses.replace(belief.rejections, waited_s=waited_s.astype(belief.mean.dtype))
    return eqx.tree_at(
        lambda b: (b.initialised, b.rejections),
        belief,
        (belief.initialised & ~lost, _cleared(rejections, lost)),
    )


def contradicted(
    belief: Belief, max_count: int, max_duration_s: Float[Array, ""] | float
) -> Bool[Array, " K"]:
    """Whether so many contradictions in a row agree, or they have lasted so long (R3)."""
    rejections = belief.rejections
    return (rejections.count >= max_count) | (rejections.duration_s >= max_duration_s)


def gated(
    belief: Belief,
    offer: Offer,
    taken: Bool[Array, ""],
) -> tuple[Belief, Float[Array, ""]]:
    """One hypothesis that was offered a pose, and its NIS, 0 where there was none to compare.

    It starts with `first`, or takes `posterior` where the gate admits it, or stays as predicted
    (RELIABILITY R1).

    Args:
        taken: whether there is a pose at all.
    """
    nis = jnp.sum(offer.innovation**2)
    offered = taken & belief.initialised
    starts, agrees = taken & ~belief.initialised, offered & (nis <= offer.gate_nis)
    accepted = offered & (nis <= offer.gate_nis * offer.inflation)
    predicted = (belief.mean, belief.covariance)
    mean, covariance = where(accepted, offer.posterior, where(starts, offer.first, predicted))
    return Belief(
        mean,
        covariance,
        belief.log_weight,
        belief.initialised | taken,
        _cleared(_and_another(belief.rejections, offered, offer.innovation), agrees | starts),
        belief.number,
    ), jnp.where(offered, nis, 0)


def _and_another(
    rejections: Rejections, rejected: Bool[Array, ""], innovation: Array
) -> Rejections:
    """One more, which agrees with the last one if it lies within 60 degrees of its direction."""
    both = jnp.sum(innovation**2) * jnp.sum(rejections.last**2)
    along = jnp.sum(innovation * rejections.last)
    agrees = (along > 0) & (along**2 > both / 4)
    return Rejections(
        jnp.where(rejected, jnp.where(agrees, rejections.count, 0) + 1, rejections.count),
        jnp.where(rejected, innovation, rejections.last),
        rejections.duration_s + jnp.where(rejected, rejections.waited_s, 0),
        jnp.where(rejected, 0, rejections.waited_s),
    )


def _cleared(rejections: Rejections, over: Bool[Array, "*K"]) -> Rejections:
    return where(over, jax.tree.map(jnp.zeros_like, rejections), rejections)


def followed(
    P: Float[Array, "n n"],
    T_world_prior: jaxlie.SE3,
    T_world_vehicle: jaxlie.SE3,
    covariance: Array,
    freedom: Float[Array, "6 d"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The whole state after its pose was corrected: the regression of the rest on the pose.

    Args:
        P: of the predicted state, its first d entries the pose error xi = freedom' cay^-1(...).
        covariance: (6, 6) of the corrected pose, at the corrected pose.

    Returns:
        Correction of the state (the pose's own entries included), and covariance after it.
    """
    d = freedom.shape[1]
    away = inverse_cayley(T_world_prior.inverse() @ T_world_vehicle)
    xi = applied(freedom.T, away)
    # Error at the corrected pose -> at the prediction.
    back = sandwich(freedom.T, inverse_cayley_jacobian(away))
    posterior = sandwich(freedom.T, covariance)
    factor = cholesky(P[:d, :d])
    gain = cho_solve(factor, P[:d, d:]).T  # of the rest on the pose, (n - d, d)
    # Block by block: as P plus a correction the pose would keep the rounding of its prediction,
    # which may be thousands of times as wide.
    explained = gram(solve_lower(factor, P[:d, d:]).T)
    moves = product(gain, back)
    cross = product(moves, posterior)
    rest = P[d:, d:] - explained + sandwich(moves, posterior)
    after = kalman.symmetrise(jnp.block([[posterior, cross.T], [cross, rest]]))
    return jnp.append(xi, applied(gain, xi)), kalman.floored(after, P)


def merged(
    belief: Belief,
    heir: Int[Array, " K"],
    difference: Callable[[Array, Array], Array],
    moved: Callable[[Array, Array], Array],
) -> Belief:
    """Hypotheses that share an heir as one, with their common mean and covariance.

    Args:
        belief: after the update, with the weights of that.
        heir: index of the hypothesis that takes each one in.
        difference: (mean, from) -> error state (d,).
        moved: (mean, error state) -> mean.

    Source: Salmond (2009), "Mixture reduction algorithms for point and extended object tracking".
    """
    count = heir.shape[0]
    if count == 1:
        return belief
    mass = jnp.where(belief.initialised, jnp.exp(belief.log_weight), 0)
    member = (heir[None] == jnp.arange(count)[:, None]) & belief.initialised[None]
    total = jnp.sum(jnp.where(member, mass[None], 0), axis=1)
    share = jnp.where(member, mass[None] / jnp.where(total > 0, total, 1)[:, None], 0)
    alone = jnp.sum(member, axis=1) <= 1

    def common() -> tuple[Array, Array]:
        apart = jax.vmap(difference)(belief.mean, belief.mean[heir])
        shift = product(share, apart)
        spread = apart - shift[heir]
        second = belief.covariance + spread[:, :, None] * spread[:, None]
        covariance = product(share, second.reshape(count, -1)).reshape(second.shape)
        return jax.vmap(moved)(belief.mean, shift), covariance

    # Few frames merge anything.
    mean, covariance = jax.lax.cond(
        jnp.all(alone), lambda: (belief.mean, belief.covariance), common
    )
    stays = belief.initialised & (heir == jnp.arange(count))
    return dataclasses.replace(
        belief,
        mean=jnp.where(alone[:, None], belief.mean, mean),
        covariance=jnp.where(alone[:, None, None], belief.covariance, covariance),
        log_weight=jnp.where(stays, jnp.log(jnp.where(total > 0, total, 1)), belief.log_weight),
        initialised=stays,
    )


def of_mixture(belief: Belief, log_values: Float[Array, " K"]) -> Float[Array, ""]:
    """log sum_k w_k exp(log_value_k) of hypotheses that live; 0 where none does."""
    lives = belief.initialised
    log_weight = jnp.where(lives, belief.log_weight, 0)
    total = jax.nn.logsumexp(log_weight, where=lives)
    value = jax.nn.logsumexp(log_weight + jnp.where(lives, log_values, 0), where=lives)
    any_lives = jnp.any(lives)
    return jnp.where(any_lives, value, 0) - jnp.where(any_lives, total, 0)


def leading(belief: Belief, count: int) -> Belief:
    """The first hypotheses of a bank."""
    first: Belief = jax.tree.map(lambda leaf: leaf[:count], belief)
    return first


def followed_by(belief: Belief, empty: Belief) -> Belief:
    """Hypotheses in the first slots of a bank that is empty otherwise."""
    kept = belief.initialised.shape[0]
    bank: Belief = jax.tree.map(lambda a, b: jnp.concatenate([a, b[kept:]]), belief, empty)
    return bank


def numbered_anew_where_empty(belief: Belief) -> Belief:
    """The same, slots counted from 0 where no hypothesis lives that goes by another number."""
    anew = jnp.arange(belief.number.shape[0])
    number = jnp.where(jnp.any(belief.initialised), belief.number, anew)
    return dataclasses.replace(belief, number=number)


def survivors_first(belief: Belief) -> Belief:
    """The same bank, hypotheses that live before those that don't, each in their order."""
    count = belief.initialised.shape[0]
    if count == 1:
        return belief
    lives = belief.initialised.astype(int)
    place = jnp.where(
        belief.initialised,
        jnp.cumsum(lives) - 1,
        jnp.sum(lives) + jnp.cumsum(1 - lives) - 1,
    )
    order = jnp.argmax(place[None] == jnp.arange(count)[:, None], axis=1)
    sorted_bank: Belief = jax.tree.map(lambda leaf: leaf[order], belief)
    return sorted_bank


def restarted_where_broken(belief: Belief, start: Belief) -> Belief:
    """The belief, with `start` in place of hypotheses whose numbers overflowed."""
    hypotheses = (belief.mean, belief.covariance.reshape(*belief.mean.shape[:1], -1))
    finite = jnp.all(jnp.isfinite(jnp.concatenate(hypotheses, axis=1)), axis=1)
    return dataclasses.replace(where(finite, belief, start), number=belief.number)
