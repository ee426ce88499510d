"""Readings and views of the drives for the calibration of odometry, put on one time axis."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxnav.errors import BadInput

GAP_S = 0.25  # a longer time without a reading leaves the car's way unknown
_ROOM_S = 0.5  # of readings kept before the first view and after the last, for the delay
_BETWEEN_S = 10.0  # between two stretches on the common time axis
_SPIKE_SIGMAS = 10.0
_LEAST_READINGS = 20
_LEAST_VIEWS = 30
# Readings are taken to be no better than this: they may be rounded, or made up by a model of the
# servo.
_LEAST_SIGMA_MPS, _LEAST_SIGMA_RAD = 0.002, 0.001


@dataclass(frozen=True)
class Drive:
    """K readings of the odometer and V views of markers; a view is one marker in one frame.

    Attributes:
        name: name of the recording.
        reading_stamps_ns: (K,) int64, by the odometer's clock.
        speed_mps: (K,), as read, uncorrected.
        steering_rad: (K,), as read, uncorrected.
        view_stamps_ns: (V,) int64, by the cameras' clock.
        camera: (V,) int, index in the rig.
        marker: (V,) int, index in the map.
        corners_px: (V, 4, 2).
        sigma_px: (V, 4), standard deviation of each corner along one axis.
        left_out: number of readings and views left out for values impossible for a car's sensors.
    """

    name: str
    reading_stamps_ns: Int[np.ndarray, " K"]
    speed_mps: Float[np.ndarray, " K"]
    steering_rad: Float[np.ndarray, " K"]
    view_stamps_ns: Int[np.ndarray, " V"]
    camera: Int[np.ndarray, " V"]
    marker: Int[np.ndarray, " V"]
    corners_px: Float[np.ndarray, "V 4 2"]
    sigma_px: Float[np.ndarray, "V 4"]
    left_out: int = 0


Column = Any  # a NumPy array on the host, a JAX array inside jit


class ReadingSigma(NamedTuple):
    """The standard deviations of single readings."""

    speed_mps: float
    steering_rad: float


class Intervals(NamedTuple):
    """N intervals, each from one node to the next, with one reading in the middle.

    Attributes:
        begin_s: (N,), on the common time axis.
        dt_s: (N,).
        speed_mps, steering_rad: (N,), as read.
        linked: (N,), 0. for intervals between two stretches, else 1.
    """

    begin_s: Column
    dt_s: Column
    speed_mps: Column
    steering_rad: Column
    linked: Column


class MarkerViews(NamedTuple):
    """V views; see `Drive`.

    Attributes:
        time_s: (V,), by the cameras' clock, on the common time axis.
        first, last: (V,) int, first and last interval of the view's stretch.
    """

    time_s: Column
    first: Column
    last: Column
    camera: Column
    marker: Column
    corners_px: Column
    sigma_px: Column


class Course(NamedTuple):
    """All stretches of all drives, one after the other."""

    intervals: Intervals
    views: MarkerViews

    @property
    def node_times_s(self) -> Float[np.ndarray, " nodes"]:
        """(N + 1,) times of the nodes on the common time axis."""
        ends = self.intervals.begin_s[-1:] + self.intervals.dt_s[-1:]
        return np.concatenate([self.intervals.begin_s, ends])

    @property
    def stretches(self) -> int:
        """The number of stretches."""
        return 1 + int(np.sum(self.intervals.linked == 0))

    @property
    def duration_s(self) -> float:
        """The total duration of the stretches."""
        return float(np.sum(self.intervals.dt_s * self.intervals.linked))


def lay_out(drives: Sequence[Drive]) -> Course:
    """Lay out the stretches without a gap in the readings, and their views, on one time axis.

    A reading stands for the time around its stamp, from half-way to its neighbours: by the
    midpoint rule its noise enters one interval alone, and intervals are independent.

    Raises:
        BadInput: there are too few readings or views; the message names the drive.
    """
    parts = [part for drive in drives for part in _stretches(drive)]
    if sum(len(columns["time_s"]) for _, columns in parts) < _LEAST_VIEWS:
        names = ", ".join(drive.name for drive in drives)
        count = sum(len(drive.view_stamps_ns) for drive in drives)
        problem = (
            f"markers of the map were seen {count} times beside readings of the odometer, at least "
            f"{_LEAST_VIEWS} views are needed: drive where a camera sees a marker of --markers"
        )
        raise BadInput(names, problem)
    begin_s, intervals, views = 0.0, [], []
    count = 0
    for number, (readings, seen) in enumerate(parts):
        times_s, edges_s = readings["time_s"], _edges(readings["time_s"])
        shift_s = begin_s - edges_s[0]
        n = len(times_s)
        intervals.append(
            Intervals(
                edges_s[:-1] + shift_s,
                np.diff(edges_s),
                readings["speed_mps"],
                readings["steering_rad"],
                np.ones(n),
            )
        )
        size = len(seen["time_s"])
        first, last = np.full(size, count), np.full(size, count + n - 1)
        on_axis = seen | {"time_s": seen["time_s"] + shift_s}
        views.append(MarkerViews(first=first, last=last, **on_axis))
        count += n
        begin_s = edges_s[-1] + shift_s
        if number < len(parts) - 1:
            zero = np.zeros(1)
            intervals.append(Intervals(zero + begin_s, zero + _BETWEEN_S, zero, zero, zero))
            begin_s += _BETWEEN_S
            count += 1
    return Course(
        Intervals(*(np.concatenate(column) for column in zip(*intervals, strict=True))),
        MarkerViews(*(np.concatenate(column) for column in zip(*views, strict=True))),
    )


def reading_sigma(intervals: Intervals) -> ReadingSigma:
    """Estimate the noise of readings from their scatter about lines through three in a row.

    It is the median of second differences: the car's own motion within three readings counts
    little, unless it goes on all the time.
    """
    steady = (intervals.linked[:-2] * intervals.linked[1:-1] * intervals.linked[2:]) > 0

    def scatter(values: np.ndarray) -> float:
        second = (values[:-2] - 2 * values[1:-1] + values[2:])[steady]
        return float(np.median(np.abs(second)) / 0.6745 / np.sqrt(6)) if len(second) else 0.0

    return ReadingSigma(
        max(scatter(intervals.speed_mps), _LEAST_SIGMA_MPS),
        max(scatter(intervals.steering_rad), _LEAST_SIGMA_RAD),
    )


def _edges(times_s: np.ndarray) -> np.ndarray:
    """(K + 1,): the midpoints between (K,) instants, and the outer two instants."""
    middle = (times_s[1:] + times_s[:-1]) / 2
    return np.concatenate([times_s[:1], middle, times_s[-1:]])


_Columns = dict[str, np.ndarray]


def _stretches(drive: Drive) -> list[tuple[_Columns, _Columns]]:
    """Readings and views of each usable stretch of a drive."""
    order = np.unique(drive.reading_stamps_ns, return_index=True)[1]
    speed, steering = drive.speed_mps[order], drive.steering_rad[order]
    good = np.isfinite(speed) & np.isfinite(steering)
    good &= ~_spikes(speed, _LEAST_SIGMA_MPS) & ~_spikes(steering, _LEAST_SIGMA_RAD)
    stamps_ns = drive.reading_stamps_ns[order][good]
    if len(stamps_ns) < _LEAST_READINGS:
        problem = f"holds {len(stamps_ns)} readings of the odometer: record the drive with them"
        raise BadInput(drive.name, problem)
    begin_ns = stamps_ns[0]
    readings = {
        "time_s": (stamps_ns - begin_ns) / 1e9,
        "speed_mps": speed[good],
        "steering_rad": steering[good],
    }
    usable = np.isfinite(drive.corners_px).all(axis=(1, 2))
    usable &= (np.isfinite(drive.sigma_px) & (drive.sigma_px > 0)).all(axis=1)
    views = {
        "time_s": (drive.view_stamps_ns - begin_ns) / 1e9,
        "camera": drive.camera,
        "marker": drive.marker,
        "corners_px": drive.corners_px,
        "sigma_px": drive.sigma_px,
    }
    views = {name: column[usable] for name, column in views.items()}
    views = _chosen(views, np.argsort(views["time_s"], kind="stable"))
    cuts = np.flatnonzero(np.diff(readings["time_s"]) > GAP_S) + 1
    stretches = []
    for piece in np.split(np.arange(len(stamps_ns)), cuts):
        times_s = readings["time_s"][piece]
        inside = (views["time_s"] >= times_s[0]) & (views["time_s"] <= times_s[-1])
        if len(piece) < _LEAST_READINGS or not inside.any():
            continue
        seen = _chosen(views, inside)
        near = times_s >= seen["time_s"][0] - _ROOM_S
        near &= times_s <= seen["time_s"][-1] + _ROOM_S
        stretches.append((_chosen(readings, piece[near]), seen))
    return stretches


def _chosen(columns: _Columns, rows: np.ndarray) -> _Columns:
    return {name: column[rows] for name, column in columns.items()}


def _spikes(values: np.ndarray, least_sigma: float) -> np.ndarray:
    """(K,) bool: true for readings far from the median of themselves and their two neighbours."""
    if not len(values):
        return np.zeros(0, bool)
    padded = np.concatenate([values[:1], values, values[-1:]])
    off = np.abs(values - np.median(np.stack([padded[:-2], values, padded[2:]]), axis=0))
    sigma = max(1.4826 * float(np.median(off)), least_sigma)
    return np.asarray(off > max(_SPIKE_SIGMAS * sigma, 0.05))
