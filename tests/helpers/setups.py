"""What plug-ins are told in tests, and drivers that keep every promise."""

import threading
import time

import numpy as np

from jaxnav.core.models.rig import CameraRig
from jaxnav.drive.interfaces import Frame, Odometry, Setup
from tests.worlds import paper_markers, qcar, qcar_rig

FULL_THROTTLE = 0.3


def setup_with(rig: CameraRig | None = None, **options: str) -> Setup:
    """The paper's car with these options; a double underscore stands for a dot."""
    named = {key.replace("__", "."): value for key, value in options.items()}
    return Setup(rig or qcar_rig(), paper_markers(), qcar(), (2.0, -1.0, 0.0), options=named)


class GoodVehicle:
    """Stands where it is, and knows what it was last told."""

    timeout_s = 0.2

    def __init__(self, setup: Setup):
        self.throttle = 0.0
        self.closed = False
        self._lock = threading.Lock()

    def read(self) -> Odometry:
        return Odometry(time.monotonic_ns(), 0.0, 0.0)

    def write(self, steering_rad: float, throttle: float) -> None:
        with self._lock:
            if self.closed:
                raise OSError("closed")
            self.throttle = throttle

    def stop(self) -> None:
        with self._lock:
            self.throttle = 0.0

    def close(self) -> None:
        self.stop()
        self.closed = True


class GoodCamera:
    """Noise, every 10 ms."""

    def __init__(self, name: str, size_px: tuple[int, int]):
        self.name, self.size_px = name, size_px
        self.closed = threading.Event()
        self.number = 0

    def image(self) -> np.ndarray:
        width_px, height_px = self.size_px
        return np.full((height_px, width_px), self.number % 256, np.uint8)

    def stamp_ns(self) -> int:
        return time.monotonic_ns()

    def read(self, timeout_s: float) -> Frame | None:
        if self.closed.wait(min(timeout_s, 0.01)) or timeout_s < 0.01:
            return None
        self.number += 1
        return Frame(self.stamp_ns(), self.image())

    def close(self) -> None:
        self.closed.set()


def good_cameras(setup: Setup, vehicle: object) -> list[GoodCamera]:
    """One for each of the rig."""
    rig = setup.rig
    return [GoodCamera(n, s) for n, s in zip(rig.names, rig.image_sizes_px, strict=True)]
