"""Motion models: how a bank of hypotheses moves, and how a pose and the odometry correct it.

They share one interface, so that `step` and the selectors do not depend on the state:

    bank = motion.init(hypotheses)
    bank = motion.predict(bank, obs)                  # by dt_s, then the odometry, if any
    prior = motion.poses(bank)                        # poses and covariances, for a selector
    updated = motion.update(bank, selection, obs)
    covariance = motion.error_covariance(bank, best)  # of the pose that is reported

A bank has K hypotheses along the leading axis of every leaf. `planar.py` is for cars and
other bases on wheels, `free.py` and `imu.py` are for everything else.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter import kalman
from jaxnav.core.filter.bank import (
    Bank,
    Moments,
    Offer,
    PoseBelief,
    apply_gate,
    branched,
    merge_hypotheses,
    restart_broken,
)
from jaxnav.core.filter.choose import MeasuredPose, Selection
from jaxnav.core.filter.errors import EACH, ridge
from jaxnav.core.linalg.small_matrices import (
    cholesky,
    gram,
    log_det,
    matvec,
    product,
    sandwich,
    solve_lower,
    solve_upper,
)
from jaxnav.core.models.geometry import inverse_cayley, inverse_cayley_jacobian
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Observation

# A time is up where less than this is left: it adds up from intervals, and has their rounding.
_NO_TIME_S = 1e-3


def follow_pose(
    P: Float[Array, "n n"],
    T_world_prior: jaxlie.SE3,
    posterior: MeasuredPose,
    freedom: Float[Array, "6 d"],
    states: int,
    behind: int = 0,
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Correct the rest of a state after its pose, by regression.

    With y = (xi, q), the pose's error and the errors of the cameras in view, the rest v, and the
    gain G = P_vy P_yy^-1:

        v += G y,    P_vx = G M C,    P_vv = P_vv - G P_yv + G C_y G',

    where C is the covariance of the corrected pose, M carries its error to y, and
    C_y = M C M' + the covariance of q given the pose.

    What C is inflated by widens pose and velocity alone. Errors that are only considered keep their
    covariance, and would be correlated with a wider pose by more than they vary.

    Args:
        P: (n, n) of the predicted state, whose first d entries are
            xi = freedom' cay^-1(T_world_prior^-1 T_world_vehicle), and whose last ones are the
            cameras' errors, but for `behind`.
        T_world_prior: the predicted pose.
        posterior: the corrected pose, with a covariance in its own axes, and the errors in view.
        freedom: (6, d), the directions in which the vehicle can move.
        states: of pose and velocity, before the errors.
        behind: states behind the cameras' errors.

    Returns:
        Correction (n,) of the state, the pose's d entries included, and the covariance after it.
    """
    d, n = freedom.shape[1], P.shape[0]
    end = n - behind
    away = inverse_cayley(T_world_prior.inverse() @ posterior.T_world_vehicle)
    xi = matvec(freedom.T, away)
    inflation = 1.0 if posterior.inflation is None else posterior.inflation
    C = sandwich(freedom.T, posterior.covariance) / inflation
    # Error at the corrected pose -> at the prediction.
    M = sandwich(freedom.T, inverse_cayley_jacobian(away))
    y, P_yy, P_y, given_pose = xi, P[:d, :d], P[:d], None
    errors = posterior.errors
    if errors is not None:
        M = jnp.concatenate([M, errors.slope])
        y = jnp.append(xi, errors.change)
        e = errors.rows.shape[1]
        P_y = jnp.concatenate([P_y, product(errors.rows, P[end - e : end])])
        of_errors = product(P_y[:, end - e : end], errors.rows.T)
        P_yy = jnp.block([[P_yy, of_errors[:d]], [of_errors[:d].T, of_errors[d:]]])
        hidden = 1 - jnp.sum(errors.rows, axis=1)
        P_yy = P_yy + jnp.diag(jnp.append(jnp.zeros(d, P.dtype), hidden + ridge(P.dtype)))
        given_pose = errors.covariance
    factor = cholesky(P_yy)
    whitened = solve_lower(factor, P_y[:, d:])
    gain = solve_upper(factor, whitened).T  # of the rest on y, (n - d, len(y))
    rest = P[d:, d:] - gram(whitened.T)
    if given_pose is not None:
        rest = rest + sandwich(gain[:, d:], given_pose)
    # Not as P plus a correction: the pose would keep the rounding of its prediction, which may be
    # thousands of times as wide.
    by_pose = sandwich(jnp.concatenate([jnp.eye(d, dtype=C.dtype), product(gain, M)]), C)
    after = kalman.symmetrise(by_pose.at[d:, d:].add(rest))
    wider = (inflation - 1) * by_pose[:states, :states]
    after = after.at[:states, :states].add(wider)
    return jnp.append(xi, matvec(gain, y)), kalman.add_floor(after, P)


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


