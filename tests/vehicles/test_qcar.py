"""The QCar's plug-in on an imitation of its maker's driver, bad habits included."""

import contextlib
import math
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.drive.limits import Limits
from jaxnav.drive.plugins import open_cameras as open_by_name
from jaxnav.drive.plugins import open_vehicle as open_vehicle_by_name
from jaxnav.errors import BadInput
from jaxnav.vehicles.conformance import check_cameras, check_vehicle
from jaxnav.vehicles.qcar import QCarVehicle, Servo, open_cameras, open_vehicle
from tests.helpers.fake_pal import Hardware, fake_pal
from tests.helpers.setups import setup_with

SETUP = setup_with()


@pytest.fixture
def hardware(monkeypatch):
    hardware = Hardware()
    for name, module in fake_pal(hardware).items():
        monkeypatch.setitem(sys.modules, name, module)
    return hardware


@pytest.fixture
def car(hardware):
    vehicle = open_vehicle(SETUP)
    yield vehicle
    vehicle.close()


def test_vehicle_and_cameras_keep_their_promises(hardware):
    check_vehicle(open_vehicle, SETUP, lambda vehicle: hardware.throttle)
    assert "terminate" in hardware.calls
    check_cameras(open_cameras, SETUP)
    assert all(camera.terminated for camera in hardware.cameras.csi)


def test_a_reading_that_repeats_is_not_valid_until_it_changes(hardware, car):
    hardware.tach_mps = -0.75
    for _ in range(30):  # one sensor alone may repeat: a car that stands has the same speed
        reading = car.read()
        assert (reading.speed_mps, reading.valid) == (-0.75, True)
        time.sleep(0.003)
    hardware.fails = True
    stale = [car.read()]
    while stale[-1].valid and len(stale) < 1000:
        time.sleep(0.005)
        stale.append(car.read())
    assert 5 <= len(stale) < 100
    hardware.fails = False
    assert car.read().valid


def test_it_reports_the_steering_that_the_servo_has_reached(hardware, car):
    begin_ns = time.monotonic_ns()
    car.write(0.5, 0.0)  # a first command turns nowhere: no time has passed
    time.sleep(0.05)
    car.write(0.5, 0.0)
    commanded_rad = hardware.steering
    most_rad = 5.0 * (time.monotonic_ns() - begin_ns) / 1e9
    assert 5.0 * 0.05 <= commanded_rad <= min(most_rad, 0.5)
    assert 0 <= car.read().steering_rad < commanded_rad
    time.sleep(0.15)
    assert car.read().steering_rad == commanded_rad


def test_a_servo_turns_at_its_rate():
    servo = Servo(rate_limit_radps=5.0)
    servo.turn_to(0.5, 1_000_000_000)
    assert servo.angle_at(1_000_000_000) == 0
    assert servo.angle_at(1_040_000_000) == pytest.approx(0.2)
    servo.turn_to(-0.5, 1_060_000_000)  # at 0.3 by then
    assert servo.angle_at(1_160_000_000) == pytest.approx(-0.2)
    assert servo.angle_at(1_100_000_000) == pytest.approx(-0.2)  # a time that goes back
    assert servo.angle_at(9_000_000_000) == -0.5


@settings(max_examples=200)
@given(st.floats(), st.floats(), st.floats(), st.floats())
def test_no_command_is_beyond_the_limits(first_rad, steering_rad, throttle, limit):
    hardware = Hardware()
    car = fake_pal(hardware)["pal.products.qcar"].QCar(pwmLimit=math.inf)
    allowed = Limits(0.5, 5.0, abs(limit) if math.isfinite(limit) else 1.0)
    vehicle = QCarVehicle(car, allowed)
    vehicle.write(first_rad, 0.0)
    vehicle.write(steering_rad, throttle)
    assert abs(hardware.throttle) <= min(allowed.throttle, 0.3)
    assert abs(hardware.steering) <= 0.5
    vehicle.close()


