"""The rate that a gyro has told between two times; what it can't have told is left out."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.flags import Fault
from jaxnav.drive.gyro_track import GAP_NS, STUCK_AFTER, GyroTrack
from jaxnav.drive.interfaces import GyroReading

MS = 1_000_000
BEGIN_NS = 10**12
LIMIT_RADPS = 30.0


def told(track, rates, period_ms=10, begin_ms=0):
    """Readings at their own time; their faults together."""
    faults = Fault(0)
    for index, rate in enumerate(rates):
        stamp_ns = BEGIN_NS + (begin_ms + index * period_ms) * MS
        faults |= track.take([GyroReading(stamp_ns, rate)], stamp_ns + MS)
    return faults


def mean(track, begin_ms, end_ms):
    return track.mean_radps(BEGIN_NS + round(begin_ms * MS), BEGIN_NS + round(end_ms * MS))


def test_between_its_readings_the_rate_changes_evenly():
    track = GyroTrack(LIMIT_RADPS)
    assert told(track, [0.0, 1.0, 3.0, 3.5]) == Fault(0)
    assert mean(track, 0, 10) == pytest.approx(0.5)
    assert mean(track, 0, 20) == pytest.approx(1.25)
    assert mean(track, 5, 15) == pytest.approx((0.75 + 1.5) / 2)
    assert mean(track, 20, 40) == pytest.approx((3.25 + 3.5) / 2)  # the newest holds a while
    assert track.newest_ns == BEGIN_NS + 30 * MS


@given(st.integers(0, 2**31), st.floats(10, 250), st.floats(1, 100))
def test_it_is_the_turn_by_the_time(seed, begin_ms, length_ms):
    rng = np.random.default_rng(seed)
    rates = rng.normal(0, 0.2, 50)
    track = GyroTrack(LIMIT_RADPS)
    told(track, rates.tolist())
    times = np.linspace(begin_ms, begin_ms + length_ms, 20_001)
    expected = np.trapezoid(np.interp(times, 10.0 * np.arange(50), rates), times) / length_ms
    assert mean(track, begin_ms, begin_ms + length_ms) == pytest.approx(expected, abs=1e-3)


def test_nobody_knows_the_rate_before_long_after_or_across_a_hole():
    track = GyroTrack(LIMIT_RADPS)
    assert math.isnan(mean(track, 0, 10))
    told(track, [1.0] * 3)
    assert math.isnan(mean(track, -5, 10))
    assert math.isnan(mean(track, 10, 10))
    assert math.isnan(mean(track, 10, 20 + GAP_NS / MS + 1))
    told(track, [1.0] * 3, begin_ms=120)
    assert math.isnan(mean(track, 10, 130))
    assert math.isnan(mean(track, 60, 130))
    assert mean(track, 120, 140) == pytest.approx(1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, LIMIT_RADPS, -40.0])
def test_a_reading_that_is_no_rate_is_a_hole(bad):
    track = GyroTrack(LIMIT_RADPS)
    assert told(track, [1.0, 1.5, bad]) == Fault.GYRO_INVALID
    assert mean(track, 0, 10) == pytest.approx(1.25)
    assert math.isnan(mean(track, 10, 15))
    assert told(track, [1.5, 1.0], begin_ms=30) == Fault(0)
    assert math.isnan(mean(track, 10, 40))
    assert mean(track, 30, 40) == pytest.approx(1.25)


def test_of_a_gyro_without_a_limit_no_rate_is_beyond_what_turns():
    track = GyroTrack(math.inf)
    assert told(track, [1.0, 1e30]) == Fault.GYRO_INVALID
    assert told(track, [999.0], begin_ms=30) == Fault(0)


def test_one_that_repeats_itself_is_stuck_and_one_that_stands_at_zero_is_not():
    track = GyroTrack(LIMIT_RADPS)
    assert told(track, [0.0] * 2 * STUCK_AFTER) == Fault(0)
    assert told(track, [0.1] * STUCK_AFTER, begin_ms=1000) == Fault(0)
    assert told(track, [0.1], begin_ms=1000 + 10 * STUCK_AFTER) == Fault.GYRO_INVALID
    assert told(track, [0.11], begin_ms=1010 + 10 * STUCK_AFTER) == Fault(0)


@pytest.mark.parametrize("off_ms", [0, -5, -2000, 500])
def test_a_stamp_that_can_not_be_is_refused(off_ms):
    track = GyroTrack(LIMIT_RADPS)
    told(track, [1.0, 1.5, 2.0])
    reading = GyroReading(BEGIN_NS + (20 + off_ms) * MS, 9.0)
    assert track.take([reading], BEGIN_NS + 30 * MS) == Fault.STAMP_INVALID
    assert mean(track, 0, 20) == pytest.approx(1.5)


def test_the_clock_of_a_gyro_may_jump():
    track = GyroTrack(LIMIT_RADPS)
    told(track, [1.0, 1.5])
    faults = Fault(0)
    for index in range(20):
        now_ns = BEGIN_NS + (20 + 10 * index) * MS
        faults |= track.take([GyroReading(now_ns - 100_000 * MS, 1.0 + 0.1 * index)], now_ns)
    assert faults == Fault.STAMP_INVALID | Fault.CLOCK_JUMPED
    assert mean(track, 190, 210) == pytest.approx(2.8, abs=0.11)


@given(
    st.lists(st.tuples(st.integers(-(2**62), 2**62) | st.integers(-(10**9), 10**9), st.floats()))
)
def test_whatever_is_told_it_never_raises_and_a_rate_is_below_the_limit(readings):
    track = GyroTrack(LIMIT_RADPS)
    for off_ns, rate in readings:
        track.take([GyroReading(BEGIN_NS + off_ns, rate)], BEGIN_NS)
    for begin_ms in (-100, -5):
        rate = mean(track, begin_ms, 10)
        assert math.isnan(rate) or abs(rate) < LIMIT_RADPS
