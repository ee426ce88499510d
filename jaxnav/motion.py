"""Motion models: how the belief moves, and how a pose and the odometry correct it.

Both share one interface, so that `step` and the selectors know nothing of the state:

    belief = motion.init()
    belief = motion.predict(belief, dt_s)
    prior  = motion.poses(belief)                                # what a selector sees
    belief, nis = motion.update(belief, candidates, weights, obs)

A belief is a bank of K hypotheses along the leading axis of every leaf.
"""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav import bicycle, kalman
from jaxnav.ambiguity import PoseBelief
from jaxnav.bicycle import Vehicle
from jaxnav.candidates import Candidates
from jaxnav.geometry import (
    T_world_vehicle_from_planar,
    planar_covariance,
    planar_from_T_world_vehicle,
    wrap_angle,
)
from jaxnav.observation import Observation


class Belief(eqx.Module):
    """K hypotheses: means as the motion model stores them, covariances, weights."""

    mean: Float[Array, "*K n"]
    covariance: Float[Array, "*K d d"]
    log_weight: Float[Array, "*K"]
    initialised: Bool[Array, "*K"]


def restarted_where_broken(belief: Belief, start: Belief) -> Belief:
    """The belief, with `start` in place of hypotheses whose numbers overflowed."""
    hypotheses = (belief.mean, belief.covariance.reshape(*belief.mean.shape[:1], -1))
    finite = jnp.all(jnp.isfinite(jnp.concatenate(hypotheses, axis=1)), axis=1)
    return jax.vmap(lambda ok, b, s: jax.tree.map(lambda x, y: jnp.where(ok, x, y), b, s))(
        finite, belief, start
    )


@runtime_checkable
class Motion(Protocol):
    """What `Navigator` asks of a motion model."""

    def init(self) -> Belief: ...
    def predict(self, belief: Belief, dt_s: Float[Array, ""] | float) -> Belief: ...
    def poses(self, belief: Belief) -> PoseBelief: ...
    def update(
        self,
        belief: Belief,
        candidates: Candidates,
        weights: Float[Array, "K N"],
        obs: Observation,
    ) -> tuple[Belief, Float[Array, " K"]]: ...


