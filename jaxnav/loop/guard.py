"""The only way to the vehicle, and the dog that watches it; see docs/promises.md, It stops.

    guard = Guard(vehicle, limits)
    guard.arm()
    guard.write(steering_rad, throttle)     # again and again, or it stops the vehicle
    guard.close()

A thread of its own, the monotonic clock, and nothing of JAX. It stops the vehicle when no fresh
command came for a while, when a watched thread hangs, on a command that is no number, and when it
is told to. It says stop until the vehicle has heard it, and once more after anything that might
have undone it. Once it has stopped it does not arm again: whoever wants to drive on starts anew.

A thread can't act while C code of the same process holds the interpreter, nor once the process is
gone: vehicles that can be moved have a guard in a process of its own (see `guard_process`), and the
one here beside it.
"""

import atexit
import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from jaxnav.loop.corrections import Corrections
from jaxnav.loop.interfaces import Vehicle
from jaxnav.loop.limits import Limits

TIMEOUT_S = 0.2
_LOOK_S = 0.02  # between two looks of the dog
_LOCK_S = 0.02  # so long it waits for a thread that is inside the driver
_AGAIN_S = 0.1  # between two stops of a vehicle that has heard the first one
HEARD_WITHIN_S = 10.0  # so long `close` goes on with a vehicle that does not hear


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
        self._deadline_ns = self._written_ns
        self._unheard: str | None = None  # why the last stop did not reach the vehicle
        self._stopped_s = 0.0  # when the last one did
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

    @property
    def unheard(self) -> str | None:
        """Why the vehicle has not heard that it should stop; None: it has, or was not told."""
        return self._unheard

    def wait(self, timeout_s: float | None = None) -> bool:
        """Sleep, and wake when it trips: whether it has."""
        return self._tripped.wait(timeout_s)

    def arm(self) -> None:
        """From now on commands get through, and must come."""
        with self._lock:
            now_ns = self._now_ns()
            self._written_ns = now_ns
            self._deadline_ns = now_ns + self._timeout_ns
            self._beats = dict.fromkeys(self._beats, now_ns)
            self._armed = not self.tripped

    def beat(self, name: str) -> None:
        """A sign of life of a thread, which is watched from its first one on."""
        self._beats[name] = self._now_ns()

    def leave(self, name: str) -> None:
        """A thread ends as it should: it is watched no more."""
        self._beats.pop(name, None)

    def write(self, steering_rad: float, throttle: float, deadline_ns: int | None = None) -> bool:
        """A command, inside the limits whatever it says.

        Args:
            deadline_ns: by when the next one must have come; by default the guard's own time from
                now. A command whose own deadline is over is not obeyed.

        Returns:
            Whether the vehicle took it. A driver that can't write now gets the next one.
        """
        if not (math.isfinite(steering_rad) and math.isfinite(throttle)):
            self.trip(f"the command was no number: {steering_rad}, {throttle}")
            return False
        if not self._thread.is_alive() and not self._closed.is_set():
            self.trip("the guard's own thread has ended")
        with self._lock:
            now_ns = self._now_ns()
            if self.tripped or (deadline_ns is not None and deadline_ns <= now_ns):
                return False
            elapsed_s = (now_ns - self._written_ns) / 1e9
            steering_rad, throttle = self._limits.applied(
                steering_rad, throttle if self._armed else 0.0, self._steering_rad, elapsed_s
            )
            try:
                self._vehicle.write(self._corrections.servo_rad(steering_rad), throttle)
            except OSError:
                return False
            finally:
                if self.tripped:  # meanwhile: what was written last must not be a throttle
                    self._stop()
            self._steering_rad, self._written_ns = steering_rad, now_ns
            self._deadline_ns = now_ns + self._timeout_ns if deadline_ns is None else deadline_ns
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

    def close(self, heard_within_s: float = HEARD_WITHIN_S) -> None:
        """Stop and let go of the vehicle. Any number of times.

        Args:
            heard_within_s: so long it goes on saying stop to a vehicle that does not hear; then
                `unheard` says why.
        """
        if self._closed.is_set():
            return
        self.trip("closed")
        end_s = time.monotonic() + heard_within_s
        while self._unheard is not None and time.monotonic() < end_s:
            time.sleep(_LOOK_S)
            self._stop()
        self._closed.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(1.0)
        atexit.unregister(self._at_exit)
        with suppress(Exception):
            self._vehicle.close()
        with suppress(Exception):  # once more, for a driver that let go without a word
            self._vehicle.stop()

    def _watch(self) -> None:
        while not self._closed.wait(self._until_next_look_s()):
            try:
                self._look()
            except Exception as error:  # a dog that dies unseen watches nothing
                self.trip(f"the guard failed: {type(error).__name__}: {error}")

    def _until_next_look_s(self) -> float:
        if not self._armed or self.tripped:
            return _LOOK_S
        return min(max((self._deadline_ns - self._now_ns()) / 1e9, 0.001), _LOOK_S)

    def _look(self) -> None:
        if self.tripped:
            if self._unheard is not None or time.monotonic() - self._stopped_s > _AGAIN_S:
                self._stop()
            return
        if not self._armed:
            return
        now_ns = self._now_ns()
        if now_ns > self._deadline_ns:
            self.trip(f"no fresh command for {(now_ns - self._written_ns) / 1e9:.2f} s")
        for name, beat_ns in list(self._beats.items()):
            if now_ns - beat_ns > self._timeout_ns:
                self.trip(f"{name} hangs for {(now_ns - beat_ns) / 1e9:.2f} s")

    def _stop(self) -> None:
        """Say it once; `_look` and `close` say it again until it is heard."""
        try:
            self._vehicle.stop()
        except Exception as error:  # whatever it is, there is nothing else to do but try again
            self._unheard = f"{type(error).__name__}: {error}"
        else:
            self._unheard, self._stopped_s = None, time.monotonic()

    def _at_exit(self) -> None:
        self.trip("the program ends")
