"""Cameras that look at the world from where a `PlainCar` must be by what it was told."""

import threading
import time
from pathlib import Path

from jaxnav.drive.interfaces import Frame, Setup
from jaxnav.vehicles.world import SimWorld
from tests.helpers import plain_car

NAME = f"{__name__}:open_cameras"
_PERIOD_S, _LATE_NS = 1 / 30, 20_000_000


class Eyes:
    """All cameras look at once; each hands over what it saw."""

    def __init__(self, setup: Setup):
        begin_ns = time.monotonic_ns()
        self._world = SimWorld(
            setup.rig, setup.markers, setup.vehicle, setup.start_pose, begin_ns, seed=setup.seed
        )
        self._world.detections(begin_ns + 1)
        self._log, self._told = Path(setup.options["log"]), 0
        self._news, self._closed = threading.Condition(), False
        self._stamp_ns, self._found = 0, []
        threading.Thread(target=self._look, daemon=True).start()

    def frame(self, camera, after_ns, timeout_s):
        with self._news:
            self._news.wait_for(lambda: self._closed or self._stamp_ns > after_ns, timeout_s)
            if self._stamp_ns <= after_ns:
                return None
            return Frame(self._stamp_ns, None, self._found[camera])

    def close(self):
        with self._news:
            self._closed = True
            self._news.notify_all()

    def _look(self):
        while not self._closed:
            time.sleep(_PERIOD_S)
            told = plain_car.words(self._log)
            for word in told[self._told :]:
                self._world.write(word.steering_rad, word.throttle, word.stamp_ns)
            self._told = len(told)
            stamp_ns = time.monotonic_ns() - _LATE_NS
            found = self._world.detections(stamp_ns)
            with self._news:
                self._stamp_ns, self._found = stamp_ns, found
                self._news.notify_all()


class Camera:
    """One of them."""

    def __init__(self, name, index, eyes):
        self.name, self._index, self._eyes, self._last_ns = name, index, eyes, 0

    def read(self, timeout_s):
        frame = self._eyes.frame(self._index, self._last_ns, timeout_s)
        if frame is not None:
            self._last_ns = frame.stamp_ns
        return frame

    def close(self):
        self._eyes.close()


def open_cameras(setup, vehicle):
    """Option: log, the car's."""
    eyes = Eyes(setup)
    return [Camera(name, index, eyes) for index, name in enumerate(setup.rig.names)]
