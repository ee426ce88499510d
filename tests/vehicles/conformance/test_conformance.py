"""The checks for plug-ins: a good plug-in passes, and each fault of a bad one is named."""

import dataclasses
import itertools
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.detection.types import Detections
from jaxnav.drive.interfaces import Frame, GyroReading, Odometry, TwistOdometry
from jaxnav.vehicles.conformance import check_cameras, check_vehicle
from jaxnav.vehicles.sim import open_vehicle
from tests.helpers.setups import FULL_THROTTLE, GoodCamera, GoodVehicle, good_cameras, setup_with

SETUP = setup_with()
SHORT_RIG = setup_with(SETUP.rig.first(2))


def throttle_of(vehicle):
    return vehicle.throttle


def test_a_good_vehicle_passes():
    opened = []
    check_vehicle(lambda setup: opened.append(GoodVehicle(setup)) or opened[0], SETUP, throttle_of)
    assert opened[0].closed
    assert opened[0].throttle == 0
    before = threading.active_count()
    check_vehicle(GoodVehicle, SETUP)  # nor do its threads stay
    time.sleep(0.05)
    assert threading.active_count() <= before


def no_cable(self):
    raise OSError("no cable")


class RaisesValueError(GoodVehicle):
    def write(self, steering_rad, throttle):
        if abs(throttle) == FULL_THROTTLE:
            raise ValueError("too fast")
        super().write(steering_rad, throttle)


class StopWaits(GoodVehicle):
    """Until who writes is done, who then lets it go first: locks know no order of their own."""

    stops = False

    def write(self, steering_rad, throttle):
        while self.stops:
            time.sleep(0.001)
        with self._lock:
            time.sleep(0.3)
        super().write(steering_rad, throttle)

    def stop(self):
        self.stops = True
        super().stop()
        self.stops = False


class OneThreadOnly(GoodVehicle):
    """As many a driver: what was begun in one thread must not be touched by another."""

    thread = None

    def read(self):
        self.thread = threading.get_ident()
        return super().read()

    def stop(self):
        if self.thread != threading.get_ident():
            raise RuntimeError("wrong thread")


class ReadDrivesOn(GoodVehicle):
    """Every read sends the last command once more."""

    last = 0.0

    def write(self, steering_rad, throttle):
        self.last = self.throttle = throttle

    def read(self):
        self.throttle = self.last
        return super().read()


class CloseOnce(GoodVehicle):
    def close(self):
        if self.closed:
            raise RuntimeError("closed already")
        super().close()


def broken(**changes):
    """A vehicle with other members."""
    return type("Broken", (GoodVehicle,), changes)


def reads(stamp_ns=time.monotonic_ns, speed_mps=0.0, valid=True):
    """A vehicle with other readings."""
    return broken(read=lambda self: Odometry(stamp_ns(), speed_mps, 0.0, valid))


def backwards(count=itertools.count()):  # noqa: B008
    return time.monotonic_ns() - 20_000_000 * (next(count) % 3)


