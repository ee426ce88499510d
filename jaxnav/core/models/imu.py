"""Inertial sensors: what they get wrong, and their readings between two observations as one.

Two classes stand for the sensors of a price, by the figures of one of them:

* `consumer`, some euros: Bosch Sensortec BMI088 (BST-BMI088-DS001). Noise densities, offsets,
  range and tolerance of the sensitivity are the typical ones of its data sheet.
* `tactical`, some hundreds: Analog Devices ADIS16470. Noise densities and range of the gyro are
  those of its data sheet; its offset is the 1-sigma initial error of that family of sensors.

What no data sheet tells is an order of magnitude of the class, no measurement: the offset of the
tactical accelerometer, the walks, what is left of the delay. A walk is above what an Allan plot
shows, as filters need it: EuRoC's rig, with an ADIS16448, has 1.9e-5 rad/s/sqrt(s) and 3e-3
m/s^2/sqrt(s) (Burri et al., 2016), the consumer's; the tactical ones are a fifth of that. The
delay is that of a bus that a host polls, and of a sensor that stamps its own samples.

A gyroscope reads z = (1 + e) w(t - delay) + b + white noise, where b' is white noise.

Between two observations the gyroscope and the accelerometer tell how the body turned and moved,
in the axes that it had at the beginning, whatever its pose, velocity and gravity were there:

    R_end = R_begin dR
    v_end = v_begin + g T + R_begin dv
    p_end = p_begin + v_begin T + g T^2 / 2 + R_begin dp

over a duration T, with dR, dv, dp from the readings alone.

Source: IEEE Std 952 (1997), annex C (angle random walk N and rate random walk K); Forster, Carlone,
Dellaert, Scaramuzza (2017), "On-manifold preintegration for real-time visual-inertial odometry",
Eqs. 31-44 and appendix A; the biases' random walk as in Carlone's CombinedImuFactor of GTSAM.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, DTypeLike, Float, Int

from jaxnav.core.linalg.small_matrices import matvec, product, sandwich
from jaxnav.core.models.geometry import rotation_matrix, safe_norm, safe_sinc, skew

_Sums = tuple[Array, Array, Array, Array, Array]

_G_MPS2 = 9.80665  # standard gravity, in which data sheets count


class Gyro(eqx.Module):
    """Errors of a gyroscope about one axis, for a filter and for a simulation."""

    noise_density: Float[Array, ""] | float  # N: rad/s/sqrt(Hz)
    bias_sigma_radps: Float[Array, ""] | float  # of the bias before anything has measured it
    bias_walk: Float[Array, ""] | float  # K: random walk of the bias, rad/s/sqrt(s)
    saturation_radps: Float[Array, ""] | float  # a reading at the limit or beyond it is none
    scale_sigma: Float[Array, ""] | float = 0.0  # of the error e of its scale
    delay_s: Float[Array, ""] | float = 0.0  # how much older than its stamp a reading is
    delay_sigma_s: Float[Array, ""] | float = 0.0  # of what is left of the delay


class ImuNoise(eqx.Module):
    """Errors of an IMU, alike on its three axes. The names of densities and walks are Kalibr's."""

    gyroscope_noise_density: float  # rad/s/sqrt(Hz)
    accelerometer_noise_density: float  # m/s^2/sqrt(Hz)
    gyroscope_random_walk: float  # of its bias, rad/s^2/sqrt(Hz)
    accelerometer_random_walk: float  # m/s^3/sqrt(Hz)
    gyroscope_bias_sigma: float  # before anything measures it, rad/s
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


CONSUMER = ImuNoise(
    gyroscope_noise_density=math.radians(0.014),
    accelerometer_noise_density=175.0 * 1e-6 * _G_MPS2,  # 160 along x and y, 190 along z
    gyroscope_random_walk=2e-5,
    accelerometer_random_walk=3e-3,
    gyroscope_bias_sigma=math.radians(1.0),
    accelerometer_bias_sigma=20.0 * 1e-3 * _G_MPS2,
)
TACTICAL = ImuNoise(
    gyroscope_noise_density=math.radians(0.008),
    accelerometer_noise_density=100.0 * 1e-6 * _G_MPS2,
    gyroscope_random_walk=4e-6,
    accelerometer_random_walk=6e-4,
    gyroscope_bias_sigma=math.radians(0.2),
    accelerometer_bias_sigma=10.0 * 1e-3 * _G_MPS2,
)
PRESETS = {"consumer": CONSUMER, "tactical": TACTICAL}


