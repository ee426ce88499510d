"""The rate that a gyro has told between two times: what it can't have told is left out, and where
wheels and corners agree against it, it is named."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.chassis import Motion
from jaxnav.drive.flags import Fault
from jaxnav.drive.gyro import GAP_NS, STUCK_AFTER, GyroTrack, TurnVotes
from jaxnav.drive.interfaces import GyroReading
from tests.drive.test_actuation import CAR, DIFFERENTIAL, PERIOD_NS, Truth, commands

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


@pytest.mark.parametrize(
    ("bad", "limit_radps"), [(math.nan, LIMIT_RADPS), (LIMIT_RADPS, LIMIT_RADPS), (1e30, math.inf)]
)
def test_a_reading_that_is_no_rate_is_a_hole(bad, limit_radps):
    track = GyroTrack(limit_radps)
    assert told(track, [1.0, 1.5, bad]) == Fault.GYRO_INVALID
    assert mean(track, 0, 10) == pytest.approx(1.25)
    assert math.isnan(mean(track, 10, 15))
    assert told(track, [1.5, 1.0], begin_ms=30) == Fault(0)
    assert math.isnan(mean(track, 10, 40))
    assert mean(track, 30, 40) == pytest.approx(1.25)


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


BIAS_RADPS = 0.01
SOUND = "sound"
LIES = {
    "stuck at 0": lambda rate: 0.0,
    "of the wrong sign": lambda rate: -rate,
    "in degrees": math.degrees,
}


def votes_on(chassis, mean_radps) -> TurnVotes:
    """Those on a gyro that tells this."""
    gyro = SimpleNamespace(saturation_radps=LIMIT_RADPS, bias_sigma_radps=BIAS_RADPS)
    votes = TurnVotes(chassis, gyro)
    votes.track = SimpleNamespace(mean_radps=mean_radps)
    return votes


def drive(chassis, seed, duration_s, lie=SOUND, dark=lambda time_s: False, turns=1.0):
    """The way until the gyro is named, inf: never.

    Args:
        dark: when no marker is seen.
        turns: what the wheels multiply the turn by.
    """
    rng = np.random.default_rng(seed)
    truth, commanded = Truth(chassis, rng), commands(chassis, rng)
    rates: dict[int, float] = {}
    votes = votes_on(chassis, lambda begin_ns, end_ns: mean_of(rates, begin_ns, end_ns))
    bias, scale = BIAS_RADPS * rng.uniform(-2, 2), rng.uniform(0.97, 1.03)
    wheels = turns * rng.uniform(0.95, 1.05)
    for index in range(int(duration_s * 30)):
        now_ns, gap_s, command = index * PERIOD_NS, PERIOD_NS / 1e9, next(commanded)
        before = truth.pose[2]
        fix = truth.go(command, gap_s)
        rate = (truth.pose[2] - before) / gap_s
        read = rate if lie == SOUND else LIES[lie](rate)
        rates[index] = scale * read + bias + 0.02 * rng.standard_normal()
        votes.add_command(command, gap_s)
        moved = np.array(truth.rates)
        if chassis is CAR:
            moved = np.array([truth.rates[0], 0.0, 0.0])
        moved[2] = wheels * rate + 0.02 * moved[0]
        votes.add_reading(now_ns, Motion(*moved.tolist()))
        if not dark(now_ns / 1e9):
            votes.add_fix(now_ns, fix.psi_rad)
        if votes.gyro_is_wrong:
            return truth.way_m
    return math.inf


def mean_of(rates, begin_ns, end_ns):
    between = range(begin_ns // PERIOD_NS + 1, end_ns // PERIOD_NS + 1)
    return float(np.mean([rates[index] for index in between]))


BOTH = pytest.mark.parametrize("chassis", [CAR, DIFFERENTIAL], ids=["car", "base"])


@BOTH
@pytest.mark.parametrize("turns", [1.0, 1.5, -1.0], ids=["sound", "sliding", "reversed"])
def test_a_sound_gyro_is_never_named(chassis, turns):
    """Whatever the wheels tell, with the marker in view; without one, while they are sound."""
    gap = (lambda s: False) if turns < 0 else (lambda s: 4.0 < s < 8.0)
    ways_m = [drive(chassis, seed, 12.0, dark=gap, turns=turns) for seed in range(10)]
    assert ways_m == [math.inf] * 10


@BOTH
@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("dark", [False, True], ids=["seeing", "blind"])
def test_one_that_lies_is_named(chassis, lie, dark):
    ways_m = [drive(chassis, seed, 10.0, lie, lambda s: dark) for seed in range(10)]
    assert max(ways_m) < (1.5 if dark else 1.0)


def test_it_takes_more_than_a_little_to_blame_a_gyro():
    """Blind, while the wheels count too much and the vehicle turns hardly less than it might."""
    least = 1 / DIFFERENTIAL.parts[-1].factor
    votes = votes_on(DIFFERENTIAL, lambda begin_ns, end_ns: 0.93 * least)
    for index in range(40):
        votes.add_command((0.0, 0.0, 1.0), PERIOD_NS / 1e9)
        votes.add_reading(index * PERIOD_NS, Motion(0.0, 0.0, 1.3))
    assert votes._gyro_wheels.most > 0.1
    assert not votes.gyro_is_wrong
