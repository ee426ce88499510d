"""Vehicles: a car by the 3-DOF bicycle, other bases by their twist, and what odometry gets wrong.

The reference point of a car lies midway between the axles (Lf = Lr), where the paper puts the
centre of gravity. How the wheels of a `TwistBase` make its twist (v_x, v_y, omega) is the driver's
affair: to the filter a differential, tracks, mecanum, omni and a swerve drive are the same.

Source: Liu, Schofield, Shan (2023), Eqs. 4-7; Siegwart, Nourbakhsh, Scaramuzza (2011), section 3.2
(kinematics of wheeled bases).
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from jaxnav.core.linalg.small_matrices import matvec
from jaxnav.core.models.geometry import planar_rotation, rotation_matrix, safe_sinc
from jaxnav.core.models.imu import Gyro

# Errors of the sensors that a filter keeps, and their standard deviations where nobody says.
SENSOR_ERRORS = ("speed_scale", "steering_gain", "steering_offset_rad", "camera_delay_s")
DEFAULT_SENSOR_SIGMA = np.asarray([0.03, 0.03, np.deg2rad(0.5), 0.02])


class Vehicle(eqx.Module):
    """Parameters of one vehicle, for the estimator, the controller and the simulated car."""

    wheelbase_m: Float[Array, ""]
    steering_limit_rad: Float[Array, ""]  # |steering| never exceeds it
    steering_rate_limit_radps: Float[Array, ""]
    throttle_limit: Float[Array, ""]  # in the driver's unit (QCar: PWM duty)
    speed_per_throttle_mps: Float[Array, ""]  # steady-state speed at throttle 1
    speed_time_constant_s: Float[Array, ""]  # first-order lag from throttle to speed
    # Standard deviations of what is left of the errors below, such as `DEFAULT_SENSOR_SIGMA`; None:
    # the sensors are exact but for white noise.
    sensor_sigma: Float[Array, " 4"] | None = None
    gyro: Gyro | None = None
    # Calibration of its sensors. `jaxnav.drive.corrections` applies it; the core reads corrected
    # values only.
    speed_scale: float = eqx.field(static=True, default=1.0)  # true speed per speed read
    steering_gain: float = eqx.field(static=True, default=1.0)  # true angle per angle read
    steering_offset_rad: float = eqx.field(static=True, default=0.0)  # true angle where 0 is read
    camera_delay_s: float = eqx.field(static=True, default=0.0)  # cameras' stamp less odometer's

    @staticmethod
    def create(
        wheelbase_m: float,
        steering_limit_rad: float,
        throttle_limit: float,
        speed_per_throttle_mps: float,
        speed_time_constant_s: float,
        steering_rate_limit_radps: float = 5.0,  # a hobby servo: 60 degrees in 0.2 s
        speed_scale: float = 1.0,
        steering_gain: float = 1.0,
        steering_offset_rad: float = 0.0,
        camera_delay_s: float = 0.0,
        sensor_sigma: Float[Array | np.ndarray, " 4"] | None = None,
        gyro: Gyro | None = None,
    ) -> "Vehicle":
        """A vehicle from plain numbers."""
        return Vehicle(
            jnp.asarray(wheelbase_m, float),
            jnp.asarray(steering_limit_rad, float),
            jnp.asarray(steering_rate_limit_radps, float),
            jnp.asarray(throttle_limit, float),
            jnp.asarray(speed_per_throttle_mps, float),
            jnp.asarray(speed_time_constant_s, float),
            None if sensor_sigma is None else jnp.asarray(sensor_sigma, float),
            gyro,
            speed_scale=float(speed_scale),
            steering_gain=float(steering_gain),
            steering_offset_rad=float(steering_offset_rad),
            camera_delay_s=float(camera_delay_s),
        )

    @property
    def dtype(self) -> jnp.dtype:
        """The precision of its numbers."""
        return self.wheelbase_m.dtype


def sideslip_rad(steering_rad: Float[Array, ""]) -> Float[Array, ""]:
    """Sideslip beta, rad, the angle of the velocity in the vehicle frame (Eq. 4).

    beta = atan(tan(steering) / 2)
    """
    return jnp.arctan(jnp.tan(steering_rad) / 2)


def curvature_per_m(
    steering_rad: Float[Array, ""], wheelbase_m: Float[Array, ""]
) -> Float[Array, ""]:
    """Curvature of the path, 1/m: 1 / R_r = cos(beta) tan(steering) / l (Eq. 5).

    It is finite when driving straight; l is the wheelbase.
    """
    return jnp.cos(sideslip_rad(steering_rad)) * jnp.tan(steering_rad) / wheelbase_m


def velocity_world(
    speed_mps: Float[Array, ""],
    steering_rad: Float[Array, ""],
    psi_rad: Float[Array, ""],
    wheelbase_m: Float[Array, ""],
) -> Float[Array, " 3"]:
    """(v_x m/s, v_y m/s, psi_dot rad/s) in the world at heading psi (Eqs. 6 and 7).

    v_x = v cos(psi + beta),  v_y = v sin(psi + beta),  psi_dot = v / R_r
    """
    course_rad = psi_rad + sideslip_rad(steering_rad)
    return speed_mps * jnp.stack(
        [
            jnp.cos(course_rad),
            jnp.sin(course_rad),
            curvature_per_m(steering_rad, wheelbase_m),
        ]
    )


def advance_bicycle(
    pose: Float[Array, " 3"],
    speed_mps: Float[Array, ""],
    steering_rad: Float[Array, ""],
    dt_s: Float[Array, ""],
    wheelbase_m: Float[Array, ""],
) -> Float[Array, " 3"]:
    """(x_m, y_m, psi_rad) after dt at constant speed and steering, exactly along the arc.

    The chord of an arc that turns by a has the direction of its middle and the length
    s sin(a/2) / (a/2).
    """
    distance_m = speed_mps * dt_s
    half_turn = distance_m * curvature_per_m(steering_rad, wheelbase_m) / 2
    chord_m = distance_m * safe_sinc(half_turn)
    direction = pose[2] + sideslip_rad(steering_rad) + half_turn
    return pose + jnp.stack(
        [chord_m * jnp.cos(direction), chord_m * jnp.sin(direction), 2 * half_turn]
    )


# Errors of its odometry that a filter keeps, and their standard deviations where nobody says:
# wheels that are a per cent apart turn a base of 0.3 m by 0.03 rad a metre.
TWIST_ERRORS = ("speed_scale", "turn_gain", "turn_offset_radpm", "camera_delay_s")
DEFAULT_TWIST_SIGMA = np.asarray([0.03, 0.05, 0.03, 0.02])


class TwistBase(eqx.Module):
    """Parameters of one base, for the estimator, the controller and the simulated base."""

    forward_limit_mps: Float[Array, ""]  # |v_x| never exceeds it
    left_limit_mps: Float[Array, ""]  # |v_y|; 0: differential drive, tracks
    turn_limit_radps: Float[Array, ""]  # |omega|
    time_constant_s: Float[Array, ""]  # first-order lag from command to twist
    # Standard deviations of the errors above, such as `DEFAULT_TWIST_SIGMA`; None: the odometry is
    # exact but for white noise.
    sensor_sigma: Float[Array, " 4"] | None = None
    gyro: Gyro | None = None

    @staticmethod
    def create(
        forward_limit_mps: float,
        turn_limit_radps: float,
        time_constant_s: float,
        left_limit_mps: float = 0.0,
        sensor_sigma: Float[Array | np.ndarray, " 4"] | None = None,
        gyro: Gyro | None = None,
    ) -> "TwistBase":
        """A base from plain numbers."""
        return TwistBase(
            jnp.asarray(forward_limit_mps, float),
            jnp.asarray(left_limit_mps, float),
            jnp.asarray(turn_limit_radps, float),
            jnp.asarray(time_constant_s, float),
            None if sensor_sigma is None else jnp.asarray(sensor_sigma, float),
            gyro,
        )

    @property
    def dtype(self) -> jnp.dtype:
        """The precision of its numbers."""
        return self.time_constant_s.dtype

    @property
    def limits(self) -> Float[Array, " 3"]:
        """Largest v_x m/s, v_y m/s, omega rad/s, each in either direction."""
        return jnp.stack([self.forward_limit_mps, self.left_limit_mps, self.turn_limit_radps])


def advance_twist(
    pose: Float[Array, " 3"], twist: Float[Array, " 3"], dt_s: Float[Array, ""]
) -> Float[Array, " 3"]:
    """(x_m, y_m, psi_rad) after dt at a constant twist in the vehicle's axes: along an arc.

    Its chord is that of `advance_bicycle`.
    """
    half_turn = twist[2] * dt_s / 2
    chord = matvec(planar_rotation(pose[2] + half_turn), twist) * dt_s
    shorter = safe_sinc(half_turn)
    return pose + chord * jnp.stack([shorter, shorter, jnp.ones_like(shorter)])


ERRORS = 4  # k, and m about the vehicle's x, y and z
# Standard deviations of k and m where nobody says: the scale of other odometers, as in
# `DEFAULT_TWIST_SIGMA`, and a direction measured by hand or by a calibration of one degree.
DEFAULT_SCALE_SIGMA = 0.03
DEFAULT_TURN_SIGMA_RAD = float(np.deg2rad(1.0))


def default_odometry_sigma(
    scale: float = DEFAULT_SCALE_SIGMA, turn_rad: float = DEFAULT_TURN_SIGMA_RAD
) -> Float[np.ndarray, " 4"]:
    """Standard deviations of an odometry's scale k and of its turn m about each axis."""
    return np.asarray([scale, turn_rad, turn_rad, turn_rad])


class OdometryErrors(eqx.Module):
    """How far off an odometry may be, and where its body is."""

    sigma: Float[Array, " 4"]  # of k, and of m, rad
    lever_arm_m: Float[Array, " 3"]  # l

    @staticmethod
    def create(
        sigma: Float[np.ndarray, " 4"], lever_arm_m: Float[np.ndarray, " 3"]
    ) -> "OdometryErrors":
        """From plain numbers, in the process's precision."""
        return OdometryErrors(jnp.asarray(sigma, float), jnp.asarray(lever_arm_m, float))

    def corrected(
        self, twist: Float[Array, " 6"], errors: Float[Array, " 4"]
    ) -> Float[Array, " 6"]:
        """The vehicle's twist (m/s, rad/s), in its axes, where the odometry tells `twist`.

        Args:
            errors: (k, m).
        """
        arm_m = jnp.asarray(self.lever_arm_m, twist.dtype)
        R = rotation_matrix(jaxlie.SO3.exp(errors[1:]))
        w = matvec(R, twist[3:])
        at_body = matvec(R, twist[:3] + jnp.cross(twist[3:], arm_m)) * (1 + errors[0])
        return jnp.concatenate([at_body - jnp.cross(w, arm_m), w])