def _gyro(noise: ImuNoise, scale_sigma: float, delay_sigma_s: float) -> Gyro:
    """The gyroscope of an IMU of these classes, which saturates at 2 000 deg/s, for one axis."""
    return Gyro(
        noise.gyroscope_noise_density,
        noise.gyroscope_bias_sigma,
        noise.gyroscope_random_walk,
        math.radians(2000.0),
        scale_sigma,
        delay_sigma_s=delay_sigma_s,
    )


GYROS = {"consumer": _gyro(CONSUMER, 0.01, 5e-3), "tactical": _gyro(TACTICAL, 0.003, 1e-3)}


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
        """The measurement of an interval without a reading."""
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
        numbers = [leaf for leaf in jax.tree.leaves(self) if leaf.dtype != bool]
        good = jnp.all(jnp.isfinite(jnp.concatenate([jnp.ravel(leaf) for leaf in numbers])))
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
    """Integrate readings (N,) into one measurement.

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


_preintegrate_all = jax.jit(jax.vmap(preintegrate, in_axes=(0, None)))


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


_GAP_PERIODS = 3.5  # a longer hole between samples is bridged: nobody knows what happened in it
_MAX_BRIDGED_S = 0.25  # of an interval; beyond it the interval has no reading
_STILL_S = 0.5  # a body at rest is one whose readings scatter as their noise does for so long
_STILL_SCATTER = 2.5  # times the noise: ticks, fans and quantisation
_STILL_RATE_SIGMAS = 3.0  # of the bias; a steady turn scatters as little as no turn
_CHUNK = 64  # intervals that are preintegrated together, with as many rows as the longest has


@dataclass(frozen=True)
class ImuSamples:
    """N samples of an IMU that is fixed to a vehicle.

    Attributes:
        stamps_ns: (N,), increasing, on the cameras' clock but for `delay_s`.
        gyro_radps: (N, 3) in the IMU's own axes.
        accel_mps2: (N, 3) specific force, +g upwards at rest.
        T_vehicle_imu: (4, 4), where the IMU is on the vehicle.
        noise: of its readings.
        delay_s: a sample was taken so long before its stamp.
        max_gyro_radps, max_accel_mps2: its range; a reading there is saturated.
        level: the z of the map in which it moves points up.
    """

    stamps_ns: Int[np.ndarray, " N"]
    gyro_radps: Float[np.ndarray, "N 3"]
    accel_mps2: Float[np.ndarray, "N 3"]
    T_vehicle_imu: Float[np.ndarray, "4 4"]
    noise: ImuNoise
    delay_s: float = 0.0
    max_gyro_radps: float = np.inf
    max_accel_mps2: float = np.inf
    level: bool = True

    @property
    def lever_arm_m(self) -> Float[np.ndarray, " 3"]:
        """The IMU's place in the vehicle's axes."""
        return self.T_vehicle_imu[:3, 3]

    @property
    def good(self) -> Bool[np.ndarray, " N"]:
        """Samples that are finite and inside the range of the sensor."""
        gyro = np.abs(self.gyro_radps) < 0.999 * self.max_gyro_radps
        accel = np.abs(self.accel_mps2) < 0.999 * self.max_accel_mps2
        finite = np.isfinite(self.gyro_radps) & np.isfinite(self.accel_mps2)
        return np.all(finite & gyro & accel, axis=1)

    def between(self, stamps_ns: Int[np.ndarray, " F"]) -> Preintegrated:
        """The measurements (F,) since the stamp before each; none for the first.

        None, too, where more than 0.25 s would have to be bridged: the samples do not reach so far,
        or lack, or were saturated.
        """
        chunks = []
        for readings in self.readings(stamps_ns):
            chunks.append(jax.device_get(_preintegrate_all(readings, self.noise)))
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(stamps_ns)], *chunks)

    def readings(self, stamps_ns: Int[np.ndarray, " F"]) -> Iterator[Readings]:
        """The readings before each stamp, `_CHUNK` intervals at a time, in the vehicle's axes."""
        good = self.good
        # Seconds since the first stamp: in float64, as ns are not.
        samples_s = (self.stamps_ns[good] - stamps_ns[0]) / 1e9 - self.delay_s
        R = self.T_vehicle_imu[:3, :3]
        values = np.hstack([self.gyro_radps[good] @ R.T, self.accel_mps2[good] @ R.T])
        bounds_s = (stamps_ns - stamps_ns[0]) / 1e9
        period_s = float(np.median(np.diff(self.stamps_ns))) / 1e9 if len(good) > 1 else np.inf
        still = self._still(samples_s, values, bounds_s, period_s)
        # Between which good samples there is a bad one, or a hole; behind the last one, any.
        hole = np.diff(np.flatnonzero(good)) > 1
        hole |= np.diff(samples_s) > _GAP_PERIODS * period_s
        rows = [
            _cut(samples_s, values, *bounds, hole, period_s)
            for bounds in itertools.pairwise(bounds_s)
        ]
        rows = [np.zeros((0, 8)), *rows]
        for begin in range(0, len(rows), _CHUNK):
            chunk = rows[begin : begin + _CHUNK]
            longest = max(max(map(len, chunk)), 1)
            count = 1 << (longest - 1).bit_length()  # few shapes to compile
            padded = np.zeros((_CHUNK, count, 8))
            for row, filled in zip(chunk, padded, strict=False):
                filled[: len(row)] = row
            at_rest = np.zeros(_CHUNK, bool)
            at_rest[: len(chunk)] = still[begin : begin + _CHUNK]
            yield Readings(
                jnp.asarray(padded[..., :3]),
                jnp.asarray(padded[..., 3:6]),
                jnp.asarray(padded[..., 6]),
                jnp.asarray(padded[..., 7] > 0),
                jnp.asarray(at_rest),
            )

    def _still(
        self, samples_s: np.ndarray, values: np.ndarray, bounds_s: np.ndarray, period_s: float
    ) -> Bool[np.ndarray, " F"]:
        """Whether the body was at rest for `_STILL_S` before each bound.

        Its readings scatter by no more than their noise, and turn by no more than the gyroscope's
        bias may be. A body that glides at a constant velocity can't be told from one at rest.
        """
        still = np.zeros(len(bounds_s), bool)
        if not len(samples_s):
            return still
        density = np.sqrt(np.asarray(self.noise.densities())[:6] / period_s)
        begin = np.searchsorted(samples_s, bounds_s - _STILL_S)
        end = np.searchsorted(samples_s, bounds_s, side="right")
        whole = (end - begin) * period_s > 0.9 * _STILL_S
        sums = np.cumsum(np.vstack([np.zeros(6), values - values[0]]), axis=0)
        squares = np.cumsum(np.vstack([np.zeros(6), (values - values[0]) ** 2]), axis=0)
        count = np.maximum(end - begin, 1)[:, None]
        mean = (sums[end] - sums[begin]) / count
        scatter = np.sqrt(np.maximum((squares[end] - squares[begin]) / count - mean**2, 0))
        rate = np.abs(mean + values[0])[:, :3]
        quiet = np.all(scatter < _STILL_SCATTER * density, axis=1)
        slow = np.all(rate < _STILL_RATE_SIGMAS * self.noise.gyroscope_bias_sigma, axis=1)
        return whole & quiet & slow


