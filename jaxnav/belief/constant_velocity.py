"""A filter for bodies that move freely: pose on SE(3) and twist."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnav.belief import kalman
from jaxnav.belief.bank import Bank
from jaxnav.belief.free_body import FreeBody, moved_by_twist
from jaxnav.belief.gate import Moments
from jaxnav.models.geometry import safe_norm
from jaxnav.pose.observation import Observation

_LARGEST_TWIST = 1e3  # m/s and rad/s; a larger one is an error of the sensor


class ConstantVelocity(FreeBody):
    """A body that moves freely: pose on SE(3) and body twist, for hand-held and aerial rigs.

    The mean is (wxyz, xyz) of T_world_vehicle followed by the twist (m/s, rad/s) in vehicle axes;
    the 12 error states are xi in `T_world_vehicle * cay(xi)` and the error of the twist. Where
    another estimator (visual-inertial odometry, lidar) tells the motion between observations, it
    replaces the twist, and its drift the acceleration; where it is silent, the twist carries on.

    Source: Liu, Schofield, Shan (2023), end of section II-D; Barfoot (2017), chapter 7.
    """

    states: ClassVar[int] = 12
    acceleration_density: Float[Array, " 6"] | Float[Array, "6 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0**2] * 3 + [2.0**2] * 3)
    )  # (m/s^2)^2/Hz three times, (rad/s^2)^2/Hz three times; or the matrix
    vision_floor: Float[Array, " 6"] | Float[Array, "6 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.002] * 3 + [0.002] * 3)
    )  # standard deviations, m and rad; or their covariance
    initial_velocity_sigma: Float[Array, " 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0] * 3 + [1.0] * 3)
    )  # m/s and rad/s
    # Random walk of the odometry along each axis: per way, per angle, and twice per time;
    # m/sqrt(m), rad/sqrt(rad), m/sqrt(s), rad/sqrt(s).
    odometry_drift: Float[Array, " 4"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.04, 0.02, 0.005, 0.005])
    )
    camera_states: int = eqx.field(static=True, default=0)  # see `for_rig`
    camera_turn_sigma_rad: Float[Array, "C 3"] | None = None  # see `for_rig`
    learn_sigma_rad: float = 0.035  # sigma of the orientation below which errors are estimated
    lost_sigma_m: float = 0.5  # a hypothesis whose position is less certain is forgotten
    gate_nis: float = 27.9  # chi-square with 6 dof at 99.99 %; inf: no gate
    max_rejections: int = eqx.field(static=True, default=10)  # in a row that agree: forgotten
    max_rejected_s: float = 7.0  # of rejections, whether they agree or not: forgotten

    def predict(self, bank: Bank, obs: Observation) -> Bank:
        """T = T exp(u dt),  P = F P F' + Q.

        u is the twist of the state, F = [Ad(exp(-u dt)), dt I; 0, I] and Q that of a white
        acceleration; or, where the odometry tells u, F = [Ad(exp(-u dt)), 0; 0, 0] and

            Q = [D, D / dt; D / dt, D / dt^2 + A dt / 3]

        with the drift D in the interval, and the twist at its end off its mean by A dt / 3, A the
        density of the acceleration.

        A hypothesis is forgotten, and started anew by its next pose, where the sigma of its
        position exceeds `lost_sigma_m` or the gate has contradicted it too often or too long.
        """
        moments = jax.vmap(lambda mean, P: self.evolve(mean, P, obs))(bank.mean, bank.covariance)
        return self.without_lost(bank, *moments, jnp.asarray(obs.dt_s, bank.mean.dtype))

    def evolve(self, mean: Float[Array, " n"], P: Float[Array, "d d"], obs: Observation) -> Moments:
        """One hypothesis `obs.dt_s` later; see `predict`."""
        dtype, dt_s = mean.dtype, jnp.asarray(obs.dt_s, mean.dtype)
        Q = kalman.white_acceleration(self.acceleration_density, dt_s).astype(dtype)
        told, twist = self._told(obs, dtype)
        u = jnp.where(told, twist, mean[7:13])
        mean, P = moved_by_twist(mean, P, u, dt_s, ~told)
        if obs.twist is not None:
            P = P.at[6:12].multiply(1 - told).at[:, 6:12].multiply(1 - told)
        return mean, P.at[:12, :12].add(jnp.where(told, self._drift(twist, dt_s), Q))

    def _told(self, obs: Observation, dtype: Any) -> tuple[Bool[Array, ""], Float[Array, " 6"]]:
        """Whether the odometry tells the motion, and its twist; 0 where it does not."""
        if obs.twist is None:
            return jnp.asarray(False), jnp.zeros(6, dtype)
        twist = jnp.asarray(obs.twist, dtype)
        usable = jnp.all(jnp.abs(twist) < _LARGEST_TWIST) & (jnp.asarray(obs.dt_s) > 0)
        return usable, jnp.where(usable, twist, 0)

    def _drift(self, twist: Array, dt_s: Array) -> Array:
        """Q (12, 12) of an interval in which the odometry told the motion."""
        dtype = twist.dtype
        per_m, per_rad, walk_m, walk_rad = jnp.asarray(self.odometry_drift, dtype) ** 2
        speed, rate = safe_norm(twist[:3]), safe_norm(twist[3:])
        # The drift over dt: it grows with the way, the angle and the time, which all do with dt.
        linear, angular = per_m * speed + walk_m, per_rad * rate + walk_rad
        D = jnp.diag(jnp.concatenate([jnp.full(3, linear), jnp.full(3, angular)]))
        per_dt = 1 / jnp.where(dt_s > 0, dt_s, 1)
        A = kalman.as_matrix(self.acceleration_density).astype(dtype)
        return jnp.block([[D * dt_s, D], [D, D * per_dt + A * dt_s / 3]])

    def at_first(self) -> Moments:
        """No velocity, with `initial_velocity_sigma`."""
        sigma = jnp.asarray(self.initial_velocity_sigma, float)
        return jnp.zeros_like(sigma), jnp.diag(sigma**2)
