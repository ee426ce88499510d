"""Detect what stands still while others move: a frozen camera, a stuck odometer, a held vehicle.

    corners rest, the odometer goes             the camera shows an old picture
    corners move, the odometer rests            the odometer is stuck
    neither moves, and the throttle pulls       both are, or the vehicle is held

A camera is judged by the share of the expected shift that it shows: with d the shifts of corners
due by the odometer's way, and s the shifts seen,

    share = <s, d> / <d, d>,      its sigma = sqrt(2) sigma_px / |d|.

A marker far ahead on the axis of motion has no expected shift, so it raises no alarm; neither does
a vehicle that stands. In the third case nothing tells where it goes: it may be blind, held fast, or
without power. The vehicle does not try to go again, since it might go blind: the fault lasts until
something moves, for example when someone pushes it. Missing data are stale, and handled elsewhere.
"""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.drive.chassis import Motion, pace_mps
from jaxnav.drive.expect import Place

# The corners before and after a motion (x_m, y_m, psi_rad, in the vehicle's earlier axes);
# None: the pose of the vehicle is not known.
Due = Callable[[Place], tuple[Float[np.ndarray, "C M 4 2"], Float[np.ndarray, "C M 4 2"]] | None]

_MOVED_PX, _MOVED_SIGMAS = 1.0, 6.0  # more than noise moves any corner of some markers
_MIN_SIGMA_PX = 0.05  # detectors report less, but lens models are not that accurate
# A camera with an unknown delay of 100 ms hides 5 cm at 0.5 m/s, half of this.
_WAY_M = 0.1
_SHARE, _SHARE_SIGMAS = 0.5, 3.0
_FROZEN_AFTER = 3  # such frames in a row
# Resting corners are compared for this long: 0.1 m in 5 s are twice the odometry's sigma in the
# filter, which is the sigma of one reading, not of all of them.
_REST_NS = 5_000_000_000

_RESTS_MPS = 0.02  # the odometer of a standing car reads less: twice the same sigma
_SLOW_NS = 100_000_000  # after the car has stopped: frames may be late, whatever their stamps say
# This often and long: no single push, no marker that is moved. Fewer do where the throttle pulls.
_MOVES, _PULLED_MOVES, _MOVES_NS = 3, 2, 300_000_000
_PAUSE_NS = 1_000_000_000  # longest time between two moves of one motion

# Without a marker and without odometry the vehicle stops after 1 s (see `health`): nothing tells
# where it goes here either. A motor starts sooner, and a shorter commanded way counts as standing.
_PULLS_NS, _PULLS_M = 1_000_000_000, 0.2
_MAX_GAP_NS = 200_000_000  # without a command this long the watchdog stops it; cameras are stale
_GOES_MPS, _GOES_SHARE = 0.05, 0.25  # five sigmas of the odometer; share of the expected speed


_KEPT_NS = 1_500_000_000  # more than the age of the oldest frame that is taken, see `stamps`
_SILENT_NS = 250_000_000  # without a reading for this long the way is unknown
_AHEAD_NS = 100_000_000  # the newest reading is extrapolated for this long: it is not stale yet


@dataclass
class Way:
    """The vehicle's way of the last 1.5 s by odometry alone, in a frame of its own.

    Attributes:
        lever_m: of the vehicle's rim; see `Chassis`.
    """

    lever_m: float = 0.0
    number: int = 0  # of the way: places on different ways can't be compared
    _track: deque[tuple[int, Place]] = field(default_factory=deque)
    _motion: Motion = field(default_factory=lambda: Motion(0.0, 0.0, 0.0))

    def go(self, stamp_ns: int, motion: Motion) -> None:
        """Take what a reading tells; a late one is left out, and after a pause a new way begins."""
        if self._track and not 0 < stamp_ns - self._track[-1][0] <= _SILENT_NS:
            if stamp_ns <= self._track[-1][0]:
                return
            self._track.clear()
            self.number += 1
        self._motion = motion
        place = self._beyond(stamp_ns) if self._track else (0.0, 0.0, 0.0)
        self._track.append((stamp_ns, place))
        while self._track[0][0] < stamp_ns - _KEPT_NS:
            self._track.popleft()

    def at(self, stamp_ns: int) -> Place | None:
        """The place at a time, interpolated; None: not known."""
        track = self._track
        if not track or not track[0][0] <= stamp_ns <= track[-1][0] + _AHEAD_NS:
            return None
        if stamp_ns >= track[-1][0]:
            return self._beyond(stamp_ns)
        index = bisect_right(track, stamp_ns, key=lambda row: row[0])
        (before_ns, before), (after_ns, after) = track[index - 1], track[index]
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        x_m, y_m, psi_rad = (a + share * (b - a) for a, b in zip(before, after, strict=True))
        return x_m, y_m, psi_rad

    def _beyond(self, stamp_ns: int) -> Place:
        """The place extrapolated from the newest reading, along the chord of an arc."""
        before_ns, (x_m, y_m, psi_rad) = self._track[-1]
        forward_mps, left_mps, turn_radps = self._motion
        gap_s = (stamp_ns - before_ns) / 1e9
        turned_rad = turn_radps * gap_s
        c, s = math.cos(psi_rad + turned_rad / 2), math.sin(psi_rad + turned_rad / 2)
        return (
            x_m + (c * forward_mps - s * left_mps) * gap_s,
            y_m + (s * forward_mps + c * left_mps) * gap_s,
            psi_rad + turned_rad,
        )

    def length_m(self, motion: Place) -> float:
        """The length of a motion, with that of the rim by its turn."""
        return math.hypot(motion[0], motion[1]) + self.lever_m * abs(motion[2])


