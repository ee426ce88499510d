"""Check the promises of a vehicle one by one."""

import contextlib
import dataclasses
import math
import statistics
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from jaxnav.drive.interfaces import (
    GyroReading,
    HasGyro,
    Odometry,
    OpenVehicle,
    Reading,
    Setup,
    TwistOdometry,
    Vehicle,
)
from jaxnav.drive.limits import Command, Limits, TwistLimits, limits_of
from jaxnav.drive.plugins import missing_members
from jaxnav.vehicles.conformance.calls import HANGS_S, Worker, check_stamp, start_call

_READ_S = 0.05  # "may wait for some milliseconds at most"
_STOP_S = 0.5
_PATIENCE_S = 3.0  # time within which the first readings must come
_READINGS = 20
_BUSY_S = 0.3
_STOPS = 5  # at least so many while another thread drives
_BESIDE = "while another thread drives"


def check_vehicle(
    factory: OpenVehicle, setup: Setup, throttle_of: Callable[[Any], float] | None = None
) -> None:
    """Open a vehicle, read it, drive it, stop it and close it.

    Args:
        throttle_of: returns the last throttle of a car's motor, or the largest part of the twist
            that another base was last commanded; None: not known.

    Raises:
        AssertionError: its message says which promise is broken.
    """
    vehicle = factory(setup)
    lacking = missing_members(vehicle, Vehicle)
    assert not lacking, f"the vehicle has no {', '.join(lacking)}"
    check = _Check(vehicle, limits_of(setup.vehicle), throttle_of)
    try:
        check.timeout()
        check.readings()
        check.writes()
        check.stops()
        check.closed()
    finally:
        with contextlib.suppress(Exception):  # an error here would hide the one found
            start_call(vehicle.close)("close()", HANGS_S)
        check.end()


