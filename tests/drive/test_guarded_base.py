"""The guard of a base that is driven by a twist: its last word is zero, in all three parts."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.guard import Guard
from jaxnav.drive.interfaces import TwistOdometry
from jaxnav.drive.limits import TwistLimits, limits_from, limits_of
from jaxnav.drive.moved_vehicle import GuardProcess
from tests.helpers import plain_base
from tests.helpers.plain_base import PlainBase, make_setup, words

ROOT = Path(__file__).resolve().parents[2]
LIMITS = TwistLimits(forward_mps=1.0, left_mps=0.5, turn_radps=3.0)
ZERO = (0.0, 0.0, 0.0)
anything = st.floats() | st.integers(-(10**300), 10**300)
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


def wait_for(condition, within_s=10.0):
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s, "it does not come"
        time.sleep(0.01)


@given(st.tuples(anything, anything, anything), st.floats())
def test_any_twist_is_cut_at_each_limit_and_one_that_is_no_number_is_zero(command, elapsed_s):
    told = LIMITS.within(command, ZERO, elapsed_s)
    if not all(map(math.isfinite, command)):
        assert told == ZERO
        return
    for part, limit, wanted in zip(told, (1.0, 0.5, 3.0), command, strict=True):
        assert part == (wanted if abs(wanted) <= limit else math.copysign(limit, wanted))


def test_the_limits_are_the_files():
    base = TwistBase.create(1.2, 3.0, 0.1, left_limit_mps=0.7)
    assert limits_of(base) == TwistLimits(*map(float, (base.limits)))
    assert limits_from({"forward_mps": 1.0, "left_mps": 0.5, "turn_radps": 3.0}) == LIMITS


@pytest.fixture
def base(tmp_path):
    return PlainBase(make_setup(log=tmp_path / "log"))


@pytest.fixture
def guard(base):
    guard = Guard(base, LIMITS)
    yield guard
    guard.close()


def last(tmp_path) -> tuple[float, float, float] | None:
    """What the base was told last, None before its first word."""
    told = words(tmp_path / "log")
    return told[-1].twist if told else None


def test_what_is_beyond_the_limits_is_cut(tmp_path, guard):
    guard.arm()
    assert guard.write(9.0, -9.0, -9.0)
    assert last(tmp_path) == (1.0, -0.5, -3.0)


def test_before_it_is_armed_it_stands(tmp_path, guard):
    assert guard.write(1.0, 0.5, 2.0)
    assert last(tmp_path) == ZERO


@pytest.mark.parametrize("part", range(3))
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_one_part_that_is_no_number_stops_all_for_good(tmp_path, guard, part, value):
    guard.arm()
    guard.write(0.5, 0.0, 2.0)
    command = [0.5, 0.0, 2.0]
    command[part] = value
    assert not guard.write(*command)
    assert "the command was no number" in guard.reason
    assert last(tmp_path) == ZERO
    assert not guard.write(0.5, 0.0, 2.0)
    assert last(tmp_path) == ZERO


def test_without_a_fresh_command_a_turn_on_the_spot_ends(tmp_path, guard):
    guard.arm()
    guard.write(0.0, 0.0, 2.0)
    assert last(tmp_path) == (0.0, 0.0, 2.0)
    wait_for(lambda: guard.tripped)
    assert last(tmp_path) == ZERO


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_however_the_process_that_computes_ends_the_last_word_is_zero(tmp_path, how):
    log = tmp_path / "log"
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVES, str(log)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
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


def test_readings_limits_and_a_gyro_pass_through_the_guards_process(tmp_path):
    guarding = GuardProcess(plain_base.NAME)
    try:
        guarding.prepare(lambda: None)
        limits = TwistLimits(1.0, 0.0, 3.0)
        vehicle = guarding.open(make_setup(log=tmp_path / "log"), limits, 5.0)
        assert vehicle is not None, guarding.stays
        vehicle.watch(lambda *why: None)
        assert vehicle.read().values == ZERO
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
    finally:
        guarding.end()


def test_a_gyro_that_can_not_be_read_is_no_reason_to_go_without_the_odometer(tmp_path):
    guarding = GuardProcess(plain_base.NAME)
    try:
        guarding.prepare(lambda: None)
        setup = make_setup(log=tmp_path / "log", broken_gyro="yes")
        vehicle = guarding.open(setup, TwistLimits(1.0, 0.0, 3.0), 5.0)
        assert vehicle is not None, guarding.stays
        vehicle.watch(lambda *why: None)
        assert vehicle.read().values == ZERO
        assert vehicle.read_gyro() == ()
        vehicle.close()
    finally:
        guarding.end()