def begun_thread(target, *args) -> threading.Thread:
    thread = threading.Thread(target=target, args=args)
    thread.start()
    return thread


class Held:
    """A function that tells when it has begun, and waits until it is let go."""

    def __init__(self, function):
        self.function, self.begun, self.let_go = function, threading.Event(), threading.Event()

    def __call__(self, *command):
        if command[0] != 0:  # a stop's zero throttle passes
            self.begun.set()
            self.let_go.wait(5.0)
        return self.function(*command)


def test_stop_does_not_wait_for_a_driver_that_hangs(hardware, car):
    hardware.hangs = threading.Event()
    driving = begun_thread(car.write, 0.0, 0.2)
    while hardware.throttle == 0:
        time.sleep(0.001)
    begin_s = time.monotonic()
    car.stop()
    assert time.monotonic() - begin_s < 1.0
    assert hardware.throttle == 0
    hardware.hangs.set()
    driving.join()
    assert hardware.throttle == 0


def test_a_write_that_comes_late_is_undone(hardware, car, monkeypatch):
    """The driver hangs before it sends: the stop comes first, the old throttle after it."""
    slow = Held(hardware.write)
    monkeypatch.setattr(hardware, "write", slow)
    driving = begun_thread(car.write, 0.0, 0.2)
    slow.begun.wait(5.0)
    car.stop()
    slow.let_go.set()
    driving.join()
    assert hardware.throttle == 0
    car.read()
    assert hardware.throttle == 0


def test_a_stop_while_a_command_is_made_is_not_lost(hardware, car, monkeypatch):
    """The lock is taken and nothing is sent yet: the stop comes and goes in between."""
    slow = Held(lambda *command: (0.0, 0.2))
    monkeypatch.setattr(car, "_limits", SimpleNamespace(within=slow))
    driving = begun_thread(car.write, 0.1, 0.2)
    slow.begun.wait(5.0)
    car.stop()
    slow.let_go.set()
    driving.join()
    assert hardware.throttle == 0


def test_a_write_that_overtakes_a_stop_and_hangs_is_undone(hardware, car, monkeypatch):
    """The stop asks for the lock first, the write gets it, and sends after the stop gave up."""
    asked, slow = threading.Event(), Held(hardware.write)

    class Unfair(contextlib.nullcontext):
        def acquire(self, timeout):
            asked.set()
            slow.begun.wait(5.0)
            return False

    monkeypatch.setattr(hardware, "write", slow)
    monkeypatch.setattr(car, "_driver", Unfair())
    stopping = begun_thread(car.stop)
    asked.wait(5.0)
    driving = begun_thread(car.write, 0.0, 0.2)
    stopping.join()
    slow.let_go.set()
    driving.join()
    assert hardware.throttle == 0


def test_errors_of_the_driver_are_oserrors_and_a_closed_car_says_so(hardware, car, monkeypatch):
    with monkeypatch.context() as patch:
        patch.delattr(type(hardware.car), "read_write_std")
        with pytest.raises(OSError, match="the QCar's driver: AttributeError"):
            car.read()
    car.close()
    for call in (car.read, lambda: car.write(0.0, 0.1)):
        with pytest.raises(OSError, match="closed"):
            call()
    count = len(hardware.calls)
    car.stop()
    assert len(hardware.calls) == count  # the board belongs to somebody else by now


def test_a_board_without_data_is_one_line(hardware, monkeypatch):
    monkeypatch.setattr("jaxnav.vehicles.qcar._FIRST_DATA_S", 0.1)
    hardware.fails = True
    with pytest.raises(BadInput, match="--car qcar: the board gives no data"):
        open_vehicle(SETUP)
    assert "terminate" in hardware.calls


def test_options_reach_the_driver(hardware):
    open_vehicle(setup_with(frequency="200", read_mode="1")).close()
    assert (hardware.car.readMode, hardware.car.frequency) == (1, 200)


def cameras(setup):
    return open_cameras(setup, None)


