"""Preintegration: the readings of an inertial measurement unit (IMU) as one measurement.

Between two observations the gyroscope and the accelerometer tell how the body turned and moved,
in the axes that it had at the beginning, whatever its pose, velocity and gravity were there:

    R_end = R_begin dR
    v_end = v_begin + g T + R_begin dv
    p_end = p_begin + v_begin T + g T^2 / 2 + R_begin dp

over a duration T, with dR, dv, dp from the readings alone.

Source: Forster, Carlone, Dellaert, Scaramuzza (2017), "On-manifold preintegration for real-time
visual-inertial odometry", Eqs. 31-44 and appendix A; the biases' random walk as in Carlone's
CombinedImuFactor of GTSAM.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, DTypeLike, Float

from jaxnav.core.linalg.small_matrices import matvec, product, sandwich
from jaxnav.core.models.geometry import rotation_matrix, safe_norm, safe_sinc, skew
from jaxnav.core.models.imu_classes import IMU_CLASSES

_Sums = tuple[Array, Array, Array, Array, Array]


class ImuNoise(eqx.Module):
    """Errors of an IMU, alike on its three axes. The names of densities and walks are Kalibr's."""

    gyroscope_noise_density: float  # rad/s/sqrt(Hz)
    accelerometer_noise_density: float  # m/s^2/sqrt(Hz)
    gyroscope_random_walk: float  # of its bias, rad/s^2/sqrt(Hz)
    accelerometer_random_walk: float  # m/s^3/sqrt(Hz)
    gyroscope_bias_sigma: float  # before anything tells it, rad/s
    accelerometer_bias_sigma: float  # m/s^2
    # How far off a reading may be that was held or interpolated for want of a better one.
    bridged_gyroscope_sigma: float = 2.0  # rad/s
    bridged_accelerometer_sigma: float = 5.0  # m/s^2

    def densities(self) -> Float[Array, " 12"]:
        """Power spectral densities: gyroscope, accelerometer, and the walks of their biases."""
        sigmas = (
            self.gyroscope_noise_density,
            self.accelerometer_noise_density,
            self.gyroscope_random_walk,
            self.accelerometer_random_walk,
        )
        return jnp.repeat(jnp.stack([jnp.asarray(sigma, float) for sigma in sigmas]) ** 2, 3)

    def bridged_variances(self) -> Float[Array, " 12"]:
        """Variances of what a bridged reading is off by, in the order of `densities`."""
        sigmas = self.bridged_gyroscope_sigma, self.bridged_accelerometer_sigma, 0.0, 0.0
        return jnp.repeat(jnp.stack([jnp.asarray(sigma, float) for sigma in sigmas]) ** 2, 3)


PRESETS = {
    name: ImuNoise(
        gyroscope_noise_density=figures.gyro_noise,
        accelerometer_noise_density=figures.accel_noise,
        gyroscope_random_walk=figures.gyro_walk,
        accelerometer_random_walk=figures.accel_walk,
        gyroscope_bias_sigma=figures.gyro_offset_radps,
        accelerometer_bias_sigma=figures.accel_offset_mps2,
    )
    for name, figures in IMU_CLASSES.items()
}
CONSUMER, TACTICAL = PRESETS["consumer"], PRESETS["tactical"]


class Readings(eqx.Module):
    """N readings of an IMU in the axes of the vehicle, each of which holds for its `dt_s`.

    A row with `dt_s` 0 is padding. The acceleration is the specific force, +g upwards at rest, in
    the axes that the body has at the beginning of the row.
    """

    gyro_radps: Float[Array, "*F N 3"]
    accel_mps2: Float[Array, "*F N 3"]
    dt_s: Float[Array, "*F N"]
    bridged: Bool[Array, "*F N"]  # no good sample: held or interpolated over a hole
    still: Bool[
        Array, "*F"
    ]  # the readings up to the end of the last row are those of a body at rest


class Preintegrated(eqx.Module):
    """What an IMU tells of the motion in an interval, at the biases that it was preintegrated with.

    The 15 errors are those of (dR, dv, dp) and of the biases at the end, gyroscope's first: dR by a
    rotation on the right, dR Exp(phi), the others by addition. A duration of 0, or a NaN anywhere,
    is no reading in this interval.
    """

    R_begin_end: jaxlie.SO3
    velocity_mps: Float[Array, "*F 3"]  # dv, in the axes of the beginning
    position_m: Float[Array, "*F 3"]  # dp
    covariance: Float[Array, "*F 15 15"]  # (9, 9) of the increments, then what the walks add
    by_bias: Float[Array, "*F 9 6"]  # derivative of the increments by the biases
    gyro_bias_radps: Float[Array, "*F 3"]  # with which it was preintegrated
    accel_bias_mps2: Float[Array, "*F 3"]
    duration_s: Float[Array, "*F"]
    still: Bool[Array, "*F"]

    @staticmethod
    def none(dtype: DTypeLike = float) -> "Preintegrated":
        """No reading."""
        zero = jnp.zeros(3, dtype)
        return Preintegrated(
            jaxlie.SO3(jnp.asarray([1, 0, 0, 0], dtype)),
            zero,
            zero,
            jnp.zeros((15, 15), dtype),
            jnp.zeros((9, 6), dtype),
            zero,
            zero,
            jnp.zeros((), dtype),
            jnp.asarray(False),
        )

    def usable(self, dtype: DTypeLike = float) -> "Preintegrated":
        """The same, or `none` where a number is not finite or the duration is not positive."""
        told = [leaf for leaf in jax.tree.leaves(self) if leaf.dtype != bool]
        good = jnp.all(jnp.isfinite(jnp.concatenate([jnp.ravel(leaf) for leaf in told])))
        good = good & (self.duration_s > 0)

        def kept(leaf: Array, other: Array) -> Array:
            return jnp.where(good, leaf.astype(other.dtype), other)

        result: Preintegrated = jax.tree.map(kept, self, Preintegrated.none(dtype))
        return result

    def at_biases(
        self, gyro_bias_radps: Float[Array, " 3"], accel_bias_mps2: Float[Array, " 3"]
    ) -> tuple[jaxlie.SO3, Float[Array, " 3"], Float[Array, " 3"]]:
        """dR, dv, dp at other biases, to first order (Eq. 44)."""
        change = jnp.concatenate(
            [gyro_bias_radps - self.gyro_bias_radps, accel_bias_mps2 - self.accel_bias_mps2]
        )
        moved = matvec(self.by_bias, change)
        turned = self.R_begin_end @ jaxlie.SO3.exp(moved[:3])
        return turned, self.velocity_mps + moved[3:6], self.position_m + moved[6:]