class BicycleKalman(eqx.Module):
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
        default_factory=lambda: jnp.asarray([1.0**2, 1.0**2, 3.0**2])
    )  # (m/s^2)^2/Hz twice, (rad/s^2)^2/Hz
    vision_floor: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.005, 0.005, 0.005])
    )  # standard deviations, m m rad
    odometry_sigma: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.03, 0.03, 0.05])
    )  # standard deviations, m/s m/s rad/s
    initial_velocity_sigma: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0, 1.0, 2.0])
    )  # before the first odometry, m/s m/s rad/s

    def init(self) -> Belief:
        """One hypothesis that has seen nothing."""
        dtype = self.vehicle.wheelbase_m.dtype
        return Belief(
            mean=jnp.zeros((1, 6), dtype),
            covariance=jnp.eye(6, dtype=dtype)[None],
            log_weight=jnp.zeros(1, dtype),
            initialised=jnp.zeros(1, bool),
        )

    def predict(self, belief: Belief, dt_s: Float[Array, ""] | float) -> Belief:
        """x = A x, P = A P A' + Q (Eq. 9)."""
        dtype = belief.mean.dtype
        eye, zero = jnp.eye(3, dtype=dtype), jnp.zeros((3, 3), dtype)
        A = jnp.block([[eye, jnp.asarray(dt_s, dtype) * eye], [zero, eye]])
        Q = kalman.white_acceleration(self.acceleration_density, dt_s).astype(dtype)
        mean = belief.mean @ A.T
        covariance = jax.vmap(lambda P: kalman.predict_covariance(P, A, Q))(belief.covariance)
        return eqx.tree_at(
            lambda b: (b.mean, b.covariance),
            belief,
            (mean.at[:, 2].set(wrap_angle(mean[:, 2])), covariance),
        )

    def poses(self, belief: Belief) -> PoseBelief:
        """Height, roll and pitch are zero and certain (Eq. 12)."""
        T_world_vehicle = T_world_vehicle_from_planar(belief.mean[:, :3])

        def body_covariance(pose: Array, P: Array) -> Array:
            c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
            lift = jnp.zeros((6, 3), P.dtype)
            lift = lift.at[0, :2].set(jnp.stack([c, s])).at[1, :2].set(jnp.stack([-s, c]))
            lift = lift.at[5, 2].set(1)
            return lift @ P[:3, :3] @ lift.T

        return PoseBelief(
            T_world_vehicle,
            jax.vmap(body_covariance)(belief.mean, belief.covariance),
            belief.log_weight,
            belief.initialised,
        )

    def update(
        self,
        belief: Belief,
        candidates: Candidates,
        weights: Float[Array, "K N"],
        obs: Observation,
    ) -> tuple[Belief, Float[Array, " K"]]:
        """The posterior of every hypothesis (Eqs. 10 and 11), and the pose's NIS (3 dof).

        The first pose that is taken starts the filter. Without a pose only the odometry counts,
        and the NIS is 0.
        """
        return jax.vmap(lambda b, w: self._update_one(b, candidates, w, obs))(belief, weights)

    def _update_one(
        self, belief: Belief, candidates: Candidates, weights: Array, obs: Observation
    ) -> tuple[Belief, Array]:
        chosen = jnp.argmax(weights)
        seen = weights[chosen] > 0
        T_world_vehicle = jaxlie.SE3(candidates.T_vehicle_world.wxyz_xyz[chosen]).inverse()
        pose = planar_from_T_world_vehicle(T_world_vehicle)
        R_pose = planar_covariance(T_world_vehicle, candidates.covariance[chosen])
        R_pose = R_pose + jnp.diag(self.vision_floor**2)

        starts = seen & ~belief.initialised
        zero = jnp.zeros((3, 3), pose.dtype)
        first_covariance = jnp.block(
            [[R_pose, zero], [zero, jnp.diag(self.initial_velocity_sigma**2)]]
        )
        mean = jnp.where(starts, jnp.append(pose, jnp.zeros(3, pose.dtype)), belief.mean)
        P = jnp.where(starts, first_covariance, belief.covariance)

        speed_mps = jnp.asarray(obs.speed_mps, pose.dtype)
        velocity = bicycle.velocity_world(
            speed_mps,
            jnp.asarray(obs.steering_rad, pose.dtype),
            mean[2],
            self.vehicle.wheelbase_m,
        )
        turned_velocity = jnp.stack([-velocity[1], velocity[0], jnp.zeros_like(speed_mps)])
        innovation = jnp.append(pose - mean[:3], velocity - mean[3:])
        innovation = innovation.at[2].set(wrap_angle(innovation[2]))
        H = jnp.eye(6, dtype=pose.dtype).at[3:, 2].set(-turned_velocity)
        R = jnp.block([[R_pose, zero], [zero, jnp.diag(self.odometry_sigma**2)]])
        takes_pose = (seen & belief.initialised).astype(pose.dtype)
        has_odometry = jnp.asarray(obs.has_odometry, pose.dtype)
        present = jnp.append(jnp.full(3, takes_pose), jnp.full(3, has_odometry))

        correction, P, S = kalman.update(P, *kalman.hide_rows(innovation, H, R, present))
        mean = mean + correction
        posterior = Belief(
            mean.at[2].set(wrap_angle(mean[2])), P, belief.log_weight, belief.initialised | seen
        )
        return posterior, takes_pose * kalman.nis(present[:3] * innovation[:3], S[:3, :3])


