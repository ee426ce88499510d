"""Motion models: how a bank of hypotheses moves, and how a pose and the odometry correct it.

They share one interface, so that `step` and the selectors do not depend on the state:

    bank = motion.init(hypotheses)
    bank = motion.predict(bank, obs)                  # by dt_s, then the odometry, if any
    prior = motion.poses(bank)                        # poses and covariances, for a selector
    updated = motion.update(bank, selection, obs)
    covariance = motion.error_covariance(bank, best)  # of the pose that is reported

A bank has K hypotheses along the leading axis of every leaf. `bicycle_kalman.py` is for cars,
`constant_velocity.py` for everything else.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.belief import kalman
from jaxnav.belief.ambiguity import PoseBelief, PoseMeasurement, PosePosterior, Selection
from jaxnav.belief.camera_errors import EACH, ridge
from jaxnav.models.geometry import inverse_cayley, inverse_cayley_jacobian
from jaxnav.models.rig import CameraRig
from jaxnav.numerics.small_matrices import (
    cho_solve,
    cholesky,
    gram,
    matvec,
    product,
    sandwich,
    solve_lower,
)
from jaxnav.numerics.trees import where
from jaxnav.pose.observation import Observation

# A pause without any pose contradicts nothing: at most this much of it counts, the time after which
# a missing marker is flagged (docs/promises.md, Missing data).
_PAUSE_S = 1.0


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


class BankUpdate(NamedTuple):
    """A bank after an observation, and the outcome of the gate for each hypothesis."""

    bank: Bank
    nis: Float[Array, " K"]  # of the offered pose; 0 without a pose or a prediction
    accepted: Bool[Array, " K"]  # the pose was inside the gate, or started the hypothesis
    log_likelihood: Float[Array, " K"]  # of the pose given the prediction, up to a constant; or 0


class Planar(NamedTuple):
    """Planar pose and velocity of a vehicle, with their covariances."""

    pose: Float[Array, " 3"]  # x_m, y_m, psi_rad in the world
    pose_covariance: Float[Array, "3 3"]
    velocity: Float[Array, " 3"]  # v_x_mps, v_y_mps, psi_dot_radps in the world
    velocity_covariance: Float[Array, "3 3"]


Moments = tuple[Float[Array, " n"], Float[Array, "d d"]]  # mean and covariance


class Offer(NamedTuple):
    """One hypothesis as a measured pose would start or correct it; `apply_gate` chooses."""

    innovation: Float[Array, " m"]  # of the pose, whitened
    # Mean and covariance where the pose starts the hypothesis, and where the hypothesis takes it.
    first: Moments
    posterior: Moments
    gate_nis: Float[Array, ""] | float  # a larger NIS is a contradiction, and counted
    log_likelihood: Float[Array, ""]  # of what was measured given the prediction
    inflation: Float[Array, ""] | float = 1.0  # a NIS above inflation * gate_nis is not fused


class Motion(eqx.Module):
    """Base class of the motion models: the abstract methods differ, the others are shared."""

    states: ClassVar[int]  # error states of pose and velocity; those of sensors come behind

    @abc.abstractmethod
    def init(self, hypotheses: int = 1) -> Bank:
        """Hypotheses that have seen nothing."""

    @abc.abstractmethod
    def predict(self, bank: Bank, obs: Observation) -> Bank:
        """The bank at this observation, before its corners are looked at."""

    @abc.abstractmethod
    def lost(self, bank: Bank) -> Bool[Array, " K"]:
        """Hypotheses that the gate has contradicted too often or too long: `predict` drops them."""

    @abc.abstractmethod
    def poses(self, bank: Bank) -> PoseBelief:
        """Poses, covariances and weights of the hypotheses, for a selector."""

    @abc.abstractmethod
    def measure(self, bank: Bank, measured: PoseMeasurement, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has chosen a candidate."""

    @abc.abstractmethod
    def follow(self, bank: Bank, measured: PosePosterior, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has corrected its pose."""

    @abc.abstractmethod
    def difference(self, mean: Float[Array, " n"], base: Float[Array, " n"]) -> Float[Array, " d"]:
        """The error state that leads from one mean to another."""

    @abc.abstractmethod
    def moved(self, base: Float[Array, " n"], error: Float[Array, " d"]) -> Float[Array, " n"]:
        """The mean to which an error state leads."""

    @abc.abstractmethod
    def T_world_vehicle(self, mean: Float[Array, " n"]) -> jaxlie.SE3:
        """The pose of a mean."""

    @abc.abstractmethod
    def on_ground(self, mean: Float[Array, " n"]) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
        """(x_m, y_m, psi_rad) of a mean in the world, and their derivatives."""

    @abc.abstractmethod
    def for_rig(self, rig: CameraRig, hypotheses: int) -> "Motion":
        """The model with the errors of this rig's cameras among its states, and of the sensors.

        A single hypothesis has neither: a rule that takes one pose doubts nothing.
        """

    @abc.abstractmethod
    def learns(self, bank: Bank) -> Bool[Array, ""]:
        """Whether the errors that are only considered at first are estimated by now."""

    def considered(self, learns: Bool[Array, ""], before: Moments, after: Moments) -> Moments:
        """The posterior whose errors keep their mean and covariance unless the model `learns`.

        Pose and velocity are corrected by their own gain, and stay correlated with the errors.

        Source: Schmidt (1966), "Application of state-space methods to navigation problems".
        """
        (x, P), (mean, covariance) = before, after
        states = self.states
        gap = x.shape[0] - P.shape[0]
        errors = jnp.where(learns, mean[states + gap :], x[states + gap :])
        block = jnp.where(learns, covariance[states:, states:], P[states:, states:])
        return (
            mean.at[states + gap :].set(errors),
            covariance.at[states:, states:].set(block),
        )

    def planar(self, mean: Float[Array, " n"], covariance: Float[Array, "d d"]) -> Planar:
        """Pose and velocity on the ground: J P J' with the Jacobians of `on_ground`.

        Args:
            mean: (n,) as the model stores it.
            covariance: (d, d) of the error state.
        """
        P, still = covariance, jnp.zeros(covariance.shape[0], mean.dtype)
        slopes = jax.jacfwd(lambda error: self.on_ground(self.moved(mean, error)))(still)
        (pose, velocity), (J_pose, J_velocity) = self.on_ground(mean), slopes
        return Planar(pose, sandwich(J_pose, P), velocity, sandwich(J_velocity, P))

    def update(self, bank: Bank, selection: Selection, obs: Observation) -> BankUpdate:
        """The posterior of every hypothesis (Eqs. 10 and 11), with those of one heir merged.

        A measured pose starts a hypothesis that is not initialised. Otherwise it is fused where its
        NIS is inside the gate, and counted as a rejection where it is not.

        Args:
            bank: predicted.
            selection: what each hypothesis takes as measured, its weight and its heir.
            obs: the observation; its odometry gives a hypothesis that starts its velocity.
        """
        if selection.parent is not None:
            bank = branched(bank, selection.parent)
        bank = eqx.tree_at(
            lambda b: (b.log_weight, b.initialised), bank, (selection.log_weight, selection.kept)
        )
        measured = selection.measured
        offer = self.follow if isinstance(measured, PosePosterior) else self.measure
        learns = self.learns(bank)

        def one(before: Bank, measured: Any) -> BankUpdate:
            offered = offer(before, measured, obs)
            predicted = before.mean, before.covariance
            posterior = self.considered(learns, predicted, offered.posterior)
            offered = offered._replace(posterior=posterior)
            after, nis, accepted = apply_gate(before, offered, measured.valid)
            compared = measured.valid & before.initialised
            return BankUpdate(after, nis, accepted, jnp.where(compared, offered.log_likelihood, 0))

        updated: BankUpdate = jax.vmap(one)(bank, measured)
        bank = merge_heirs(updated.bank, selection.heir, self.difference, self.moved)
        return updated._replace(bank=bank)

    def error_covariance(self, bank: Bank, index: Int[Array, ""]) -> Float[Array, "d d"]:
        """Expected squared error of one hypothesis: the second moment of the bank about its mean.

            sum_k w_k (P_k + d_k d_k'),    d_k = difference(mean_k, mean_index).

        Source: Bar-Shalom, Li, Kirubarajan (2001), section 1.4.16 (moments of a mixture).
        """
        mass = jnp.where(bank.initialised, jnp.exp(bank.log_weight), 0)
        total = jnp.sum(mass)
        share = jnp.where(total > 0, mass / jnp.where(total > 0, total, 1), 0)
        share = jnp.where(total > 0, share, jnp.arange(mass.shape[0]) == index)
        apart = jax.vmap(lambda mean: self.difference(mean, bank.mean[index]))(bank.mean)
        apart = jnp.where((share > 0)[:, None], apart, 0)
        squared = apart[:, :, None] * apart[:, None]
        return jnp.sum(share[:, None, None] * (bank.covariance + squared), axis=0)


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
    )


def camera_states(rig: CameraRig, hypotheses: int) -> int:
    """How many errors of a rig's cameras a bank keeps: none where the cameras are exact."""
    return 0 if rig.extrinsics_sigma is None or hypotheses == 1 else EACH * len(rig)


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


def forget_lost(bank: Bank, lost: Bool[Array, " K"], dt_s: Float[Array, ""] | float) -> Bank:
    """The bank with the hypotheses that are `lost` no longer initialised: a pose starts them anew.

    Args:
        dt_s: time since the last observation of any kind, added to `waited_s` of the others.
    """
    waited_s = jnp.minimum(bank.rejections.waited_s + dt_s, _PAUSE_S)
    rejections = dataclasses.replace(bank.rejections, waited_s=waited_s.astype(bank.mean.dtype))
    return eqx.tree_at(
        lambda b: (b.initialised, b.rejections),
        bank,
        (bank.initialised & ~lost, _cleared(rejections, lost)),
    )


def contradicted(
    bank: Bank, max_count: int, max_duration_s: Float[Array, ""] | float
) -> Bool[Array, " K"]:
    """Whether `max_count` rejections in a row agree, or they have lasted `max_duration_s`."""
    rejections = bank.rejections
    return (rejections.count >= max_count) | (rejections.duration_s >= max_duration_s)


def apply_gate(
    bank: Bank,
    offer: Offer,
    valid: Bool[Array, ""],
) -> tuple[Bank, Float[Array, ""], Bool[Array, ""]]:
    """One hypothesis after the gate, the NIS of its pose, and whether the pose was accepted.

    The hypothesis becomes `first` where it is not initialised, `posterior` where
    NIS = |innovation|^2 <= gate_nis * inflation, and stays as predicted otherwise. The NIS is 0
    where there was nothing to compare.

    See docs/design.md, Gate.

    Args:
        bank: a bank without its leading axis.
        offer: what the pose makes of it.
        valid: whether there is a pose at all.
    """
    nis = jnp.sum(offer.innovation**2)
    offered = valid & bank.initialised
    starts, agrees = valid & ~bank.initialised, offered & (nis <= offer.gate_nis)
    accepted = offered & (nis <= offer.gate_nis * offer.inflation)
    predicted = (bank.mean, bank.covariance)
    mean, covariance = where(accepted, offer.posterior, where(starts, offer.first, predicted))
    return (
        Bank(
            mean,
            covariance,
            bank.log_weight,
            bank.initialised | valid,
            _cleared(_and_another(bank.rejections, offered, offer.innovation), agrees | starts),
            bank.number,
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


def _cleared(rejections: Rejections, over: Bool[Array, "*K"]) -> Rejections:
    return where(over, jax.tree.map(jnp.zeros_like, rejections), rejections)


def follow_pose(
    P: Float[Array, "n n"],
    T_world_prior: jaxlie.SE3,
    posterior: PosePosterior,
    freedom: Float[Array, "6 d"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The whole state after its pose was corrected: the rest follows by regression.

    With y = (xi, q), the pose's error and the errors of the cameras in view, the rest v, and the
    gain G = P_vy P_yy^-1:

        v += G y,    P_vx = G M C,    P_vv = P_vv - G P_yv + G C_y G',

    where C is the covariance of the corrected pose, M carries its error to y, and
    C_y = M C M' + the covariance of q given the pose.

    Args:
        P: (n, n) of the predicted state, whose first d entries are
            xi = freedom' cay^-1(T_world_prior^-1 T_world_vehicle), and whose last ones are the
            cameras' errors.
        T_world_prior: the predicted pose.
        posterior: the corrected pose, with a covariance in its own axes, and the errors in view.
        freedom: (6, d), the directions in which the vehicle can move.

    Returns:
        Correction (n,) of the state, the pose's d entries included, and the covariance after it.
    """
    d, n = freedom.shape[1], P.shape[0]
    away = inverse_cayley(T_world_prior.inverse() @ posterior.T_world_vehicle)
    xi = matvec(freedom.T, away)
    C = sandwich(freedom.T, posterior.covariance)
    # Error at the corrected pose -> at the prediction.
    M = sandwich(freedom.T, inverse_cayley_jacobian(away))
    y, P_yy, P_y, given_pose = xi, P[:d, :d], P[:d], None
    errors = posterior.errors
    if errors is not None:
        M = jnp.concatenate([M, product(errors.slope, M)])
        y = jnp.append(xi, errors.change)
        e = errors.rows.shape[1]
        P_y = jnp.concatenate([P_y, product(errors.rows, P[n - e :])])
        of_errors = product(P_y[:, n - e :], errors.rows.T)
        P_yy = jnp.block([[P_yy, of_errors[:d]], [of_errors[:d].T, of_errors[d:]]])
        hidden = 1 - jnp.sum(errors.rows, axis=1)
        P_yy = P_yy + jnp.diag(jnp.append(jnp.zeros(d, P.dtype), hidden + ridge(P.dtype)))
        given_pose = errors.covariance
    factor = cholesky(P_yy)
    gain = cho_solve(factor, P_y[:, d:]).T  # of the rest on y, (n - d, len(y))
    # Block by block: as P plus a correction the pose would keep the rounding of its prediction,
    # which may be thousands of times as wide.
    explained = gram(solve_lower(factor, P_y[:, d:]).T)
    moves = product(gain, M)
    cross = product(moves, C)
    rest = P[d:, d:] - explained + product(cross, moves.T)
    if given_pose is not None:
        rest = rest + sandwich(gain[:, d:], given_pose)
    after = kalman.symmetrise(jnp.block([[C, cross.T], [cross, rest]]))
    return jnp.append(xi, matvec(gain, y)), kalman.add_floor(after, P)


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


def branched(bank: Bank, parent: Int[Array, " K"]) -> Bank:
    """The bank whose slots continue their parents; a copy of another slot gets a new number."""
    copied = parent != jnp.arange(parent.shape[0])
    anew = jnp.max(jnp.where(bank.initialised, bank.number, -1)) + jnp.cumsum(copied)
    number = jnp.where(copied, anew, bank.number)
    copies: Bank = jax.tree.map(lambda leaf: leaf[parent], bank)
    return dataclasses.replace(copies, number=number)


def heaviest(bank: Bank) -> Int[Array, ""]:
    """Index of the most probable hypothesis."""
    return jnp.argmax(jnp.where(bank.initialised, bank.log_weight, -jnp.inf))


def mixture_log_mean(bank: Bank, log_values: Float[Array, " K"]) -> Float[Array, ""]:
    """log (sum_k w_k exp(log_value_k) / sum_k w_k) over initialised hypotheses; 0 without any."""
    lives = bank.initialised
    log_weight = jnp.where(lives, bank.log_weight, 0)
    total = jax.nn.logsumexp(log_weight, where=lives)
    value = jax.nn.logsumexp(log_weight + jnp.where(lives, log_values, 0), where=lives)
    any_lives = jnp.any(lives)
    return jnp.where(any_lives, value, 0) - jnp.where(any_lives, total, 0)


def first_hypotheses(bank: Bank, count: int) -> Bank:
    """The bank cut to its first `count` hypotheses."""
    first: Bank = jax.tree.map(lambda leaf: leaf[:count], bank)
    return first


def fill_slots(first: Bank, empty: Bank) -> Bank:
    """The bank `empty` with its first slots replaced by the hypotheses of `first`."""
    kept = first.initialised.shape[0]
    bank: Bank = jax.tree.map(lambda a, b: jnp.concatenate([a, b[kept:]]), first, empty)
    return bank


def renumber_if_empty(bank: Bank) -> Bank:
    """The bank with numbers 0 to K - 1 where no hypothesis is initialised; else unchanged."""
    anew = jnp.arange(bank.number.shape[0])
    number = jnp.where(jnp.any(bank.initialised), bank.number, anew)
    return dataclasses.replace(bank, number=number)


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


def restart_broken(bank: Bank, start: Bank) -> Bank:
    """The bank with `start` in place of hypotheses whose mean or covariance is not finite."""
    hypotheses = (bank.mean, bank.covariance.reshape(*bank.mean.shape[:1], -1))
    finite = jnp.all(jnp.isfinite(jnp.concatenate(hypotheses, axis=1)), axis=1)
    return dataclasses.replace(where(finite, bank, start), number=bank.number)
