"""The filter of a body that moves freely and carries an inertial measurement unit (IMU)."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter import kalman
from jaxnav.core.filter.bank import Bank, Moments, normalise
from jaxnav.core.filter.free import FreeBody, moved_by_twist
from jaxnav.core.linalg.small_matrices import matvec, product, sandwich, where
from jaxnav.core.models.geometry import rotation_matrix, skew
from jaxnav.core.models.imu import CONSUMER, ImuNoise, Preintegrated
from jaxnav.core.pose.observation import Observation

_G_MPS2 = 9.81
_LEVEL_RAD = float(np.deg2rad(2.0))  # how far a map that is called level may lean
_SAME_S = 1e-3  # an IMU's duration that differs by more from dt_s is that of another interval
_LEAST_LOG_EVIDENCE = -7.0  # of one rest, as `MultiHypothesis.outlier_log_evidence`


class InertialMotion(FreeBody):
    """Pose on SE(3), velocity and turn rate of a body, the biases of its IMU, and gravity.

    The mean is (wxyz, xyz) of T_world_vehicle, velocity and turn rate (m/s, rad/s) in vehicle axes,
    the biases of gyroscope and accelerometer (rad/s, m/s^2) in the same axes, and gravity (m/s^2)
    in the world's; the 21 error states are in this order. The velocity is that of the IMU's place,
    `lever_arm_m` from the vehicle's origin: so no angular acceleration has to be known.

    What the IMU tells of an interval replaces the twist that carries the body on. Where it tells
    nothing the model is that of `ConstantVelocity`.

    Gravity is a vector with a prior. A map that is level within `gravity_sigma_mps2` knows its
    direction, and of the two poses of a marker the one that contradicts it moves otherwise than the
    IMU says, and loses. Of a map that may hang anyhow, `in_any_world`, nothing is known, no pose
    contradicts it, and the body's motion finds it; it enters linearly, however wide its prior.

    Source: Forster et al. (2017), Eqs. 31-44; Skog, Haendel, Nilsson, Rantakokko (2010),
    "Zero-velocity detection", for bodies at rest.
    """

    states: ClassVar[int] = 21
    noise: ImuNoise = CONSUMER
    lever_arm_m: Float[Array, " 3"] = eqx.field(default_factory=lambda: jnp.zeros(3))
    gravity_mps2: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.0, 0.0, -_G_MPS2])
    )
    gravity_sigma_mps2: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([_G_MPS2 * _LEVEL_RAD] * 2 + [0.03])
    )  # over the Earth its length differs by 0.03 m/s^2 (1 sigma)
    still_sigma: Float[Array, " 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.01] * 3 + [0.005] * 3)
    )  # m/s and rad/s of a body that its IMU finds at rest

    @staticmethod
    def in_any_world(noise: ImuNoise = CONSUMER, **fields: object) -> "InertialMotion":
        """The model where nobody knows the direction of gravity in the map's axes."""
        unknown = {"gravity_mps2": jnp.zeros(3), "gravity_sigma_mps2": jnp.full(3, 10.0)}
        return InertialMotion(noise=noise, **(unknown | fields))  # type: ignore[arg-type]

    def at_first(self) -> Moments:
        """No velocity and no biases, gravity as the map has it."""
        noise = self.noise
        biases = jnp.stack(
            [
                jnp.asarray(noise.gyroscope_bias_sigma, float),
                jnp.asarray(noise.accelerometer_bias_sigma, float),
            ]
        )
        sigma = jnp.concatenate(
            [self.initial_velocity_sigma, jnp.repeat(biases, 3), self.gravity_sigma_mps2]
        )
        mean = jnp.concatenate([jnp.zeros(12, sigma.dtype), self.gravity_mps2])
        return mean, jnp.diag(sigma**2)

    def predict(self, bank: Bank, obs: Observation) -> Bank:
        """The bank `obs.dt_s` later: by the IMU, or else by a white acceleration.

            R' = R dR,  p' = p + R (v T + dp) + g T^2 / 2,  v' = dR' (v + dv + R' g T)

        of the IMU's place, with v in the vehicle's axes, and P' = F P F' + G S G' with F and G the
        derivatives by the error states and by the errors of the increments.

        At rest velocity and turn rate are zero: that tells the biases and the lean, and weighs the
        hypotheses as every measurement does.
        """
        predicted = FreeBody.predict(self, bank, obs)
        read, imu = self._imu_read(obs, bank.mean.dtype)
        return predicted if imu is None else self._rested(predicted, read & imu.still)

    def evolve(self, mean: Float[Array, " n"], P: Float[Array, "d d"], obs: Observation) -> Moments:
        """One hypothesis `obs.dt_s` later, before rest tells it anything; see `predict`."""
        read, imu = self._imu_read(obs, mean.dtype)
        coasted = self._coasted(mean, P, jnp.asarray(obs.dt_s, mean.dtype))
        return coasted if imu is None else where(read, self._carried(mean, P, imu), coasted)

    def _imu_read(
        self, obs: Observation, dtype: jnp.dtype
    ) -> tuple[Bool[Array, ""], Preintegrated | None]:
        """Whether the IMU read the motion in this interval, and what it read."""
        if obs.imu is None:
            return jnp.asarray(False), None
        imu, dt_s = obs.imu.usable(dtype), jnp.asarray(obs.dt_s, dtype)
        return (imu.duration_s > 0) & (jnp.abs(imu.duration_s - dt_s) < _SAME_S), imu

    def _coasted(self, mean: Array, P: Array, dt_s: Array) -> Moments:
        """Move one hypothesis without a reading, as `ConstantVelocity` does."""
        dtype, across = mean.dtype, skew(jnp.asarray(self.lever_arm_m, mean.dtype))
        mean, P = _other_velocity(mean, P, across)
        mean, P = moved_by_twist(mean, P, mean[7:13], dt_s, True)
        P = P.at[:12, :12].add(
            kalman.white_acceleration(self.acceleration_density, dt_s).astype(dtype)
        )
        P = P.at[12:18, 12:18].add(jnp.diag(self.noise.densities()[6:].astype(dtype) * dt_s))
        return _other_velocity(mean, P, -across)

    def _carried(self, mean: Array, P: Array, imu: Preintegrated) -> Moments:
        """Move one hypothesis by the IMU."""
        dtype, states = mean.dtype, self.states
        after = self._after(mean, jnp.zeros(15, dtype), imu)

        def off(errors: Array) -> Array:
            error = jnp.concatenate([errors[:states], jnp.zeros(self.camera_states, dtype)])
            return self.difference(
                self._after(self.moved(mean, error), errors[states:], imu), after
            )

        slopes = jax.jacfwd(off)(jnp.zeros(states + 15, dtype))[:states]
        P = kalman.replace_first(P, slopes[:, :states])
        Q = sandwich(slopes[:, states:], imu.covariance)
        # The rate is the mean of the interval; at its end a white acceleration has changed it.
        A = kalman.as_matrix(self.acceleration_density).astype(dtype)[3:, 3:]
        Q = Q.at[9:12, 9:12].add(jnp.where(imu.still, 0, A * imu.duration_s / 3))
        return after, P.at[:states, :states].add(kalman.symmetrise(Q))

    def _after(self, mean: Array, noise: Array, imu: Preintegrated) -> Array:
        """The mean (n,) at the end of an interval whose 15 increments are off by `noise`."""
        T_world_vehicle, T = jaxlie.SE3(mean[:7]), imu.duration_s
        R_begin_end, dv, dp = imu.at_biases(mean[13:16], mean[16:19])
        R_begin_end = R_begin_end @ jaxlie.SO3.exp(noise[:3])
        dv, dp = dv + noise[3:6], dp + noise[6:9]
        v, g, arm = mean[7:10], mean[19:22], jnp.asarray(self.lever_arm_m, mean.dtype)
        R_world_vehicle = T_world_vehicle.rotation()
        R = rotation_matrix(R_world_vehicle)
        R_after = (R_world_vehicle @ R_begin_end).normalize()
        way = matvec(R, arm + v * T + dp) + g * T**2 / 2 - matvec(rotation_matrix(R_after), arm)
        velocity = matvec(rotation_matrix(R_begin_end).T, v + dv + matvec(R.T, g) * T)
        rate = R_begin_end.log() / jnp.where(T > 0, T, 1)
        biases = mean[13:19] + noise[9:]
        place = T_world_vehicle.translation() + way
        return jnp.concatenate([R_after.wxyz, place, velocity, rate, biases, mean[19:]])

    def _rested(self, bank: Bank, still: Bool[Array, ""]) -> Bank:
        """Update a bank by zero velocity and turn rate, where the body is at rest."""
        dtype = bank.mean.dtype
        H = jnp.eye(6, 12, k=6, dtype=dtype)
        R = jnp.diag(jnp.asarray(self.still_sigma, dtype) ** 2)

        def one(mean: Array, P: Array) -> tuple[Array, Array, Array, Array]:
            correction, posterior, S = kalman.update(P, -mean[7:13], H, R)
            taken = still & (kalman.nis(mean[7:13], S) < self.gate_nis)
            log_likelihood = kalman.log_likelihood(mean[7:13], S)
            after = self.moved(mean, correction), posterior
            # It tells nothing of the cameras.
            after = self.schmidt_update(jnp.asarray(False), (mean, P), after)
            mean, P = where(taken, after, (mean, P))
            return mean, P, taken, log_likelihood

        mean, covariance, taken, log_likelihood = jax.vmap(one)(bank.mean, bank.covariance)
        taken = taken & bank.initialised
        best = jnp.max(jnp.where(taken, log_likelihood, -jnp.inf))
        fits = jnp.where(taken, log_likelihood - best, _LEAST_LOG_EVIDENCE)
        log_weight = bank.log_weight + jnp.maximum(fits, _LEAST_LOG_EVIDENCE)
        weighed = normalise(jnp.where(bank.initialised, log_weight, -jnp.inf))
        counts = still & jnp.any(taken) & bank.initialised
        log_weight = jnp.where(counts, weighed, bank.log_weight)
        return eqx.tree_at(
            lambda b: (b.mean, b.covariance, b.log_weight), bank, (mean, covariance, log_weight)
        )

    def on_ground(self, mean: Float[Array, " n"]) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
        """(x, y, psi) and (v_x, v_y, psi_dot) of the vehicle's origin, see `FreeBody`."""
        at_imu, arm = mean[7:10], jnp.asarray(self.lever_arm_m, mean.dtype)
        velocity = at_imu - jnp.cross(mean[10:13], arm)
        return FreeBody.on_ground(self, mean.at[7:10].set(velocity))


def _other_velocity(mean: Array, P: Array, across: Float[Array, "3 3"]) -> Moments:
    """The state with the velocity v + across w: of a point that is off by -arm, skew(arm) = across.

    Its velocity is v + w x (-arm) = v + arm x w.
    """
    mean = mean.at[7:10].add(matvec(across, mean[10:13]))
    P = P.at[6:9].add(product(across, P[9:12]))
    return mean, P.at[:, 6:9].add(product(P[:, 9:12], across.T))
