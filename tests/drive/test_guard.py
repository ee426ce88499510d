"""The watchdog: whatever happens, a vehicle's last command is zero throttle, and soon."""

import math
import signal
import subprocess
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.drive.guard import TIMEOUT_S, Guard
from jaxnav.drive.limits import Limits
from jaxnav.drive.standing_clock import WaitingClock
from tests.helpers.processes import python

LIMITS = Limits(steering_rad=0.5, steering_rate_radps=5.0, throttle=0.3)
SLACK_S = 0.15  # of a machine that does something else


class Car:
    """Remembers what it was told, and when."""

    timeout_s = math.inf

    def __init__(self):
        self.told = []
        self.steered = []
        self.lock = threading.Lock()
        self.hangs = threading.Event()
        self.let_go = threading.Event()
        self.fails = 0

    def write(self, steering_rad, throttle):
        if self.hangs.is_set():
            self.let_go.wait(5)
        if self.fails:
            self.fails -= 1
            raise OSError("not now")
        self.told.append((time.monotonic(), steering_rad, throttle))
        self.steered.append(steering_rad)

    def stop(self):
        if self.fails:
            self.fails -= 1
            raise OSError("not now")
        self.told.append((time.monotonic(), 0.0, 0.0))

    def close(self):
        self.stop()


@pytest.fixture
def car():
    return Car()


@pytest.fixture
def guard(car):
    guard = Guard(car, LIMITS)
    yield guard
    car.let_go.set()
    guard.close()


def drive(guard, duration_s, **beats):
    end = time.monotonic() + duration_s
    while time.monotonic() < end:
        guard.write(0.1, 0.2)
        for name, alive in beats.items():
            if alive:
                guard.beat(name)
        time.sleep(0.01)


@pytest.fixture
def driving(guard):
    """One that is armed and has let commands through."""
    guard.arm()
    drive(guard, 0.05)
    return guard


@pytest.fixture
def resuming(car):
    guard = Guard(car, LIMITS, resumes=True)
    guard.arm()
    drive(guard, 0.05)
    yield guard
    guard.close()


def stopped_after(car, since):
    """Seconds until zero throttle, after which nothing else came."""
    zero = [index for index, (_, _, throttle) in enumerate(car.told) if throttle != 0][-1] + 1
    return car.told[zero][0] - since


def test_nothing_gets_through_before_it_is_armed(car, guard):
    guard.write(0.3, 0.3)
    assert [throttle for _, _, throttle in car.told] == [0.0]
    time.sleep(2 * TIMEOUT_S)
    assert not guard.tripped
    guard.arm()
    guard.write(0.0, 0.3)
    assert car.told[-1][2] == 0.3


def test_a_loop_that_falls_silent_is_stopped_in_time(car, guard):
    guard.arm()
    drive(guard, 0.3)
    assert not guard.tripped
    since = car.told[-1][0]
    assert guard.wait(1.0)
    assert stopped_after(car, since) < TIMEOUT_S + SLACK_S
    assert "no fresh command" in guard.reason


def test_it_does_not_arm_again(car, guard):
    guard.arm()
    guard.trip("told to")
    guard.arm()
    assert not guard.write(0.1, 0.2)
    assert car.told[-1][2] == 0
    assert guard.reason == "told to"


def test_where_the_file_allows_it_the_vehicle_drives_on_after_a_stop_for_being_late(car, resuming):
    for _ in range(2):
        since = len(car.told)
        assert resuming.wait(1.0)
        assert resuming.pauses
        assert "no fresh command" in resuming.reason
        assert not resuming.write(0.1, 0.2)
        time.sleep(0.3)  # it repeats the stop meanwhile, and not after
        assert {throttle for _, _, throttle in car.told[since:]} == {0.0}
        assert resuming.resume()
        assert not resuming.tripped
        since = len(car.told)
        drive(resuming, 0.3)
        assert {throttle for _, _, throttle in car.told[since:]} == {0.2}


def test_without_that_word_it_does_not_resume(car, driving):
    assert driving.wait(1.0)
    assert driving.late
    assert not driving.pauses
    assert not driving.resume()
    assert not driving.write(0.1, 0.2)


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        (lambda guard, car: guard.trip("SIGINT"), "SIGINT"),
        (lambda guard, car: guard.write(math.nan, 0.2), "the command was no number: nan, 0.2"),
        (lambda guard, car: guard.write(0, -math.inf), "the command was no number: 0, -inf"),
        (lambda guard, car: guard.close(), "closed"),
    ],
)
@pytest.mark.parametrize("paused", [True, False])
def test_what_is_not_late_is_for_good(car, resuming, what, reason, paused):
    if paused:
        assert resuming.wait(1.0)
    what(resuming, car)
    assert resuming.tripped
    assert not resuming.pauses
    assert not resuming.resume()
    assert not resuming.write(0.1, 0.2)
    assert resuming.reason == reason
    assert car.told[-1][2] == 0


