"""What a gyro has told of the last moments, and whether it contradicts wheels and corners.

A filter goes from event to event, and an event that comes late makes two intervals of one: so it is
told the mean rate of any interval, from rates at the gyro's own stamps, between which the rate is
taken to change evenly. Where a reading is missing, saturated or no number nothing is told, and the
filter goes on by wheels and corners.

Where the gyro and the wheels differ, the corners decide who is wrong, and where no marker is seen
the command does. What differs beyond the errors of all of them is summed and slowly forgotten.
"""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from jaxnav.core.models.imu import Gyro
from jaxnav.drive.actuation import Apart, Reach
from jaxnav.drive.chassis import Chassis, Motion
from jaxnav.drive.flags import Fault
from jaxnav.drive.interfaces import GyroReading
from jaxnav.drive.limits import Command
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

# Six degrees, a tenth of a rad for each metre of wheels that are 3 % apart, and what a turn's own
# gain may be off by (tracks slide).
_MARGIN_RAD, _SLACK_RADPM, _SHARE = 0.1, 0.1, 0.15
_CLEARLY = 2.0  # so much farther from the third than the wheels are
_FORGETS_S = 2.0
_SIGMAS = 3.0  # of the gyro's bias
_APART_NS = 300_000_000  # after a longer gap nothing is compared
_SEEN_NS = 300_000_000  # after a fix; then the command is the third


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


class TurnVotes:
    """The gyro of one drive, and the votes on its turn.

    Attributes:
        track: its readings.
        gyro_is_wrong: for the rest of the drive: it was contradicted.
    """

    def __init__(self, chassis: Chassis, gyro: Gyro):
        self.gyro_is_wrong = False
        self._chassis, self.track = chassis, GyroTrack(float(gyro.saturation_radps))
        self._bias_radps = _SIGMAS * float(gyro.bias_sigma_radps)
        self._part = chassis.parts[-1]
        self._reach = Reach(self._part.lag_s, self._part.factor)
        self._gyro_wheels, self._gyro_corners, self._wheels_corners = Apart(), Apart(), Apart()
        self._gyro_command, self._wheels_command = Apart(), Apart()
        self._reading: tuple[int, Motion] | None = None
        self._fix: tuple[int, float] | None = None
        self._wheels_rad = self._way_m = 0.0  # since the last fix

    def mean_radps(self, begin_ns: int, end_ns: int) -> float:
        """What the gyro tells of the interval between two times, rad/s; NaN: nothing, or wrong."""
        return math.nan if self.gyro_is_wrong else self.track.mean_radps(begin_ns, end_ns)

    def add_command(self, command: Command, gap_s: float) -> None:
        """Take the command that was in force for a time."""
        self._reach.go(self._chassis.targets(command)[-1], gap_s)

    def add_reading(self, now_ns: int, motion: Motion) -> None:
        """Hold the gyro against a reading of the odometer."""
        last, self._reading = self._reading, (now_ns, motion)
        if last is None or not 0 < now_ns - last[0] <= _APART_NS:
            return
        gap_s = (now_ns - last[0]) / 1e9
        turned_rad, way_m = motion.turn_radps * gap_s, motion.forward_mps * gap_s
        self._wheels_rad += turned_rad
        self._way_m += abs(way_m)
        gyro_rad = self.track.mean_radps(last[0], now_ns) * gap_s
        if not math.isfinite(gyro_rad):
            return
        share_rad = _SHARE * max(abs(turned_rad), abs(gyro_rad))
        kept = math.exp(-gap_s / _FORGETS_S)
        slack_rad = _SLACK_RADPM * abs(way_m)
        bias_rad = self._bias_radps * gap_s
        per = way_m if self._part.by_way else gap_s
        least, most = sorted((per * self._reach.least, per * self._reach.most))
        for apart, rad, slack in (
            (self._gyro_command, gyro_rad, slack_rad + bias_rad),
            (self._wheels_command, turned_rad, slack_rad),
        ):
            apart.add(rad - most, rad - least, slack, kept)
        off_rad = gyro_rad - turned_rad
        self._gyro_wheels.add(off_rad, off_rad, share_rad + slack_rad + bias_rad, kept)
        if self._gyro_wheels.most > _MARGIN_RAD and not self.gyro_is_wrong:
            seen = self._fix is not None and now_ns - self._fix[0] < _SEEN_NS
            gyro, wheels = (
                (self._gyro_corners, self._wheels_corners)
                if seen
                else (self._gyro_command, self._wheels_command)
            )
            self.gyro_is_wrong = gyro.most > max(_MARGIN_RAD / 2, _CLEARLY * wheels.most)

    def add_fix(self, now_ns: int, psi_rad: float) -> None:
        """Hold the gyro and the wheels against a heading by the corners."""
        last, self._fix = self._fix, (now_ns, psi_rad)
        wheels_rad, self._wheels_rad = self._wheels_rad, 0.0
        way_m, self._way_m = self._way_m, 0.0
        if last is None or not 0 < now_ns - last[0] <= _APART_NS:
            return
        gap_s = (now_ns - last[0]) / 1e9
        turned_rad = math.remainder(psi_rad - last[1], math.tau)
        gyro_rad = self.track.mean_radps(last[0], now_ns) * gap_s
        slack_rad = _SHARE * abs(turned_rad)
        kept = math.exp(-gap_s / _FORGETS_S)
        off_rad = wheels_rad - turned_rad
        self._wheels_corners.add(off_rad, off_rad, slack_rad + _SLACK_RADPM * way_m, kept)
        if math.isfinite(gyro_rad):
            off_rad = gyro_rad - turned_rad
            self._gyro_corners.add(off_rad, off_rad, slack_rad + self._bias_radps * gap_s, kept)

    def forget(self) -> None:
        """The next heading follows from no earlier one: the filter has begun anew."""
        self._fix = None
