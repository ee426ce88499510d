"""Drive the Quanser QCar through its maker's `pal.products.qcar`.

Options of the car: `read_mode`, 0 (every read samples the sensors) or 1 (every read takes them from
the board's queue, which it fills at `frequency`, Hz: for a loop that reads as often, since
otherwise the queue, and so the odometry, is up to two seconds old). Of the cameras: `frame_rate`,
Hz, and `latency_ms`. The rig's cameras are called front, right, rear (or back) and left.

The maker's driver prints hardware errors and goes on with the values that it read last. So values
that do not change are taken for an error: the noise of a gyroscope never repeats.
"""

import math
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxnav.drive.interfaces import Camera, Frame, Odometry, Setup, Vehicle
from jaxnav.drive.limits import Limits, turns_by_twist
from jaxnav.errors import BadInput
from jaxnav.vehicles.grabber import Grabber
from jaxnav.vehicles.options import latency_ns, whole_number

THROTTLE_LIMIT = 0.3  # PWM duty, the maker's own limit
STEERING_LIMIT_RAD = 0.6  # the maker's own limit
_LOCK_PATIENCE_S = 0.03  # three times the duration of a read at the lowest frequency
_FROZEN_READS = 5  # reads without any change, and
_FROZEN_NS = 50_000_000  # their duration: a slow gyroscope needs it for a new value
_FIRST_DATA_S = 2.0
_FRAME_POLL_S = 0.002

_CAMERAS = {"front": "Front", "right": "Right", "rear": "Back", "back": "Back", "left": "Left"}


def open_vehicle(setup: Setup) -> Vehicle:
    """Open the car.

    Raises:
        ImportError: the maker's software is not there.
        BadInput: an option is wrong, or the board gives no data.
    """
    if turns_by_twist(setup.vehicle):
        raise BadInput("--vehicle", "must be that of a car: qcar is one")
    read_mode = whole_number(setup.options, "read_mode", 0, 0, 1)
    frequency = whole_number(setup.options, "frequency", 500, 100, 1000)
    car = _maker("--car qcar").QCar(readMode=read_mode, frequency=frequency)
    vehicle = QCarVehicle(car, Limits.from_vehicle(setup.vehicle))
    if not vehicle.gives_data(_FIRST_DATA_S):
        vehicle.close()
        raise BadInput(
            "--car qcar",
            "the board gives no data; its driver says why above this line. Is another program"
            " using it, or the car switched off?",
        )
    return vehicle


def open_cameras(setup: Setup, vehicle: Vehicle) -> list[Camera]:
    """Open the four CSI cameras, or those of them that the rig has.

    Raises:
        ImportError: the maker's software is not there.
        BadInput: an option is wrong, or the rig has cameras that a QCar has not.
    """
    rig = setup.rig
    sides = []
    for name in rig.names:
        if name not in _CAMERAS:
            raise BadInput("--cameras qcar", f"has no {name!r}: expected {', '.join(_CAMERAS)}")
        sides.append(_CAMERAS[name])
    if len(set(sides)) < len(sides):
        raise BadInput("--cameras qcar", f"the rig has one camera twice: {', '.join(rig.names)}")
    if len(set(rig.image_sizes_px)) > 1:
        raise BadInput("--cameras qcar", "all images of a QCar are of one size, the rig's are not")
    frame_rate = whole_number(setup.options, "frame_rate", 30, 1, 120)
    delay_ns = latency_ns(setup.options)
    width_px, height_px = rig.image_sizes_px[0]
    maker = _maker("--cameras qcar").QCarCameras(
        frameWidth=width_px,
        frameHeight=height_px,
        frameRate=frame_rate,
        **{f"enable{side}": True for side in sides},
    )
    return [
        _csi_camera(name, getattr(maker, f"csi{side}"), delay_ns)
        for name, side in zip(rig.names, sides, strict=True)
    ]


def _maker(flag: str) -> Any:
    try:
        import pal.products.qcar as maker
    except ImportError:
        raise
    except Exception as error:
        # On import it reads the login name and the type of car, and fails where there is none.
        raise BadInput(flag, f"pal.products.qcar: {type(error).__name__}: {error}") from error
    return maker


@dataclass
class Servo:
    """A steering servo that turns at its full rate until it reaches the commanded angle."""

    rate_limit_radps: float
    angle_rad: float = 0.0
    target_rad: float = 0.0
    _time_ns: int | None = None

    def turn_to(self, target_rad: float, now_ns: int) -> None:
        """Command an angle from this instant on."""
        self.angle_at(now_ns)
        self.target_rad = target_rad

    def angle_at(self, now_ns: int) -> float:
        """The angle at a time, rad. Times must not decrease."""
        elapsed_s = 0.0 if self._time_ns is None else max(now_ns - self._time_ns, 0) / 1e9
        self._time_ns = now_ns
        reach_rad = self.rate_limit_radps * elapsed_s
        way_rad = self.target_rad - self.angle_rad
        self.angle_rad += min(max(way_rad, -reach_rad), reach_rad)
        return self.angle_rad


