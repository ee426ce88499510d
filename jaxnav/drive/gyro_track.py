"""Keep what a gyro has told of the last moments, and say how fast the vehicle turned meanwhile.

    faults = track.take(readings, now_ns)
    track.mean_radps(begin_ns, end_ns)      # NaN: not known

A filter goes from event to event, and an event that comes late makes two intervals of one: so it is
told the mean rate of any interval, from rates at the gyro's own stamps, between which the rate is
taken to change evenly. Where a reading is missing, saturated or no number nothing is told, and the
filter goes on by wheels and corners.
"""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from jaxnav.drive.flags import Fault
from jaxnav.drive.interfaces import GyroReading
from jaxnav.drive.stamps import Stamps
from jaxnav.files.ranges import RANGES

# Readings farther apart leave a hole; so long the newest one holds. A turn may begin meanwhile: at
# 5 rad/s^2 it is 6 mrad.
GAP_NS = 50_000_000
_MOST_RADPS = RANGES["turn_radps"].most
_KEPT_NS = 1_500_000_000  # more than the age of the oldest event that is fused, see `stamps`
STUCK_AFTER = 25  # readings to the last bit alike, other than zero: a sensor's noise is never so
# White noise of as many, which a sensor of cars has fifty times less of, and the most that a single
# bend counts for: a single odd reading makes three, and is not yet noise.
_NOISE_RADPS, _MOST_BEND_RADPS = 0.3, 0.8


class _Sample(NamedTuple):
    stamp_ns: int
    turn_radps: float
    turned_rad: float  # since the begin of its part
    part: int  # of the track, between two holes


class GyroTrack:
    """The readings of one drive's gyro. A late one is left out."""

    def __init__(self, saturation_radps: float):
        """Args:
        saturation_radps: a reading at this limit or beyond tells nothing.
        """
        self._saturation_radps = saturation_radps
        self._stamps = Stamps()
        self._samples: deque[_Sample] = deque()
        self._newest_ns: int | None = None  # of all that was told, usable or not
        self._part = 0
        self._raw_radps, self._alike = math.nan, 0
        self._before_radps, self._noise_rad2ps2 = math.nan, 0.0

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest reading that was a rate; None before the first."""
        return self._samples[-1].stamp_ns if self._samples else None

    def take(self, readings: Sequence[GyroReading], now_ns: int) -> Fault:
        """Take readings in the order of their stamps; return their faults."""
        faults = Fault(0)
        for reading in readings:
            faults |= self._take(reading, now_ns)
        return faults

    def mean_radps(self, begin_ns: int, end_ns: int) -> float:
        """The mean turn rate between two times, rad/s; NaN where it is not known."""
        begin, end = self._at(begin_ns), self._at(end_ns)
        if begin is None or end is None or begin.part != end.part or end_ns <= begin_ns:
            return math.nan
        return (end.turned_rad - begin.turned_rad) / ((end_ns - begin_ns) / 1e9)

    def _take(self, reading: GyroReading, now_ns: int) -> Fault:
        jumps = self._stamps.jumps
        stamp_ns = self._stamps.take(reading.stamp_ns, now_ns)
        if stamp_ns is None or (self._newest_ns is not None and stamp_ns <= self._newest_ns):
            return Fault.STAMP_INVALID
        faults = Fault.CLOCK_JUMPED if self._stamps.jumps > jumps else Fault(0)
        self._newest_ns = stamp_ns
        if not self._is_rate(float(reading.turn_radps)):
            self._part += 1
            return faults | Fault.GYRO_INVALID
        last = self._samples[-1] if self._samples else None
        if last is None or stamp_ns - last.stamp_ns > GAP_NS:
            self._part += 1
        turned_rad = 0.0
        if last is not None and last.part == self._part:
            mean_radps = (last.turn_radps + reading.turn_radps) / 2
            turned_rad = last.turned_rad + mean_radps * (stamp_ns - last.stamp_ns) / 1e9
        self._samples.append(_Sample(stamp_ns, reading.turn_radps, turned_rad, self._part))
        while self._samples[0].stamp_ns < stamp_ns - _KEPT_NS:
            self._samples.popleft()
        return faults

    def _is_rate(self, turn_radps: float) -> bool:
        """Whether a reading is a rate: one that can be, below the limit, and not stuck."""
        alike = turn_radps == self._raw_radps and turn_radps != 0
        self._alike = self._alike + 1 if alike else 0
        # (1, -2, 1) of white noise of sigma s has the variance 6 s^2.
        bend_radps = (turn_radps - 2 * self._raw_radps + self._before_radps) / math.sqrt(6)
        if math.isfinite(bend_radps):
            bend_radps = min(abs(bend_radps), _MOST_BEND_RADPS)
            self._noise_rad2ps2 += (bend_radps**2 - self._noise_rad2ps2) / STUCK_AFTER
        self._raw_radps, self._before_radps = turn_radps, self._raw_radps
        is_smooth = self._noise_rad2ps2 < _NOISE_RADPS**2
        is_alive = self._alike < STUCK_AFTER
        is_within = abs(turn_radps) < min(self._saturation_radps, _MOST_RADPS)
        return is_within and is_alive and is_smooth

    def _at(self, stamp_ns: int) -> _Sample | None:
        """The track at a time, interpolated, or held after its newest reading; None: not known."""
        samples = self._samples
        if not samples or stamp_ns < samples[0].stamp_ns:
            return None
        index = bisect_right(samples, stamp_ns, key=lambda sample: sample.stamp_ns) - 1
        before = samples[index]
        gap_s = (stamp_ns - before.stamp_ns) / 1e9
        if not gap_s:
            return before
        if index + 1 < len(samples):
            after = samples[index + 1]
            if after.part != before.part:
                return None
            slope = (after.turn_radps - before.turn_radps) / (after.stamp_ns - before.stamp_ns)
            turn_radps = before.turn_radps + slope * (stamp_ns - before.stamp_ns)
        elif before.part == self._part and stamp_ns - before.stamp_ns <= GAP_NS:
            turn_radps = before.turn_radps
        else:
            return None
        turned_rad = before.turned_rad + (before.turn_radps + turn_radps) / 2 * gap_s
        return _Sample(stamp_ns, turn_radps, turned_rad, before.part)
