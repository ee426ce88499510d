"""Compare the vehicle's way by the corners with its way by the odometer.

    ways.add_odometry(motion, pace_mps, heading_rad, gap_s)   # with every odometry
    ways.note_corners(now_ns)                             # with every frame that shows markers
    ways.add_fix(now_ns, fix)                             # with every pose to be trusted
    ways.out_of_reach(fix)                                # before that

A marker that is carried along, or a copy of it elsewhere, fits its own corners as well as the true
one does. It can't imitate the odometer: the car has not gone where the corners say. There are two
measures, since a slow drag is hidden by wheel slip and a leap is not:

    disputed       over some seconds the two ways differ by more than DRIFT_M + DRIFT_SHARE * way
    out of reach   a pose farther from the last one than the wheels have turned, or turned farther
                   than they can have turned it

Neither detects a copy carried slower than DRIFT_SHARE of the car's own speed or by less than the
two margins, or one that was there from the beginning.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

from jaxnav.loop.chassis import Motion

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


def _part_m(one: _Anchor, other: _Anchor) -> float:
    return math.hypot(one.x_m - other.x_m, one.y_m - other.y_m)


def _parts(here: _Anchor, then: _Anchor) -> bool:
    bound_m = DRIFT_M + DRIFT_SHARE * (here.way_m - then.way_m) + _SIGMAS * then.fix.sigma_m
    return _part_m(here, then) > bound_m


def _agrees(here: _Anchor, then: _Anchor) -> bool:
    return _part_m(here, then) <= _AGREES_M + DRIFT_SHARE / 2 * (here.way_m - then.way_m)