def test_it_does_not_resume_before_a_thread_is_back_and_the_stop_was_heard(car, resuming):
    resuming.beat("camera")
    drive(resuming, 0.3)
    assert not resuming.resume()
    resuming.beat("camera")
    car.fails = 10**6
    time.sleep(0.15)
    resuming.beat("camera")
    assert resuming.unheard is not None
    assert not resuming.resume()
    car.fails = 0
    time.sleep(0.15)
    resuming.beat("camera")
    assert resuming.resume()


def test_the_clock_of_a_simulation_waits_for_who_is_behind(car):
    clock = WaitingClock()
    guard = Guard(car, LIMITS, now_ns=clock.now_ns)
    clock.wait_for(guard.oldest_sign_ns, 0.08)
    for _ in range(2):
        assert abs(clock.now_ns() - time.monotonic_ns()) < 50_000_000  # nobody is behind yet
    guard.arm()
    guard.beat("camera")
    begin_ns = clock.now_ns()
    drive(guard, 0.6)  # and no sign of the camera
    assert not guard.tripped
    times_ns = [clock.now_ns() for _ in range(3)]
    assert times_ns == sorted(set(times_ns))
    assert 70_000_000 < times_ns[-1] - begin_ns < 81_000_000
    guard.beat("camera")
    drive(guard, 0.03)
    assert 100_000_000 < clock.now_ns() - begin_ns < 165_000_000
    guard.trip("told to")
    after_ns = clock.now_ns()
    time.sleep(0.3)
    assert clock.now_ns() - after_ns >= 300_000_000  # what has stopped is not waited for
    guard.close()


def test_a_watched_thread_that_hangs_stops_it_and_one_that_ends_is_not_missed(car, guard):
    guard.arm()
    drive(guard, 0.1, detector=True, camera=True, sweeper=True)
    guard.leave("sweeper")
    since = time.monotonic()
    drive(guard, 0.5, detector=True)
    assert guard.tripped
    assert "camera hangs" in guard.reason
    assert "drive/test_guard.py:" in guard.reason  # where it is just now
    assert stopped_after(car, since) < TIMEOUT_S + SLACK_S


def test_a_write_that_hangs_and_returns_after_the_stop_is_not_the_last_word(car, driving):
    """It is stopped around. A driver that lets go in the end does what it was told long ago."""
    since = time.monotonic()
    car.hangs.set()
    writer = threading.Thread(target=driving.write, args=(0.1, 0.2), daemon=True)
    writer.start()
    assert driving.wait(1.0)
    assert car.told[-1][2] == 0
    assert car.told[-1][0] - since < TIMEOUT_S + SLACK_S
    car.let_go.set()
    writer.join(1.0)
    throttles = [throttle for _, _, throttle in car.told]
    assert throttles[-1] == 0
    hung = len(throttles) - 1 - throttles[::-1].index(0.2)
    assert 0 in throttles[:hung]  # it was stopped around, and once more after it


def test_an_outage_of_the_bus_is_outlasted_and_told_of_where_it_lasts(car, driving):
    car.fails = 10**9
    driving.trip("told to")
    assert "not now" in driving.unheard
    time.sleep(1.0)
    assert car.told[-1][2] != 0
    car.fails = 0
    end_s = time.monotonic() + 2.0
    while car.told[-1][2] != 0 and time.monotonic() < end_s:
        time.sleep(0.01)
    assert car.told[-1][2] == 0
    assert driving.unheard is None
    car.fails = 10**9
    driving.close(heard_within_s=0.1)
    assert driving.unheard == "OSError: not now"


def test_a_dog_that_fails_stops_the_vehicle(car, driving, monkeypatch):
    monkeypatch.setattr(driving, "_beats", None)  # whatever it is that breaks it
    assert driving.wait(1.0)
    assert "the guard failed: AttributeError" in driving.reason
    assert car.told[-1][2] == 0


