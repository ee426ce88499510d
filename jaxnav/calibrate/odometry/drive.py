"""Readings and views of the drives for the calibration of odometry, put on one time axis."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import median_filter

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
    """K readings of the odometer and V views of markers; a view is one marker in one frame."""

    name: str  # name of the recording
    reading_stamps_ns: Int[np.ndarray, " K"]  # by the odometer's clock
    speed_mps: Float[np.ndarray, " K"]  # as read, uncorrected
    steering_rad: Float[np.ndarray, " K"]  # as read, uncorrected
    view_stamps_ns: Int[np.ndarray, " V"]  # by the cameras' clock
    camera: Int[np.ndarray, " V"]  # index in the rig
    marker: Int[np.ndarray, " V"]  # index in the map
    corners_px: Float[np.ndarray, "V 4 2"]
    sigma_px: Float[np.ndarray, "V 4"]  # standard deviation of each corner along one axis
    # number of readings and views left out for values impossible for a car's sensors
    left_out: int = 0


Column = Any  # a NumPy array on the host, a JAX array inside jit


class ReadingSigma(NamedTuple):
    """The standard deviations of single readings."""

    speed_mps: float
    steering_rad: float


class Intervals(NamedTuple):
    """N intervals, each from one node to the next, with one reading in the middle."""

    begin_s: Column  # (N,), on the common time axis
    dt_s: Column  # (N,)
    speed_mps: Column  # (N,), as read, like the next
    steering_rad: Column
    linked: Column  # (N,), 0. for intervals between two stretches, else 1.


class MarkerViews(NamedTuple):
    """V views; see `Drive`."""

    time_s: Column  # (V,), by the cameras' clock, on the common time axis
    first: Column  # (V,) int, and `last`: first and last interval of the view's stretch
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
    if sum(len(seen.time_s) for _, seen in parts) < _LEAST_VIEWS:
        names = ", ".join(drive.name for drive in drives)
        count = sum(len(drive.view_stamps_ns) for drive in drives)
        problem = (
            f"markers of the map were seen {count} times beside readings of the odometer, at least "
            f"{_LEAST_VIEWS} views are needed: drive where a camera sees a marker of --markers"
        )
        raise BadInput(names, problem)
    intervals: list[Intervals] = []
    views: list[MarkerViews] = []
    begin_s, count = 0.0, 0
    for own, seen in parts:
        if intervals:
            gap = np.array([[begin_s], [_BETWEEN_S], [0.0], [0.0], [0.0]])
            intervals.append(Intervals(*gap))
            begin_s, count = begin_s + _BETWEEN_S, count + 1
        shift_s = begin_s - own.begin_s[0]
        intervals.append(own._replace(begin_s=own.begin_s + shift_s))
        first, last = (np.full(len(seen.time_s), count + end) for end in (0, len(own.dt_s) - 1))
        views.append(seen._replace(time_s=seen.time_s + shift_s, first=first, last=last))
        begin_s, count = begin_s + float(np.sum(own.dt_s)), count + len(own.dt_s)
    return Course(
        Intervals(*map(np.concatenate, zip(*intervals, strict=True))),
        MarkerViews(*map(np.concatenate, zip(*views, strict=True))),
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


def _stretches(drive: Drive) -> list[tuple[Intervals, MarkerViews]]:
    """Readings and views of each usable stretch of a drive, from its first reading on."""
    order = np.unique(drive.reading_stamps_ns, return_index=True)[1]
    speed, steering = drive.speed_mps[order], drive.steering_rad[order]
    good = np.isfinite(speed) & np.isfinite(steering)
    good &= ~_spikes(speed, _LEAST_SIGMA_MPS) & ~_spikes(steering, _LEAST_SIGMA_RAD)
    stamps_ns, speed, steering = drive.reading_stamps_ns[order][good], speed[good], steering[good]
    if len(stamps_ns) < _LEAST_READINGS:
        problem = f"holds {len(stamps_ns)} readings of the odometer: record the drive with them"
        raise BadInput(drive.name, problem)
    times_s, seen_s = ((of - stamps_ns[0]) / 1e9 for of in (stamps_ns, drive.view_stamps_ns))
    usable = np.isfinite(drive.corners_px).all(axis=(1, 2))
    usable &= (np.isfinite(drive.sigma_px) & (drive.sigma_px > 0)).all(axis=1)
    in_order = np.argsort(seen_s, kind="stable")
    in_order = in_order[usable[in_order]]
    cuts = np.flatnonzero(np.diff(times_s) > GAP_S) + 1
    stretches = []
    for piece in np.split(np.arange(len(stamps_ns)), cuts):
        begin_s, end_s = times_s[piece[[0, -1]]]
        rows = in_order[(seen_s[in_order] >= begin_s) & (seen_s[in_order] <= end_s)]
        if len(piece) < _LEAST_READINGS or not len(rows):
            continue
        near = times_s[piece] >= seen_s[rows[0]] - _ROOM_S
        kept = piece[near & (times_s[piece] <= seen_s[rows[-1]] + _ROOM_S)]
        own_s = times_s[kept]
        edges_s = np.concatenate([own_s[:1], (own_s[1:] + own_s[:-1]) / 2, own_s[-1:]])
        readings = edges_s[:-1], np.diff(edges_s), speed[kept], steering[kept], np.ones(len(kept))
        columns = (drive.camera, drive.marker, drive.corners_px, drive.sigma_px)
        seen = (seen_s[rows], rows, rows, *(column[rows] for column in columns))
        stretches.append((Intervals(*readings), MarkerViews(*seen)))
    return stretches


def _spikes(values: np.ndarray, least_sigma: float) -> np.ndarray:
    """(K,) bool: true for readings far from the median of themselves and their two neighbours."""
    if not len(values):
        return np.zeros(0, bool)
    off = np.abs(values - median_filter(values, 3, mode="nearest"))
    sigma = max(1.4826 * float(np.median(off)), least_sigma)
    return np.asarray(off > max(_SPIKE_SIGMAS * sigma, 0.05))
