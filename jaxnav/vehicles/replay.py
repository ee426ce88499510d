"""Replay a recorded drive as a vehicle in real time: nothing moves, all data come as they came.

jaxnav run --car replay --option drive=drive.mcap       # detections as recorded
    --option images=true                                    # the recorded images

The clock of the recording starts when it is first read; data arrive at their recorded times, with
their recorded ages, and their stamps are shifted into the present. Readings and frames that were
invalid are invalid again, and a read that failed fails. The whole drive is held in memory, with
its JPEGs if `images` is true.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.core.models.rig import CameraRig
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import AnyVehicle, Camera, Frame, GyroReading, OwnFiles, Reading, Setup
from jaxnav.drive.standing_clock import WaitingClock
from jaxnav.errors import BadInput
from jaxnav.files.images import decode_image
from jaxnav.recordings.drive_log import DriveLog, read_drive
from jaxnav.recordings.drive_replay import check_inputs, recorded_pixels
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.vehicles.options import switch

_WAITS_NS = 50_000_000  # longest wait of a reading when several came between two looks
_LINGERS_NS = 50_000_000  # time after the last input for the search of its markers


class Clock:
    """The clock of a recording, which starts when it is first read. Thread-safe."""

    def __init__(self, begin_ns: int, present: WaitingClock):
        """Args:
        begin_ns: begin of the recording, on its own clock.
        present: the time of the drive.
        """
        self._begin_ns, self._present = begin_ns, present
        self._shift_ns: int | None = None
        self._lock = threading.Lock()

    @property
    def is_running(self) -> bool:
        """Whether the clock has started."""
        return self._shift_ns is not None

    def recorded_ns(self) -> int:
        """The present time on the recording's clock."""
        shift_ns = self._shift()
        return self._present.now_ns() - shift_ns

    def present_ns(self, stamp_ns: int) -> int:
        """A recorded stamp on the present clock; a stamp that is not positive stays as it is."""
        return stamp_ns + self._shift() if stamp_ns > 0 else stamp_ns

    def _shift(self) -> int:
        with self._lock:
            if self._shift_ns is None:
                self._shift_ns = self._present.now_ns() - self._begin_ns
            return self._shift_ns


class ReplayVehicle:
    """The vehicle of a recording: reads give the recorded readings, commands are only counted.

    Attributes:
        recorded: the recording.
        camera_names: names of its cameras, in the order of its rig.
        waiting_clock: see `HasTime`.
        clock: the clock of the vehicle and its cameras.
        writes: number of commands written.
        throttle: of the last command, or the largest part of a twist; 0 after a stop.
    """

    shares_process = True  # its cameras share its clock
    timeout_s = 0.2  # the car stands whatever the command, so any time is true

    def __init__(self, setup: Setup):
        """Options: drive, the recording; images (false).

        Raises:
            BadInput: the file is missing, no recording, empty or damaged, or an option is wrong.
        """
        self.recorded, own = _recorded(setup.options)
        self.camera_names = own.rig.names
        self.waiting_clock = WaitingClock()
        self.clock = Clock(self.recorded.inputs[0].now_ns, self.waiting_clock)
        self.writes, self.throttle = 0, 0.0
        self._end_ns = self.recorded.inputs[-1].now_ns + _LINGERS_NS
        # The time of each read of the vehicle, and its reading; None: the read failed.
        self._readings = [
            (given.now_ns, given.odometry)
            for given in self.recorded.inputs
            if given.odometry is not None or Fault.VEHICLE_FAILED in given.faults
        ]
        self._next = 0
        self._gyro = deque(
            (given.now_ns, given.gyro) for given in self.recorded.inputs if given.gyro
        )
        self._reading: Reading | None = None
        self._closed = False

    @staticmethod
    def own_files(options: Mapping[str, str]) -> OwnFiles:
        """See `HasOwnFiles`: the files with which the drive was recorded."""
        _, own = _recorded(options)
        return OwnFiles(own.rig, own.markers, own.vehicle, own.route)

    @property
    def over(self) -> str | None:
        """See `Ending`. Asking for it does not start the recording."""
        is_over = self.clock.is_running and self.clock.recorded_ns() > self._end_ns
        return "the recording is over" if is_over else None

    def read(self) -> Any:
        """See `Vehicle` and `TwistVehicle`. Readings since the last call come one by one, if not
        too late; at the end the last one repeats.

        Raises:
            OSError: the recorded read failed, there is no reading yet, or the vehicle is closed.
        """
        now_ns = self.clock.recorded_ns()
        while self._next < len(self._readings) and self._readings[self._next][0] <= now_ns:
            due_ns, self._reading = self._readings[self._next]
            self._next += 1
            if now_ns - due_ns < _WAITS_NS:
                break
        if self._closed or self._reading is None:
            raise OSError("the vehicle is closed" if self._closed else "nothing was read")
        reading = self._reading
        return replace(reading, stamp_ns=self.clock.present_ns(reading.stamp_ns))

    def read_gyro(self) -> list[GyroReading]:
        """See `HasGyro`."""
        now_ns, readings = self.clock.recorded_ns(), []
        while self._gyro and self._gyro[0][0] <= now_ns:
            for one in self._gyro.popleft()[1]:
                readings.append(replace(one, stamp_ns=self.clock.present_ns(one.stamp_ns)))
        return readings

    def write(self, *command: float) -> None:
        """See `Vehicle` and `TwistVehicle`. The command moves nothing."""
        if self._closed:
            raise OSError("the vehicle is closed")
        moves = command[1:] if len(command) == 2 else command
        self.writes, self.throttle = self.writes + 1, max(moves, key=abs)

    def stop(self) -> None:
        """See `Vehicle`."""
        self.throttle = 0.0

    def close(self) -> None:
        """See `Vehicle`."""
        self._closed = True
        self.stop()