def test_a_dog_that_is_gone_is_missed(car, driving, monkeypatch):
    ended = threading.Thread(target=int)
    ended.start()
    ended.join()
    monkeypatch.setattr(driving, "_thread", ended)
    assert not driving.write(0.0, 0.2)
    assert "the guard's own thread has ended" in driving.reason


def test_a_command_that_fails_or_comes_after_its_deadline_is_none(car, guard):
    guard.arm()
    car.fails = 1
    assert not guard.write(0.0, 0.1)
    assert guard.write(0.0, 0.1, deadline_ns=time.monotonic_ns() + 10**8)
    assert not guard.write(0.0, 0.2, deadline_ns=time.monotonic_ns() - 1)
    assert car.told[-1][2] == 0.1


@settings(max_examples=200)
@given(st.lists(st.tuples(st.floats(), st.floats()), max_size=20))
def test_what_reaches_the_vehicle_is_inside_the_limits(commands):
    car, now_ns = Car(), [0]
    guard = Guard(car, LIMITS, timeout_s=1e6, now_ns=lambda: now_ns[0])
    guard.arm()
    for steering_rad, throttle in commands:
        now_ns[0] += 20_000_000
        guard.write(steering_rad, throttle)
    guard.close()
    told = np.array([(steering, throttle) for _, steering, throttle in car.told])
    assert np.all(np.isfinite(told))
    assert np.all(np.abs(told[:, 0]) <= LIMITS.steering_rad)
    assert np.all(np.abs(told[:, 1]) <= LIMITS.throttle)
    turns = np.abs(np.diff(car.steered))
    assert np.all(turns <= LIMITS.steering_rate_radps * 0.02 + 1e-12)


PROGRAM = """
import math, sys, threading, time
from jaxnav.drive.guard import Guard
from jaxnav.drive.limits import Limits
from jaxnav.drive.signals import Signals

class Car:
    timeout_s = math.inf
    def say(self, throttle):
        print(time.monotonic_ns(), throttle, flush=True)
    def write(self, steering_rad, throttle):
        self.say(throttle)
    def stop(self):
        self.say(0.0)
    def close(self):
        self.stop()

guard = Guard(Car(), Limits(0.5, 5.0, 0.3))
{before}
signals = Signals()
signals.on_signal(guard.trip)
guard.arm()
end = time.monotonic() + 0.3
while time.monotonic() < end:
    guard.write(0.0, 0.2)
    time.sleep(0.01)
{ending}
"""

DRIVES_ON = "while not guard.tripped:\n    guard.write(0.0, 0.2); time.sleep(0.01)"
ENDINGS = {
    "exception": "raise RuntimeError('somewhere')",
    "sys.exit": "sys.exit(3)",
    "end of the program": "",
    # The main thread is inside the C library and runs no handler of Python's for a second. What
    # holds the interpreter as well is for the guard's process, see test_guard_process.
    "SIGTERM in a hang": "threading.main_thread(); import ctypes; ctypes.CDLL(None).sleep(1)",
    **dict.fromkeys(("SIGTERM", "SIGINT", "SIGTSTP", "SIGTERM with many files"), DRIVES_ON),
}


# Descriptors of 1024 and more, which `select` can't look at.
MANY_FILES = """
import os, resource
resource.setrlimit(resource.RLIMIT_NOFILE, (4096, 4096))
kept = [os.dup(0) for _ in range(1500)]
"""


@pytest.mark.parametrize("name", ENDINGS)
def test_however_a_program_ends_zero_throttle_is_the_last_word(name):
    before = MANY_FILES if "many files" in name else ""
    source = PROGRAM.format(ending=ENDINGS[name], before=before)
    process = python("-c", source, stderr=subprocess.DEVNULL)
    since_ns = None
    if name.startswith("SIG"):
        for _ in range(30):
            process.stdout.readline()
        time.sleep(0.15 if "hang" in name else 0)
        since_ns = time.monotonic_ns()
        process.send_signal(getattr(signal, name.split()[0]))
    output, _ = process.communicate(timeout=30)
    rows = [line.split() for line in output.splitlines() if len(line.split()) == 2]
    assert float(rows[-1][1]) == 0.0
    if since_ns is not None:
        driven = [int(stamp) for stamp, throttle in rows if float(throttle) != 0]
        zero = min(int(stamp) for stamp, throttle in rows if float(throttle) == 0)
        last_ns = max([since_ns, *driven])
        assert (zero - since_ns) / 1e9 < TIMEOUT_S + SLACK_S
        assert (last_ns - since_ns) / 1e9 < TIMEOUT_S + SLACK_S
