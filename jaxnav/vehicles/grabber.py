"""A camera whose driver may block: a thread of its own asks it, and `read` never waits too long.

Who reads slowly gets the newest picture, not the oldest.
"""

import contextlib
import threading
import time
from collections.abc import Callable

from jaxnav.loop.interfaces import Frame

_PATIENCE_S = 0.5  # what `close` grants a driver that hangs, before it leaves the thread behind
_RETRY_S = 0.25  # after an error


class Grabber:
    """A `Camera`, made of two functions of a driver that only one thread may call."""

    def __init__(
        self,
        name: str,
        grab: Callable[[], Frame | None],
        release: Callable[[], None],
        pause_s: float = 0.0,
    ):
        """Start to grab.

        Args:
            name: as the rig calls it.
            grab: the next frame, whose image is the caller's to keep; None: there is no new
                one. May block, and raise OSError.
            release: lets go of the hardware; called once, after the last `grab`.
            pause_s: after each None.
        """
        self._name, self._grab, self._release, self._pause_s = name, grab, release, pause_s
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._frame: Frame | None = None
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._run, name=f"camera {name}", daemon=True)
        self._thread.start()

    @property
    def name(self) -> str:
        """As the rig calls it."""
        return self._name

    def read(self, timeout_s: float) -> Frame | None:
        """The newest frame that was not read yet; None where there is none within the time.

        Raises:
            OSError: the driver failed, or the camera is closed.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                if self._closing.is_set():
                    raise OSError(f"the camera {self._name} is closed")
                if self._frame is not None:
                    frame, self._frame = self._frame, None
                    return frame
                if self._error is not None:
                    error, self._error = self._error, None
                    raise OSError(f"the camera {self._name}: {error}") from error
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    return None
                self._changed.wait(left_s)

    def close(self) -> None:
        """Let go of the hardware; a `read` that waits returns. Any number of times."""
        with self._changed:
            self._closing.set()
            self._changed.notify_all()
        self._thread.join(_PATIENCE_S)

    def _run(self) -> None:
        while not self._closing.is_set():
            frame, failure, pause_s = None, None, self._pause_s
            try:
                frame = self._grab()
            except OSError as error:
                failure, pause_s = error, _RETRY_S
            except Exception as error:
                # Drivers raise what they like; a thread that died of it would say nothing.
                failure, pause_s = OSError(f"{type(error).__name__}: {error}"), _RETRY_S
            with self._changed:
                self._frame = self._frame if frame is None else frame
                self._error = failure
                self._changed.notify_all()
            if frame is None:
                self._closing.wait(pause_s)
        with contextlib.suppress(Exception):  # nobody is left who could do anything about it
            self._release()
