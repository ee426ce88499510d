"""The paper's filter for a vehicle on wheels: six states, one measured pose, odometry, a gyro."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
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
from jaxnav.core.filter.motion import Motion, Planar, camera_states, follow_pose
from jaxnav.core.filter.odometry import (
    GYRO,
    SENSORS_END,
    SIX,
    ReadVelocity,
    Turn,
    bias_at_rest,
    gyro_variance,
    read_velocity,
    seen_pose,
    slip_of,
    slipped,
    turn_of,
    turned,
    velocity_lead_after,
)
from jaxnav.core.linalg.small_matrices import matvec, product, sandwich
from jaxnav.core.models.geometry import (
    OFF_GROUND,
    ON_GROUND,
    T_world_vehicle_from_planar,
    planar_covariance,
    planar_from_T_world_vehicle,
    planar_rotation,
    safe_norm,
    wrap_angle,
)
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.pose.observation import Observation


class BicycleKalman(Motion):
    """The paper's six-state filter in the plane: x, y, psi, v_x, v_y, psi_dot in the world.

    For a car, and for every base whose odometry reads a twist.

        x = A x,  P = A P A' + Q,    A = [I, dt I; 0, I]                               (Eq. 9)
        K = P H' (H P H' + R)^-1,  x += K (z - H x)                            (Eqs. 10, 11)

    The pose of the chosen candidate measures the first half of the state, odometer and steering the
    second. The paper leaves open (see docs/design.md, Odometry and the headings before it):

    * The odometry's v (cos(beta + psi), sin(beta + psi)) depends on the state's own heading. Its
      innovation uses the predicted psi, and H carries the derivative, so a correction of
      the heading turns the velocity along and the drift of the position corrects the heading.
    * Q and the odometry's noise are given in the vehicle's axes, since wheels slip along and across
      themselves: numbers learned on one course are valid on another.
    * Errors that repeat are states behind the six: five of the sensors (`odometry.py`) and
      three of each camera (`errors.py`), where vehicle and rig say that there are any. The
      corners show the pose x - tau v; the odometer's scale has a part that stays and one that comes
      and goes, the slip of the wheels.
    * Where the vehicle has a gyro, it tells the turn of every interval (`odometry.py`).
    * The covariance of a vision pose is the candidate's own (from J'J at its minimum), plus a
      floor, since errors of successive frames are correlated.

    Source: Liu, Schofield, Shan (2023), Eqs. 8-11.
    """

    states: ClassVar[int] = SIX
    vehicle: Vehicle | TwistBase
    acceleration_density: Float[Array, " 3"] | Float[Array, "3 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.1**2, 0.1**2, 0.3**2])
    )  # along, across, turning: (m/s^2)^2/Hz twice, (rad/s^2)^2/Hz; or the matrix
    vision_floor: Float[Array, " 3"] | Float[Array, "3 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.005, 0.005, 0.005])
    )  # x, y, psi: standard deviations, m m rad; or their covariance
    odometry_sigma: Float[Array, " 3"] | Float[Array, "3 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([0.01, 0.01, 0.01])
    )  # along, across, turning: standard deviations, m/s m/s rad/s; or their covariance
    slip_sigma: float = 0.05  # of the wheels, a share of their speed; none where they are exact
    slip_length_m: float = 0.2  # way after which the correlation of a slip has fallen to 1/e
    gyro_slip_length_m: float = 0.5  # the same while a gyro tells, which shows when a slip begins
    initial_velocity_sigma: Float[Array, " 3"] = eqx.field(
        default_factory=lambda: jnp.asarray([1.0, 1.0, 2.0])
    )  # before the first odometry, m/s m/s rad/s
    tilt_sigma_rad: float = 0.005  # roll and pitch of the cameras, against level and calibration
    height_sigma_m: float = 0.002
    gate_nis: float = eqx.field(default=21.1, kw_only=True)  # chi-square, 3 dof, at 99.99 %

    def init(self, hypotheses: int = 1) -> Bank:
        """A bank of K hypotheses before the first pose."""
        dtype = self.vehicle.dtype
        variance = jnp.append(jnp.ones(SIX, dtype), self._error_variance())
        return empty_bank(jnp.zeros_like(variance), jnp.diag(variance), 3, hypotheses)

    def predict(self, bank: Bank, obs: Observation) -> Bank:
        """x = A x, P = A P A' + Q (Eq. 9), then the odometry (Eqs. 10 and 11).

        Speed and steering change at an unknown instant t inside the interval dt: with the
        difference d (3,) between the velocity read now and the one believed before, velocity and
        pose get the second moments of a step d and of d t for a uniform t,

            [dt^2 / 3, dt / 2; dt / 2, 1] (x) d d'.

        So a step is followed at once, however short the interval is, and leaves to the pose half of
        d dt, and a standard deviation of d dt / sqrt(12).

        A hypothesis that the gate has contradicted too often or too long is forgotten.
        """
        dtype, gyro = bank.mean.dtype, self.vehicle.gyro
        dt_s = jnp.asarray(obs.dt_s, dtype)
        turn_sigma_radps = jnp.sqrt(kalman.as_covariance(self.odometry_sigma)[2, 2]).astype(dtype)

        def one(mean: Array, P: Array, velocity_lead: Array) -> tuple[Array, Array, Array]:
            turn = self._turn(obs, mean)
            later, P = self._later(mean, P, obs, turn)
            if turn is None or gyro is None:
                later, P = self._with_odometry(later, P, obs, dt_s)
            else:
                if self.vehicle.sensor_sigma is not None:
                    read = read_velocity(self.vehicle, obs, later)
                    later, P = slip_of(turn, read, turn_sigma_radps, later, P)
                later, P = self._with_odometry(later, P, obs, dt_s, turn.measured)
                read = read_velocity(self.vehicle, obs, later)
                read_turn = turn, mean[3:5], read, turn_sigma_radps, dt_s
                later, P = bias_at_rest(gyro, *read_turn, later, P)
                later = later.at[2].set(wrap_angle(later[2]))
            change = _in_body(later) - _in_body(mean)
            return later, P, velocity_lead_after(velocity_lead, change, dt_s)

        predicted = eqx.tree_at(
            lambda b: (b.mean, b.covariance, b.velocity_lead),
            bank,
            jax.vmap(one)(bank.mean, bank.covariance, bank.velocity_lead),
        )
        return forget_lost(predicted, self.lost(bank), obs.dt_s)

    def evolve(self, mean: Float[Array, " n"], P: Float[Array, "n n"], obs: Observation) -> Moments:
        """One hypothesis before its odometry measures it; see `predict`."""
        turn = self._turn(obs, mean)
        later, P = self._later(mean, P, obs, turn)
        dt_s = jnp.asarray(obs.dt_s, mean.dtype)
        return later, self._stepped(later, P, obs, dt_s, None if turn is None else turn.measured)

    def poses(self, bank: Bank) -> PoseBelief:
        """Poses level on the ground (Eq. 12); height, roll and pitch are nuisances with a sigma."""
        seen, slopes = jax.vmap(seen_pose)(bank.mean, bank.velocity_lead)
        dtype = bank.mean.dtype
        freedom = jnp.asarray(ON_GROUND, dtype)
        tilt = [self.height_sigma_m, self.tilt_sigma_rad, self.tilt_sigma_rad]
        nuisance = jnp.asarray(OFF_GROUND, dtype) * jnp.asarray(tilt, dtype)[None]

        def in_body(P: Array, seen: Array, slope: Array) -> tuple[Array, Array]:
            H = product(planar_rotation(-seen[2]), slope)
            h = H.shape[1]
            of_pose = product(H, P[:h])
            covariance = kalman.symmetrise(product(of_pose[:, :h], H.T))
            return sandwich(freedom, covariance), product(freedom, of_pose[:, self._cameras])

        covariance, cross = jax.vmap(in_body)(bank.covariance, seen, slopes)
        errors = None
        if self.camera_states:
            at = self._cameras
            errors = CameraErrors(bank.mean[:, at], bank.covariance[:, at, at], cross)
        return PoseBelief(
            T_world_vehicle_from_planar(seen),
            covariance,
            bank.log_weight,
            bank.initialised,
            freedom,
            nuisance,
            self.gate_nis,
            errors,
        )

    def compared(
        self, bank: Bank, measured: MeasuredPose
    ) -> tuple[Float[Array, " 3"], Float[Array, "3 h"], Float[Array, "3 3"]]:
        """See `Motion`, in 3 dof."""
        T = measured.T_world_vehicle
        seen, slope = seen_pose(bank.mean, bank.velocity_lead)
        gap = self.difference(planar_from_T_world_vehicle(T), seen)
        R = planar_covariance(T, measured.covariance) + kalman.as_covariance(self.vision_floor)
        return gap, slope, R

    def adopted(self, bank: Bank, measured: MeasuredPose) -> Moments:
        """See `Motion`, in 3 dof."""
        T, velocity_lead = measured.T_world_vehicle, bank.velocity_lead
        pose = planar_from_T_world_vehicle(T)
        seen, slope = seen_pose(bank.mean, velocity_lead)
        in_body = product(planar_rotation(-seen[2]), slope)
        predicted = kalman.replace_first(bank.covariance, in_body)
        freedom = jnp.asarray(ON_GROUND, pose.dtype)
        correction, P = follow_pose(
            jnp.where(bank.initialised, predicted, jnp.eye(predicted.shape[0], dtype=pose.dtype)),
            T_world_vehicle_from_planar(seen),
            measured,
            freedom,
            self.states,
            0 if self.vehicle.gyro is None else GYRO,
        )
        P = kalman.replace_first(P, planar_rotation(pose[2]))
        return _at_stamp(jnp.append(pose, bank.mean[3:] + correction[3:]), P, velocity_lead)

    def for_rig(self, rig: CameraRig, hypotheses: int) -> "BicycleKalman":
        """The model with the errors of cameras and sensors; the paper's six states for one rule."""
        vehicle = self.vehicle
        if hypotheses == 1:
            vehicle = eqx.tree_at(
                lambda v: (v.sensor_sigma, v.gyro),
                vehicle,
                (None, None),
                is_leaf=lambda leaf: leaf is None,
            )
        count = camera_states(rig, hypotheses)
        return dataclasses.replace(self, vehicle=vehicle, camera_states=count)

    def learns(self, bank: Bank) -> Bool[Array, ""]:
        """Whether the heading is known to `learn_sigma_rad`."""
        apart = wrap_angle(bank.mean[:, 2] - bank.mean[heaviest(bank), 2])
        return known_to(bank, apart, bank.covariance[:, 2, 2]) < self.learn_sigma_rad**2

    def difference(self, mean: Float[Array, " n"], base: Float[Array, " n"]) -> Float[Array, " n"]:
        """mean - base, (n,), with the heading wrapped."""
        apart = mean - base
        return apart.at[2].set(wrap_angle(apart[2]))

    def moved(self, base: Float[Array, " n"], error: Float[Array, " n"]) -> Float[Array, " n"]:
        """base + error, (n,), with the heading wrapped."""
        mean = base + error
        return mean.at[2].set(wrap_angle(mean[2]))

    def T_world_vehicle(self, mean: Float[Array, " n"]) -> jaxlie.SE3:
        """The pose of a mean, level on the ground."""
        return T_world_vehicle_from_planar(mean[:3])

    def planar(self, mean: Float[Array, " n"], covariance: Float[Array, "n n"]) -> Planar:
        """Pose and velocity as they stand in the state, which is planar."""
        return Planar(mean[:3], covariance[:3, :3], mean[3:SIX], covariance[3:SIX, 3:SIX])

    def start(self, bank: Bank, measured: MeasuredPose, obs: Observation) -> Moments:
        """One hypothesis that begins at a measured pose, moving as read, its errors unknown."""
        pose = planar_from_T_world_vehicle(measured.T_world_vehicle)
        covariance = planar_covariance(measured.T_world_vehicle, measured.covariance)
        if measured.innovation is None:
            covariance = covariance + kalman.as_covariance(self.vision_floor)
        velocity = jnp.asarray(self.initial_velocity_sigma, pose.dtype) ** 2
        variance = jnp.concatenate([jnp.zeros(3, pose.dtype), velocity, self._error_variance()])
        P = jnp.diag(variance).at[:3, :3].set(covariance)
        errors = measured.errors
        if errors is not None:
            # d q / d (x, y, psi) in the world, of the errors in view
            slope = product(errors.slope, planar_rotation(-pose[2]))
            cross = product(covariance, product(slope.T, errors.rows))
            P = P.at[:3, self._cameras].set(cross).at[self._cameras, :3].set(cross.T)
        start = jnp.append(pose, jnp.zeros_like(variance[3:]))
        return _at_stamp(*self._with_odometry(start, P, obs), bank.velocity_lead)

    @property
    def _cameras(self) -> slice:
        """Where in the state the errors of the cameras are."""
        return slice(SENSORS_END, SENSORS_END + self.camera_states)

    def _error_variance(self) -> Array:
        """Variances (p,) of the errors that the state holds behind pose and velocity."""
        sigma, gyro, dtype = self.vehicle.sensor_sigma, self.vehicle.gyro, self.vehicle.dtype
        if sigma is None and gyro is None and not self.camera_states:
            return jnp.zeros(0, dtype)
        of_sensors = jnp.zeros(4, dtype) if sigma is None else jnp.asarray(sigma, dtype) ** 2
        slip = self._slip_sigma()[None] ** 2
        variance = jnp.concatenate([slip, of_sensors, jnp.ones(self.camera_states, dtype)])
        if gyro is None:
            return variance
        return jnp.append(variance, gyro_variance(gyro, dtype))

    def _slip_sigma(self) -> Array:
        """Standard deviation of the slip; 0 where the sensors are exact."""
        dtype = self.vehicle.dtype
        return jnp.asarray(0.0 if self.vehicle.sensor_sigma is None else self.slip_sigma, dtype)

    def _later(self, mean: Array, P: Array, obs: Observation, turn: Turn | None = None) -> Moments:
        """The state `dt_s` later (Eq. 9), turned as a gyro has measured."""
        dtype, dt_s = mean.dtype, jnp.asarray(obs.dt_s, mean.dtype)
        A = jnp.eye(3, SIX, dtype=dtype).at[:, 3:].set(dt_s * jnp.eye(3, dtype=dtype))
        density = sandwich(planar_rotation(mean[2]), kalman.as_matrix(self.acceleration_density))
        Q = kalman.white_acceleration(density, dt_s).astype(dtype)
        pose = mean[:3] + dt_s * mean[3:SIX]
        if turn is not None:
            six, A, Q = turned(turn, mean, jnp.append(pose, mean[3:SIX]), A, Q, dt_s)
            pose, mean = six[:3], mean.at[3:SIX].set(six[3:])
        P = kalman.replace_first(P, A).at[:SIX, :SIX].add(Q)
        later = mean.at[:3].set(pose.at[2].set(wrap_angle(pose[2])))
        way_m = safe_norm(mean[3:5]) * dt_s
        length_m = jnp.asarray(self.slip_length_m, dtype)
        if turn is not None:
            length_m = jnp.where(
                turn.measured, jnp.asarray(self.gyro_slip_length_m, dtype), length_m
            )
        if self.vehicle.gyro is not None:
            P = P.at[-1, -1].add(jnp.asarray(self.vehicle.gyro.bias_walk, dtype) ** 2 * dt_s)
        return slipped(later, P, way_m, self._slip_sigma(), length_m)

    def _turn(self, obs: Observation, mean: Array) -> Turn | None:
        """What the gyro says of the interval; None without one."""
        if self.vehicle.gyro is None:
            return None
        density = kalman.as_matrix(self.acceleration_density)[2, 2].astype(mean.dtype)
        return turn_of(self.vehicle.gyro, obs, mean, density)

    def _with_odometry(
        self,
        mean: Array,
        P: Array,
        obs: Observation,
        since_s: Array | float = 0.0,
        turns: Array | None = None,
    ) -> Moments:
        """Update a state by the velocity that the odometry reads at its heading, and by its step.

        What the sensors read says nothing of their own errors, which are only considered. `since_s`
        is the time of the prediction; where a gyro has measured the turn, `turns`, the wheels' is
        not looked at.
        """
        P = self._stepped(mean, P, obs, since_s, turns)
        read = read_velocity(self.vehicle, obs, mean)
        H = jnp.eye(3, SIX, k=3, dtype=mean.dtype).at[:, 2].set(-read.by_heading)
        H = jnp.concatenate([H, -read.by_errors], axis=1)
        R = sandwich(planar_rotation(mean[2]), kalman.as_covariance(self.odometry_sigma))
        change, present = read.velocity - mean[3:SIX], _present(read, turns)
        rows = kalman.hide_rows(change, H, R.astype(mean.dtype), present)
        correction, after, _ = kalman.update(P, *rows)
        corrected = self.moved(mean, correction), after
        return self.schmidt_update(jnp.asarray(False), (mean, P), corrected)

    def _stepped(
        self, mean: Array, P: Array, obs: Observation, since_s: Array | float, turns: Array | None
    ) -> Array:
        """Widen the covariance by a step of the velocity to what is read."""
        read = read_velocity(self.vehicle, obs, mean)
        step = _present(read, turns) * (read.velocity - mean[3:SIX])
        dt_s = jnp.asarray(since_s, mean.dtype)
        moments = jnp.stack([dt_s**2 / 3, dt_s / 2, dt_s / 2, jnp.ones_like(dt_s)]).reshape(2, 2)
        return P.at[:SIX, :SIX].add(jnp.kron(moments, step[:, None] * step[None]))


def _present(read: ReadVelocity, turns: Array | None) -> Float[Array, " 3"]:
    """Which rows of a velocity count; see `BicycleKalman._with_odometry`."""
    if turns is None:
        return read.present
    return read.present.at[2].multiply(jnp.where(turns, 0, 1))


def planar_poses(
    bank: Bank,
) -> tuple[Float[Array | np.ndarray, "K 3"], Float[Array | np.ndarray, "K 3 3"]]:
    """(x_m, y_m, psi_rad) of every hypothesis of a car, and its covariance, of JAX or NumPy."""
    return bank.mean[:, :3], bank.covariance[:, :3, :3]


def _at_stamp(seen: Array, P: Array, velocity_lead: Array) -> Moments:
    """A state at its stamp, of one whose first three entries are the seen pose."""
    pose, slope = seen_pose(seen, velocity_lead, sign=1)
    mean = seen.at[:3].set(pose.at[2].set(wrap_angle(pose[2])))
    return mean, kalman.replace_first(P, slope)


def _in_body(mean: Array) -> Array:
    """The velocity in the vehicle's own axes."""
    return matvec(planar_rotation(-mean[2]), mean[3:SIX])
