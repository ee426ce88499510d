"""Compare the vehicle's way by the corners with its way by the odometer.

A marker that is carried along, or a copy of it elsewhere, fits its own corners as well as the true
one does. It can't imitate the odometer: the car has not gone where the corners say. There are two
measures, since a slow drag is hidden by wheel slip and a leap is not:

    disputed       over some seconds the two ways differ by more than DRIFT_M + DRIFT_SHARE * way
    out of reach   a pose farther from the last one than the wheels have turned, or turned farther
                   than they can have turned it

Neither detects a copy carried slower than DRIFT_SHARE of the car's own speed or by less than the
two margins, or one that was there from the beginning.

How fast a marker comes nearer needs no estimate: neither of a pose, nor of which of two it is. A
marker or a focal length that is s times as large as its file says makes every range s times as
long, wheels make every way so, and a camera that looks the other way sees a marker go that comes.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnav.drive.chassis import Motion

# Error of the corners themselves while the car goes round a marker, with cameras off by 1 deg or
# 2 %. It is also how near a car that was carried off must come.
DRIFT_M = 0.1
# Error of wheels and their calibration, as where `Odometer` believes a sensor again.
DRIFT_SHARE = 0.1
REACH_RAD = math.radians(20.0)  # from this angle on `MultiHypothesis` calls it another branch
_WINDOW_NS = 8_000_000_000  # for a standing car, 0.1 m in this time is 1.25 cm/s
_EVERY_NS = 200_000_000
# The ways agree again when, over a second, they differ by no more than this (see
# `Odometer._agrees`) plus half of DRIFT_SHARE.
_AGREES_NS = 1_000_000_000
_AGREES_M = 0.02
_GAP_NS = 500_000_000  # after longer gaps without corners dead reckoning has errors of its own
_SILENT_S = 0.1  # a longer gap between readings leaves the way unknown
_SIGMAS = 3.0

# Ranges change by this share more or less than the way: the prior of the wheels' scale, 3 %, and a
# slip of 5 % that forgets itself on 0.2 m, over half a metre (see `DEFAULT_SENSOR_SIGMA`).
_WHEELS = 0.053
# The noise counts this many times: of many looks in a row one is further off than three sigmas.
# Fitted with what is beside it to 261 sound drives with wheels that are 10 % off, spin for 1 s of
# each 3, do both or neither: two of 105 that did both were blamed (`bench_lies.py --clean`).
_MANY_LOOKS = 1.25
# A range may be off by this share of it at one place, and not at the next: what lenses leave at
# different places in the image, as `_JITTER_M` where cameras are late while the vehicle speeds up.
_LENS, _JITTER_M = 0.01, 0.01
_STRIDE_M = 0.01  # between two looks that count: a standing vehicle tells nothing new
# Way on which the weight of a look falls to 1/e: wheels seldom spin as far, so the way before and
# after counts as well.
_FORGETS_M = 3.0
_LEAST_LOOKS, _IN_A_ROW = 4, 2
_LEAP_SHARE = 0.1  # of the range, beyond the way: the vehicle or the marker was carried off
# A lane whose ranges have agreed this well is as its files say: what differs later is slip.
_TRUE = 0.15
_LASTING_M = 0.5  # way after a contradiction on which it must pass


class Fix(NamedTuple):
    """A pose in the world measured by the corners, and its sigmas."""

    x_m: float
    y_m: float
    psi_rad: float
    sigma_m: float
    sigma_rad: float


class _Anchor(NamedTuple):
    now_ns: int
    fix: Fix
    x_m: float  # of the fix, minus the place by odometry
    y_m: float
    way_m: float
    turned_rad: float


@dataclass
class Ways:
    """The ways of one drive by corners and by odometer.

    Attributes:
        slides_m: of the vehicle; see `Chassis`.
        disputed: the two ways differ.
        way_m: length by odometry, forwards or backwards, since the drive began; with that of the
            rim of what turns on the spot.
    """

    slides_m: float
    disputed: bool = False
    way_m: float = 0.0
    _turned_rad: float = 0.0  # sum of turns in both directions
    _x_m: float = 0.0  # by odometry, along the estimated heading
    _y_m: float = 0.0
    _seen_ns: int = 0
    _last: _Anchor | None = None
    _window: deque[_Anchor] = field(default_factory=deque)

    def add_odometry(
        self, motion: Motion, pace_mps: float, heading_rad: float, gap_s: float
    ) -> None:
        """Take a reading of the odometer: the motion that it tells, and its pace.

        Args:
            heading_rad: the estimated heading, so that a steering sensor's offset does not add up.
            gap_s: time since the reading before.
        """
        if gap_s > _SILENT_S:
            self._window.clear()
            self.disputed = False
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        self._x_m += (c * motion.forward_mps - s * motion.left_mps) * gap_s
        self._y_m += (s * motion.forward_mps + c * motion.left_mps) * gap_s
        self.way_m += pace_mps * gap_s
        self._turned_rad += abs(motion.turn_radps) * gap_s

    def note_corners(self, now_ns: int) -> None:
        """Note that corners were seen, believed or not."""
        if not 0 <= now_ns - self._seen_ns <= _GAP_NS:
            self._window.clear()
        self._seen_ns = now_ns

    def add_fix(self, now_ns: int, fix: Fix) -> None:
        """Compare a pose measured by the corners with the way by odometry."""
        here = _Anchor(
            now_ns, fix, fix.x_m - self._x_m, fix.y_m - self._y_m, self.way_m, self._turned_rad
        )
        self._last = here
        window = self._window
        if not window:
            self._agree(here)
            return
        if now_ns - window[-1].now_ns < _EVERY_NS:
            return
        window.append(here)
        while window[0].now_ns < now_ns - _WINDOW_NS:
            window.popleft()
        if any(_parts(here, then) for then in window):
            self.disputed = True
        if self.disputed:
            recent = [then for then in window if then.now_ns >= now_ns - _AGREES_NS]
            lasting = now_ns - recent[0].now_ns >= _AGREES_NS - _EVERY_NS
            if lasting and all(_agrees(here, then) for then in recent):
                self._agree(here)

    def out_of_reach(self, fix: Fix, slack_m: float = 0.0) -> bool:
        """Whether no slip explains how the car came from the last pose to this one.

        With spinning or sliding wheels the car is anywhere within the way that they have turned.

        Args:
            slack_m: the way may be this much longer than the odometer says.
        """
        if self._last is None:
            return False
        before = self._last.fix
        way_m, turned_rad = self.way_m - self._last.way_m, self._turned_rad - self._last.turned_rad
        off_m = math.hypot(fix.x_m - before.x_m, fix.y_m - before.y_m)
        off_rad = abs(math.remainder(fix.psi_rad - before.psi_rad, math.tau))
        sliding_rad = (way_m + slack_m) / self.slides_m
        return off_m > DRIFT_M + way_m + slack_m + _SIGMAS * (
            before.sigma_m + fix.sigma_m
        ) or off_rad > REACH_RAD + turned_rad + sliding_rad + _SIGMAS * (
            before.sigma_rad + fix.sigma_rad
        )

    @property
    def since_fix_m(self) -> float:
        """The way by odometry since the last pose, m."""
        return 0.0 if self._last is None else self.way_m - self._last.way_m

    def forget(self) -> None:
        """Forget the last pose: it tells nothing about the next one."""
        self._last, self.disputed = None, False
        self._window.clear()

    def _agree(self, here: _Anchor) -> None:
        self.disputed = False
        self._window.clear()
        self._window.append(here)


@dataclass
class Ranges:
    """How the range of a marker changes by corners and by the odometer, in one drive.

    Over the last way, with weights that fade, ranges r by corners are fitted to those x that the
    odometer alone gives: r = a + slope x. The slope is 1 where all files are true. Each camera and
    marker, and each leap, has an a of its own.

    Attributes:
        contradicted: the slope is not, and never was with this camera and marker.
        lasting: it has been so for a while of way.
    """

    contradicted: bool = False
    slope: float = 1.0
    sigma: float = math.inf
    _lane: tuple[int, int] | None = None
    _true: set[tuple[int, int]] = field(default_factory=set)
    _place_m: Sequence[float] = (0.0, 0.0, 0.0)  # at the last look that counts
    _range_m: float = 0.0
    _x_m: float = 0.0
    _since_m: float = 0.0  # way since the contradiction
    _weight: float = 0.0  # of the looks with this a, and their means of x and r
    _means_m: tuple[float, float] = (0.0, 0.0)
    _free: float = 0.0  # weight of all looks but one for each a
    _sums: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of xx, xr, rr about the means
    _odd: int = 0  # looks in a row that contradict

    @property
    def lasting(self) -> bool:
        """See the class."""
        return self.contradicted and self._since_m > _LASTING_M

    @property
    def agreed(self) -> bool:
        """Whether a camera and a marker have agreed with the way."""
        return bool(self._true)

    def add_way(self, way_m: float) -> None:
        """Take how far the vehicle has gone by odometry, whatever it sees."""
        self._since_m += way_m

    def add_place(
        self,
        lane: tuple[int, int],
        place_m: Sequence[float],
        motion: tuple[float, float, float] | None,
    ) -> bool:
        """Take where corners alone have a marker; return whether the look counts.

        Args:
            lane: camera and marker.
            place_m: of the marker's centre, in the vehicle's axes.
            motion: by the odometer since the last look that counts, (x_m, y_m, psi_rad) in the
                vehicle's axes then; None: not known.
        """
        range_m, way_m, leaps = math.hypot(*place_m), 0.0, False
        if lane == self._lane and motion is not None:
            x_m, y_m, z_m = self._place_m
            way_m = math.hypot(motion[0], motion[1])
            nearer_m = self._range_m - math.hypot(x_m - motion[0], y_m - motion[1], z_m)
            leaps = abs(self._range_m - nearer_m - range_m) > _LEAP_SHARE * range_m
        if lane != self._lane or motion is None or leaps:
            self._odd = 0
            # A lane that is true shows nothing of others, what was before a leap nothing.
            if self._lane in self._true or leaps:
                self._free, self._sums = 0.0, (0.0, 0.0, 0.0)
            self._lane, self._x_m, self._weight = lane, range_m, 0.0
        elif way_m < _STRIDE_M:
            return False
        else:
            self._x_m -= nearer_m
        self._place_m, self._range_m = place_m, range_m
        self._look(range_m, math.exp(-way_m / _FORGETS_M))
        return True

    def _look(self, range_m: float, kept: float) -> None:
        x_m, lane, before = self._x_m, self._lane, kept * self._weight
        x_mean_m, r_mean_m = self._means_m if before else (x_m, range_m)
        dx, dr, self._weight = x_m - x_mean_m, range_m - r_mean_m, before + 1
        self._means_m = x_mean_m + dx / self._weight, r_mean_m + dr / self._weight
        share, new = before / self._weight, (dx * dx, dx * dr, dr * dr)
        xx, xr, rr = (kept * old + share * one for old, one in zip(self._sums, new, strict=True))
        self._sums, self._free = (xx, xr, rr), kept * self._free + bool(before)
        free = self._free
        if not before or free < _LEAST_LOOKS or xx <= 0 or lane is None:
            return
        self.slope = slope = xr / xx
        noise = max(rr - slope * xr, 0.0) / (free - 1)
        # Three sigmas of Student's t, within 2 % from three degrees of freedom on.
        noise *= (1 + 2 / (free - 1) + 12 / (free - 1) ** 2) ** 2
        # An error that grows along the whole way, whose looks lie evenly on it.
        along = (_LENS * range_m) ** 2 + _JITTER_M**2
        seen = _MANY_LOOKS**2 * (noise + along * free / 12) / xx
        self.sigma = sigma = math.sqrt(seen + _WHEELS**2)
        off = abs(slope - 1)
        self._odd = self._odd + 1 if off > _SIGMAS * sigma else 0
        if off + sigma < _TRUE:
            self._true.add(lane)
            self.contradicted = False
        elif self._odd >= _IN_A_ROW and lane not in self._true and not self.contradicted:
            self.contradicted, self._since_m = True, 0.0
            # What comes now says whether it was slip.
            self._weight, self._free, self._sums = 0.0, 0.0, (0.0, 0.0, 0.0)


class Corridor:
    """All that is within a distance of a drive's route: the way past all waypoints."""

    def __init__(self, waypoints_m: Sequence[Sequence[float]] | np.ndarray, leave_m: float):
        # Complex: of few legs NumPy takes ten times as long as plain numbers.
        self._waypoints_m = [complex(x, y) for x, y in np.asarray(waypoints_m, float).tolist()]
        self._leave_m, self._route_m = leave_m, list[complex]()

    def is_left(self, place_m: Float[np.ndarray, " 2"]) -> bool:
        """Whether a place is outside; the first one asked about is where the route begins."""
        here_m = complex(*place_m.tolist())
        self._route_m = self._route_m or [here_m, *self._waypoints_m]
        legs_m = pairwise(self._route_m)
        return all(_off_m(here_m - begin, end - begin) > self._leave_m for begin, end in legs_m)


def _part_m(one: _Anchor, other: _Anchor) -> float:
    return math.hypot(one.x_m - other.x_m, one.y_m - other.y_m)


def _parts(here: _Anchor, then: _Anchor) -> bool:
    bound_m = DRIFT_M + DRIFT_SHARE * (here.way_m - then.way_m) + _SIGMAS * then.fix.sigma_m
    return _part_m(here, then) > bound_m


def _agrees(here: _Anchor, then: _Anchor) -> bool:
    return _part_m(here, then) <= _AGREES_M + DRIFT_SHARE / 2 * (here.way_m - then.way_m)


def _off_m(place_m: complex, leg_m: complex) -> float:
    """How far a place is from a leg; both count from where the leg begins."""
    share = (place_m * leg_m.conjugate()).real / max(abs(leg_m) ** 2, 1e-12)
    return abs(place_m - min(max(share, 0.0), 1.0) * leg_m)