class ReplayCamera:
    """One camera of the recording."""

    def __init__(
        self,
        name: str,
        clock: Clock,
        frames: Sequence[tuple[int, FrameDetections]],
        jpegs: Mapping[int, bytes],
    ):
        """Args:
        frames: (time of handling in ns of the recording, frame), in the order of time.
        jpegs: recorded stamp in ns -> the image to show in place of detections.
        """
        self.name, self._clock = name, clock
        self._frames, self._jpegs = frames, jpegs
        self._next = 0
        self._closed = threading.Event()

    def read(self, timeout_s: float) -> Frame | None:
        """See `Camera`. A frame that could not be used has no image."""
        left_s, due_ns = np.inf, 0
        if self._next < len(self._frames):
            due_ns, sighted = self._frames[self._next]
            left_s = max(due_ns - self._clock.recorded_ns(), 0) / 1e9
        if self._closed.wait(min(left_s, timeout_s)) or left_s > timeout_s:
            return None
        if self._clock.recorded_ns() < due_ns:  # it waits for who is behind
            return None
        self._next += 1
        stamp_ns = self._clock.present_ns(sighted.stamp_ns)
        if sighted.stamp_ns in self._jpegs:
            return Frame(stamp_ns, decode_image(self._jpegs[sighted.stamp_ns]))
        return Frame(stamp_ns, None, sighted.detections)

    def close(self) -> None:
        """See `Camera`."""
        self._closed.set()


def open_cameras(setup: Setup, vehicle: AnyVehicle) -> Sequence[Camera]:
    """Open the recording's cameras, by their names in the rig.

    Options: images (false): show the recorded images, which are then searched for markers.

    Raises:
        BadInput: another vehicle; a camera that was not recorded; images that are missing, can't be
            decoded or have another size than the rig's.
    """
    if not isinstance(vehicle, ReplayVehicle):
        raise BadInput("--cameras", "replay shows what --car replay has recorded")
    log, rig = vehicle.recorded, setup.rig
    for name in rig.names:
        if name not in vehicle.camera_names:
            problem = f"{log.path} has no camera {name!r}: it has {', '.join(vehicle.camera_names)}"
            raise BadInput("--rig", problem)
    frames: dict[str, list[tuple[int, FrameDetections]]] = {
        name: [] for name in vehicle.camera_names
    }
    for given in log.inputs:
        for sighted in given.frames:
            frames[vehicle.camera_names[sighted.camera]].append((given.now_ns, sighted))
    jpegs = _jpegs(log, rig) if switch(setup.options, "images") else {}
    return [
        ReplayCamera(name, vehicle.clock, frames[name], jpegs.get(name, {})) for name in rig.names
    ]


def _recorded(options: Mapping[str, str]) -> tuple[DriveLog, DriveSetup]:
    """The recording and its setup, in the precision of this process."""
    if not options.get("drive"):
        raise BadInput("--option drive", "missing: the recorded drive (.mcap)")
    path, written_ns = Path(options["drive"]), 0
    with contextlib.suppress(OSError):
        written_ns = path.stat().st_mtime_ns
    log = _read(path, written_ns)
    own = DriveSetup.from_header(log.header, path)
    if not log.inputs:
        raise BadInput(path, "holds no input")
    check_inputs(log.inputs, own, path)
    if switch(options, "images"):
        topics = [f"/camera/{name}" for name in own.rig.names]
        if not any(image.topic in topics for image in log.images()):
            raise BadInput(path, f"holds no image on {', '.join(topics)}")
    return log, own


@lru_cache(maxsize=1)
def _read(path: Path, written_ns: int) -> DriveLog:
    """Read a drive, or take it from the cache: it is needed for its files and for its data."""
    return read_drive(path)


def _jpegs(log: DriveLog, rig: CameraRig) -> dict[str, dict[int, bytes]]:
    """The JPEGs of each camera of a rig, by their stamps."""
    jpegs: dict[str, dict[int, bytes]] = {name: {} for name in rig.names}
    for image in log.images():
        name = image.topic.removeprefix("/camera/")
        if name not in jpegs:
            continue
        if not jpegs[name]:
            recorded_pixels(log, image, rig, rig.names.index(name))
        jpegs[name][image.stamp_ns] = image.jpeg
    return jpegs