@pytest.mark.parametrize(
    ("vehicle", "sentence"),
    [
        (broken(stop=None), r"the vehicle has no stop\(\)"),
        (broken(timeout_s="soon"), "timeout_s is no number but 'soon'"),
        (reads(time.monotonic), "stamp_ns of an Odometry must be an int"),
        (reads(lambda: time.monotonic_ns() - 3_000_000_000), "an Odometry is 3.* s old: it must"),
        (
            broken(read=lambda self: self.__dict__.setdefault("first", GoodVehicle.read(self))),
            r"the stamps of read\(\) stood still for 0.5 s",
        ),
        (reads(backwards), r"the stamps of read\(\) go back in time"),
        (
            broken(read=lambda self: time.sleep(0.06) or GoodVehicle.read(self)),
            r"read\(\) took longer than 0.05 s",
        ),
        (broken(read=no_cable), r"read\(\) raised OSError for 0.5 s: no cable"),
        (reads(valid=False), r"no reading of read\(\) was valid"),
        (RaisesValueError, r"write\(0.*\) raised ValueError: too fast; only OSError is allowed"),
        (StopWaits, r"stop\(\) took .* s"),
        (broken(stop=lambda self: threading.Event().wait()), r"stop\(\) did not return within"),
        (OneThreadOnly, r"stop\(\) raised RuntimeError: wrong thread"),
        (broken(stop=lambda self: None), r"the throttle is 0.3 after stop\(\), it must be 0"),
        (ReadDrivesOn, "the throttle is 0.3 when it is read after stop"),
        (broken(close=lambda self: setattr(self, "closed", True)), r"is 0.3 after close\(\)"),
        (
            broken(write=lambda self, steering_rad, throttle: setattr(self, "throttle", throttle)),
            r"the throttle is 0.3 when it is written after close\(\)",
        ),
        (CloseOnce, r"a second close\(\) raised RuntimeError: closed already"),
    ],
)
def test_a_broken_promise_of_a_vehicle_is_named(vehicle, sentence, monkeypatch):
    quick = {"_PATIENCE_S": 0.5, "_BUSY_S": 0.03, "_STOP_S": 0.2, "_READINGS": 6, "HANGS_S": 1.2}
    for name, value in quick.items():
        monkeypatch.setattr(f"jaxnav.vehicles.conformance.vehicle.{name}", value)
    monkeypatch.setattr("jaxnav.vehicles.conformance.calls.HANGS_S", 1.2)
    with pytest.raises(AssertionError, match=sentence):
        check_vehicle(vehicle, SETUP, throttle_of)


def test_a_hook_that_sees_nothing_is_named(monkeypatch):
    monkeypatch.setattr("jaxnav.vehicles.conformance.vehicle._BUSY_S", 0.03)
    with pytest.raises(AssertionError, match=r"throttle_of\(\) says 0 after write"):
        check_vehicle(GoodVehicle, SETUP, lambda vehicle: 0.0)


def test_good_cameras_pass():
    seen = []

    def factory(setup, vehicle):
        seen.append(vehicle)
        vehicle.write(0.0, 0.0)
        assert vehicle.read().valid
        return good_cameras(setup, vehicle)

    check_cameras(factory, SHORT_RIG)
    assert seen[0].timeout_s > 0
    given = GoodVehicle(SETUP)
    check_cameras(factory, SHORT_RIG, given)
    assert seen[1] is given


def eyes(**changes):
    """Both cameras of the rig with other methods."""
    broken = type("Broken", (GoodCamera,), changes)
    return lambda setup, vehicle: [
        broken(n, s) for n, s in zip(setup.rig.names, setup.rig.image_sizes_px, strict=True)
    ]


def read_forever(self, timeout_s):
    """Gives what it has, then waits for more, whoever closes it."""
    if self.number < 5:
        return GoodCamera.read(self, timeout_s)
    time.sleep(min(timeout_s, 3.0))
    return None


def in_one_buffer(self):
    self.buffer = getattr(self, "buffer", GoodCamera.image(self))
    self.buffer[:] = self.number
    return self.buffer


