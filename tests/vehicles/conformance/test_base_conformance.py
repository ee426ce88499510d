"""What a plug-in of a base that is no car promises, and who breaks it."""

import dataclasses
import time

import pytest

from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.interfaces import GyroReading, Odometry, TwistOdometry
from jaxnav.vehicles.conformance import check_vehicle
from jaxnav.vehicles.sim import open_vehicle
from tests.helpers.setups import setup_with

BASE = TwistBase.create(1.0, 4.0, 0.15, left_limit_mps=0.5, gyro=GYROS["consumer"])
SETUP = dataclasses.replace(setup_with(), vehicle=BASE)


class GoodBase:
    """Stands where it is, and knows what it was last told."""

    timeout_s = 0.2

    def __init__(self, setup):
        self.told, self.most, self.closed = (0.0, 0.0, 0.0), [0.0, 0.0, 0.0], False

    def read(self):
        return TwistOdometry(time.monotonic_ns(), 0.0, 0.0, 0.0)

    def read_gyro(self):
        return [GyroReading(time.monotonic_ns(), 0.01)]

    def write(self, forward_mps, left_mps, turn_radps):
        if self.closed:
            raise OSError("closed")
        self.told = forward_mps, left_mps, turn_radps
        self.most = [max(a, abs(b)) for a, b in zip(self.most, self.told, strict=True)]

    def stop(self):
        self.told = 0.0, 0.0, 0.0

    def close(self):
        self.stop()
        self.closed = True


def largest(base) -> float:
    return max(map(abs, base.told))


def test_a_good_base_keeps_its_promises_and_is_told_all_its_limits():
    opened = []
    check_vehicle(lambda setup: opened.append(GoodBase(setup)) or opened[0], SETUP, largest)
    assert opened[0].most == [1.0, 0.5, 4.0]


def test_the_simulated_base_keeps_them():
    check_vehicle(open_vehicle, SETUP)


class StopForgetsTheTurn(GoodBase):
    def stop(self):
        self.told = 0.0, 0.0, self.told[2]

    def write(self, forward_mps, left_mps, turn_radps):
        super().write(forward_mps, left_mps, turn_radps + 0.1)


def broken(**changes):
    return type("Broken", (GoodBase,), {name: lambda self, c=c: c() for name, c in changes.items()})


now_ns = time.monotonic_ns


@pytest.mark.parametrize(
    ("base", "sentence"),
    [
        (
            broken(read=lambda: Odometry(now_ns(), 0.0, 0.0)),
            r"read\(\) gives Odometry\(.*expected a TwistOdometry",
        ),
        (
            broken(read=lambda: TwistOdometry(now_ns(), 0.0, 0.0, float("nan"))),
            "turn_radps of a valid TwistOdometry must be a finite number, not nan",
        ),
        (broken(read_gyro=lambda: [GyroReading(time.time_ns(), 0.01)]), "GyroReading"),
        (broken(read_gyro=lambda: [0.01]), r"read_gyro\(\) gives 0.01, expected a GyroReading"),
        (StopForgetsTheTurn, r"the throttle is .* after stop\(\), it must be 0"),
    ],
)
def test_a_broken_promise_is_named(monkeypatch, base, sentence):
    monkeypatch.setattr("jaxnav.vehicles.conformance.vehicle._READINGS", 6)
    with pytest.raises(AssertionError, match=sentence):
        check_vehicle(base, SETUP, largest)
