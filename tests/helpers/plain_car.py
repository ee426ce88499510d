"""A car without JAX, as a driver of real hardware is: for tests of the guard's process.

Its motor and its servo follow with a lag; `plain_cameras` looks at the world from where it is. Each
line of the file `log`: when, `time.monotonic_ns()`, steering and throttle that it was told, and the
process that told it.
"""

import ctypes
import math
import os
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from jaxnav.drive.interfaces import Odometry, Setup
from jaxnav.vehicles.qcar import Servo

NAME = f"{__name__}:open_vehicle"


HANGS_S = 30
HANGS = {
    "held": lambda: ctypes.PyDLL(None).sleep(HANGS_S),
    "locked": lambda: time.sleep(HANGS_S),
    "stopped": lambda: os.kill(os.getpid(), signal.SIGSTOP),
}


class PlainCar:
    """Options: log, the file; deaf, a file while which exists nothing gets through; slow, a file
    that says how many seconds a `read` takes; hangs, a file that says how the next word hangs:
    `held` has C code hold the interpreter, `locked` waits with the driver's lock, `stopped`
    suspends the process."""

    timeout_s = math.inf  # it obeys its last command for ever: nothing but the guard stops it

    def __init__(self, setup):
        options, self._model = setup.options, setup.vehicle
        self._file = os.open(options["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self._deaf = Path(options.get("deaf", "/nonexistent"))
        self._slow = Path(options.get("slow", "/nonexistent"))
        self._hangs = Path(options.get("hangs", "/nonexistent"))
        self._lock = threading.RLock()  # as many drivers have
        self._servo = Servo(self._model.steering_rate_limit_radps)
        self._speed_mps = self._throttle = 0.0
        self._time_ns = time.monotonic_ns()

    def read(self):
        if self._slow.exists():
            time.sleep(float(self._slow.read_text()))
        now_ns = self._moved()
        return Odometry(now_ns, self._speed_mps, self._servo.angle_at(now_ns))

    def write(self, steering_rad, throttle):
        with self._lock:
            if self._hangs.exists():
                HANGS[self._hangs.read_text()]()
            self._tell(steering_rad, throttle)
        now_ns = self._moved()
        self._servo.turn_to(steering_rad, now_ns)
        self._throttle = throttle

    def stop(self):
        with self._lock:
            self._tell(0.0, 0.0)
        self._throttle = 0.0

    def close(self):
        self.stop()

    def _moved(self):
        now_ns = time.monotonic_ns()
        done = 1 - math.exp(-(now_ns - self._time_ns) / 1e9 / self._model.speed_time_constant_s)
        aim_mps = self._throttle * self._model.speed_per_throttle_mps
        self._speed_mps += done * (aim_mps - self._speed_mps)
        self._time_ns = now_ns
        return now_ns

    def _tell(self, steering_rad, throttle):
        if self._deaf.exists():
            raise OSError("the bus is out")
        line = f"{time.monotonic_ns()} {steering_rad!r} {throttle!r} {os.getpid()}\n"
        os.write(self._file, line.encode())  # in one call: threads and processes do not mix


def open_vehicle(setup: Setup) -> PlainCar:
    """See `PlainCar`."""
    return PlainCar(setup)


def open_curious_vehicle(setup: Setup) -> PlainCar:
    """One that looks at the rig."""
    assert setup.rig.names
    return PlainCar(setup)


@dataclass(frozen=True)
class Word:
    """What the car was told."""

    stamp_ns: int
    steering_rad: float
    throttle: float
    pid: int


def words(path: Path) -> list[Word]:
    """All of it so far; none where no car was opened."""
    if not path.exists():
        return []
    whole_lines = path.read_text().rpartition("\n")[0].splitlines()
    parts = (line.split() for line in whole_lines)
    return [Word(int(s), float(angle), float(t), int(pid)) for s, angle, t, pid in parts]


def wait_for(condition, within_s=10.0):
    """Wait until something that another process does can be seen."""
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s, "it does not come"
        time.sleep(0.01)
