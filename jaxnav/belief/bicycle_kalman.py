"""The paper's filter for a car: six states, one measured pose, odometry."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.belief import kalman
from jaxnav.belief.ambiguity import PoseBelief, PoseMeasurement, PosePosterior
from jaxnav.belief.motion import (
    Bank,
    Motion,
    Offer,
    Planar,
    contradicted,
    empty_bank,
    follow_pose,
    forget_lost,
)
from jaxnav.models import bicycle
from jaxnav.models.bicycle import Vehicle
from jaxnav.models.geometry import (
    OFF_GROUND,
    ON_GROUND,
    T_world_vehicle_from_planar,
    planar_covariance,
    planar_from_T_world_vehicle,
    wrap_angle,
)
from jaxnav.numerics.small_matrices import cholesky, log_det, sandwich
from jaxnav.pose.observation import Observation


class BicycleKalman(Motion):
    """The paper's six-state filter for a car: x, y, psi, v_x, v_y, psi_dot in the world.

        x = A x,  P = A P A' + Q,    A = [I, dt I; 0, I]                               (Eq. 9)
        K = P H' (H P H' + R)^-1,  x += K (z - H x)                            (Eqs. 10, 11)

    The pose of the chosen candidate measures the first half of the state, odometer and steering the
    second. The paper leaves open (see docs/design.md, Odometry and the headings before it):

    * The odometry's v (cos(beta + psi), sin(beta + psi)) depends on the state's own heading. Its
      innovation uses the predicted psi, and H carries the derivative, so a correction of
      the heading turns the velocity along and the drift of the position corrects the heading.
    * Q and the odometry's noise are given in the vehicle's axes, since wheels slip along and across
      themselves: numbers learned on one course are valid on another.
    * The covariance of a vision pose is the candidate's own (from J'J at its minimum), plus a
      floor, since errors of successive frames are correlated.

    Source: Liu, Schofield, Shan (2023), Eqs. 8-11.
    """

    vehicle: Vehicle
    acceleration_density: Float[Array, " 3"] | Float[Array, "3 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.1**2, 0.1**2, 0.3**2])
    )  # along, across, turning: (m/s^2)^2/Hz twice, (rad/s^2)^2/Hz; or the matrix
    vision_floor: Float[Array, " 3"] | Float[Array, "3 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.005, 0.005, 0.005])
    )  # x, y, psi: standard deviations, m m rad; or their covariance
    odometry_sigma: Float[Array, " 3"] | Float[Array, "3 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.01, 0.01, 0.01])
    )  # along, across, turning: standard deviations, m/s m/s rad/s; or their covariance
    initial_velocity_sigma: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0, 1.0, 2.0])
    )  # before the first odometry, m/s m/s rad/s
    tilt_sigma_rad: float = 0.005  # roll and pitch of the cameras, against level and calibration
    height_sigma_m: float = 0.002
    gate_nis: float = 21.1  # chi-square with 3 dof at 99.99 %; inf: no gate
    max_rejections: int = eqx.field(static=True, default=10)  # in a row that agree: forgotten
    max_rejected_s: float = 7.0  # of rejections, whether they agree or not: forgotten

    def init(self, hypotheses: int = 1) -> Bank:
        """A bank of K hypotheses before the first pose."""
        return empty_bank(jnp.zeros(6, self.vehicle.wheelbase_m.dtype), 6, 3, hypotheses)

    def predict(self, bank: Bank, obs: Observation) -> Bank:
        """x = A x, P = A P A' + Q (Eq. 9), then the odometry (Eqs. 10 and 11).

        Speed and steering change at an unknown instant inside the interval: with the difference d
        (3,) between the velocity measured now and the one believed before, the pose gets the
        noise D D', D = d dt / sqrt(12), the standard deviation of d t for a uniform t in (0, dt).

        A hypothesis that the gate has contradicted too often or too long is forgotten.
        """
        mean, covariance = jax.vmap(
            lambda x, P: self._with_odometry(*self._later(x, P, obs), obs, obs.dt_s)
        )(bank.mean, bank.covariance)
        predicted = eqx.tree_at(lambda b: (b.mean, b.covariance), bank, (mean, covariance))
        return forget_lost(predicted, self.lost(bank), obs.dt_s)

    def lost(self, bank: Bank) -> Bool[Array, " K"]:
        """Whether the gate has contradicted a hypothesis too often or too long."""
        return contradicted(bank, self.max_rejections, self.max_rejected_s)

    def poses(self, bank: Bank) -> PoseBelief:
        """Poses level on the ground (Eq. 12); height, roll and pitch are nuisances with a sigma."""
        T_world_vehicle = T_world_vehicle_from_planar(bank.mean[:, :3])
        dtype = bank.mean.dtype
        freedom = jnp.asarray(ON_GROUND, dtype)
        tilt = [self.height_sigma_m, self.tilt_sigma_rad, self.tilt_sigma_rad]
        nuisance = jnp.asarray(OFF_GROUND, dtype) * jnp.asarray(tilt, dtype)[None]

        def body_covariance(pose: Array, P: Array) -> Array:
            return sandwich(freedom, sandwich(_turn(-pose[2]), P[:3, :3]))

        return PoseBelief(
            T_world_vehicle,
            jax.vmap(body_covariance)(bank.mean, bank.covariance),
            bank.log_weight,
            bank.initialised,
            freedom,
            nuisance,
            self.gate_nis,
        )

    def measure(self, bank: Bank, measured: PoseMeasurement, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has chosen a candidate, in 3 dof."""
        P = bank.covariance
        pose = planar_from_T_world_vehicle(measured.T_world_vehicle)
        R = planar_covariance(measured.T_world_vehicle, measured.covariance)
        # Height, roll and pitch were fitted as well, or were not free: then their variances are 0.
        fitted = measured.covariance
        fixed = (jnp.diagonal(fitted) <= 0).astype(fitted.dtype)
        log_volume = log_det(cholesky(fitted + jnp.diag(fixed))) / 2
        R = R + kalman.as_covariance(self.vision_floor)
        innovation = self.difference(pose, bank.mean[:3])
        correction, posterior, S = kalman.update(P, innovation, jnp.eye(3, 6, dtype=P.dtype), R)
        return Offer(
            kalman.whiten(innovation, S),
            gate_nis=self.gate_nis,
            log_likelihood=measured.log_misfit + log_volume + kalman.log_likelihood(innovation, S),
            first=self._first(pose, R, obs),
            posterior=(self.moved(bank.mean, correction), posterior),
        )

    def follow(self, bank: Bank, measured: PosePosterior, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has corrected its pose, in 3 dof."""
        T = measured.T_world_vehicle
        pose = planar_from_T_world_vehicle(T)
        eye = jnp.eye(6, dtype=bank.mean.dtype)
        to_body = eye.at[:3, :3].set(_turn(-bank.mean[2]))
        to_world = eye.at[:3, :3].set(_turn(pose[2]))
        correction, P = follow_pose(
            jnp.where(bank.initialised, sandwich(to_body, bank.covariance), eye),
            T_world_vehicle_from_planar(bank.mean[:3]),
            T,
            measured.covariance,
            jnp.asarray(ON_GROUND, eye.dtype),
        )
        return Offer(
            measured.innovation,
            gate_nis=self.gate_nis,
            log_likelihood=measured.log_likelihood,
            inflation=measured.inflation,
            first=self._first(pose, planar_covariance(T, measured.covariance), obs),
            posterior=(jnp.append(pose, bank.mean[3:] + correction[3:]), sandwich(to_world, P)),
        )

    def difference(self, mean: Float[Array, " n"], base: Float[Array, " n"]) -> Float[Array, " n"]:
        """mean - base, (6,), with the heading wrapped."""
        apart = mean - base
        return apart.at[2].set(wrap_angle(apart[2]))

    def moved(self, base: Float[Array, " 6"], error: Float[Array, " 6"]) -> Float[Array, " 6"]:
        """base + error, (6,), with the heading wrapped."""
        mean = base + error
        return mean.at[2].set(wrap_angle(mean[2]))

    def on_ground(self, mean: Float[Array, " 6"]) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
        """The two halves of the state: pose and velocity, (3,) each."""
        return mean[:3], mean[3:]

    def planar(self, mean: Float[Array, " 6"], covariance: Float[Array, "6 6"]) -> Planar:
        """Pose and velocity as they stand in the state, which is planar."""
        return Planar(mean[:3], covariance[:3, :3], mean[3:], covariance[3:, 3:])

    def _first(self, pose: Array, covariance: Array, obs: Observation) -> tuple[Array, Array]:
        """Mean and covariance of a hypothesis that starts at a pose, moving as measured."""
        zero = jnp.zeros((3, 3), pose.dtype)
        velocity = jnp.diag(self.initial_velocity_sigma**2)
        return self._with_odometry(
            jnp.append(pose, jnp.zeros(3, pose.dtype)),
            jnp.block([[covariance, zero], [zero, velocity]]),
            obs,
        )

    def _later(self, mean: Array, P: Array, obs: Observation) -> tuple[Array, Array]:
        """The state `dt_s` later (Eq. 9)."""
        dtype, dt_s = mean.dtype, jnp.asarray(obs.dt_s, mean.dtype)
        eye, zero = jnp.eye(3, dtype=dtype), jnp.zeros((3, 3), dtype)
        A = jnp.block([[eye, dt_s * eye], [zero, eye]])
        density = sandwich(_turn(mean[2]), kalman.as_matrix(self.acceleration_density))
        Q = kalman.white_acceleration(density, dt_s).astype(dtype)
        mean = jnp.sum(A * mean[None], axis=1)
        mean = mean.at[2].set(wrap_angle(mean[2]))
        return mean, kalman.predict_covariance(P, A, Q)

    def _with_odometry(
        self, mean: Array, P: Array, obs: Observation, since_s: Array | float = 0.0
    ) -> tuple[Array, Array]:
        """The state after speed and steering were measured, at its own heading.

        Args:
            since_s: time of the prediction, in which the velocity has changed.
        """
        dtype = mean.dtype
        speed_mps, steering_rad = (
            jnp.asarray(value, dtype) for value in (obs.speed_mps, obs.steering_rad)
        )
        velocity = bicycle.velocity_world(
            speed_mps, steering_rad, mean[2], self.vehicle.wheelbase_m
        )
        turned_velocity = jnp.stack([-velocity[1], velocity[0], jnp.zeros_like(speed_mps)])
        H = jnp.eye(3, 6, k=3, dtype=dtype).at[:, 2].set(-turned_velocity)
        R = sandwich(_turn(mean[2]), kalman.as_covariance(self.odometry_sigma)).astype(dtype)
        present = jnp.asarray(obs.has_odometry, dtype)
        change = velocity - mean[3:]
        D = present * change * (jnp.asarray(since_s, dtype) / np.sqrt(12))
        P = P.at[:3, :3].add(D[:, None] * D[None])
        seen = kalman.hide_rows(change, H, R, jnp.full(3, present))
        correction, P, _ = kalman.update(P, *seen)
        return self.moved(mean, correction), P


def planar_poses(
    bank: Bank,
) -> tuple[Float[Array | np.ndarray, "K 3"], Float[Array | np.ndarray, "K 3 3"]]:
    """(x_m, y_m, psi_rad) of every hypothesis of a car, and its covariance, of JAX or NumPy."""
    return bank.mean[:, :3], bank.covariance[:, :3, :3]


def _turn(angle_rad: Array) -> Array:
    """Rotation (3, 3) of (x, y, psi) about z."""
    c, s, zero, one = jnp.cos(angle_rad), jnp.sin(angle_rad), angle_rad * 0, angle_rad * 0 + 1
    rows = ([c, -s, zero], [s, c, zero], [zero, zero, one])
    return jnp.stack([jnp.stack(row) for row in rows])