def preintegrate(
    readings: Readings,
    noise: ImuNoise,
    gyro_bias_radps: Float[Array, " 3"] | None = None,
    accel_bias_mps2: Float[Array, " 3"] | None = None,
) -> Preintegrated:
    """The measurement that readings (N,) are together.

        dR' = dR Exp(w dt),  dv' = dv + dR a dt,  dp' = dp + dv dt + dR a dt^2 / 2
        P' = A P A' + Q

    with the readings w, a less their biases, and A the derivative of a step by the 15 errors. The
    product of all A holds the derivative by the biases. Readings that were bridged may be off
    alike, so their variance grows with the square of the time that they bridge.

    Source: Forster et al. (2017), Eqs. 35-38 and A.7-A.9.
    """
    dtype = readings.dt_s.dtype
    zero = jnp.zeros(3, dtype)
    gyro_bias = zero if gyro_bias_radps is None else gyro_bias_radps
    accel_bias = zero if accel_bias_mps2 is None else accel_bias_mps2
    density = noise.densities().astype(dtype)
    bridged_s = jnp.sum(jnp.where(readings.bridged, readings.dt_s, 0))
    per_bridged = noise.bridged_variances().astype(dtype) * bridged_s

    def step(carry: _Sums, row: tuple[Array, Array, Array, Array]) -> tuple[_Sums, None]:
        wxyz, v, p, P, chain = carry
        gyro, accel, dt, bridged = row
        dR = jaxlie.SO3(wxyz)
        turn, a = (gyro - gyro_bias) * dt, accel - accel_bias
        R = rotation_matrix(dR)
        A, G = _step_derivatives(R, turn, a, dt)
        spread = density + jnp.where(bridged, per_bridged, 0)
        Q = product(G * spread[None], G.T) * jnp.where(dt > 0, 1 / jnp.where(dt > 0, dt, 1), 0)
        moved = matvec(R, a)
        p = p + v * dt + moved * dt**2 / 2
        v = v + moved * dt
        wxyz = (dR @ jaxlie.SO3.exp(turn)).normalize().wxyz
        return (wxyz, v, p, sandwich(A, P) + Q, product(A, chain)), None

    identity = jnp.asarray([1, 0, 0, 0], dtype)
    eye = jnp.eye(15, dtype=dtype)
    start = identity, zero, zero, jnp.zeros_like(eye), eye
    rows = readings.gyro_radps, readings.accel_mps2, readings.dt_s, readings.bridged
    (wxyz, v, p, P, chain), _ = jax.lax.scan(step, start, rows)
    return Preintegrated(
        jaxlie.SO3(wxyz),
        v,
        p,
        (P + P.T) / 2,
        chain[:9, 9:],
        gyro_bias,
        accel_bias,
        jnp.sum(readings.dt_s),
        readings.still,
    )


def right_jacobian(turn: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """J in Exp(turn + d) = Exp(turn) Exp(J d) for small d (Forster et al., Eq. 8)."""
    angle, cross = safe_norm(turn), skew(turn)
    small = angle < 0.5
    squared = jnp.where(small, angle, 0) ** 2
    series = (1 - squared / 20 * (1 - squared / 42 * (1 - squared / 72))) / 6
    large = jnp.where(small, 1, angle)
    of_square = jnp.where(small, series, (large - jnp.sin(large)) / large**3)
    eye = jnp.eye(3, dtype=turn.dtype)
    return eye - safe_sinc(angle / 2) ** 2 / 2 * cross + of_square * product(cross, cross)


def _step_derivatives(
    R: Float[Array, "3 3"], turn: Float[Array, " 3"], a: Float[Array, " 3"], dt: Float[Array, ""]
) -> tuple[Float[Array, "15 15"], Float[Array, "15 12"]]:
    """A by the errors of (dR, dv, dp, biases), G by the noises of the readings, integrated over dt.

    The noises are those of gyroscope, accelerometer, and the walks of both biases.
    """
    eye, zero = jnp.eye(3, dtype=R.dtype), jnp.zeros((3, 3), R.dtype)
    J = right_jacobian(turn) * dt
    back = rotation_matrix(jaxlie.SO3.exp(-turn))
    lean = product(R, skew(a)) * dt  # of dv, by a turn
    A = jnp.block(
        [
            [back, zero, zero, -J, zero],
            [-lean, eye, zero, zero, -R * dt],
            [-lean * dt / 2, eye * dt, eye, zero, -R * dt**2 / 2],
            [zero, zero, zero, eye, zero],
            [zero, zero, zero, zero, eye],
        ]
    )
    G = jnp.block(
        [
            [J, zero, zero, zero],
            [zero, R * dt, zero, zero],
            [zero, R * dt**2 / 2, zero, zero],
            [zero, zero, eye * dt, zero],
            [zero, zero, zero, eye * dt],
        ]
    )
    return A, G