class QCarVehicle:
    """A QCar as a `Vehicle`. Its steering angle is not measured, but computed by a servo model."""

    timeout_s = math.inf  # the board keeps the last command

    def __init__(self, car: Any, limits: Limits):
        """Args:
        car: the maker's `QCar`.
        limits: of this vehicle; the maker's own hold as well.
        """
        self._car = car
        self._limits = Limits(
            min(limits.steering_rad, STEERING_LIMIT_RAD),
            limits.steering_rate_radps,
            min(limits.throttle, THROTTLE_LIMIT),
        )
        self._driver = threading.Lock()  # the maker's driver is for one thread
        self._servo = Servo(limits.steering_rate_radps)
        self._steering_rad = self._throttle = 0.0
        self._written_ns: int | None = None
        self._stops = 0
        self._closed = False
        self._bits = b""
        self._changed_ns = time.monotonic_ns()
        self._changes = self._repeats = 0

    def gives_data(self, within_s: float) -> bool:
        """Whether the sensors give new values within this time."""
        deadline_s = time.monotonic() + within_s
        while time.monotonic() < deadline_s:
            try:
                self.read()
            except OSError:
                time.sleep(0.01)
            if self._changes >= 2:  # the first reading differs from nothing
                return True
        return False

    def read(self) -> Odometry:
        """The latest reading; not valid if the sensor values do not change.

        Raises:
            OSError: the driver failed, or the car is closed.
        """
        with self._driver:
            speed_mps = self._exchange(self._stops)
            now_ns = time.monotonic_ns()
            frozen = self._repeats >= _FROZEN_READS and now_ns - self._changed_ns >= _FROZEN_NS
            return Odometry(now_ns, speed_mps, self._servo.angle_at(now_ns), valid=not frozen)

    def write(self, steering_rad: float, throttle: float) -> None:
        """Apply a command, clamped to the limits.

        Raises:
            OSError: the driver failed, or the car is closed.
        """
        with self._driver:
            stops = self._stops
            now_ns = time.monotonic_ns()
            before_ns = now_ns if self._written_ns is None else self._written_ns
            self._steering_rad, self._throttle = self._limits.within(
                (steering_rad, throttle), (self._steering_rad, 0.0), (now_ns - before_ns) / 1e9
            )
            self._written_ns = now_ns
            self._servo.turn_to(self._steering_rad, now_ns)
            self._exchange(stops)

    def stop(self) -> None:
        """Set zero throttle now, also while the driver hangs in another thread.

        Raises:
            OSError: the driver failed.
        """
        self._stops += 1
        self._throttle = 0.0
        if self._closed:
            return
        # Two threads in the driver are better than a car that drives on.
        free = self._driver.acquire(timeout=_LOCK_PATIENCE_S)
        try:
            # Once more, for a `write` that took the lock after it was counted first.
            self._stops, self._throttle = self._stops + 1, 0.0
            self._ask("write", 0.0, self._steering_rad)
        finally:
            if free:
                self._driver.release()

    def close(self) -> None:
        """Stop and release the board. May be called any number of times."""
        if self._closed:
            return
        try:
            self.stop()
        finally:
            self._closed = True
            free = self._driver.acquire(timeout=_LOCK_PATIENCE_S)
            try:
                self._ask("terminate")
            finally:
                if free:
                    self._driver.release()

    def _exchange(self, stops: int) -> float:
        """Send the command and read the sensors; return the speed, m/s. Needs the lock.

        Args:
            stops: number of stops when the lock was taken.
        """
        if self._closed:
            raise OSError("the QCar is closed")
        self._ask("read_write_std", self._throttle, self._steering_rad)
        if self._stops != stops:
            # A stop did not wait for this call: its throttle may have reached the motor after it.
            self._throttle = 0.0
            self._ask("write", 0.0, self._steering_rad)
        sensed = [self._sensor(name) for name in ("motorTach", "motorEncoder", "gyroscope")]
        bits = b"".join(values.tobytes() for values in sensed)
        if bits == self._bits:
            self._repeats += 1
        else:
            self._bits, self._repeats = bits, 0
            self._changed_ns = time.monotonic_ns()
            self._changes += 1
        return float(sensed[0][0])

    def _sensor(self, name: str) -> np.ndarray:
        """A buffer of the driver, which is a number in some of its versions."""
        try:
            return np.ravel(np.asarray(getattr(self._car, name)))
        except AttributeError as error:
            raise OSError("the QCar's driver has no data: its board was not opened") from error

    def _ask(self, method: str, *values: float) -> None:
        try:
            getattr(self._car, method)(*values)
        except Exception as error:
            # The driver of a board that was not opened may raise anything.
            raise OSError(f"the QCar's driver: {type(error).__name__}: {error}") from error


def _csi_camera(name: str, camera: Any, delay_ns: int) -> Grabber:
    """A camera of the maker's; only a changed picture shows that there is a new one."""
    last = np.zeros_like(camera.imageData)  # the initial content of its buffer

    def grab() -> Frame | None:
        fresh = camera.read()
        now_ns = time.monotonic_ns()
        if (fresh is not None and not fresh) or np.array_equal(camera.imageData, last):
            return None
        np.copyto(last, camera.imageData)
        return Frame(now_ns - delay_ns, last.copy())

    return Grabber(name, grab, camera.terminate, pause_s=_FRAME_POLL_S)
