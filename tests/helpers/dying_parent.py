"""A process that drives a `PlainCar` behind its guard, and comes to the end that it is told.

    python -m tests.helpers.dying_parent LOG HOW AFTER_S

It prints when, `time.monotonic_ns()`, right before. An environment variable HANGS names the file
of that option of the car.
"""

import ctypes
import os
import re
import resource
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from jaxnav.drive.guard import Guard
from jaxnav.drive.interfaces import Setup
from jaxnav.drive.limits import Limits
from jaxnav.drive.moved_vehicle import GuardProcess
from jaxnav.drive.signals import Signals
from tests.helpers import plain_car

LIMITS = Limits(steering_rad=0.5, steering_rate_radps=5.0, throttle=0.3)
HANGS_S = 2.0


@dataclass(frozen=True)
class Numbers:
    """A `Vehicle` without JAX."""

    wheelbase_m: float = 0.256
    steering_limit_rad: float = 0.5
    steering_rate_limit_radps: float = 5.0
    throttle_limit: float = 0.3
    speed_per_throttle_mps: float = 10.0
    speed_time_constant_s: float = 0.3
    speed_scale: float = 1.0
    steering_gain: float = 1.0
    steering_offset_rad: float = 0.0
    camera_delay_s: float = 0.0


def make_setup(**options: Any) -> Setup:
    """What a `PlainCar` needs."""
    told = {name: str(value) for name, value in options.items()}
    return Setup(None, None, Numbers(), (0.0, 0.0, 0.0), options=told)


def hold_the_lock() -> None:
    """As C code does that holds the interpreter: no thread of this process runs."""
    ctypes.PyDLL(None).usleep(int(HANGS_S * 1e6))


def run_a_regular_expression() -> None:
    """The same, of the standard library."""
    re.match("(a+)+b", "a" * 27)


def use_all_memory() -> None:
    """Until there is none left; the error is nobody's."""
    resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31))
    kept = []
    while True:
        kept.append(bytearray(2**24))


def spin() -> None:
    """One that computes for ever where a command should be written."""
    end_s = time.monotonic() + HANGS_S
    while time.monotonic() < end_s:
        pass


def dump_core() -> None:
    """The kernel writes down all its memory, which takes a while, before it closes anything."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    os.abort()


ENDS = {
    "kill -9": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "SIGSTOP": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "segfault": lambda: ctypes.string_at(0),
    "abort": dump_core,
    "no memory": use_all_memory,
    "held lock": hold_the_lock,
    "regular expression": run_a_regular_expression,
    "full core": spin,
    "exit": lambda: os._exit(3),
}
ENDS_WELL = "end of time"  # or by a signal, before


def main(log: str, how: str, after_s: float) -> None:
    """Drive, and end."""
    signals = Signals()
    signals.hold()  # as a drive does: it ends when the vehicle is closed
    guarding = GuardProcess(plain_car.NAME)
    guarding.prepare(lambda: None)
    options = {"hangs": os.environ["HANGS"]} if "HANGS" in os.environ else {}
    timeout_s = 2.0 if options else 0.2  # that nobody stops it before it is to be stopped
    vehicle = guarding.open(make_setup(log=log, **options), LIMITS, timeout_s)
    assert vehicle is not None, guarding.stays
    guard = Guard(vehicle, LIMITS, timeout_s)
    vehicle.watch(guard.trip)
    signals.on_signal(guard.trip)
    guard.arm()
    end_s = time.monotonic() + after_s
    while time.monotonic() < end_s and signals.number is None:
        with suppress(OSError):
            vehicle.read()
        guard.write(0.0, 0.2)
        time.sleep(0.02)
    os.write(1, f"{time.monotonic_ns()}\n".encode())
    if how != ENDS_WELL:
        guard.write(0.0, 0.2)
        ENDS[how]()
    guard.close()
    os.write(1, f"{guard.reason}; {vehicle.replaced}; {vehicle.unheard}\n".encode())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
