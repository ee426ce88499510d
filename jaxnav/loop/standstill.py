"""Who stands still while others move: a frozen camera, a stuck odometer, a vehicle that is held.

    corners rest, the odometer goes             the camera shows an old picture
    corners move, the odometer rests            the odometer is stuck
    neither moves, and the throttle pulls       both are, or the vehicle is held

A camera is judged by the share of its due that it shows: with d the shifts of the corners that the
odometer's way makes due, and s those that are seen,

    share = <s, d> / <d, d>,      sigma of it = sqrt(2) sigma_px / |d|.

A marker far ahead on the axis of motion has no due, and so raises no alarm; neither does a vehicle
that stands. In the third case nothing tells where it goes: it may be blind, held fast, or without
power. Whether it can go again is not tried, for it might go blind: it stays so until something
moves, a vehicle that is pushed say. Senses that tell nothing are stale, and others' concern.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from jaxnav.loop.way import Place, Way, between

# The corners due by a motion (x_m, y_m, psi_rad, in the vehicle's earlier axes): places before and
# after it, (C, M, 4, 2) each; None: it is not known where the vehicle is.
Due = Callable[[Place], tuple[np.ndarray, np.ndarray] | None]

_MOVED_PX, _MOVED_SIGMAS = 1.0, 6.0  # more than noise makes of any of the corners of some markers
_MIN_SIGMA_PX = 0.05  # detectors promise less, models of lenses do not keep it
# A camera that looks 100 ms late, which nobody has told, hides 5 cm at 0.5 m/s, half of this.
_WAY_M = 0.1
_SHARE, _SHARE_SIGMAS = 0.5, 3.0
_FROZEN_AFTER = 3  # such frames in a row
# Corners that rest are compared for so long: 0.1 m in 5 s are twice the odometry's sigma in the
# filter, which is that of a reading, not of all of them.
_REST_NS = 5_000_000_000

_RESTS_MPS = 0.02  # an odometer that stands says less: twice the same sigma
_SLOW_NS = 100_000_000  # after it has stopped: frames may be late, whatever they say
_MOVES, _MOVES_NS = 3, 300_000_000  # so often and so long: no single push, no marker that is moved
_PAUSE_NS = 1_000_000_000  # between two moves of one motion

# Without a marker and without odometry it stops after 1 s (see `health`): nothing tells
# where it goes then either. A motor takes less to start, and what is meant to go less far stands.
_PULLS_NS, _PULLS_M = 1_000_000_000, 0.2
_MAX_GAP_NS = 200_000_000  # without a command the watchdog stops it then, and cameras are stale
_GOES_MPS, _GOES_SHARE = 0.05, 0.25  # five sigmas of the odometer; of the speed that is pulled for


@dataclass
class _Rest:
    """Corners of one camera that have not moved since."""

    corners_px: np.ndarray  # (M, 4, 2)
    visible: np.ndarray  # (M,)
    stamp_ns: int
    place: Place | None  # by the odometer
    way: int  # number of the way that the place is on
    moves: int = 0  # that led here one after the other
    moving_ns: int = 0  # since when
    doubts: int = 0  # frames in a row that show less than their due
    frozen: bool = False


@dataclass
class Standstill:
    """Of one drive.

    Attributes:
        nothing_moves: the throttle pulls, and neither wheels nor corners move.
    """

    way: Way
    speed_per_throttle_mps: float
    time_constant_s: float
    nothing_moves: bool = False
    _rests: dict[int, _Rest] = field(default_factory=dict)
    _quiet_ns: int | None = None  # since when the odometer says that it stands
    _told_ns: int = 0  # stamp of the last reading, believed or not
    _contradicted_ns: int | None = None  # stamp of the last corners that moved meanwhile
    _pulled_mps: float = 0.0
    _pulled_m: float = 0.0  # since something moved
    _moved_ns: int | None = None  # when that was
    _commanded_ns: int | None = None
    _claimed_ns: int | None = None  # when a sense last told anything

    def read(self, stamp_ns: int, now_ns: int, speed_mps: float) -> bool:
        """A reading, whatever is thought of it: whether corners move while it says it stands."""
        self._claimed_ns = now_ns
        self._told_ns = max(stamp_ns, self._told_ns)
        if abs(speed_mps) >= _RESTS_MPS:
            self._quiet_ns = self._contradicted_ns = None
            return False
        self._quiet_ns = stamp_ns if self._quiet_ns is None else self._quiet_ns
        since_ns = self._contradicted_ns
        return since_ns is not None and stamp_ns - since_ns < _PAUSE_NS

    def went(self, stamp_ns: int, now_ns: int, speed_mps: float, steering_rad: float) -> None:
        """A reading that is believed, and is not always the same."""
        self.way.go(stamp_ns, speed_mps, steering_rad)
        goes_mps = _GOES_MPS
        if not self.nothing_moves:
            goes_mps = min(goes_mps, _GOES_SHARE * abs(self._pulled_mps))
        if abs(speed_mps) >= goes_mps:
            self._moves(now_ns)

    def commanded(self, throttle: float, now_ns: int) -> None:
        """What the motor is told now: how fast the vehicle should be after what it was told."""
        before_ns = now_ns if self._commanded_ns is None else self._commanded_ns
        self._commanded_ns = now_ns
        gap_s = min(max(now_ns - before_ns, 0), _MAX_GAP_NS) / 1e9
        target_mps = throttle * self.speed_per_throttle_mps
        done = 1 - math.exp(-gap_s / self.time_constant_s)
        self._pulled_mps += done * (target_mps - self._pulled_mps)
        self._pulled_m += abs(self._pulled_mps) * gap_s
        claims = self._claimed_ns is not None and now_ns - self._claimed_ns < _MAX_GAP_NS
        if self._moved_ns is None or throttle == 0 or not claims:
            self._moved_ns, self._pulled_m = now_ns, 0.0
        if self._pulled_m >= _PULLS_M and now_ns - self._moved_ns >= _PULLS_NS:
            self.nothing_moves = True

    def frozen(
        self,
        camera: int,
        stamp_ns: int,
        now_ns: int,
        corners_px: np.ndarray,
        visible: np.ndarray,
        sigma_px: float,
        due: Due,
    ) -> bool:
        """Whether a camera shows what it should not see any more.

        Args:
            corners_px: (M, 4, 2), finite where a marker is visible, (M,).
            sigma_px: of the least certain.
            due: asked where corners rest while the odometer goes.
        """
        rest = self._rests.get(camera)
        both = None if rest is None else rest.visible & visible
        if rest is None or both is None or not both.any():
            self._rests[camera] = self._rest(corners_px, visible, stamp_ns)
            return False
        sigma_px = max(sigma_px, _MIN_SIGMA_PX)
        with np.errstate(over="ignore"):  # whatever a camera says
            seen_px = corners_px[both] - rest.corners_px[both]
        moved_px, noise_px = np.abs(seen_px).max(), max(_MOVED_PX, _MOVED_SIGMAS * sigma_px)
        if moved_px > noise_px:
            moved = self._moved(rest, self._rest(corners_px, visible, stamp_ns))
            self._rests[camera] = moved
            # Where it stands for long, noise goes far once in a while, but not three times as far.
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
        if math.hypot(motion[0], motion[1]) < _WAY_M or (quads_px := due(motion)) is None:
            return False
        due_px = (quads_px[1] - quads_px[0])[camera][both]
        rest.doubts = rest.doubts + 1 if _withheld(due_px, seen_px, sigma_px) else 0
        rest.frozen = rest.doubts >= _FROZEN_AFTER
        return rest.frozen

    def _rest(self, corners_px: np.ndarray, visible: np.ndarray, stamp_ns: int) -> _Rest:
        return _Rest(corners_px, visible, stamp_ns, self.way.at(stamp_ns), self.way.number)

    def _moved(self, before: _Rest, now: _Rest) -> _Rest:
        """Corners that have moved: for how long already, and whether the odometer knows of it."""
        goes_on = 0 < now.stamp_ns - before.stamp_ns < _PAUSE_NS and before.moves > 0
        now.moves = before.moves + 1 if goes_on else 1
        now.moving_ns = before.moving_ns if goes_on else before.stamp_ns
        if self._quiet_ns is not None and now.stamp_ns < self._told_ns + _SLOW_NS:
            since_ns = max(now.moving_ns, self._quiet_ns + _SLOW_NS)
            if now.moves >= _MOVES and now.stamp_ns - since_ns >= _MOVES_NS:
                self._contradicted_ns = now.stamp_ns
        return now

    def _moves(self, now_ns: int) -> None:
        self.nothing_moves = False
        self._moved_ns, self._pulled_m = now_ns, 0.0


def _withheld(due_px: np.ndarray, seen_px: np.ndarray, sigma_px: float) -> bool:
    """Whether surely less than half is seen of the shifts that are due."""
    with np.errstate(over="ignore", invalid="ignore"):
        squared_px2, along_px2 = float(np.sum(due_px**2)), float(np.sum(seen_px * due_px))
    if not 0 < squared_px2 < math.inf:
        return False
    share = along_px2 / squared_px2
    return share + _SHARE_SIGMAS * math.sqrt(2 / squared_px2) * sigma_px < _SHARE
