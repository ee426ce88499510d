"""Cameras whose pictures come in a thread of their own, so that `read` keeps its timeout.

A slow reader gets the newest picture, not the oldest.
"""

import contextlib
import threading
import time
from collections.abc import Callable

from jaxnav.drive.interfaces import Frame

_PATIENCE_S = 0.5  # time that `close` waits for a hanging driver, before it abandons the thread
RETRY_S = 0.25  # after an error


class NewestFrame:
    """A `Camera` that another thread feeds by `add`."""

    def __init__(self, name: str, leave: Callable[[], None]):
        """Args:
        name: the camera's name in the rig.
        leave: called whenever the camera is closed.
        """
        self.name, self._leave = name, leave
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._frame: Frame | None = None
        self._error: OSError | None = None

    def add(self, frame: Frame | None, error: OSError | None = None) -> None:
        """Take a frame, if there is one, and an error that the next read raises, or none."""
        with self._changed:
            self._frame = self._frame if frame is None else frame
            self._error = error
            self._changed.notify_all()

    def read(self, timeout_s: float) -> Frame | None:
        """The newest frame that was not read yet; None if none comes within the timeout.

        Raises:
            OSError: the driver failed, or the camera is closed.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                if self._closing.is_set():
                    raise OSError(f"the camera {self.name} is closed")
                if self._frame is not None:
                    frame, self._frame = self._frame, None
                    return frame
                if self._error is not None:
                    error, self._error = self._error, None
                    raise OSError(f"the camera {self.name}: {error}") from error
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    return None
                self._changed.wait(left_s)

    def close(self) -> None:
        """Leave the source; a waiting `read` returns. May be called any number of times."""
        with self._changed:
            self._closing.set()
            self._changed.notify_all()
        self._leave()


class Grabber(NewestFrame):
    """A camera made of two functions of a driver that may block, which only one thread calls."""

    def __init__(
        self,
        name: str,
        grab: Callable[[], Frame | None],
        release: Callable[[], None],
        pause_s: float = 0.0,
    ):
        """Start to grab frames.

        Args:
            name: the camera's name in the rig.
            grab: returns the next frame, whose image the caller may keep, or None if there is no
                new one. May block, and raise OSError.
            release: releases the hardware; called once, after the last `grab`.
            pause_s: pause after each None.
        """
        super().__init__(name, lambda: self._thread.join(_PATIENCE_S))
        self._grab, self._release, self._pause_s = grab, release, pause_s
        self._thread = threading.Thread(target=self._run, name=f"camera {name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._closing.is_set():
            frame, failure, pause_s = None, None, self._pause_s
            try:
                frame = self._grab()
            except OSError as error:
                failure, pause_s = error, RETRY_S
            except Exception as error:
                # Drivers raise any exception; a thread that died of one would not report it.
                failure, pause_s = OSError(f"{type(error).__name__}: {error}"), RETRY_S
            self.add(frame, failure)
            if frame is None:
                self._closing.wait(pause_s)
        with contextlib.suppress(Exception):  # nothing could be done about it
            self._release()
