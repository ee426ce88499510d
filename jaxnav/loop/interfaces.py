"""What a vehicle and a camera are to the loop: write these, and any car drives.

A plug-in is a factory, found by an entry point of the group `jaxnav.vehicles` or
`jaxnav.cameras`, or as `module:name`:

    def open_vehicle(setup: Setup) -> Vehicle
    def open_cameras(setup: Setup, vehicle: Vehicle) -> Sequence[Camera]   # one for each of the rig

`jaxnav.testing.check_vehicle` and `check_cameras` say whether it keeps its promises. A vehicle may
also be `Ending`, and its factory may have `HasOwnFiles` or `SharesProcess`.

`jaxnav run` opens a vehicle in the process of its guard, which outlives whatever happens to the one
that computes (see `guard_process`). There `setup.vehicle` is plain numbers, `setup.rig` and
`setup.markers` are missing, and the vehicle that `open_cameras` gets only passes its calls on. A
vehicle whose module imports JAX or OpenCV, that looks at rig or markers, or says `SharesProcess`,
stays in the process that computes, watched by a thread. The guard runs at real-time priority where
it may: a `read` that waits must sleep, not spin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:  # plug-ins import this file in the guard's process, which has none of these
    import numpy as np

    from jaxnav.detection.types import Detections
    from jaxnav.files import Route
    from jaxnav.models.bicycle import Vehicle as VehicleModel
    from jaxnav.models.markers import MarkerMap
    from jaxnav.models.rig import CameraRig


@dataclass(frozen=True)
class Setup:
    """What a plug-in is told when it is opened."""

    rig: CameraRig
    markers: MarkerMap
    vehicle: VehicleModel
    start_pose: tuple[float, float, float]  # x_m, y_m, psi_rad on the map; for simulations
    seed: int = 0  # for simulations
    options: Mapping[str, str] = field(default_factory=dict)  # --option KEY=VALUE


@dataclass(frozen=True)
class Odometry:
    """One reading of wheel odometer and steering sensor.

    Attributes:
        stamp_ns: when it was measured, `time.monotonic_ns()` of this machine.
        speed_mps: along the vehicle's course, negative backwards.
        steering_rad: angle of the front wheels, positive to the left.
        valid: False where the driver itself knows that it could not read.
    """

    stamp_ns: int
    speed_mps: float
    steering_rad: float
    valid: bool = True


@dataclass(frozen=True)
class Frame:
    """What one camera saw at one instant: an image, or the markers that it found itself.

    Attributes:
        stamp_ns: middle of the exposure, `time.monotonic_ns()` of this machine.
        image: (H, W) or (H, W, 3) in BGR order, uint8.
        detections: of a camera that detects by itself; the image is then only shown and recorded.
    """

    stamp_ns: int
    image: np.ndarray | None = None
    detections: Detections | None = None


@runtime_checkable
class Vehicle(Protocol):
    """A car. `read` and `write` are called by one thread, `stop` by any, at any time."""

    @property
    def timeout_s(self) -> float:
        """After this time without a `write` the vehicle stops by itself; inf: it does not."""
        ...

    def read(self) -> Odometry:
        """The latest reading, without waiting longer than some milliseconds.

        Raises:
            OSError: it can't be read now; the loop goes on without it and asks again.
        """
        ...

    def write(self, steering_rad: float, throttle: float) -> None:
        """Steer and drive, throttle in the driver's unit, until the next call.

        Raises:
            OSError: it can't be written now; the loop tries again at the next tick.
        """
        ...

    def stop(self) -> None:
        """Zero throttle, now. From any thread, also while another is inside `read` or `write`, any
        number of times, also after `close`."""
        ...

    def close(self) -> None:
        """Stop and let go of the hardware. Any number of times."""
        ...


@runtime_checkable
class Ending(Protocol):
    """What a vehicle may have beside: its drive can be over by itself, as a recording's is."""

    @property
    def over(self) -> str | None:
        """Why there is nothing more to drive, which ends the loop in good order; None: there is."""
        ...


@runtime_checkable
class Camera(Protocol):
    """One camera, read by a thread of its own."""

    @property
    def name(self) -> str:
        """As the rig calls it."""
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame, never the same twice; None where there is none within the time.

        Raises:
            OSError: it can't be read now; the loop waits a little and asks again.
        """
        ...

    def close(self) -> None:
        """Let go of the hardware; a `read` that waits returns. Any number of times."""
        ...


OpenVehicle = Callable[[Setup], Vehicle]
OpenCameras = Callable[[Setup, Vehicle], Sequence[Camera]]


@runtime_checkable
class SharesProcess(Protocol):
    """What the factory of a vehicle may have beside: its cameras, say, need the vehicle itself."""

    shares_process: bool  # True: it is opened in the process that computes


@dataclass(frozen=True)
class OwnFiles:
    """What a vehicle brings with it."""

    rig: CameraRig
    markers: MarkerMap
    vehicle: VehicleModel
    route: Route


@runtime_checkable
class HasOwnFiles(Protocol):
    """What the factory of a vehicle, a class perhaps, may have beside: where no flag names a file,
    the vehicle's own is taken."""

    def own_files(self, options: Mapping[str, str]) -> OwnFiles:
        """Called before anything is opened, in the precision of the drive.

        Raises:
            BadInput: an option is wrong, or what it names.
        """
        ...
