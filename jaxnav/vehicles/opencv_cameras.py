"""Read cameras with OpenCV's VideoCapture: USB and CSI cameras, or video files in their place.

Options: `source.<camera>` for each camera of the rig, which is one of

    /dev/video0, /dev/v4l/by-id/..., 0     a V4L2 device
    drive.avi                              a video file, played once at its own frame rate
    nvarguscamerasrc sensor-id=0 ! ... ! appsink drop=true max-buffers=1      GStreamer

and `latency_ms`, from the middle of the exposure until the picture is received.
"""

import re
import time
from pathlib import Path

import cv2
import numpy as np

from jaxnav.drive.interfaces import Camera, Frame, Setup, Vehicle
from jaxnav.errors import BadInput
from jaxnav.files.images import open_video
from jaxnav.vehicles.grabber import Grabber
from jaxnav.vehicles.options import by_camera, latency_ns

_PREFIX = "source."
_DEFAULT_RATE_HZ = 30.0  # of a file that does not say


def open_cameras(setup: Setup, vehicle: Vehicle | None) -> list[Camera]:
    """Open one source for each camera of the rig.

    Raises:
        BadInput: a source is missing, can't be opened, or gives images of another size.
    """
    names, options = setup.rig.names, setup.options
    sources = by_camera(options, _PREFIX, names)
    delay_ns = latency_ns(options)
    captures: list[_Capture] = []
    try:
        for name, size_px in zip(names, setup.rig.image_sizes_px, strict=True):
            key = _PREFIX + name
            if not sources.get(name):
                raise BadInput(f"--option {key}", "missing: a device, a video or a pipeline")
            captures.append(_Capture(f"--option {key}", sources[name], size_px, delay_ns))
    except BadInput:
        for capture in captures:
            capture.release()
        raise
    return [
        Grabber(name, capture.grab, capture.release)
        for name, capture in zip(names, captures, strict=True)
    ]


setattr(open_cameras, "needs_no_vehicle", True)  # noqa: B010  (a function has no such field)


class _Capture:
    """A source of pictures, which is reopened after a failure unless it is a file."""

    def __init__(self, where: str, source: str, size_px: tuple[int, int], delay_ns: int):
        """Open the source and check one picture.

        Raises:
            BadInput: it can't be opened, gives no picture, or one of another size.
        """
        self._source, self._size_px, self._delay_ns = source, size_px, delay_ns
        device = _device(source)
        self._opened_with: tuple[str | int, int]
        self._period_s = 0.0
        if "!" in source:
            if not has_gstreamer():
                raise BadInput(
                    where,
                    "this OpenCV was built without GStreamer, as pip's always is: build OpenCV"
                    " with it, or name a V4L2 device such as /dev/video0",
                )
            self._opened_with = source, cv2.CAP_GSTREAMER
        elif device is not None:
            self._opened_with = device, cv2.CAP_V4L2
        elif Path(source).is_file():
            self._opened_with = source, cv2.CAP_ANY
        else:
            raise BadInput(where, f"there is no device or file {source}")
        self._is_file = self._opened_with[1] == cv2.CAP_ANY
        self._due_s = time.monotonic()
        self._capture: cv2.VideoCapture | None = None
        try:
            self._open()
            self.grab()
        except OSError as error:
            self.release()
            raise BadInput(where, str(error)) from error
        if self._is_file:
            self._open()  # from its beginning

    def grab(self) -> Frame:
        """Wait for the next picture.

        Raises:
            OSError: it is unplugged, at the end of its file, or gives a picture of another size.
        """
        if self._capture is None:
            self._open()
        assert self._capture is not None
        if self._is_file:
            time.sleep(max(self._due_s - time.monotonic(), 0.0))
            self._due_s = max(self._due_s + self._period_s, time.monotonic() - self._period_s)
        grabbed = self._capture.grab()
        now_ns = time.monotonic_ns()  # before it is decoded
        good, image = self._capture.retrieve() if grabbed else (False, None)
        if not good or image is None:
            if self._is_file:
                raise OSError(f"{self._source} has no more pictures")
            self.release()
            raise OSError(f"{self._source} gives no pictures any more: is it unplugged?")
        self._check(image)
        return Frame(now_ns - self._delay_ns, np.asarray(image))

    def release(self) -> None:
        """Release the source."""
        if self._capture is not None:
            self._capture.release()
        self._capture = None

    def _open(self) -> None:
        self.release()
        source, backend = self._opened_with
        capture = (
            open_video(Path(str(source))) if self._is_file else cv2.VideoCapture(source, backend)
        )
        if not capture.isOpened():
            capture.release()
            raise OSError(f"{self._source} can't be opened")
        if self._is_file:
            self._period_s = 1 / (capture.get(cv2.CAP_PROP_FPS) or _DEFAULT_RATE_HZ)
        elif backend == cv2.CAP_V4L2:
            width_px, height_px = self._size_px
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, width_px)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height_px)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # pictures in a queue are old
        self._capture = capture

    def _check(self, image: np.ndarray) -> None:
        height_px, width_px = image.shape[:2]
        if (width_px, height_px) != self._size_px:
            wanted = "x".join(map(str, self._size_px))
            raise OSError(
                f"{self._source} gives pictures of {width_px}x{height_px} px, the rig has {wanted}"
            )


def _device(source: str) -> int | None:
    """The number of a V4L2 device, which OpenCV needs to open it."""
    if re.fullmatch("[0-9]{1,6}", source):
        return int(source)
    if not source.startswith("/dev/"):
        return None
    number = re.fullmatch(r"/dev/video(\d+)", str(Path(source).resolve()))
    return int(number[1]) if number else None


def has_gstreamer() -> bool:
    """Whether this OpenCV can read GStreamer pipelines."""
    return re.search(r"GStreamer:\s+YES", cv2.getBuildInformation()) is not None
