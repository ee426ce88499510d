"""A filter for bodies that move freely: pose on SE(3) and twist."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter import kalman
from jaxnav.core.filter.bank import Bank
from jaxnav.core.filter.free_body import FreeBody, moved_by_twist
from jaxnav.core.filter.gate import Moments
from jaxnav.core.linalg.trees import where
from jaxnav.core.models.geometry import inverse_cayley, safe_norm
from jaxnav.core.models.odometry_errors import ERRORS, OdometryErrors
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Observation

_ERRORS = slice(12, 12 + ERRORS)  # of the odometry, among the error states
_LARGEST_TWIST = 1e3  # m/s and rad/s; a larger one is an error of the sensor


class ConstantVelocity(FreeBody):
    """A body that moves freely: pose on SE(3) and body twist, for hand-held and aerial rigs.

    The mean is (wxyz, xyz) of T_world_vehicle followed by the twist (m/s, rad/s) in vehicle axes;
    the 12 error states are xi in `T_world_vehicle * cay(xi)` and the error of the twist. Where
    another estimator (visual-inertial odometry, lidar) tells the motion between observations, it
    replaces the twist, and its drift the acceleration; where it is silent, the twist carries on.
    Where `odometry_errors` says how far off its scale and direction may be, these four are states
    behind the twist, considered until the orientation is known, then estimated.

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
    odometry_errors: OdometryErrors | None = None  # None: white noise is all that it gets wrong
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
        density of the acceleration. Errors of the odometry turn and scale u, and F has their
        derivatives of pose and twist.

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
        if self.odometry_errors is not None:
            later, coasted = moved_by_twist(mean, P, mean[7:13], dt_s, True)
            coasts = later, coasted.at[:12, :12].add(Q)
            return where(told, self._led(self.odometry_errors, mean, P, twist, dt_s), coasts)
        u = jnp.where(told, twist, mean[7:13])
        mean, P = moved_by_twist(mean, P, u, dt_s, ~told)
        if obs.twist is not None:
            P = P.at[6:12].multiply(1 - told).at[:, 6:12].multiply(1 - told)
        return mean, P.at[:12, :12].add(jnp.where(told, self._drift(twist, dt_s), Q))

    def _told(
        self, obs: Observation, dtype: jnp.dtype
    ) -> tuple[Bool[Array, ""], Float[Array, " 6"]]:
        """Whether the odometry tells the motion, and its twist; 0 where it does not."""
        if obs.twist is None:
            return jnp.asarray(False), jnp.zeros(6, dtype)
        twist = jnp.asarray(obs.twist, dtype)
        usable = jnp.all(jnp.abs(twist) < _LARGEST_TWIST) & (jnp.asarray(obs.dt_s) > 0)
        return usable, jnp.where(usable, twist, 0)

    def _led(
        self, errors: OdometryErrors, mean: Array, P: Array, twist: Array, dt_s: Array
    ) -> Moments:
        """One hypothesis by odometry whose own errors are states."""
        dtype, known = mean.dtype, mean[13 : 13 + ERRORS]
        u = errors.corrected(twist, known)
        back = jaxlie.SE3.exp(u * dt_s).inverse()

        def off(change: Array) -> Array:
            led = errors.corrected(twist, known + change)
            return jnp.append(inverse_cayley(back @ jaxlie.SE3.exp(led * dt_s)), led)

        F = jnp.zeros((12, _ERRORS.stop), dtype).at[:6, :6].set(back.adjoint())
        F = F.at[:, _ERRORS].set(jax.jacfwd(off)(jnp.zeros(ERRORS, dtype)))
        T_world_vehicle = (jaxlie.SE3(mean[:7]) @ back.inverse()).normalize()
        P = kalman.replace_first(P, F).at[:12, :12].add(self._drift(u, dt_s))
        return jnp.concatenate([T_world_vehicle.wxyz_xyz, u, mean[13:]]), P

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
        """No velocity, with `initial_velocity_sigma`; an odometry that is right, within its own."""
        sigma = jnp.asarray(self.initial_velocity_sigma, float)
        if self.odometry_errors is not None:
            sigma = jnp.append(sigma, self.odometry_errors.sigma)
        return jnp.zeros_like(sigma), jnp.diag(sigma**2)

    def for_rig(self, rig: CameraRig, hypotheses: int) -> "FreeBody":
        """See `Motion`."""
        errors = self.odometry_errors if hypotheses > 1 else None
        return FreeBody.for_rig(dataclasses.replace(self, odometry_errors=errors), rig, hypotheses)
