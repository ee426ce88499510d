"""Check the promises of cameras one by one."""

import contextlib
import math
import threading
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from jaxnav.detection.observe import are_mirrored
from jaxnav.detection.types import Detections
from jaxnav.drive.interfaces import Camera, Frame, Odometry, OpenCameras, Setup, Vehicle
from jaxnav.drive.plugins import missing_members
from jaxnav.vehicles.conformance.calls import HANGS_S, Worker, check_stamp, start_call

_PATIENCE_S = 3.0  # time within which the first frames must come
_FRAMES = 5
_LATE_S = 0.2  # time that a camera may need beyond its timeout


def check_cameras(factory: OpenCameras, setup: Setup, vehicle: Vehicle | None = None) -> None:
    """Open the cameras, read each in a thread of its own, and close them.

    Args:
        vehicle: passed to the factory; by default one that stands still.

    Raises:
        AssertionError: its message says which promise is broken.
    """
    cameras = factory(setup, vehicle or Parked())
    assert isinstance(cameras, Sequence), "the factory gives no sequence of cameras"
    try:
        for index, camera in enumerate(cameras):
            lacking = missing_members(camera, Camera)
            assert not lacking, f"camera {index} has no {', '.join(lacking)}"
        names = tuple(camera.name for camera in cameras)
        assert names == setup.rig.names, (
            f"the cameras are {', '.join(names)}, those of the rig {', '.join(setup.rig.names)}"
        )
        looks = [
            start_call(partial(_check_camera, camera, size_px))
            for camera, size_px in zip(cameras, setup.rig.image_sizes_px, strict=True)
        ]
        for name, look in zip(names, looks, strict=True):
            look(f"the check of the camera {name}", 10 * HANGS_S)
    finally:
        for camera in cameras:
            with contextlib.suppress(Exception):  # an error here would hide the one found
                start_call(camera.close)("close()", HANGS_S)


class Parked:
    """A vehicle that stands still, for cameras that need one."""

    timeout_s = math.inf

    def read(self) -> Odometry:
        return Odometry(time.monotonic_ns(), 0.0, 0.0)

    def write(self, steering_rad: float, throttle: float) -> None:
        pass

    def stop(self) -> None:
        pass

    def close(self) -> None:
        pass


def _check_camera(camera: Any, size_px: tuple[int, int]) -> None:
    """Read a camera in one thread, and close it from another."""
    reader = Worker()
    try:
        _check_frames(camera, reader, size_px)
        _check_closing(camera, reader)
    finally:
        reader.close()


def _check_frames(camera: Any, reader: Worker, size_px: tuple[int, int]) -> None:
    """Check the first frames, and that later reads do not change them."""
    frames: list[tuple[Frame, np.ndarray | None]] = []
    failure = None
    begin_s = time.monotonic()
    for timeout_s in _timeouts(begin_s + _PATIENCE_S):
        if len(frames) == _FRAMES:
            break
        frame, error = _read_in_time(camera, reader, timeout_s)
        failure = error or failure
        if frame is not None:
            _check_frame(frame, camera.name, size_px)
            if frames:
                newer = frame.stamp_ns > frames[-1][0].stamp_ns
                assert newer, f"the camera {camera.name} gives the same or an older stamp again"
            frames.append((frame, None if frame.image is None else frame.image.copy()))
        if error is not None:
            time.sleep(0.05)
    assert len(frames) == _FRAMES, (
        f"the camera {camera.name} gave {len(frames)} frames in {_PATIENCE_S:g} s,"
        f" expected {_FRAMES}" + (f": {failure}" if failure else "")
    )
    for frame, image in frames:
        assert image is None or np.array_equal(np.asarray(frame.image), image), (
            f"the camera {camera.name} changes the image of a frame that was already read"
        )


def _timeouts(end_s: float) -> Iterator[float]:
    """Yield timeouts until `end_s`; some are too short for any camera."""
    while time.monotonic() < end_s:
        yield from (0.0, 0.2, 0.001, 1.0)


def _read_in_time(camera: Any, reader: Worker, timeout_s: float) -> tuple[Any, OSError | None]:
    what = f"read({timeout_s:g}) of the camera {camera.name}"
    called_s = time.monotonic()
    frame, error = reader.call(what, partial(camera.read, timeout_s))
    took_s = time.monotonic() - called_s
    assert took_s <= timeout_s + _LATE_S, f"{what} took {took_s:.2g} s"
    return frame, error


def _check_frame(frame: object, name: str, size_px: tuple[int, int]) -> None:
    what = f"a frame of the camera {name}"
    assert isinstance(frame, Frame), f"read() gives {frame!r}, expected a Frame or None"
    check_stamp(what, frame.stamp_ns)
    assert frame.image is not None or frame.detections is not None, (
        f"{what} holds neither an image nor detections"
    )
    if frame.detections is not None:
        assert isinstance(frame.detections, Detections), f"the detections of {what} are none"
        shape, count = frame.detections.corners_px.shape, len(frame.detections)
        assert shape == (count, 4, 2), f"the corners of {what} have the shape {shape}"
        assert not are_mirrored(frame.detections.corners_px, frame.detections.sigma_px).any(), (
            f"the corners of {what} run anticlockwise, not from top left to top right and on"
        )
    if frame.image is not None:
        image, (width_px, height_px) = np.asarray(frame.image), size_px
        assert image.dtype == np.uint8, f"the image of {what} is {image.dtype}, expected uint8"
        assert image.shape in ((height_px, width_px), (height_px, width_px, 3)), (
            f"the image of {what} has the shape {image.shape}, the rig says {width_px}x{height_px}"
        )


def _check_closing(camera: Any, reader: Worker) -> None:
    """Check `close` while a `read` waits, a second `close`, and a `read` after it."""
    closed = threading.Event()

    def read_on() -> None:
        while not closed.is_set():
            with contextlib.suppress(OSError):
                camera.read(60.0)

    reading = reader.begin(read_on)
    time.sleep(0.02)
    try:
        start_call(camera.close)(f"close() of the camera {camera.name}", HANGS_S)
    finally:
        closed.set()
    reading(f"a read() of the camera {camera.name} that waits while close() is called", 1.0)
    start_call(camera.close)(f"a second close() of the camera {camera.name}", HANGS_S)
    _read_in_time(camera, reader, 0.0)