class ConstantVelocity(eqx.Module):
    """A body that moves freely: pose on SE(3) and body twist, for hand-held and aerial rigs.

    The mean is (wxyz, xyz) of T_world_vehicle followed by the twist (m/s, rad/s) in vehicle axes;
    the 12 error states are xi in `T_world_vehicle * exp(xi)` and the twist's own error. There is no
    odometry. Source: Liu, Schofield, Shan (2023), end of section II-D; Barfoot (2017), chapter 7.
    """

    acceleration_density: Float[Array, " 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0**2] * 3 + [2.0**2] * 3)
    )  # (m/s^2)^2/Hz three times, (rad/s^2)^2/Hz three times
    vision_floor: Float[Array, " 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.002] * 3 + [0.002] * 3)
    )  # standard deviations, m and rad
    initial_velocity_sigma: Float[Array, " 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0] * 3 + [1.0] * 3)
    )  # m/s and rad/s
    lost_sigma_m: float = 0.5  # a prediction less certain than this is forgotten

    def init(self) -> Belief:
        """One hypothesis that has seen nothing."""
        dtype = self.acceleration_density.dtype
        return Belief(
            mean=jnp.zeros((1, 13), dtype).at[:, 0].set(1),
            covariance=jnp.eye(12, dtype=dtype)[None],
            log_weight=jnp.zeros(1, dtype),
            initialised=jnp.zeros(1, bool),
        )

    def predict(self, belief: Belief, dt_s: Float[Array, ""] | float) -> Belief:
        """T = T exp(twist dt); the error turns with the frame.

        Without odometry a prediction is soon worth nothing: past `lost_sigma_m` the next pose
        starts the filter anew.
        """
        dtype = belief.mean.dtype
        eye, zero = jnp.eye(6, dtype=dtype), jnp.zeros((6, 6), dtype)
        Q = kalman.white_acceleration(self.acceleration_density, dt_s).astype(dtype)

        def one(mean: Array, P: Array) -> tuple[Array, Array]:
            motion = jaxlie.SE3.exp(mean[7:] * dt_s)
            T_world_vehicle = (jaxlie.SE3(mean[:7]) @ motion).normalize()
            F = jnp.block(
                [[motion.inverse().adjoint(), jnp.asarray(dt_s, dtype) * eye], [zero, eye]]
            )
            return (
                jnp.append(T_world_vehicle.wxyz_xyz, mean[7:]),
                kalman.predict_covariance(P, F, Q),
            )

        mean, covariance = jax.vmap(one)(belief.mean, belief.covariance)
        variance_m2 = jnp.max(jnp.diagonal(covariance, axis1=1, axis2=2)[:, :3], axis=1)
        kept = belief.initialised & (variance_m2 < self.lost_sigma_m**2)
        return Belief(mean, covariance, belief.log_weight, kept)

    def poses(self, belief: Belief) -> PoseBelief:
        """The pose part of the state."""
        return PoseBelief(
            jaxlie.SE3(belief.mean[:, :7]),
            belief.covariance[:, :6, :6],
            belief.log_weight,
            belief.initialised,
        )

    def update(
        self,
        belief: Belief,
        candidates: Candidates,
        weights: Float[Array, "K N"],
        obs: Observation,
    ) -> tuple[Belief, Float[Array, " K"]]:
        """The posterior of every hypothesis, and the pose's NIS (6 dof)."""
        return jax.vmap(lambda b, w: self._update_one(b, candidates, w))(belief, weights)

    def _update_one(
        self, belief: Belief, candidates: Candidates, weights: Array
    ) -> tuple[Belief, Array]:
        chosen = jnp.argmax(weights)
        seen = weights[chosen] > 0
        T_world_vehicle = jaxlie.SE3(candidates.T_vehicle_world.wxyz_xyz[chosen]).inverse()
        dtype = belief.mean.dtype
        R = candidates.covariance[chosen] + jnp.diag(self.vision_floor**2)

        starts = seen & ~belief.initialised
        zero = jnp.zeros((6, 6), dtype)
        first_covariance = jnp.block([[R, zero], [zero, jnp.diag(self.initial_velocity_sigma**2)]])
        first_mean = jnp.append(T_world_vehicle.wxyz_xyz, jnp.zeros(6, dtype))
        mean = jnp.where(starts, first_mean, belief.mean)
        P = jnp.where(starts, first_covariance, belief.covariance)

        T_world_prior = jaxlie.SE3(mean[:7])
        # Where no pose is taken the difference is that of a pose with itself: log stays smooth.
        takes_pose = seen & belief.initialised
        measured = jnp.where(takes_pose, T_world_vehicle.wxyz_xyz, T_world_prior.wxyz_xyz)
        innovation = (T_world_prior.inverse() @ jaxlie.SE3(measured)).log()
        present = jnp.full(6, takes_pose).astype(dtype)
        H = jnp.eye(6, 12, dtype=dtype)
        correction, P, S = kalman.update(P, *kalman.hide_rows(innovation, H, R, present))
        T_posterior = (T_world_prior @ jaxlie.SE3.exp(correction[:6])).normalize()
        posterior = Belief(
            jnp.append(T_posterior.wxyz_xyz, mean[7:] + correction[6:]),
            P,
            belief.log_weight,
            belief.initialised | seen,
        )
        return posterior, takes_pose * kalman.nis(present * innovation, S)