def between(place: Place, other: Place) -> Place:
    """The other place relative to the first, in the first one's axes."""
    x_m, y_m = other[0] - place[0], other[1] - place[1]
    c, s = math.cos(place[2]), math.sin(place[2])
    return c * x_m + s * y_m, c * y_m - s * x_m, other[2] - place[2]


@dataclass
class _Rest:
    """Reference corners of one camera, which have not moved since their stamp."""

    corners_px: np.ndarray  # (M, 4, 2)
    visible: np.ndarray  # (M,)
    stamp_ns: int
    place: Place | None  # by the odometer
    way: int  # number of the way that the place is on
    moves: int = 0  # number of successive moves that led here
    moving_ns: int = 0  # stamp of the beginning of these moves
    doubts: int = 0  # frames in a row that show too small a shift
    frozen: bool = False


@dataclass
class Standstill:
    """The detector of one drive for what stands still while others move.

    Attributes:
        nothing_moves: the throttle pulls, and neither wheels nor corners move.
    """

    way: Way
    time_constant_s: float
    nothing_moves: bool = False
    _rests: dict[int, _Rest] = field(default_factory=dict)
    _quiet_ns: int | None = None  # stamp of the reading since which the odometer says it stands
    _told_ns: int = 0  # stamp of the last reading, believed or not
    _contradicted_ns: int | None = None  # stamp of the last corners that moved meanwhile
    _pulled_mps: tuple[float, ...] = ()  # speed of each driven part expected from the commands
    _pulled_m: float = 0.0  # expected way since something moved
    _moved_ns: int | None = None  # time when something moved
    _commanded_ns: int | None = None
    _claimed_ns: int | None = None  # time of the last data from any sensor

    def add_reading(self, stamp_ns: int, now_ns: int, speed_mps: float) -> bool:
        """Take the pace of any reading; return whether corners move while it says it stands."""
        self._claimed_ns = now_ns
        self._told_ns = max(stamp_ns, self._told_ns)
        if abs(speed_mps) >= _RESTS_MPS:
            self._quiet_ns = self._contradicted_ns = None
            return False
        self._quiet_ns = stamp_ns if self._quiet_ns is None else self._quiet_ns
        since_ns = self._contradicted_ns
        return since_ns is not None and stamp_ns - since_ns < _PAUSE_NS

    def add_believed(self, stamp_ns: int, now_ns: int, speed_mps: float, motion: Motion) -> None:
        """Take the pace of a reading that is believed and not stuck, and the motion it tells."""
        self.way.go(stamp_ns, motion)
        goes_mps = _GOES_MPS
        if not self.nothing_moves:
            goes_mps = min(goes_mps, _GOES_SHARE * self._pull_mps)
        if abs(speed_mps) >= goes_mps:
            self._moves(now_ns)

    @property
    def _pull_mps(self) -> float:
        """The pace expected from all commands."""
        return pace_mps(self._pulled_mps) if self._pulled_mps else 0.0

    def add_command(self, wanted_mps: tuple[float, ...], now_ns: int) -> None:
        """Take the speeds that a command wants, and update speed and way expected from them."""
        before_ns = now_ns if self._commanded_ns is None else self._commanded_ns
        self._commanded_ns = now_ns
        gap_s = min(max(now_ns - before_ns, 0), _MAX_GAP_NS) / 1e9
        done = 1 - math.exp(-gap_s / self.time_constant_s)
        pulled_mps = self._pulled_mps or (0.0,) * len(wanted_mps)
        self._pulled_mps = tuple(
            part + done * (wanted - part)
            for part, wanted in zip(pulled_mps, wanted_mps, strict=True)
        )
        self._pulled_m += self._pull_mps * gap_s
        claims = self._claimed_ns is not None and now_ns - self._claimed_ns < _MAX_GAP_NS
        if self._moved_ns is None or not any(wanted_mps) or not claims:
            self._moved_ns, self._pulled_m = now_ns, 0.0
        if self._pulled_m >= _PULLS_M and now_ns - self._moved_ns >= _PULLS_NS:
            self.nothing_moves = True

    def is_frozen(
        self,
        camera: int,
        stamp_ns: int,
        now_ns: int,
        corners_px: Float[np.ndarray, "M 4 2"],
        visible: Bool[np.ndarray, " M"],
        sigma_px: float,
        due: Due,
    ) -> bool:
        """Whether a camera shows an old picture: its corners rest while the odometer goes.

        Args:
            corners_px: (M, 4, 2), finite where a marker is visible, (M,).
            sigma_px: sigma of the least certain corner.
            due: called where corners rest while the odometer goes.
        """
        rest = self._rests.get(camera)
        both = None if rest is None else rest.visible & visible
        if rest is None or both is None or not both.any():
            self._rests[camera] = self._rest(corners_px, visible, stamp_ns)
            return False
        sigma_px = max(sigma_px, _MIN_SIGMA_PX)
        with np.errstate(over="ignore"):  # corners may have any value
            seen_px = corners_px[both] - rest.corners_px[both]
        moved_px, noise_px = np.abs(seen_px).max(), max(_MOVED_PX, _MOVED_SIGMAS * sigma_px)
        if moved_px > noise_px:
            moved = self._moved(rest, self._rest(corners_px, visible, stamp_ns))
            self._rests[camera] = moved
            # In a long standstill noise rarely exceeds this bound, but not three times the bound.
            if moved.moves > 1 or moved_px > 3 * noise_px or not self.nothing_moves:
                self._moves(now_ns)
            return False
        self._claimed_ns = now_ns
        if rest.frozen:
            return True
        place = self.way.at(stamp_ns)
        on_another_way = place is not None and (rest.place is None or rest.way != self.way.number)
        if on_another_way or not 0 <= stamp_ns - rest.stamp_ns <= _REST_NS:
            self._rests[camera] = self._rest(corners_px, visible, stamp_ns)
            return False
        if place is None or rest.place is None:
            return False
        motion = between(rest.place, place)
        if self.way.length_m(motion) < _WAY_M or (quads_px := due(motion)) is None:
            return False
        due_px = (quads_px[1] - quads_px[0])[camera][both]
        rest.doubts = rest.doubts + 1 if _withheld(due_px, seen_px, sigma_px) else 0
        rest.frozen = rest.doubts >= _FROZEN_AFTER
        return rest.frozen

    def _rest(self, corners_px: np.ndarray, visible: np.ndarray, stamp_ns: int) -> _Rest:
        return _Rest(corners_px, visible, stamp_ns, self.way.at(stamp_ns), self.way.number)

    def _moved(self, before: _Rest, now: _Rest) -> _Rest:
        """Count a move of the corners, and note a contradiction if the odometer says it stands."""
        goes_on = 0 < now.stamp_ns - before.stamp_ns < _PAUSE_NS and before.moves > 0
        now.moves = before.moves + 1 if goes_on else 1
        now.moving_ns = before.moving_ns if goes_on else before.stamp_ns
        if self._quiet_ns is not None and now.stamp_ns < self._told_ns + _SLOW_NS:
            since_ns = max(now.moving_ns, self._quiet_ns + _SLOW_NS)
            pulled = self._pull_mps >= _GOES_MPS
            if (
                now.moves >= (_PULLED_MOVES if pulled else _MOVES)
                and now.stamp_ns - since_ns >= _MOVES_NS
            ):
                self._contradicted_ns = now.stamp_ns
        return now

    def _moves(self, now_ns: int) -> None:
        self.nothing_moves = False
        self._moved_ns, self._pulled_m = now_ns, 0.0


def _withheld(due_px: np.ndarray, seen_px: np.ndarray, sigma_px: float) -> bool:
    """Whether surely less than half of the expected shifts is seen."""
    with np.errstate(over="ignore", invalid="ignore"):
        squared_px2, along_px2 = float(np.sum(due_px**2)), float(np.sum(seen_px * due_px))
    if not 0 < squared_px2 < math.inf:
        return False
    share = along_px2 / squared_px2
    return share + _SHARE_SIGMAS * math.sqrt(2 / squared_px2) * sigma_px < _SHARE