def _cut(
    samples_s: Float[np.ndarray, " N"],
    values: Float[np.ndarray, "N 6"],
    begin_s: float,
    end_s: float,
    hole: Bool[np.ndarray, " gaps"],
    period_s: float,
) -> Float[np.ndarray, "n 8"]:
    """Rows (gyro, accel, dt, bridged) of one interval; none where too much would be bridged.

    A row reaches from one sample to the next, with the mean of both; at the ends of the interval
    samples are interpolated. The acceleration is that in the middle of the row, turned back by half
    the row's turn, so that a steady turn is integrated to second order.
    """
    first, last = np.searchsorted(samples_s, [begin_s, end_s], side="right")
    knots = np.unique(np.concatenate([[begin_s], samples_s[first:last], [end_s]]))
    if not len(samples_s) or len(knots) < 2:
        return np.zeros((0, 8))
    at = np.column_stack([np.interp(knots, samples_s, column) for column in values.T])
    middle, dt = (at[1:] + at[:-1]) / 2, np.diff(knots)
    before = np.searchsorted(samples_s, knots[:-1], side="right") - 1
    after_last = before + 1 >= len(samples_s)
    # The last sample holds for a period.
    bridged = np.where(after_last, knots[1:] > samples_s[-1] + 1.5 * period_s, before < 0)
    bridged |= np.append(hole, False)[np.clip(before, 0, None)] & (before >= 0)
    if np.sum(dt[bridged]) > _MAX_BRIDGED_S:
        return np.zeros((0, 8))
    back = _rotations(middle[:, :3] * dt[:, None] / 2)
    accel = np.einsum("nij,nj->ni", back, middle[:, 3:])
    return np.column_stack([middle[:, :3], accel, dt, bridged])


def _rotations(turns: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Exp of rotation vectors that are no half turns (Rodrigues)."""
    angle = np.linalg.norm(turns, axis=1)[:, None, None]
    x, y, z = turns.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    sine, half = np.sinc(angle / np.pi), np.sinc(angle / 2 / np.pi)
    return np.eye(3) + sine * cross + half**2 / 2 * cross @ cross
