"""The guard of a base that is driven by a twist: its last word is zero, in all three parts."""

import math
import os
import signal
import time

import pytest

from jaxnav.drive.guard import Guard
from jaxnav.drive.interfaces import TwistOdometry
from jaxnav.drive.limits import TwistLimits
from jaxnav.drive.moved_vehicle import GuardProcess
from tests.helpers import plain_base
from tests.helpers.plain_base import PlainBase, make_setup, words
from tests.helpers.plain_car import wait_for
from tests.helpers.processes import python

LIMITS = TwistLimits(forward_mps=1.0, left_mps=0.5, turn_radps=3.0)
ZERO = (0.0, 0.0, 0.0)
DRIVES = """
import sys, time
from tests.helpers import plain_base
from jaxnav.drive.guard import Guard
from jaxnav.drive.limits import TwistLimits
from jaxnav.drive.moved_vehicle import GuardProcess
limits = TwistLimits(1.0, 0.0, 3.0)
guarding = GuardProcess(plain_base.NAME)
guarding.prepare(lambda: None)
vehicle = guarding.open(plain_base.make_setup(log=sys.argv[1]), limits, 0.2)
guard = Guard(vehicle, limits)
guard.arm()
print("drives", flush=True)
while True:
    vehicle.read()
    guard.write(0.0, 0.0, 2.0)
    time.sleep(0.02)
"""


@pytest.fixture
def guard(tmp_path):
    guard = Guard(PlainBase(make_setup(log=tmp_path / "log")), LIMITS)
    yield guard
    guard.close()


def last(tmp_path) -> tuple[float, float, float] | None:
    """What the base was told last, None before its first word."""
    told = words(tmp_path / "log")
    return told[-1].twist if told else None


def test_before_it_is_armed_it_stands_and_then_it_is_cut_at_its_limits(tmp_path, guard):
    assert guard.write(1.0, 0.5, 2.0)
    assert last(tmp_path) == ZERO
    guard.arm()
    assert guard.write(9.0, -9.0, -9.0)
    assert last(tmp_path) == (1.0, -0.5, -3.0)
    wait_for(lambda: last(tmp_path) == ZERO)  # for want of a fresh command
    assert guard.tripped


@pytest.mark.parametrize(("part", "value"), [(0, math.nan), (1, math.inf), (2, math.nan)])
def test_one_part_that_is_no_number_stops_all_for_good(tmp_path, guard, part, value):
    guard.arm()
    guard.write(0.5, 0.0, 2.0)
    command = [0.5, 0.0, 2.0]
    command[part] = value
    for told in (command, [0.5, 0.0, 2.0]):
        assert not guard.write(*told)
        assert last(tmp_path) == ZERO
    assert "the command was no number" in guard.reason


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_however_the_process_that_computes_ends_the_last_word_is_zero(tmp_path, how):
    log = tmp_path / "log"
    with python("-c", DRIVES, log) as process:
        try:
            assert process.stdout.readline() == "drives\n"
            wait_for(lambda: any(word.twist == (0.0, 0.0, 2.0) for word in words(log)))
            os.kill(process.pid, how)
            wait_for(lambda: words(log)[-1].twist == ZERO)
            assert words(log)[-1].pid != process.pid  # not by its own hand
            count = len([word for word in words(log) if word.twist != ZERO])
            time.sleep(0.1)
            assert len([word for word in words(log) if word.twist != ZERO]) == count
        finally:
            process.kill()


@pytest.fixture
def moved(tmp_path):
    """Opens a base in a process of its own; ends that process."""
    guarding = GuardProcess(plain_base.NAME)

    def opened(**options):
        guarding.prepare(lambda: None)
        setup = make_setup(log=tmp_path / "log", **options)
        vehicle = guarding.open(setup, TwistLimits(1.0, 0.0, 3.0), 5.0)
        assert vehicle is not None, guarding.stays
        vehicle.watch(lambda *why: None)
        assert vehicle.read().values == ZERO
        return vehicle

    yield opened
    guarding.end()


def test_readings_limits_and_a_gyro_pass_through_the_guards_process(tmp_path, moved):
    vehicle = moved()
    vehicle.write(9.0, 9.0, -1.5)  # past any guard of this process
    wait_for(lambda: last(tmp_path) == (1.0, 0.0, -1.5))
    reading = vehicle.read()
    assert isinstance(reading, TwistOdometry)
    assert reading.values == (1.0, 0.0, -1.5)
    vehicle.read_gyro()
    time.sleep(0.05)
    vehicle.read()
    told = vehicle.read_gyro()
    assert len(told) >= 5
    assert {one.turn_radps for one in told} == {-1.5}
    stamps_ns = [one.stamp_ns for one in told]
    assert stamps_ns == sorted(set(stamps_ns))
    assert vehicle.read_gyro() == ()  # each is told once
    vehicle.close()
    assert last(tmp_path) == ZERO


def test_a_gyro_that_can_not_be_read_is_no_reason_to_go_without_the_odometer(moved):
    vehicle = moved(broken_gyro="yes")
    assert vehicle.read_gyro() == ()
    vehicle.close()
