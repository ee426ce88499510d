"""Keep the vehicle's way of the last 1.5 s by odometry alone, whatever the estimate."""

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, field

Place = tuple[float, float, float]  # x_m, y_m, psi_rad

_KEPT_NS = 1_500_000_000  # more than the age of the oldest frame that is taken, see `stamps`
_PAUSE_NS = 250_000_000  # without a reading for this long the way is unknown
_AHEAD_NS = 100_000_000  # the newest reading is extrapolated for this long: it is not stale yet


@dataclass
class Way:
    """Dead reckoning in a frame of its own."""

    wheelbase_m: float
    number: int = 0  # of the way: places on different ways can't be compared
    _track: deque[tuple[int, Place]] = field(default_factory=deque)
    _speed_mps: float = 0.0
    _steering_rad: float = 0.0

    def go(self, stamp_ns: int, speed_mps: float, steering_rad: float) -> None:
        """Take a reading; a late one is left out, and after a pause a new way begins."""
        if self._track and not 0 < stamp_ns - self._track[-1][0] <= _PAUSE_NS:
            if stamp_ns <= self._track[-1][0]:
                return
            self._track.clear()
            self.number += 1
        self._speed_mps, self._steering_rad = speed_mps, steering_rad
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
        """The place extrapolated from the newest reading (see `bicycle.velocity_world`)."""
        before_ns, (x_m, y_m, psi_rad) = self._track[-1]
        tangent = math.tan(self._steering_rad)
        beta_rad = math.atan(tangent / 2)
        gone_m = self._speed_mps * (stamp_ns - before_ns) / 1e9
        turned_rad = gone_m * math.cos(beta_rad) * tangent / self.wheelbase_m
        course_rad = psi_rad + beta_rad + turned_rad / 2
        return (
            x_m + gone_m * math.cos(course_rad),
            y_m + gone_m * math.sin(course_rad),
            psi_rad + turned_rad,
        )


def between(place: Place, other: Place) -> Place:
    """The other place relative to the first, in the first one's axes."""
    x_m, y_m = other[0] - place[0], other[1] - place[1]
    c, s = math.cos(place[2]), math.sin(place[2])
    return c * x_m + s * y_m, c * y_m - s * x_m, other[2] - place[2]
