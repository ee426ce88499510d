"""A base without JAX that is driven by a twist and has a gyro: for tests of the guard's process.

Each line of the file `log`: when, `time.monotonic_ns()`, what it was told, and the process that
told it.
"""

import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxnav.drive.interfaces import GyroReading, Setup, TwistOdometry

NAME = f"{__name__}:open_vehicle"
GYRO_NS = 5_000_000


@dataclass(frozen=True)
class Numbers:
    """A `TwistBase` without JAX."""

    forward_limit_mps: float = 1.0
    left_limit_mps: float = 0.0
    turn_limit_radps: float = 3.0
    time_constant_s: float = 0.15
    sensor_sigma: Any = None
    gyro: Any = None


def make_setup(**options: Any) -> Setup:
    """What a `PlainBase` needs."""
    told = {name: str(value) for name, value in options.items()}
    return Setup(None, None, Numbers(), (0.0, 0.0, 0.0), options=told)


class PlainBase:
    """It reads what it was told, at once. Options: log, the file; broken_gyro, anything."""

    timeout_s = math.inf  # it obeys its last command for ever: nothing but the guard stops it

    def __init__(self, setup: Setup):
        self.limits = setup.vehicle.forward_limit_mps, setup.vehicle.turn_limit_radps
        self._file = os.open(setup.options["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        self._told = (0.0, 0.0, 0.0)
        self._broken = "broken_gyro" in setup.options
        self._gyro_ns = time.monotonic_ns()

    def read(self) -> TwistOdometry:
        return TwistOdometry(time.monotonic_ns(), *self._told)

    def read_gyro(self) -> list[GyroReading]:
        """One each 5 ms."""
        if self._broken:
            raise OSError("the gyro's bus is out")
        now_ns, readings = time.monotonic_ns(), []
        while self._gyro_ns + GYRO_NS <= now_ns:
            self._gyro_ns += GYRO_NS
            readings.append(GyroReading(self._gyro_ns, self._told[2]))
        return readings

    def write(self, forward_mps: float, left_mps: float, turn_radps: float) -> None:
        self._told = forward_mps, left_mps, turn_radps
        numbers = " ".join(map(repr, self._told))
        os.write(self._file, f"{time.monotonic_ns()} {numbers} {os.getpid()}\n".encode())

    def stop(self) -> None:
        self.write(0.0, 0.0, 0.0)

    def close(self) -> None:
        self.stop()


def open_vehicle(setup: Setup) -> PlainBase:
    """See `PlainBase`."""
    return PlainBase(setup)


@dataclass(frozen=True)
class Word:
    """What the base was told."""

    stamp_ns: int
    twist: tuple[float, float, float]
    pid: int


def words(path: Path) -> list[Word]:
    """All of it so far; none where no base was opened."""
    if not path.exists():
        return []
    whole_lines = path.read_text().rpartition("\n")[0].splitlines()
    parts = (line.split() for line in whole_lines)
    return [Word(int(s), (float(f), float(y), float(t)), int(p)) for s, f, y, t, p in parts]
