"""The only way to the vehicle, and the dog that watches it (RELIABILITY R5 and R10).

    guard = Guard(vehicle, limits)
    guard.arm()
    guard.write(steering_rad, throttle)     # again and again, or it stops the vehicle
    guard.close()

A thread of its own, the monotonic clock, and nothing of JAX. It stops the vehicle when no fresh
command came for a while, when a watched thread hangs, on a signal, on a command that is no number,
and when it is told to. Once it has, it does not arm again: whoever wants to drive on starts anew.
"""

import atexit
import math
import os
import select
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

from jaxnav.runtime.corrections import Corrections
from jaxnav.runtime.interfaces import Vehicle
from jaxnav.runtime.limits import Limits

TIMEOUT_S = 0.2
_LOOK_S = 0.02  # between two looks of the dog
_LOCK_S = 0.02  # so long it waits for a thread that is inside the driver


class Guard:
    """For any thread. `write` is called by one."""

    def __init__(
        self,
        vehicle: Vehicle,
        limits: Limits,
        timeout_s: float = TIMEOUT_S,
        now_ns: Callable[[], int] = time.monotonic_ns,
        corrections: Corrections | None = None,
    ):
        """Disarmed: nothing but zero throttle gets through.

        Args:
            corrections: what the servo is told for a true angle; by default the angle.
            timeout_s: from the last sign of life until the vehicle has been stopped.
        """
        self._vehicle, self._limits, self._now_ns = vehicle, limits, now_ns
        self._corrections = corrections or Corrections()
        self._timeout_ns = int((timeout_s - 1.5 * _LOOK_S) * 1e9)
        self._lock = threading.Lock()
        self._armed = False
        self._reason: str | None = None
        self._tripped = threading.Event()
        self._closed = threading.Event()
        self._beats: dict[str, int] = {}  # when each watched thread was last alive
        self._steering_rad, self._written_ns = 0.0, now_ns()
        self._signals: dict[int, Any] = {}
        self._wakeup: tuple[int, int] | None = None
        self.signal: int | None = None  # that ended it
        self._thread = threading.Thread(target=self._watch, name="jaxnav-guard", daemon=True)
        self._thread.start()
        atexit.register(self._at_exit)

    @property
    def tripped(self) -> bool:
        """Whether the vehicle was stopped for good."""
        return self._tripped.is_set()

    @property
    def reason(self) -> str | None:
        """Why."""
        return self._reason

    def wait(self, timeout_s: float) -> bool:
        """Sleep, and wake when it trips: whether it has."""
        return self._tripped.wait(timeout_s)

    def arm(self) -> None:
        """From now on commands get through, and must come."""
        with self._lock:
            now_ns = self._now_ns()
            self._written_ns = now_ns
            self._beats = dict.fromkeys(self._beats, now_ns)
            self._armed = not self.tripped

    def beat(self, name: str) -> None:
        """A sign of life of a thread, which is watched from its first one on."""
        self._beats[name] = self._now_ns()

    def leave(self, name: str) -> None:
        """A thread ends as it should: it is watched no more."""
        self._beats.pop(name, None)

    def write(self, steering_rad: float, throttle: float) -> bool:
        """A command, inside the limits whatever it says.

        Returns:
            Whether the vehicle took it. A driver that can't write now gets the next one.
        """
        if not (math.isfinite(steering_rad) and math.isfinite(throttle)):
            self.trip(f"the command was no number: {steering_rad}, {throttle}")
            return False
        with self._lock:
            if self.tripped:
                return False
            now_ns = self._now_ns()
            elapsed_s = (now_ns - self._written_ns) / 1e9
            steering_rad, throttle = self._limits.applied(
                steering_rad, throttle if self._armed else 0.0, self._steering_rad, elapsed_s
            )
            try:
                self._vehicle.write(self._corrections.servo_rad(steering_rad), throttle)
            except OSError:
                return False
            self._steering_rad, self._written_ns = steering_rad, now_ns
            return True

    def trip(self, reason: str) -> None:
        """Stop the vehicle, now and for good. From any thread."""
        # A thread that hangs inside the driver holds the lock: then without it.
        held = self._lock.acquire(timeout=_LOCK_S)
        try:
            if self._reason is None:
                self._reason = reason
            self._armed = False
            self._tripped.set()
            self._stop()
        finally:
            if held:
                self._lock.release()

    def close(self) -> None:
        """Stop and let go of the vehicle. Any number of times."""
        if self._closed.is_set():
            return
        self.trip("closed")
        self._closed.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(1.0)
        self._give_signals_back()
        atexit.unregister(self._at_exit)
        with suppress(Exception):
            self._vehicle.close()
        self._stop()

    def watch_signals(self, numbers: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM)) -> None:
        """Stop the vehicle on a signal, also while the main thread is inside a library.

        Only the main thread may call it; `close` gives the old handlers back.
        """
        read_fd, write_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._wakeup = read_fd, write_fd
        signal.set_wakeup_fd(write_fd, warn_on_full_buffer=False)
        for number in numbers:
            self._signals[number] = signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.signal = self.signal or number

    def _watch(self) -> None:
        while not self._closed.is_set():
            self._look_at_signals()
            if self._armed and not self.tripped:
                now_ns = self._now_ns()
                if now_ns - self._written_ns > self._timeout_ns:
                    self.trip(f"no fresh command for {(now_ns - self._written_ns) / 1e9:.2f} s")
                for name, beat_ns in list(self._beats.items()):
                    if now_ns - beat_ns > self._timeout_ns:
                        self.trip(f"{name} hangs for {(now_ns - beat_ns) / 1e9:.2f} s")

    def _look_at_signals(self) -> None:
        """Wait a little, for a signal."""
        if self._wakeup is None:
            self._closed.wait(_LOOK_S)
            return
        ready, _, _ = select.select([self._wakeup[0]], [], [], _LOOK_S)
        if ready:
            with suppress(OSError):
                for number in os.read(self._wakeup[0], 64):
                    if number in self._signals:
                        self.signal = self.signal or number
                        self.trip(signal.Signals(number).name)

    def _give_signals_back(self) -> None:
        if self._wakeup is None:
            return
        for number, handler in self._signals.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(-1)
        for descriptor in self._wakeup:
            os.close(descriptor)
        self._wakeup = None

    def _stop(self) -> None:
        for _ in range(3):
            try:
                self._vehicle.stop()
            except Exception:  # whatever it is, try again: there is nothing else to do
                time.sleep(0.002)
            else:
                return

    def _at_exit(self) -> None:
        self.trip("the program ends")
