"""Run the simulated vehicle in real time: a vehicle and cameras like any other.

jaxnav run --car sim                           # cameras that detect markers themselves
jaxnav run --car sim --option images=true      # rendered images
"""

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxnav.drive.corrections import Corrections
from jaxnav.drive.interfaces import AnyVehicle, Camera, Frame, GyroReading, HasTime, Odometry, Setup
from jaxnav.drive.limits import limits_of
from jaxnav.drive.standing_clock import WaitingClock
from jaxnav.errors import BadInput
from jaxnav.vehicles.grabber import RETRY_S, NewestFrame
from jaxnav.vehicles.options import number, switch
from jaxnav.vehicles.rendering_process import RenderingProcess, track_times_s
from jaxnav.vehicles.world import SimWorld, WorldSettings

_LATENCY_NS = 20_000_000  # from the middle of an exposure until its corners are known
# The clock waits for frames that are later than this: a camera is stale after 0.2 s, and a process
# that renders on a core of its own takes 0.05 to 0.1 s, without which the simulation is slow.
_LATE_S = 0.12


class SimVehicle:
    """The car or other base of a `SimWorld`, which stops by itself without commands.

    Its odometer, servo and stamps have the errors in the vehicle's description.
    """

    def __init__(self, world: SimWorld):
        """Take the world, which the cameras look at too."""
        self.world, self.timeout_s = world, world.settings.vehicle_timeout_s
        self.waiting_clock = WaitingClock()
        self._corrections = Corrections.from_vehicle(world.vehicle)
        self._closed = False

    def read(self) -> Any:
        """See `Vehicle` and `TwistVehicle`."""
        if self._closed:
            raise OSError("the vehicle is closed")
        reading = self.world.reading(self.waiting_clock.now_ns())
        if not isinstance(reading, Odometry):
            return reading
        stamp_ns = reading.stamp_ns + self._corrections.reading_late_ns
        return Odometry(stamp_ns, *self._corrections.read(*reading.values))

    def read_gyro(self) -> tuple[GyroReading, ...]:
        """See `HasGyro`."""
        return self.world.gyro(self.waiting_clock.now_ns())

    def write(self, *command: float) -> None:
        """See `Vehicle` and `TwistVehicle`."""
        if self._closed:
            raise OSError("the vehicle is closed")
        if len(command) == 2:
            command = self._corrections.true_rad(command[0]), command[1]
        self.world.write(*command, self.waiting_clock.now_ns())

    def stop(self) -> None:
        """See `Vehicle` and `TwistVehicle`."""
        self.world.write(*limits_of(self.world.vehicle).zero, self.waiting_clock.now_ns())

    def close(self) -> None:
        """See `Vehicle`."""
        self._closed = True
        self.stop()


class _Shutter:
    """A thread that makes the frames of all cameras, all exposed at once."""

    def __init__(
        self,
        world: SimWorld,
        clock: WaitingClock,
        rate_hz: float,
        renderer: RenderingProcess | None,
        names: Sequence[str],
    ):
        self._world, self._clock, self._renderer = world, clock, renderer
        self._period_ns = int(1e9 / rate_hz)
        self._late_ns = Corrections.from_vehicle(world.vehicle).frame_late_ns
        self.cameras = [NewestFrame(name, self._close) for name in names]
        self._closed = False
        self._due_ns: int | None = None  # when the frames that are made now will have come
        clock.wait_for(lambda: self._due_ns, _LATE_S)
        self._thread = threading.Thread(target=self._run, name="jaxnav-sim-shutter", daemon=True)
        self._thread.start()

    def _close(self) -> None:
        """End the thread and the renderer: all cameras close together."""
        self._closed = True
        self._thread.join(1.0)
        if self._renderer is not None:
            self._renderer.close()

    def _run(self) -> None:
        clock, stamp_ns = self._clock, self._clock.now_ns()
        try:
            while not self._closed:
                due_ns = stamp_ns + _LATENCY_NS
                while (left_ns := due_ns - clock.now_ns()) > 0 and not self._closed:
                    time.sleep(left_ns / 1e9)
                self._due_ns = due_ns
                try:
                    frames = self._looked(stamp_ns)
                finally:
                    self._due_ns = None
                for camera, frame in zip(self.cameras, frames, strict=False):
                    camera.add(frame)
                behind = max(clock.now_ns() - due_ns, 0) // self._period_ns
                stamp_ns += (behind + 1) * self._period_ns
        except OSError as error:
            while not self._closed:
                for camera in self.cameras:
                    camera.add(None, error)
                time.sleep(RETRY_S)  # the renderer is gone

    def _looked(self, stamp_ns: int) -> list[Frame]:
        if self._renderer is None:
            detections = self._world.detections(stamp_ns)
            return [Frame(stamp_ns + self._late_ns, None, one) for one in detections]
        times_ns = stamp_ns + (1e9 * track_times_s()).astype(int)
        poses = np.array([self._world.state(int(t))[:3] for t in times_ns])
        return [Frame(stamp_ns + self._late_ns, image) for image in self._renderer.render(poses)]


def open_vehicle(setup: Setup) -> SimVehicle:
    """Open the simulated vehicle at the start of its route.

    Options: corner_sigma_px (0.3).
    """
    settings = WorldSettings(
        corner_sigma_px=number(setup.options, "corner_sigma_px", 0.3, 0.0, 10.0)
    )
    now_ns = time.monotonic_ns()
    world = SimWorld(
        setup.rig, setup.markers, setup.vehicle, setup.start_pose, now_ns, settings, setup.seed
    )
    world.state(now_ns + 1)  # compiled now, and not while the loop waits
    world.detections(now_ns + 1)
    return SimVehicle(world)


setattr(open_vehicle, "shares_process", True)  # noqa: B010  (mypy: a function has no such field)


def open_cameras(setup: Setup, vehicle: AnyVehicle) -> Sequence[Camera]:
    """Open the cameras of the simulated vehicle, or of any vehicle that has a `world: SimWorld`.

    Options: rate_hz (30), images (false).
    """
    world = getattr(vehicle, "world", None)
    if not isinstance(world, SimWorld):
        raise BadInput("--cameras", "sim looks at the `world` of a vehicle, and this one lacks it")
    renderer = None
    if switch(setup.options, "images"):
        renderer = RenderingProcess(setup.rig, setup.markers, setup.seed)
    rate_hz = number(setup.options, "rate_hz", 30.0, 1.0, 240.0)
    clock = vehicle.waiting_clock if isinstance(vehicle, HasTime) else WaitingClock()
    return _Shutter(world, clock, rate_hz, renderer, setup.rig.names).cameras
