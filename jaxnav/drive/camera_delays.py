"""Estimate how late each camera's images are against their stamps, from a few seconds of driving.

    delays = CameraDelays(rig, markers, vehicle)
    delays.add_outcome(outcome)          # every outcome of a pilot: some microseconds
    while delays.due:                    # in a thread that may wait: tens of milliseconds
        delays.solve()
    delays.delays                        # one `Delay` per camera

The odometer gives the car's motion over a stretch of `STRETCH_S`; the corners that a camera sees
on it fit the pose that the car had one delay before their stamps. Beside the delay these are
unknown: the start pose of the stretch, the errors of the odometer's speed, steering gain and zero,
and the camera's rotation, each with a prior wide enough for a car that was never calibrated. So
slipping wheels and misaligned cameras don't pass for a delay; an image that moves later than the
wheels does. While speed and steering are constant the data tell nothing, and sigma says so.
`jaxnav calibrate odometry` finds one delay for all cameras ten times as exactly, from a drive of a
minute.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnav.core.models.geometry import T_world_vehicle_from_planar, transform_points
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import Vehicle, advance_bicycle
from jaxnav.core.pose.observation import MODEL_SIGMA_PX
from jaxnav.drive.history import Sighting
from jaxnav.drive.pilot import Outcome
from jaxnav.files.executables import kept

STRETCH_S = 2.0  # longer ones tell more, but rely on the odometer for longer
# An error of stamps that a long exposure or a driver's jitter causes, and that does the filter no
# harm: the scenario `blur`.
HARMLESS_S = 0.02
SURE_SIGMAS = 3.0
KNOWN_S = 0.008  # the largest sigma of a delay that counts as known

_READINGS, _VIEWS = 160, 96  # of a stretch, at most: 70 Hz for 2.3 s; more are thinned out
_LEAST_VIEWS = 12
_LEAST_MPS = 0.05  # a car that stands tells nothing
_ROOM_S = 0.25  # of readings on either side of a stretch: as long as a delay may be
_STRETCH_NS, _ROOM_NS = int(STRETCH_S * 1e9), int(_ROOM_S * 1e9)
_LIMIT_S = 0.2
_TELLS_S = 0.05  # a stretch whose sigma is above this is left out
_WAITING = 8  # stretches that may wait to be solved
_EAGER = 20  # stretches of cameras, after which one every 10 s is enough
_LATER_NS = 10_000_000_000
_LEAST_SIGMA_S = 0.001
# A view counts in full up to the 99.9th percentile of chi-square with 8 degrees of freedom.
_FULL_WEIGHT = 26.1
_STEPS = 15
_DONE = 5e-3  # share of the prior sigma: after a smaller step the next one would change nothing
# Sigmas of x, y (m), psi (rad) at the start, the camera's rotation about its axes (rad), the
# odometer's speed and steering gain (shares), the steering's zero (rad), and the delay (s).
_PRIOR = np.array([1.0, 1.0, 0.5, 0.03, 0.03, 0.03, 0.15, 0.15, 0.03, 0.3])
_DELAY = len(_PRIOR) - 1
# Readings scatter, and the position error that they cause stays in the views that follow. It is
# added to the corners' own error, and inflates the sigma of a stretch, so that estimates scatter as
# their sigmas say (`benchmarks/bench_delays.py`).
_SCATTER_PX, _INFLATION = 0.6, 1.5


class Delay(NamedTuple):
    """The delay of one camera, s: how much earlier than their corrected stamps images were taken.

    Attributes:
        delay_s: NaN where nothing is known.
        sigma_s: inf where nothing is known.
    """

    delay_s: float
    sigma_s: float

    @property
    def known(self) -> bool:
        """Whether the data were enough for a small sigma."""
        return self.sigma_s <= KNOWN_S

    @property
    def late(self) -> bool:
        """Whether the delay, positive or negative, is surely larger than a harmless one."""
        return self.known and abs(self.delay_s) - SURE_SIGMAS * self.sigma_s > HARMLESS_S


class _Stretch(NamedTuple):
    """One camera's views and the odometry of a stretch; times in s since its beginning."""

    camera: Any  # int32
    edges_s: Any  # (K,), time from which each reading holds
    speed_mps: Any  # (K,)
    steering_rad: Any  # (K,)
    times_s: Any  # (V,)
    marker: Any  # (V,)
    corners_px: Any  # (V, 4, 2)
    sigma_px: Any  # (V, 4)
    used: Any  # (V,)


