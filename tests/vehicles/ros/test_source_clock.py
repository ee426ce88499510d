"""The times of messages: stamps of this clock are believed, others are times of arrival."""

import time
from types import SimpleNamespace

import pytest

from jaxnav.vehicles.ros.source_clock import SourceClock, SteadyOffset

ROS_NS = 10**18  # ROS's clock less the monotonic one


@pytest.fixture
def offset():
    return SteadyOffset(lambda: time.monotonic_ns() + ROS_NS)


def stamp(time_ns: int) -> SimpleNamespace:
    """A ROS stamp of a time on the monotonic clock."""
    stamped_ns = time_ns + ROS_NS
    return SimpleNamespace(sec=stamped_ns // 10**9, nanosec=stamped_ns % 10**9)


def test_a_stamp_of_this_clock_is_its_time_however_often_it_comes(offset):
    clock, at_ns = SourceClock(offset), time.monotonic_ns() - 30_000_000
    taken = {clock.time_ns(stamp(at_ns)) for _ in range(50)}
    assert len(taken) == 1
    assert taken.pop() == pytest.approx(at_ns, abs=1_000_000)


@pytest.mark.parametrize("jump_ns", [-(10**9) - 10**7, -(10**10), 10**9])
def test_a_source_that_was_believed_stays_so_when_its_stamps_jump(offset, jump_ns):
    clock, now_ns = SourceClock(offset), time.monotonic_ns()
    clock.time_ns(stamp(now_ns))
    assert clock.time_ns(stamp(now_ns + jump_ns)) == pytest.approx(now_ns + jump_ns, abs=2_000_000)


def test_another_clock_s_stamps_are_times_of_arrival_and_repeats_stay_repeats(offset):
    clock, other_ns = SourceClock(offset), time.monotonic_ns() - 60 * 10**9
    before_ns = time.monotonic_ns()
    first_ns = clock.time_ns(stamp(other_ns))
    assert before_ns <= first_ns <= time.monotonic_ns()
    assert clock.time_ns(stamp(other_ns)) == first_ns
    assert clock.time_ns(stamp(other_ns + 10**7)) > first_ns
    missing = [clock.time_ns(SimpleNamespace(sec=0, nanosec=0)) for _ in range(2)]
    assert first_ns < missing[0] < missing[1]


def test_a_clock_that_was_set_is_believed_after_a_while(offset):
    clock = SourceClock(offset)
    clock.time_ns(stamp(time.monotonic_ns() - 60 * 10**9))
    late_ns = 50_000_000
    for _ in range(10):
        at_ns = time.monotonic_ns() - late_ns
        taken_ns = clock.time_ns(stamp(at_ns))
    assert taken_ns == pytest.approx(at_ns, abs=1_000_000)


def test_when_ros_s_clock_is_set_its_stamps_go_along():
    ahead_ns = [ROS_NS]
    offset = SteadyOffset(lambda: time.monotonic_ns() + ahead_ns[0])
    clock, now_ns = SourceClock(offset), time.monotonic_ns()
    clock.time_ns(stamp(now_ns))
    ahead_ns[0] += 10**9
    assert clock.time_ns(stamp(now_ns + 10**9)) == pytest.approx(now_ns, abs=2_000_000)


def test_on_ros_s_own_time_a_stamp_is_what_it_says():
    assert SourceClock(None).time_ns(SimpleNamespace(sec=7, nanosec=5)) == 7 * 10**9 + 5
