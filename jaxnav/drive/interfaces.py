"""The interfaces of a vehicle and of a camera: implement these to drive any car or other base.

A plug-in is a factory, found by an entry point of the group `jaxnav.vehicles` or
`jaxnav.cameras`, or as `module:name`:

    def open_vehicle(setup: Setup) -> Vehicle
    def open_cameras(setup: Setup, vehicle: Vehicle) -> Sequence[Camera]   # one for each of the rig

A car is a `Vehicle`. A base that is driven by a twist (`base:` in its file) is a `TwistVehicle`,
which differs in the numbers that it reads and is told. Either may have a gyro, see `HasGyro`.

`jaxnav.vehicles.conformance.check_vehicle` and `check_cameras` test whether a plug-in keeps these
promises. A vehicle may also be `Ending` or `HasTime`, and its factory may be `HasOwnFiles` or
`SharesProcess`; that of cameras may be `NeedsNoVehicle`.

`jaxnav run` opens a vehicle in the process of its guard, which survives any end of the computing
process (see `guard_process`). There `setup.vehicle` is plain numbers, `setup.rig` and
`setup.markers` are missing, and the vehicle that `open_cameras` gets only forwards its calls. A
vehicle whose module imports JAX or OpenCV, that reads rig or markers, or that is `SharesProcess`,
stays in the computing process, watched by a thread. The guard runs at real-time priority where
that is permitted: a `read` that waits must sleep, not spin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:  # plug-ins import this file in the guard's process, which has none of these
    import numpy as np
    from jaxtyping import UInt8

    from jaxnav.core.models.markers import MarkerMap
    from jaxnav.core.models.rig import CameraRig
    from jaxnav.core.models.vehicle import TwistBase
    from jaxnav.core.models.vehicle import Vehicle as VehicleModel
    from jaxnav.detection.types import Detections
    from jaxnav.drive.standing_clock import WaitingClock
    from jaxnav.files import Route


@dataclass(frozen=True)
class Setup:
    """The arguments that a plug-in gets when it is opened."""

    rig: CameraRig
    markers: MarkerMap
    vehicle: VehicleModel | TwistBase
    start_pose: tuple[float, float, float]  # x_m, y_m, psi_rad on the map; for simulations
    seed: int = 0  # for simulations
    options: Mapping[str, str] = field(default_factory=dict)  # --option KEY=VALUE


@dataclass(frozen=True)
class Odometry:
    """One reading of wheel odometer and steering sensor.

    Attributes:
        stamp_ns: time of measurement, `time.monotonic_ns()` of this machine.
        speed_mps: along the vehicle's course, negative backwards.
        steering_rad: angle of the front wheels, positive to the left.
        valid: False where the driver knows that it could not read.
    """

    stamp_ns: int
    speed_mps: float
    steering_rad: float
    valid: bool = True

    @property
    def values(self) -> tuple[float, ...]:
        """What was read: speed_mps, steering_rad."""
        return self.speed_mps, self.steering_rad


@dataclass(frozen=True)
class TwistOdometry:
    """One reading of the odometer of a base that is driven by a twist, in its own axes.

    Attributes:
        stamp_ns: time of measurement, `time.monotonic_ns()` of this machine.
        forward_mps, left_mps: velocity of its origin; `left_mps` is 0 of what can't move sideways.
        turn_radps: positive to the left.
        valid: False where the driver knows that it could not read.
    """

    stamp_ns: int
    forward_mps: float
    left_mps: float
    turn_radps: float
    valid: bool = True

    @property
    def values(self) -> tuple[float, ...]:
        """What was read: forward_mps, left_mps, turn_radps."""
        return self.forward_mps, self.left_mps, self.turn_radps


Reading = Odometry | TwistOdometry


def reading_of(stamp_ns: int, values: Sequence[float], valid: bool) -> Reading:
    """The reading with these `values`: two of a car, three of another base."""
    if len(values) == 2:
        return Odometry(stamp_ns, values[0], values[1], valid)
    return TwistOdometry(stamp_ns, values[0], values[1], values[2], valid)


MOST_TURNS = 255  # readings of a gyro that are taken at once: the newest


@dataclass(frozen=True)
class GyroReading:
    """One reading of a gyro about the vehicle's vertical axis.

    Attributes:
        stamp_ns: time of measurement, `time.monotonic_ns()` of this machine.
        turn_radps: the turn rate then, or its mean since the reading before; positive to the left.
    """

    stamp_ns: int
    turn_radps: float


@dataclass(frozen=True)
class Frame:
    """One camera's data of one instant: an image, or the markers that the camera detected itself.

    Attributes:
        stamp_ns: middle of the exposure, `time.monotonic_ns()` of this machine.
        image: (H, W) or (H, W, 3) in BGR order, uint8.
        detections: from a camera that detects markers itself; its image is only shown and recorded.
        exposure_s: how long each row was exposed; None: the driver does not know.
        row_time_s: from the exposure of one row to that of the next, 0 for a global shutter; None:
            the driver does not know.
    """

    stamp_ns: int
    image: UInt8[np.ndarray, "rows columns"] | UInt8[np.ndarray, "rows columns 3"] | None = None
    detections: Detections | None = None
    exposure_s: float | None = None
    row_time_s: float | None = None


@runtime_checkable
class Vehicle(Protocol):
    """A car. `read` and `write` are called by one thread, `stop` by any, at any time."""

    @property
    def timeout_s(self) -> float:
        """Time without a `write` after which the vehicle stops by itself; inf: it does not."""
        ...

    def read(self) -> Odometry:
        """The latest reading; may wait for some milliseconds at most.

        Raises:
            OSError: no reading is possible now; the loop goes on without it and asks again.
        """
        ...

    def write(self, steering_rad: float, throttle: float) -> None:
        """Apply steering and throttle (in the driver's unit) until the next call.

        Raises:
            OSError: no command is possible now; the loop tries again at the next tick.
        """
        ...

    def stop(self) -> None:
        """Set zero throttle now. May be called from any thread, also while another is inside `read`
        or `write`, any number of times, also after `close`. Where it does not return within half a
        second, the process is killed, and another one opens the vehicle and stops it."""
        ...

    def close(self) -> None:
        """Stop and release the hardware. May be called any number of times."""
        ...


@runtime_checkable
class TwistVehicle(Protocol):
    """A base that is driven by a twist; all that is not said here is as in `Vehicle`."""

    @property
    def timeout_s(self) -> float:
        """See `Vehicle`."""
        ...

    def read(self) -> TwistOdometry:
        """See `Vehicle`."""
        ...

    def write(self, forward_mps: float, left_mps: float, turn_radps: float) -> None:
        """Apply a twist in the base's own axes until the next call; see `Vehicle`."""
        ...

    def stop(self) -> None:
        """Set all of the twist to zero now; see `Vehicle`."""
        ...

    def close(self) -> None:
        """See `Vehicle`."""
        ...


AnyVehicle = Vehicle | TwistVehicle


@runtime_checkable
class Ending(Protocol):
    """Optional part of a vehicle whose drive can end by itself, as a recording's does."""

    @property
    def over(self) -> str | None:
        """Why the drive is over, which ends the loop in good order; None while it goes on."""
        ...


@runtime_checkable
class HasTime(Protocol):
    """Optional part of a simulated vehicle in the computing process: the clock of its stamps, and
    of its cameras', which waits for a drive on a busy computer; all deadlines are on it then."""

    waiting_clock: WaitingClock


@runtime_checkable
class Resuming(Protocol):
    """Optional part of a vehicle that has a guard of its own, in another process."""

    def resume(self) -> bool:
        """Ask that guard to arm again; return whether it was asked. It may refuse."""
        ...


@runtime_checkable
class HasGyro(Protocol):
    """Optional part of a vehicle that has a gyro; its file says how good it is (`gyro:`)."""

    def read_gyro(self) -> Sequence[GyroReading]:
        """The readings since the last call, the oldest first; none where there are none. It does
        not wait. Called by the thread that calls `read`, after it.

        Raises:
            OSError: no reading is possible now; the loop goes on without it and asks again.
        """
        ...


@runtime_checkable
class Camera(Protocol):
    """One camera, read by a thread of its own."""

    @property
    def name(self) -> str:
        """The camera's name in the rig."""
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, never the same twice; None if none comes within the timeout.

        Raises:
            OSError: no frame can be read now; the loop waits a little and asks again.
        """
        ...

    def close(self) -> None:
        """Release the hardware; a waiting `read` returns. May be called any number of times."""
        ...


OpenVehicle = Callable[[Setup], AnyVehicle]
OpenCameras = Callable[[Setup, Any], Sequence[Camera]]


@runtime_checkable
class SharesProcess(Protocol):
    """Optional part of a vehicle's factory: its cameras, for example, need the vehicle itself."""

    shares_process: bool  # True: the vehicle is opened in the computing process


@runtime_checkable
class NeedsNoVehicle(Protocol):
    """Optional part of the cameras' factory, which may then be called with None for the vehicle:
    `jaxnav run` opens and closes its cameras once before it compiles, so that one that can't be
    opened is said at once."""

    needs_no_vehicle: bool


@dataclass(frozen=True)
class OwnFiles:
    """The rig, markers, parameters and route that a vehicle brings with it."""

    rig: CameraRig
    markers: MarkerMap
    vehicle: VehicleModel | TwistBase
    route: Route


@runtime_checkable
class HasOwnFiles(Protocol):
    """Optional part of a vehicle's factory, which may be a class: the vehicle's own file is used
    where no flag names one."""

    def own_files(self, options: Mapping[str, str]) -> OwnFiles:
        """The vehicle's own files. Called before anything is opened, in the drive's precision.

        Raises:
            BadInput: an option, or the file that it names, is wrong.
        """
        ...