@pytest.mark.parametrize(
    ("factory", "sentence"),
    [
        (lambda s, v: None, "the factory gives no sequence of cameras"),
        (lambda s, v: [SimpleNamespace(name="front")], r"camera 0 has no read\(\), close\(\)"),
        (lambda s, v: good_cameras(s, v)[::-1], "the cameras are right, front, those of the rig"),
        (eyes(stamp_ns=lambda self: 7), "stamp_ns of a frame of the camera front is .* s old"),
        (
            eyes(stamp_ns=lambda self: self.__dict__.setdefault("first", time.monotonic_ns())),
            "the camera front gives the same or an older stamp again",
        ),
        (eyes(image=lambda self: GoodCamera.image(self).T), r"shape \(820, 410\), the rig says"),
        (eyes(image=lambda self: None), "holds neither an image nor detections"),
        (eyes(image=in_one_buffer), "the camera front changes the image of a frame"),
        (
            eyes(read=lambda self, timeout_s: np.zeros((410, 820), np.uint8)),
            "expected a Frame or None",
        ),
        (
            eyes(read=lambda self, timeout_s: self.closed.wait(0.4) or None),
            r"read\(0\) of the camera front took 0.4",
        ),
        (eyes(read=lambda self, timeout_s: 1 / 0), r"front raised ZeroDivisionError"),
        (eyes(read=read_forever), r"a read\(\) of the camera front that waits while close\(\) is"),
        (eyes(close=lambda self: self.closed.set() or 1 / 0), r"close\(\) of .* raised ZeroDiv"),
    ],
)
def test_a_broken_promise_of_a_camera_is_named(factory, sentence, monkeypatch):
    monkeypatch.setattr("jaxnav.vehicles.conformance.cameras._PATIENCE_S", 0.5)
    with pytest.raises(AssertionError, match=sentence):
        check_cameras(factory, SHORT_RIG)


def test_a_camera_may_detect_by_itself():
    def factory(shape):
        found = Detections(
            np.arange(2), np.zeros(shape), np.ones((2, 4)), np.ones(2, bool), ("tag36h11",) * 2
        )

        def read(self, timeout_s):
            frame = GoodCamera.read(self, timeout_s)
            return frame and Frame(frame.stamp_ns, detections=found)

        return eyes(read=read)

    check_cameras(factory((2, 4, 2)), SHORT_RIG)
    with pytest.raises(AssertionError, match=r"the corners of .* have the shape \(2, 8\)"):
        check_cameras(factory((2, 8)), SHORT_RIG)


# --- bases that are no cars ---


BASE = TwistBase.create(1.0, 4.0, 0.15, left_limit_mps=0.5, gyro=GYROS["consumer"])
BASE_SETUP = dataclasses.replace(SETUP, vehicle=BASE)


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


def test_good_bases_keep_their_promises_and_are_told_all_their_limits():
    opened = []
    check_vehicle(lambda setup: opened.append(GoodBase(setup)) or opened[0], BASE_SETUP, largest)
    assert opened[0].most == [1.0, 0.5, 4.0]
    check_vehicle(open_vehicle, BASE_SETUP)


class StopForgetsTheTurn(GoodBase):
    def stop(self):
        self.told = 0.0, 0.0, self.told[2]

    def write(self, forward_mps, left_mps, turn_radps):
        super().write(forward_mps, left_mps, turn_radps + 0.1)


def base_of(**changes):
    return type("Broken", (GoodBase,), {name: lambda self, c=c: c() for name, c in changes.items()})


now_ns = time.monotonic_ns


@pytest.mark.parametrize(
    ("base", "sentence"),
    [
        (
            base_of(read=lambda: Odometry(now_ns(), 0.0, 0.0)),
            r"read\(\) gives Odometry\(.*expected a TwistOdometry",
        ),
        (
            base_of(read=lambda: TwistOdometry(now_ns(), 0.0, 0.0, float("nan"))),
            "turn_radps of a valid TwistOdometry must be a finite number, not nan",
        ),
        (base_of(read_gyro=lambda: [GyroReading(time.time_ns(), 0.01)]), "GyroReading"),
        (base_of(read_gyro=lambda: [0.01]), r"read_gyro\(\) gives 0.01, expected a Gyro"),
        (StopForgetsTheTurn, r"the throttle is .* after stop\(\), it must be 0"),
    ],
)
def test_a_broken_promise_of_a_base_is_named(monkeypatch, base, sentence):
    monkeypatch.setattr("jaxnav.vehicles.conformance.vehicle._READINGS", 6)
    with pytest.raises(AssertionError, match=sentence):
        check_vehicle(base, BASE_SETUP, largest)
