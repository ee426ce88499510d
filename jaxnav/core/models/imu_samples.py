"""Samples of an IMU with their stamps, cut into the intervals between observations.

Pure NumPy, for the boundary where recordings and simulations become observations.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnav.core.models.preintegration import ImuNoise, Preintegrated, Readings, preintegrate

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


@jax.jit
def _preintegrate_all(readings: Readings, noise: ImuNoise) -> Preintegrated:
    return jax.vmap(lambda rows: preintegrate(rows, noise))(readings)


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