class _View(NamedTuple):
    """One marker in one camera's frame."""

    stamp_ns: int
    camera: int
    marker: int
    corners_px: Float[np.ndarray, "4 2"]
    sigma_px: Float[np.ndarray, " 4"]


class CameraDelays:
    """The delays of a rig on one drive. One thread calls `add_outcome`, one may call `solve`."""

    def __init__(self, rig: CameraRig, markers: MarkerMap, vehicle: Vehicle):
        """Take the drive's rig, map and vehicle. Delays come beside the vehicle's corrections."""
        self._world = rig, markers.without_names(), vehicle.wheelbase_m
        self._dtype = np.asarray(vehicle.wheelbase_m).dtype
        # Bounded memory: 20 s of readings at 50 Hz, 270 s of one marker at 30 Hz.
        self._readings: deque[tuple[int, float, float]] = deque(maxlen=1024)
        self._views: deque[_View] = deque(maxlen=8192)
        self._open: deque[tuple[int, np.ndarray]] = deque(maxlen=_WAITING)  # begin, pose there
        self._next_ns = 0
        # For every camera: sums of information, information * delay, information * delay^2.
        self._sums = np.zeros((len(rig), 3))
        self._counts = np.zeros(len(rig), int)

    def add_outcome(self, outcome: Outcome) -> None:
        """Keep the data of an outcome and its estimated pose."""
        data = outcome.data
        if data is not None and data.odometry is not None:
            self.add_reading(outcome.stamp_ns, *data.odometry)
        if isinstance(data, Sighting):
            self.add_corners(outcome.stamp_ns, data)
        output = outcome.output
        if outcome.now_ns >= self._next_ns and bool(output.decided):
            self.add_pose(outcome.now_ns, np.asarray(output.pose, float))

    def add_reading(self, stamp_ns: int, speed_mps: float, steering_rad: float) -> None:
        """Keep a corrected reading; one that is not newer than the last is left out."""
        if not self._readings or stamp_ns > self._readings[-1][0]:
            self._readings.append((stamp_ns, speed_mps, steering_rad))

    def add_corners(self, stamp_ns: int, data: Sighting) -> None:
        """Keep corners and their corrected stamp."""
        corners_px, sigma_px = data.corners_px[data.visible], data.sigma_px[data.visible]
        lanes = np.argwhere(data.visible).tolist()
        for (camera, marker), *seen in zip(lanes, corners_px, sigma_px, strict=True):
            self._views.append(_View(stamp_ns, camera, marker, *seen))

    def add_pose(self, now_ns: int, pose: Float[np.ndarray, " 3"]) -> None:
        """Begin a stretch at the car's approximate pose, if it is time for one."""
        if now_ns >= self._next_ns:
            self._open.append((now_ns, pose))
            eager = self._counts.sum() < _EAGER
            self._next_ns = now_ns + (_STRETCH_NS if eager else _LATER_NS)

    @property
    def due(self) -> bool:
        """Whether a stretch is over and not yet solved."""
        if not (self._open and self._readings):
            return False
        return self._readings[-1][0] > self._open[0][0] + _STRETCH_NS + _ROOM_NS

    def warm_up(self) -> None:
        """Compile the program, or load it."""
        one = _View(10**9, 0, 0, np.zeros((4, 2)), np.ones(4))
        readings = [(k * 10**8, 0.1, 0.0) for k in range(30)]
        self._equations(_stretch(0, 0, readings, [one], self._dtype), 0 * _PRIOR)

    def solve(self) -> None:
        """Solve the oldest finished stretch, camera by camera."""
        begin_ns, pose = self._open.popleft()
        end_ns = begin_ns + _STRETCH_NS
        # Copied at once: the driving thread may add to them meanwhile.
        readings = [r for r in self._readings.copy() if r[0] - begin_ns >= -_ROOM_NS]
        readings = [r for r in readings if r[0] <= end_ns + _ROOM_NS]
        views = [view for view in self._views.copy() if begin_ns <= view.stamp_ns < end_ns]
        moved = max((abs(speed_mps) for _, speed_mps, _ in readings), default=0.0) > _LEAST_MPS
        if not moved or len(readings) < 3:
            return
        for camera in range(len(self._counts)):
            among = [view for view in views if view.camera == camera]
            if len({view.stamp_ns for view in among}) < _LEAST_VIEWS:
                continue
            stretch = _stretch(camera, begin_ns, readings, among, self._dtype)
            delay_s, information = self._solved(stretch, pose)
            if information > 0:
                self._sums[camera] += information * np.array([1.0, delay_s, delay_s**2])
                self._counts[camera] += 1

    @property
    def delays(self) -> list[Delay]:
        """The delay of each camera so far."""
        return list(map(_of_stretches, self._sums, self._counts))

    @property
    def common_delay(self) -> Delay:
        """The common delay of all cameras so far."""
        return _of_stretches(self._sums.sum(axis=0), self._counts.sum())

    @property
    def late(self) -> bool:
        """Whether a camera, or all together, are surely later or earlier than is harmless."""
        return self.common_delay.late or any(one.late for one in self.delays)

    def _solved(self, stretch: _Stretch, pose: np.ndarray) -> tuple[float, float]:
        """The delay in s and its information in 1/s^2, 0 where it can't be determined."""
        p = start = np.append(pose, np.zeros(len(_PRIOR) - 3))
        for _ in range(_STEPS):
            A, b, chi2 = self._equations(stretch, p)
            A = A + np.diag(1 / _PRIOR**2)
            step = np.linalg.solve(A, -(b + (p - start) / _PRIOR**2))
            if not np.isfinite(step).all():
                return 0.0, 0.0
            p = p + step
            p[_DELAY] = np.clip(p[_DELAY], -_LIMIT_S, _LIMIT_S)
            if np.max(np.abs(step) / _PRIOR) < _DONE:
                break
        else:
            return 0.0, 0.0
        numbers = 8 * int(stretch.used.sum()) - len(p)
        variance = np.linalg.inv(A)[_DELAY, _DELAY]
        if not variance > 0 or abs(p[_DELAY]) >= _LIMIT_S:
            return 0.0, 0.0
        # The information of the stretch alone, without the prior: stretches are added up.
        information = 1 / variance - 1 / _PRIOR[_DELAY] ** 2
        if not information > 1 / _TELLS_S**2:
            return 0.0, 0.0
        delay_s = p[_DELAY] / (variance * information)
        return float(delay_s), information / (_INFLATION**2 * max(chi2 / max(numbers, 1), 1.0))

    def _equations(self, stretch: _Stretch, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        A, b, chi2 = jax.device_get(_normal(*self._world, stretch, p.astype(self._dtype)))
        return A.astype(float), b.astype(float), float(chi2)


def _of_stretches(sums: np.ndarray, count: int) -> Delay:
    """The mean delay of several stretches; sigma grows where they contradict each other."""
    information, first, second = sums
    if not information > 0:
        return Delay(math.nan, math.inf)
    mean_s = first / information
    scatter = max(second - information * mean_s**2, 0.0) / max(count - 1, 1)
    sigma_s = math.sqrt(max(scatter, 1.0) / information)
    return Delay(float(mean_s), max(sigma_s, _LEAST_SIGMA_S))


def _stretch(
    camera: int,
    begin_ns: int,
    readings: Sequence[tuple[int, float, float]],
    views: Sequence[_View],
    dtype: np.dtype,
) -> _Stretch:
    """A stretch in arrays of fixed size; a reading holds from midway after the one before."""
    readings = _thinned(readings, _READINGS)
    stamps_ns, _, marker, corners_px, sigmas_px = zip(*_thinned(views, _VIEWS), strict=True)
    stamps_s = np.array([(stamp_ns - begin_ns) / 1e9 for stamp_ns, _, _ in readings])
    edges_s = np.concatenate([stamps_s[:1], (stamps_s[1:] + stamps_s[:-1]) / 2])
    rest, more = _READINGS - len(readings), _VIEWS - len(stamps_ns)

    def padded(values: Sequence[Any] | np.ndarray, extra: int) -> np.ndarray:
        array = np.array(values, dtype)
        return np.concatenate([array, np.repeat(array[-1:], extra, axis=0)])

    sigma_px = np.hypot(sigmas_px, math.hypot(MODEL_SIGMA_PX, _SCATTER_PX))
    return _Stretch(
        np.int32(camera),
        # Padding begins after every time that is used.
        np.concatenate([edges_s, np.full(rest, 1e3)]).astype(dtype),
        padded([speed_mps for _, speed_mps, _ in readings], rest),
        padded([steering_rad for _, _, steering_rad in readings], rest),
        padded([(stamp_ns - begin_ns) / 1e9 for stamp_ns in stamps_ns], more),
        padded(marker, more).astype(np.int32),
        padded(corners_px, more),
        padded(sigma_px, more),
        np.arange(_VIEWS) < len(stamps_ns),
    )


def _thinned(rows: Sequence[Any], most: int) -> list[Any]:
    """At most this many of the rows, evenly spaced."""
    which = np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))
    return [rows[index] for index in which]


