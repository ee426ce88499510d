"""Filters of bodies that move freely: pose on SE(3), twist, and further states behind."""

import abc
import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter import kalman
from jaxnav.core.filter.bank import (
    Bank,
    CameraErrors,
    Moments,
    PoseBelief,
    empty_bank,
    forget_lost,
    heaviest,
    known_to,
)
from jaxnav.core.filter.choose import MeasuredPose
from jaxnav.core.filter.errors import EACH, common_turn, schmidt_update_along
from jaxnav.core.filter.motion import Motion, Planar, camera_states, follow_pose
from jaxnav.core.linalg.small_matrices import matvec, product, sandwich, where
from jaxnav.core.models.geometry import (
    cayley,
    inverse_cayley,
    planar_from_T_world_vehicle,
    rotation_error_rad,
    rotation_matrix,
    safe_norm,
)
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import ERRORS, OdometryErrors
from jaxnav.core.pose.observation import Observation


class FreeBody(Motion):
    """A body that is free in six directions.

    The mean is (wxyz, xyz) of T_world_vehicle, the twist (m/s, rad/s) in vehicle axes, further
    states of the model, the errors of its sensors, and those of the cameras; the error states are
    xi in `T_world_vehicle * cay(xi)`, and the errors of all others.
    """

    acceleration_density: Float[Array, " 6"] | Float[Array, "6 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0**2] * 3 + [2.0**2] * 3), kw_only=True
    )  # (m/s^2)^2/Hz three times, (rad/s^2)^2/Hz three times; or the matrix
    vision_floor: Float[Array, " 6"] | Float[Array, "6 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.002] * 3 + [0.002] * 3), kw_only=True
    )  # standard deviations, m and rad; or their covariance
    initial_velocity_sigma: Float[Array, " 6"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0] * 3 + [1.0] * 3), kw_only=True
    )  # m/s and rad/s
    camera_turn_sigma_rad: Float[Array, "C 3"] | None = eqx.field(default=None, kw_only=True)
    # A hypothesis whose position is less certain is forgotten.
    lost_sigma_m: float = eqx.field(default=0.5, kw_only=True)
    gate_nis: float = eqx.field(default=27.9, kw_only=True)  # chi-square, 6 dof, at 99.99 %

    @abc.abstractmethod
    def at_first(self) -> Moments:
        """Mean and covariance of the states behind a first pose, but for the cameras' errors."""

    def init(self, hypotheses: int = 1) -> Bank:
        """A bank of K hypotheses before the first pose."""
        dtype, rest = self.acceleration_density.dtype, self.at_first()[0]
        count = 6 + rest.shape[0] + self.camera_states
        mean = jnp.zeros(1 + count, dtype).at[0].set(1)
        mean = mean.at[7 : 7 + rest.shape[0]].set(rest.astype(dtype))
        return empty_bank(mean, jnp.eye(count, dtype=dtype), 6, hypotheses)

    def predict(self, bank: Bank, obs: Observation) -> Bank:
        """The bank `obs.dt_s` later; see `evolve`.

        A hypothesis is forgotten, and started anew by its next pose, where the sigma of its
        position exceeds `lost_sigma_m` or the gate has contradicted it too often or too long.
        """
        moments = jax.vmap(lambda mean, P: self.evolve(mean, P, obs))(bank.mean, bank.covariance)
        later = eqx.tree_at(lambda b: (b.mean, b.covariance), bank, moments)
        variance_m2 = jnp.max(jnp.diagonal(later.covariance, axis1=1, axis2=2)[:, :3], axis=1)
        lost = self.lost(bank) | ~(variance_m2 < self.lost_sigma_m**2)
        return forget_lost(later, lost, jnp.asarray(obs.dt_s, bank.mean.dtype))

    def poses(self, bank: Bank) -> PoseBelief:
        """The pose part of the state: free in six directions, without nuisances."""
        P, errors = bank.covariance, None
        if self.camera_states:
            at = P.shape[-1] - self.camera_states
            errors = CameraErrors(bank.mean[:, at + 1 :], P[:, at:, at:], P[:, :6, at:])
        return PoseBelief(
            jaxlie.SE3(bank.mean[:, :7]),
            P[:, :6, :6],
            bank.log_weight,
            bank.initialised,
            jnp.eye(6, dtype=bank.mean.dtype),
            jnp.zeros((6, 0), bank.mean.dtype),
            self.gate_nis,
            errors,
        )

    def compared(
        self, bank: Bank, measured: MeasuredPose
    ) -> tuple[Float[Array, " 6"], Float[Array, "6 6"], Float[Array, "6 6"]]:
        """See `Motion`, in 6 dof."""
        away = jaxlie.SE3(bank.mean[:7]).inverse() @ measured.T_world_vehicle
        R = measured.covariance + kalman.as_covariance(self.vision_floor)
        return inverse_cayley(away), jnp.eye(6, dtype=bank.mean.dtype), R

    def adopted(self, bank: Bank, measured: MeasuredPose) -> Moments:
        """See `Motion`, in 6 dof."""
        T = measured.T_world_vehicle
        correction, P = follow_pose(
            bank.covariance,
            jaxlie.SE3(bank.mean[:7]),
            measured,
            jnp.eye(6, dtype=bank.mean.dtype),
            self.states,
        )
        if measured.errors is not None and self.camera_turn_sigma_rad is not None:
            sigma_rad = jnp.asarray(self.camera_turn_sigma_rad, P.dtype)
            common = common_turn(measured.errors, sigma_rad)
            correction, P = schmidt_update_along(common, bank.covariance, correction, P)
        return jnp.append(T.wxyz_xyz, bank.mean[7:] + correction[6:]), P

    def difference(self, mean: Float[Array, " n"], base: Float[Array, " n"]) -> Float[Array, " d"]:
        """(xi, difference of the twists), (12,): mean = base * cay(xi), in the axes of `base`."""
        T_base_other = jaxlie.SE3(base[:7]).inverse() @ jaxlie.SE3(mean[:7])
        return jnp.append(inverse_cayley(T_base_other), mean[7:] - base[7:])

    def moved(self, base: Float[Array, " n"], error: Float[Array, " d"]) -> Float[Array, " n"]:
        """The mean (13,) at an error (12,): base * cay(xi), and the twist plus its error."""
        T = (jaxlie.SE3(base[:7]) @ cayley(error[:6])).normalize()
        return jnp.append(T.wxyz_xyz, base[7:] + error[6:])

    def T_world_vehicle(self, mean: Float[Array, " n"]) -> jaxlie.SE3:
        """The pose of a mean."""
        return jaxlie.SE3(mean[:7])

    def planar(self, mean: Float[Array, " n"], covariance: Float[Array, "d d"]) -> Planar:
        """See `Motion`: J P J' with the Jacobians of `on_ground`."""
        P, still = covariance, jnp.zeros(covariance.shape[0], mean.dtype)
        slopes = jax.jacfwd(lambda error: self.on_ground(self.moved(mean, error)))(still)
        (pose, velocity), (J_pose, J_velocity) = self.on_ground(mean), slopes
        return Planar(pose, sandwich(J_pose, P), velocity, sandwich(J_velocity, P))

    def on_ground(self, mean: Float[Array, " n"]) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
        """(x, y, psi) and (v_x, v_y, psi_dot) in the world: pose and motion seen from above."""
        T_world_vehicle = jaxlie.SE3(mean[:7])
        R_world_vehicle = rotation_matrix(T_world_vehicle.rotation())
        v_mps, w_radps = matvec(R_world_vehicle, mean[7:10]), matvec(R_world_vehicle, mean[10:13])
        # psi is the direction of the x axis, which moves by w x (R e_x).
        x, y, up = R_world_vehicle[:, 0]
        level = jnp.maximum(x**2 + y**2, jnp.finfo(mean.dtype).eps)
        turn_radps = w_radps[2] - up * (x * w_radps[0] + y * w_radps[1]) / level
        return planar_from_T_world_vehicle(T_world_vehicle), jnp.append(v_mps[:2], turn_radps)

    def for_rig(self, rig: CameraRig, hypotheses: int) -> "FreeBody":
        """The model with the errors of the rig's cameras among its states."""
        count = camera_states(rig, hypotheses)
        turns = None if rig.extrinsics_sigma is None else rig.extrinsics_sigma[:, EACH:]
        turns = turns if count else None
        return dataclasses.replace(self, camera_states=count, camera_turn_sigma_rad=turns)

    def learns(self, bank: Bank) -> Bool[Array, ""]:
        """Whether the orientation is known to `learn_sigma_rad`."""
        best = jaxlie.SE3(bank.mean[heaviest(bank), :7])
        apart = jax.vmap(lambda mean: rotation_error_rad(jaxlie.SE3(mean[:7]), best))(bank.mean)
        variance = jnp.trace(bank.covariance[:, 3:6, 3:6], axis1=1, axis2=2)
        return known_to(bank, apart, variance) < self.learn_sigma_rad**2

    def start(self, bank: Bank, measured: MeasuredPose, obs: Observation) -> Moments:
        """One hypothesis that begins at a measured pose, moving as little as is known."""
        wxyz_xyz, dtype = measured.T_world_vehicle.wxyz_xyz, bank.mean.dtype
        covariance = measured.covariance
        if measured.innovation is None:
            covariance = covariance + kalman.as_covariance(self.vision_floor)
        mean, of_rest = (x.astype(dtype) for x in self.at_first())
        behind = 6 + mean.shape[0]
        cameras = jnp.ones(self.camera_states, dtype)
        P = jnp.diag(jnp.concatenate([jnp.zeros(behind, dtype), cameras]))
        P = P.at[:6, :6].set(covariance).at[6:behind, 6:behind].set(of_rest)
        errors = measured.errors
        if errors is not None:
            cross = product(covariance, product(errors.slope.T, errors.rows))
            P = P.at[:6, behind:].set(cross).at[behind:, :6].set(cross.T)
        return jnp.concatenate([wxyz_xyz, mean, jnp.zeros_like(cameras)]), P


