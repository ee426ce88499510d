"""The paper's filter for a car: six states, one measured pose, odometry."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnav import bicycle, kalman
from jaxnav.ambiguity import PoseBelief, PoseMeasurement, PosePosterior
from jaxnav.bicycle import Vehicle
from jaxnav.geometry import (
    OFF_GROUND,
    ON_GROUND,
    T_world_vehicle_from_planar,
    planar_covariance,
    planar_from_T_world_vehicle,
    wrap_angle,
)
from jaxnav.motion import Belief, Motion, Offer, contradicted, followed, forgotten, unstarted
from jaxnav.observation import Observation
from jaxnav.small_matrices import sandwich


class BicycleKalman(Motion):
    """The paper's six-state filter for a car: x, y, psi, v_x, v_y, psi_dot in the world.

    The state moves at constant velocity (Eq. 9); the pose of the chosen candidate measures the
    first half, odometer and steering the second. Two things the paper leaves open:

    * The odometry's v (cos(beta + psi), sin(beta + psi)) depends on the state's own heading. Its
      innovation uses the predicted psi, and H carries the derivative, so a correction of
      the heading turns the velocity along and the drift of the position corrects the heading.
    * The covariance of a vision pose is the candidate's own (from J'J at its minimum), plus a
      floor, since errors of successive frames are correlated (RELIABILITY R8).
    """

    vehicle: Vehicle
    acceleration_density: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.1**2, 0.1**2, 0.3**2])
    )  # (m/s^2)^2/Hz twice, (rad/s^2)^2/Hz
    vision_floor: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.005, 0.005, 0.005])
    )  # standard deviations, m m rad
    odometry_sigma: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.01, 0.01, 0.01])
    )  # standard deviations, m/s m/s rad/s
    initial_velocity_sigma: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0, 1.0, 2.0])
    )  # before the first odometry, m/s m/s rad/s
    tilt_sigma_rad: float = 0.005  # roll and pitch of the cameras, against level and calibration
    height_sigma_m: float = 0.002
    gate_nis: float = 21.1  # chi-square with 3 dof at 99.99 % (RELIABILITY R1); inf: no gate
    max_rejections: int = eqx.field(static=True, default=10)  # that agree with each other
    max_rejected_s: float = 7.0  # whether they agree or not

    def init(self, hypotheses: int = 1) -> Belief:
        """Hypotheses that have seen nothing."""
        return unstarted(jnp.zeros(6, self.vehicle.wheelbase_m.dtype), 6, 3, hypotheses)

    def predict(self, belief: Belief, obs: Observation) -> Belief:
        """x = A x, P = A P A' + Q (Eq. 9), then the odometry (Eqs. 10 and 11).

        A hypothesis that the gate has contradicted too often or too long is forgotten.
        """
        dtype, dt_s = belief.mean.dtype, jnp.asarray(obs.dt_s, belief.mean.dtype)
        eye, zero = jnp.eye(3, dtype=dtype), jnp.zeros((3, 3), dtype)
        A = jnp.block([[eye, dt_s * eye], [zero, eye]])
        Q = kalman.white_acceleration(self.acceleration_density, dt_s).astype(dtype)

        def one(mean: Array, P: Array) -> tuple[Array, Array]:
            mean = jnp.sum(A * mean[None], axis=1)
            mean = mean.at[2].set(wrap_angle(mean[2]))
            return self._with_odometry(mean, kalman.predict_covariance(P, A, Q), obs)

        mean, covariance = jax.vmap(one)(belief.mean, belief.covariance)
        predicted = eqx.tree_at(lambda b: (b.mean, b.covariance), belief, (mean, covariance))
        return forgotten(predicted, self.lost(belief))

    def lost(self, belief: Belief) -> Bool[Array, " K"]:
        """Whether the gate has contradicted a hypothesis too often or too long."""
        return contradicted(belief, self.max_rejections, self.max_rejected_s)

    def poses(self, belief: Belief) -> PoseBelief:
        """Level on the ground (Eq. 12), as far as `tilt_sigma_rad` and `height_sigma_m` go."""
        T_world_vehicle = T_world_vehicle_from_planar(belief.mean[:, :3])
        dtype = belief.mean.dtype
        freedom = jnp.asarray(ON_GROUND, dtype)
        tilt = [self.height_sigma_m, self.tilt_sigma_rad, self.tilt_sigma_rad]
        nuisance = jnp.asarray(OFF_GROUND, dtype) * jnp.asarray(tilt, dtype)[None]

        def body_covariance(pose: Array, P: Array) -> Array:
            to_body = jnp.eye(3, dtype=P.dtype).at[:2, :2].set(_turn(-pose[2]))
            return sandwich(freedom, sandwich(to_body, P[:3, :3]))

        return PoseBelief(
            T_world_vehicle,
            jax.vmap(body_covariance)(belief.mean, belief.covariance),
            belief.log_weight,
            belief.initialised,
            freedom,
            nuisance,
            self.gate_nis,
        )

    def measure(self, belief: Belief, measured: PoseMeasurement, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has chosen a candidate, in 3 dof."""
        P = belief.covariance
        pose = planar_from_T_world_vehicle(measured.T_world_vehicle)
        R = planar_covariance(measured.T_world_vehicle, measured.covariance)
        R = R + jnp.diag(self.vision_floor**2)
        innovation = self.difference(pose, belief.mean[:3])
        correction, posterior, S = kalman.update(P, innovation, jnp.eye(3, 6, dtype=P.dtype), R)
        return Offer(
            kalman.whitened(innovation, S),
            gate_nis=self.gate_nis,
            first=self._first(pose, R, obs),
            posterior=(self.moved(belief.mean, correction), posterior),
        )

    def follow(self, belief: Belief, measured: PosePosterior, obs: Observation) -> Offer:
        """The offer to one hypothesis whose selector has corrected its pose, in 3 dof."""
        T = measured.T_world_vehicle
        pose = planar_from_T_world_vehicle(T)
        eye = jnp.eye(6, dtype=belief.mean.dtype)
        to_body = eye.at[:2, :2].set(_turn(-belief.mean[2]))
        to_world = eye.at[:2, :2].set(_turn(pose[2]))
        correction, P = followed(
            jnp.where(belief.initialised, sandwich(to_body, belief.covariance), eye),
            T_world_vehicle_from_planar(belief.mean[:3]),
            T,
            measured.covariance,
            jnp.asarray(ON_GROUND, eye.dtype),
        )
        return Offer(
            measured.innovation,
            gate_nis=self.gate_nis,
            inflation=measured.inflation,
            first=self._first(pose, planar_covariance(T, measured.covariance), obs),
            posterior=(jnp.append(pose, belief.mean[3:] + correction[3:]), sandwich(to_world, P)),
        )

    def difference(self, mean: Array, base: Array) -> Array:
        """Of the states, the heading's wrapped."""
        apart = mean - base
        return apart.at[2].set(wrap_angle(apart[2]))

    def moved(self, base: Array, error: Array) -> Array:
        """The sum, its heading wrapped."""
        mean = base + error
        return mean.at[2].set(wrap_angle(mean[2]))

    def _first(self, pose: Array, covariance: Array, obs: Observation) -> tuple[Array, Array]:
        """The state of a hypothesis that starts: a pose, at rest as far as the odometry tells."""
        zero = jnp.zeros((3, 3), pose.dtype)
        velocity = jnp.diag(self.initial_velocity_sigma**2)
        return self._with_odometry(
            jnp.append(pose, jnp.zeros(3, pose.dtype)),
            jnp.block([[covariance, zero], [zero, velocity]]),
            obs,
        )

    def _with_odometry(self, mean: Array, P: Array, obs: Observation) -> tuple[Array, Array]:
        """The state after speed and steering were measured, at its own heading."""
        dtype = mean.dtype
        speed_mps, steering_rad = (
            jnp.asarray(value, dtype) for value in (obs.speed_mps, obs.steering_rad)
        )
        velocity = bicycle.velocity_world(
            speed_mps, steering_rad, mean[2], self.vehicle.wheelbase_m
        )
        turned_velocity = jnp.stack([-velocity[1], velocity[0], jnp.zeros_like(speed_mps)])
        H = jnp.eye(3, 6, k=3, dtype=dtype).at[:, 2].set(-turned_velocity)
        R = jnp.diag(self.odometry_sigma**2).astype(dtype)
        present = jnp.full(3, jnp.asarray(obs.has_odometry, dtype))
        correction, P, _ = kalman.update(P, *kalman.hide_rows(velocity - mean[3:], H, R, present))
        return self.moved(mean, correction), P


def _turn(angle_rad: Array) -> Array:
    c, s = jnp.cos(angle_rad), jnp.sin(angle_rad)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])])