class Motion(eqx.Module):
    """Base class of the motion models: the abstract methods differ, the others are shared."""

    states: ClassVar[int]  # error states of pose and velocity; those of sensors come behind
    # A pose of a larger NIS contradicts a hypothesis; inf: no gate. Each model has its own.
    gate_nis: float = eqx.field(default=float("inf"), kw_only=True)
    camera_states: int = eqx.field(static=True, default=0, kw_only=True)  # see `for_rig`
    # Sigma of the orientation below which the errors of sensors and cameras are estimated.
    learn_sigma_rad: float = eqx.field(default=0.035, kw_only=True)
    max_rejections: int = eqx.field(static=True, default=10, kw_only=True)  # that agree: forgotten
    max_rejected_s: float = eqx.field(default=7.0, kw_only=True)  # agree or not: forgotten

    @abc.abstractmethod
    def init(self, hypotheses: int = 1) -> Bank:
        """Hypotheses that have seen nothing."""

    @abc.abstractmethod
    def predict(self, bank: Bank, obs: Observation) -> Bank:
        """The bank at this observation, before its corners are looked at."""

    @abc.abstractmethod
    def evolve(self, mean: Float[Array, " n"], P: Float[Array, "d d"], obs: Observation) -> Moments:
        """One hypothesis at this observation, before its readings: F P F' + Q, linear in P.

        What moves the hypothesis, as odometry that tells the motion does, belongs to it.
        """

    def sound(self, bank: Bank) -> Bank:
        """Start hypotheses anew that are not finite."""
        return restart_broken(bank, self.init(bank.initialised.shape[0]))

    def lost(self, bank: Bank) -> Bool[Array, " K"]:
        """Hypotheses that the gate has contradicted too often or too long: `predict` drops them."""
        lasted = bank.rejections.duration_s >= self.max_rejected_s - _NO_TIME_S
        return (bank.rejections.count >= self.max_rejections) | lasted

    @abc.abstractmethod
    def poses(self, bank: Bank) -> PoseBelief:
        """Poses, covariances and weights of the hypotheses, for a selector."""

    @abc.abstractmethod
    def compared(
        self, bank: Bank, measured: MeasuredPose
    ) -> tuple[Float[Array, " m"], Float[Array, "m h"], Float[Array, "m m"]]:
        """A measured pose less the predicted one, its derivative by the first h states, and R."""

    @abc.abstractmethod
    def adopted(self, bank: Bank, measured: MeasuredPose) -> Moments:
        """Take over a pose that the selector has corrected, and correct the rest."""

    def offer(self, bank: Bank, measured: MeasuredPose) -> Offer:
        """Correct one hypothesis by a pose, for the gate to take or leave.

        A candidate that the selector has chosen is fused (Eqs. 10 and 11), a pose that it has
        corrected is adopted.
        """
        if measured.innovation is not None:
            return Offer(
                measured.innovation,
                self.adopted(bank, measured),
                self.gate_nis,
                measured.log_likelihood,
                1.0 if measured.inflation is None else measured.inflation,
            )
        innovation, H, R = self.compared(bank, measured)
        correction, posterior, S = kalman.update(bank.covariance, innovation, H, R)
        # Directions that were not free have the variance 0.
        fitted = measured.covariance
        fixed = (jnp.diagonal(fitted) <= 0).astype(fitted.dtype)
        log_volume = log_det(cholesky(fitted + jnp.diag(fixed))) / 2
        return Offer(
            kalman.whiten(innovation, S),
            (self.moved(bank.mean, correction), posterior),
            self.gate_nis,
            measured.log_likelihood + log_volume + kalman.log_likelihood(innovation, S),
        )

    @abc.abstractmethod
    def start(self, bank: Bank, measured: MeasuredPose, obs: Observation) -> Moments:
        """Start one hypothesis at a measured pose."""

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
    def for_rig(self, rig: CameraRig, hypotheses: int) -> "Motion":
        """The model with the errors of this rig's cameras among its states, and of the sensors.

        A single hypothesis has neither: a rule that takes one pose doubts nothing.
        """

    @abc.abstractmethod
    def learns(self, bank: Bank) -> Bool[Array, ""]:
        """Whether the errors that are only considered at first are estimated by now."""

    def schmidt_update(self, learns: Bool[Array, ""], before: Moments, after: Moments) -> Moments:
        """Keep mean and covariance of the errors through an update, unless the model `learns`.

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

    @abc.abstractmethod
    def planar(self, mean: Float[Array, " n"], covariance: Float[Array, "d d"]) -> Planar:
        """Pose and velocity on the ground, with their covariances.

        Args:
            mean: (n,) as the model stores it.
            covariance: (d, d) of the error state.
        """

    def update(self, bank: Bank, selection: Selection, obs: Observation) -> BankUpdate:
        """Update every hypothesis (Eqs. 10 and 11), and merge those that have become one.

        A measured pose starts a hypothesis that is not initialised. Otherwise it is fused where its
        NIS is inside the gate, and counted as a rejection where it is not.

        Args:
            bank: predicted.
            selection: what each hypothesis takes as measured, its weight, and into which it merges.
            obs: the observation; its odometry gives a hypothesis that starts its velocity.
        """
        if selection.parent is not None:
            bank = branched(bank, selection.parent)
        bank = eqx.tree_at(
            lambda b: (b.log_weight, b.initialised), bank, (selection.log_weight, selection.kept)
        )
        measured = selection.measured
        learns = self.learns(bank)

        def one(before: Bank, measured: Any, first: Moments) -> BankUpdate:
            offered = self.offer(before, measured)
            predicted = before.mean, before.covariance
            posterior = self.schmidt_update(learns, predicted, offered.posterior)
            offered = offered._replace(posterior=posterior)
            after, nis, accepted = apply_gate(before, offered, first, measured.valid)
            compared = measured.valid & before.initialised
            return BankUpdate(after, nis, accepted, jnp.where(compared, offered.log_likelihood, 0))

        # In few frames a hypothesis starts.
        first = jax.lax.cond(
            jnp.any(measured.valid & ~bank.initialised),
            lambda: jax.vmap(lambda b, pose: self.start(b, pose, obs))(bank, measured),
            lambda: (bank.mean, bank.covariance),
        )
        updated: BankUpdate = jax.vmap(one)(bank, measured, first)
        bank = merge_hypotheses(updated.bank, selection.merged_into, self.difference, self.moved)
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


def camera_states(rig: CameraRig, hypotheses: int) -> int:
    """How many errors of a rig's cameras a bank keeps: none where the cameras are exact."""
    return 0 if rig.extrinsics_sigma is None or hypotheses == 1 else EACH * len(rig)