@kept
def _normal(
    rig: CameraRig, markers: MarkerMap, wheelbase_m: Array, stretch: _Stretch, p: Array
) -> tuple[Array, Array, Array]:
    """Normal equations of the views' whitened residuals, and their chi-square, at `_PRIOR`'s p."""
    camera, edges_s, speed_mps, steering_rad, times_s, marker, corners_px, sigma_px, used = stretch

    def residuals(p: Array) -> tuple[Array, Array]:
        speed, steering = (1 + p[6]) * speed_mps, (1 + p[7]) * steering_rad + p[8]
        dt_s = jnp.diff(edges_s, append=edges_s[-1:])
        dt_s = jnp.where(dt_s < _ROOM_S + STRETCH_S, dt_s, 0.0)

        # The pose where each reading begins to hold: sums cost a tenth of steps in sequence.
        zero = jnp.zeros_like(p[:3])
        dx, dy, dpsi = jax.vmap(advance_bicycle, in_axes=(None, 0, 0, 0, None))(
            zero, speed, steering, dt_s, wheelbase_m
        ).T
        psi = jnp.cumsum(dpsi) - dpsi
        dx, dy = jnp.cos(psi) * dx - jnp.sin(psi) * dy, jnp.sin(psi) * dx + jnp.cos(psi) * dy
        nodes = jnp.stack([jnp.cumsum(dx) - dx, jnp.cumsum(dy) - dy, psi], axis=1)

        def along(time_s: Array) -> Array:
            """The pose by odometry, relative to the start of the readings."""
            at = jnp.clip(jnp.searchsorted(edges_s, time_s, side="right") - 1, 0, None)
            after_s = time_s - edges_s[at]
            return advance_bicycle(nodes[at], speed[at], steering[at], after_s, wheelbase_m)

        # From the odometer's frame to the world: at time 0 the pose is p[:3].
        times = jax.vmap(along)(jnp.append(times_s - p[9], 0.0))
        turn, moved_m = p[2] - times[-1, 2], times[:-1, :2] - times[-1:, :2]
        c, s = jnp.cos(turn), jnp.sin(turn)
        x_m, y_m = c * moved_m[:, 0] - s * moved_m[:, 1], s * moved_m[:, 0] + c * moved_m[:, 1]
        poses = jnp.stack([p[0] + x_m, p[1] + y_m, times[:-1, 2] + turn], axis=1)

        one, T_camera_vehicle = jax.tree.map(
            lambda leaf: leaf[camera], (rig.cameras, rig.Ts_camera_vehicle)
        )

        def seen(pose: Array, points: Array) -> Array:
            points = transform_points(T_world_vehicle_from_planar(pose).inverse(), points)
            points = transform_points(T_camera_vehicle, points)
            return one.project(points + jnp.cross(p[3:6][None], points))

        px = jax.vmap(seen)(poses, markers.corners_world_m[marker]) - corners_px
        r = (px / sigma_px[..., None]).reshape(len(times_s), 8)
        return r, r

    J, r = jax.jacfwd(residuals, has_aux=True)(p)
    chi2 = jnp.sum(r**2, axis=1)
    fine = used & jnp.isfinite(chi2)
    r, J = jnp.where(fine[:, None], r, 0), jnp.where(fine[:, None, None], J, 0)
    # Cauchy's loss for large residuals.
    excess = jnp.maximum(chi2 / _FULL_WEIGHT, 1.0)
    weight = jnp.where(fine, 1 / excess, 0.0)
    rho = jnp.where(excess > 1, _FULL_WEIGHT * (1 + jnp.log(excess)), chi2)
    A = jnp.einsum("v,vri,vrj->ij", weight, J, J)
    b = jnp.einsum("v,vri,vr->i", weight, J, r)
    return A, b, jnp.sum(jnp.where(fine, rho, 0.0))
