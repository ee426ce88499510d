"""What odometry of other software tells wrong alike in every step: its scale and its direction.

Between two instants the body of the odometry, at l in the vehicle's frame, moves by a step; in the
vehicle's axes its twist is (v, w). A monocular scale, a wrong baseline or wheel radius makes the
way too short by a share k, and where the body is turned on the vehicle by m beside what is told,
the step has another direction:

    w' = Exp(m) w,    v' = (1 + k) Exp(m) v    at l,

while the vehicle's own origin has the velocity v - w x l. Both are exact for steps of any length: a
twist turns and scales with its step.

Source: Furgale, Rehder, Siegwart (2013), "Unified temporal and spatial calibration for multi-sensor
systems" (the direction); Weiss, Siegwart (2011), "Real-time metric state estimation for modular
vision-inertial systems" (the scale as a state).
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from jaxnav.core.linalg.small_matrices import matvec
from jaxnav.core.models.geometry import rotation_matrix

ERRORS = 4  # k, and m about the vehicle's x, y and z
# Standard deviations of k and m where nobody says: the scale of other odometers (`TWIST_AS_TOLD`),
# and a direction that was measured by hand or by a calibration of one degree.
SCALE_AS_TOLD = 0.03
TURN_AS_TOLD_RAD = float(np.deg2rad(1.0))


def sigma_as_told(
    scale: float = SCALE_AS_TOLD, turn_rad: float = TURN_AS_TOLD_RAD
) -> Float[np.ndarray, " 4"]:
    """(k, m) of plain numbers."""
    return np.asarray([scale, turn_rad, turn_rad, turn_rad])


class OdometryErrors(eqx.Module):
    """How far off an odometry may be, and where its body is."""

    sigma: Float[Array, " 4"]  # of k, and of m, rad
    lever_arm_m: Float[Array, " 3"]  # l

    @staticmethod
    def create(
        sigma: Float[np.ndarray, " 4"], lever_arm_m: Float[np.ndarray, " 3"]
    ) -> "OdometryErrors":
        """Of plain numbers, in the process's precision."""
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