class _Check:
    """The checks of one vehicle, which one thread reads and writes, and another stops."""

    def __init__(
        self, vehicle: Any, limits: Limits | TwistLimits, throttle_of: Callable[[Any], float] | None
    ):
        self._vehicle, self._limits, self._throttle_of = vehicle, limits, throttle_of
        self._kind = Odometry if isinstance(limits, Limits) else TwistOdometry
        self._driver, self._watchdog = Worker(), Worker()

    def end(self) -> None:
        """End the threads."""
        self._driver.close()
        self._watchdog.close()

    def timeout(self) -> None:
        """Check that `timeout_s` is a positive number."""
        timeout_s = self._vehicle.timeout_s
        assert isinstance(timeout_s, int | float), f"timeout_s is no number but {timeout_s!r}"
        assert timeout_s > 0, f"timeout_s must be positive, or inf, not {timeout_s}"

    def readings(self) -> None:
        """Check the readings at rest, read faster than any driver measures."""
        readings: list[Reading] = []
        slow, failure = 0, None
        begin_s = time.monotonic()
        while time.monotonic() - begin_s < _PATIENCE_S:
            called_s = time.monotonic()
            reading, failure = self._driver.call("read()", self._vehicle.read)
            slow += time.monotonic() - called_s > _READ_S
            if failure is None:
                _check_reading(reading, self._kind)
                readings.append(reading)
            if len(readings) >= _READINGS and readings[-1].stamp_ns != readings[0].stamp_ns:
                break
            time.sleep(0.005)
        assert readings, f"read() raised OSError for {_PATIENCE_S:g} s: {failure}"
        # A busy machine delays a few reads; a driver that waits delays every one.
        assert slow <= 2, f"read() took longer than {_READ_S:g} s, {slow} times"
        stamps = [reading.stamp_ns for reading in readings]
        assert stamps == sorted(stamps), "the stamps of read() go back in time"
        assert stamps[-1] > stamps[0], f"the stamps of read() stood still for {_PATIENCE_S:g} s"
        assert any(reading.valid for reading in readings), "no reading of read() was valid"
        if isinstance(self._vehicle, HasGyro):
            turns, failure = self._driver.call("read_gyro()", self._vehicle.read_gyro)
            for one in () if failure is not None else turns:
                _check_gyro(one)

    def writes(self) -> None:
        """Check commands at rest, then at the limits, each followed by a read as in a loop."""
        steps: list[Command] = [(0, 0), (1, 0), (-1, 0), (0.5, 0.5), (0, 1), (0, -1), (0, 0)]
        if isinstance(self._limits, TwistLimits):
            steps = [(0, 0, 0), (0, 0, 1), (0, 0, -1), (0, 1, 0), (0.5, 0, 0.5), (1, 0, 0)]
            steps += [(-1, 0, 0), (0, 0, 0)]
        try:
            for shares in steps:
                self._write(shares)
                self._read()
                time.sleep(0.005)
        finally:
            self._stop()

    def stops(self) -> None:
        """Check `stop` while another thread drives, and that no command follows it."""
        done = threading.Event()

        def drive() -> None:
            while not done.is_set():
                with contextlib.suppress(OSError):
                    self._vehicle.write(*self._command(self._full))
                with contextlib.suppress(OSError):
                    self._vehicle.read()

        driving = self._driver.begin(drive)
        try:
            until_s = time.monotonic() + _BUSY_S
            took_s: list[float] = []
            while time.monotonic() < until_s or len(took_s) < _STOPS:
                took_s.append(self._timed_stop(_BESIDE))
                time.sleep(0.005)
            # A busy machine delays a few; a driver whose `stop` waits for `write` delays most.
            _check_stop(statistics.median(took_s), _BESIDE)
        finally:
            done.set()
            driving("write() and read() beside stop()", HANGS_S)
            self._stop()
        self._stands("after stop()")
        self._write(self._full)
        if self._throttle_of is not None:
            throttle = self._throttle_of(self._vehicle)
            assert throttle != 0, "throttle_of() says 0 after write() with full throttle"
        self._stop()
        for _ in range(5):
            self._read()
            self._stands("when it is read after stop()")

    def closed(self) -> None:
        """Check `close` while the vehicle drives, and all calls that are allowed afterwards."""
        self._write(self._full)
        for what in ("close()", "a second close()"):
            self._watchdog.begin(self._vehicle.close)(what, HANGS_S)
        self._stands("after close()")
        self._stop("after close()")
        self._read(" after close()")
        self._write(self._full, " after close()")
        self._stands("when it is written after close()")
        self._stop("after close()")
        self._watchdog.begin(self._vehicle.close)("a third close()", HANGS_S)

    def _read(self, when: str = "") -> None:
        self._driver.call(f"read(){when}", self._vehicle.read)

    @property
    def _full(self) -> Command:
        """Full throttle, or full speed ahead, in shares of the limits."""
        return (0, 1) if isinstance(self._limits, Limits) else (1, 0, 0)

    def _command(self, shares: Command) -> Command:
        """The command of these shares of the limits."""
        limits = self._limits
        if isinstance(limits, Limits):
            return shares[0] * limits.steering_rad, shares[1] * limits.throttle
        most = limits.forward_mps, limits.left_mps, limits.turn_radps
        return tuple(share * limit for share, limit in zip(shares, most, strict=True))

    def _write(self, shares: Command, when: str = "") -> None:
        """Write a command, given in shares of the limits."""
        command = self._command(shares)
        self._driver.call(f"write{command}{when}", partial(self._vehicle.write, *command))

    def _stop(self, when: str = "") -> None:
        _check_stop(self._timed_stop(when), when)

    def _timed_stop(self, when: str) -> float:
        """Stop; return how long that took, s."""
        called_s = time.monotonic()
        self._watchdog.call(f"stop() {when}".strip(), self._vehicle.stop)
        return time.monotonic() - called_s

    def _stands(self, when: str) -> None:
        if self._throttle_of is not None:
            throttle = self._throttle_of(self._vehicle)
            assert throttle == 0, f"the throttle is {throttle:g} {when}, it must be 0"


def _check_stop(took_s: float, when: str) -> None:
    assert took_s < _STOP_S, f"stop() took {took_s:.2g} s {when}".strip()


def _check_reading(reading: object, kind: type[Odometry] | type[TwistOdometry]) -> None:
    name = kind.__name__
    article = "an" if kind is Odometry else "a"
    assert isinstance(reading, kind), f"read() gives {reading!r}, expected {article} {name}"
    check_stamp(f"{article} {name}", reading.stamp_ns)
    if not reading.valid:
        return
    fields = [one.name for one in dataclasses.fields(kind)[1:-1]]
    for field, value in zip(fields, reading.values, strict=True):
        good = isinstance(value, int | float | np.floating) and math.isfinite(value)
        assert good, f"{field} of a valid {name} must be a finite number, not {value!r}"


def _check_gyro(reading: object) -> None:
    expected = f"read_gyro() gives {reading!r}, expected a GyroReading"
    assert isinstance(reading, GyroReading), expected
    check_stamp("a GyroReading", reading.stamp_ns)