def moved_by_twist(
    mean: Float[Array, " n"],
    P: Float[Array, "d d"],
    twist: Float[Array, " 6"],
    dt_s: Float[Array, ""],
    own: Bool[Array, ""] | bool,
) -> Moments:
    """Mean and covariance where the body has had a twist for `dt_s`.

    T = T exp(u dt),  P = F P F',  F = [Ad(exp(-u dt)), dt I; 0, I], or 0 in the place of dt I where
    the twist is not the state's `own`.
    """
    dtype = mean.dtype
    motion = jaxlie.SE3.exp(twist * dt_s)
    T_world_vehicle = (jaxlie.SE3(mean[:7]) @ motion).normalize()
    by_twist = jnp.where(own, dt_s, 0) * jnp.eye(6, dtype=dtype)
    F = jnp.concatenate([motion.inverse().adjoint(), by_twist], axis=1)
    mean = jnp.concatenate([T_world_vehicle.wxyz_xyz, twist, mean[13:]])
    return mean, kalman.replace_first(P, F)


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
    # Random walk of the odometry along each axis: per way, per angle, and twice per time;
    # m/sqrt(m), rad/sqrt(rad), m/sqrt(s), rad/sqrt(s).
    odometry_drift: Float[Array, " 4"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.04, 0.02, 0.005, 0.005])
    )
    odometry_errors: OdometryErrors | None = None  # None: white noise is all that it gets wrong

    def evolve(self, mean: Float[Array, " n"], P: Float[Array, "d d"], obs: Observation) -> Moments:
        """T = T exp(u dt),  P = F P F' + Q.

        u is the twist of the state, F = [Ad(exp(-u dt)), dt I; 0, I] and Q that of a white
        acceleration; or, where the odometry tells u, F = [Ad(exp(-u dt)), 0; 0, 0] and

            Q = [D, D / dt; D / dt, D / dt^2 + A dt / 3]

        with the drift D in the interval, and the twist at its end off its mean by A dt / 3, A the
        density of the acceleration. Errors of the odometry turn and scale u, and F has their
        derivatives of pose and twist.
        """
        dtype, dt_s = mean.dtype, jnp.asarray(obs.dt_s, mean.dtype)
        Q = kalman.white_acceleration(self.acceleration_density, dt_s).astype(dtype)
        read, twist = self._twist_read(obs, dtype)
        if self.odometry_errors is not None:
            later, coasted = moved_by_twist(mean, P, mean[7:13], dt_s, True)
            coasts = later, coasted.at[:12, :12].add(Q)
            return where(
                read, self._by_odometry(self.odometry_errors, mean, P, twist, dt_s), coasts
            )
        u = jnp.where(read, twist, mean[7:13])
        mean, P = moved_by_twist(mean, P, u, dt_s, ~read)
        if obs.twist is not None:
            P = P.at[6:12].multiply(1 - read).at[:, 6:12].multiply(1 - read)
        return mean, P.at[:12, :12].add(jnp.where(read, self._drift(twist, dt_s), Q))

    def _twist_read(
        self, obs: Observation, dtype: jnp.dtype
    ) -> tuple[Bool[Array, ""], Float[Array, " 6"]]:
        """Whether the odometry reads the motion, and its twist; 0 where it does not."""
        if obs.twist is None:
            return jnp.asarray(False), jnp.zeros(6, dtype)
        twist = jnp.asarray(obs.twist, dtype)
        usable = jnp.all(jnp.abs(twist) < _LARGEST_TWIST) & (jnp.asarray(obs.dt_s) > 0)
        return usable, jnp.where(usable, twist, 0)

    def _by_odometry(
        self, errors: OdometryErrors, mean: Array, P: Array, twist: Array, dt_s: Array
    ) -> Moments:
        """Move one hypothesis by odometry whose own errors are states."""
        dtype, known = mean.dtype, mean[13 : 13 + ERRORS]
        u = errors.corrected(twist, known)
        back = jaxlie.SE3.exp(u * dt_s).inverse()

        def off(change: Array) -> Array:
            corrected = errors.corrected(twist, known + change)
            return jnp.append(inverse_cayley(back @ jaxlie.SE3.exp(corrected * dt_s)), corrected)

        F = jnp.zeros((12, _ERRORS.stop), dtype).at[:6, :6].set(back.adjoint())
        F = F.at[:, _ERRORS].set(jax.jacfwd(off)(jnp.zeros(ERRORS, dtype)))
        T_world_vehicle = (jaxlie.SE3(mean[:7]) @ back.inverse()).normalize()
        P = kalman.replace_first(P, F).at[:12, :12].add(self._drift(u, dt_s))
        return jnp.concatenate([T_world_vehicle.wxyz_xyz, u, mean[13:]]), P

    def _drift(self, twist: Array, dt_s: Array) -> Array:
        """Q (12, 12) of an interval in which the odometry moved the body."""
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
        """No velocity, and odometry that is right, each within its sigma."""
        sigma = jnp.asarray(self.initial_velocity_sigma, float)
        if self.odometry_errors is not None:
            sigma = jnp.append(sigma, self.odometry_errors.sigma)
        return jnp.zeros_like(sigma), jnp.diag(sigma**2)

    def for_rig(self, rig: CameraRig, hypotheses: int) -> "FreeBody":
        """See `Motion`."""
        errors = self.odometry_errors if hypotheses > 1 else None
        return FreeBody.for_rig(dataclasses.replace(self, odometry_errors=errors), rig, hypotheses)
