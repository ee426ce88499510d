"""A base that moves by a twist in the plane: differential, tracks, mecanum, omni, swerve.

Its odometry reads the twist (v_x, v_y, omega) in the vehicle's axes, and its driver takes one. How
the wheels make it is the driver's affair: to the filter, tracks and a swerve drive are the same.

Source: Siegwart, Nourbakhsh, Scaramuzza (2011), section 3.2 (kinematics of wheeled bases).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnav.core.linalg.small_matrices import matvec
from jaxnav.core.models.geometry import planar_rotation, safe_sinc
from jaxnav.core.models.gyro import Gyro

# Errors of its odometry that a filter keeps, and their standard deviations where nobody says:
# wheels that are a per cent apart turn a base of 0.3 m by 0.03 rad a metre.
TWIST_ERRORS = ("speed_scale", "turn_gain", "turn_offset_radpm", "camera_delay_s")
TWIST_AS_TOLD = np.asarray([0.03, 0.05, 0.03, 0.02])


class TwistBase(eqx.Module):
    """Parameters of one base, for the estimator, the controller and the simulated base."""

    forward_limit_mps: Float[Array, ""]  # |v_x| never exceeds it
    left_limit_mps: Float[Array, ""]  # |v_y|; 0: differential drive, tracks
    turn_limit_radps: Float[Array, ""]  # |omega|
    time_constant_s: Float[Array, ""]  # first-order lag from command to twist
    # Standard deviations of the errors above, as in `TWIST_AS_TOLD`; None: the odometry is exact
    # but for white noise.
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
        """Of its numbers."""
        return self.time_constant_s.dtype

    @property
    def limits(self) -> Float[Array, " 3"]:
        """Largest v_x m/s, v_y m/s, omega rad/s, each in either direction."""
        return jnp.stack([self.forward_limit_mps, self.left_limit_mps, self.turn_limit_radps])


def advance(
    pose: Float[Array, " 3"], twist: Float[Array, " 3"], dt_s: Float[Array, ""]
) -> Float[Array, " 3"]:
    """(x_m, y_m, psi_rad) after dt at a constant twist in the vehicle's axes: along an arc.

    The chord of an arc that turns by a has the direction of its middle and the length
    s sin(a/2) / (a/2).
    """
    half_turn = twist[2] * dt_s / 2
    chord = matvec(planar_rotation(pose[2] + half_turn), twist) * dt_s
    shorter = safe_sinc(half_turn)
    return pose + chord * jnp.stack([shorter, shorter, jnp.ones_like(shorter)])