@pytest.mark.parametrize(
    ("opens", "option", "value", "problem"),
    [
        (open_vehicle, "frequency", "fast", "expected a number from 100 to 1000, got 'fast'"),
        (open_vehicle, "frequency", "150.5", "expected a whole number, got '150.5'"),
        (open_vehicle, "read_mode", "2", "expected a number from 0 to 1"),
        (cameras, "frame_rate", "0", "expected a number"),
        (cameras, "latency_ms", "inf", "expected a number"),
    ],
)
def test_a_wrong_option_is_named(hardware, opens, option, value, problem):
    with pytest.raises(BadInput, match=f"--option {option}: {problem}"):
        opens(setup_with(**{option: value}))


def rig_with(names=None, sizes_px=None):
    rig = SETUP.rig
    return type(rig)(
        rig.cameras, rig.Ts_camera_vehicle, names or rig.names, sizes_px or rig.image_sizes_px
    )


@pytest.mark.parametrize(
    ("rig", "problem"),
    [
        (rig_with(names=("front", "right", "rear", "top")), "has no 'top': expected front, right"),
        (rig_with(names=("front", "back", "rear", "left")), "the rig has one camera twice"),
        (rig_with(sizes_px=((820, 410),) * 3 + ((640, 480),)), "all images of a QCar are of one"),
    ],
)
def test_a_rig_that_a_qcar_has_not_is_refused(hardware, rig, problem):
    with pytest.raises(BadInput, match=problem):
        open_cameras(setup_with(rig), None)


def falls_silent(camera) -> bool:
    """Whether nothing comes any more, but for what was under way."""
    return any(camera.read(0.05) is None for _ in range(5))


def test_each_camera_shows_its_own_side_late_by_its_latency_and_no_picture_twice(
    hardware, monkeypatch
):
    cameras = open_cameras(setup_with(SETUP.rig.first(2), latency_ms="20"), None)
    try:
        front = cameras[0]
        assert [camera.name for camera in cameras] == ["front", "right"]
        assert hardware.cameras.csiLeft is None
        assert hardware.cameras.csiBack is None
        frame = front.read(1.0)
        assert time.monotonic_ns() - frame.stamp_ns >= 20_000_000
        hardware.pictures = False
        assert falls_silent(front)
        shown = hardware.cameras.csiFront.imageData.copy()
        hardware.pictures = True
        assert not np.array_equal(front.read(1.0).image, shown)
        monkeypatch.setattr(hardware.cameras.csiFront, "read", lambda: None)  # it says nothing
        assert falls_silent(front)
    finally:
        for camera in cameras:
            camera.close()


def test_without_the_makers_software_a_person_hears_where_it_is_from(monkeypatch):
    monkeypatch.setitem(sys.modules, "pal", None)
    target = "jaxnav.vehicles.qcar:open_{}"
    with pytest.raises(BadInput, match=r"--car: .* needs the module pal.* Quanser's software"):
        open_vehicle_by_name(target.format("vehicle"), SETUP)
    with pytest.raises(BadInput, match=r"--cameras: .* needs the module pal.* Quanser's software"):
        open_by_name(target.format("cameras"), SETUP, None)


def test_software_that_fails_on_import_is_one_line(hardware, monkeypatch):
    """It asks for the login name, which a service has not."""

    class NoLogin:
        def find_spec(self, name, path=None, target=None):
            if name == "pal.products.qcar":
                raise OSError(6, "No such device or address")

    monkeypatch.delitem(sys.modules, "pal.products.qcar")
    monkeypatch.delattr(sys.modules["pal.products"], "qcar")
    monkeypatch.setattr(sys.modules["pal.products"], "__path__", [], raising=False)
    monkeypatch.setattr(sys, "meta_path", [NoLogin(), *sys.meta_path])
    with pytest.raises(BadInput, match=r"--car qcar: pal.products.qcar: OSError: .*No such"):
        open_vehicle(SETUP)
