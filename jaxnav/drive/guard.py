"""The watchdog through which all commands reach the vehicle; see docs/promises.md, It stops.

    guard = Guard(vehicle, limits)
    guard.arm()
    guard.write(*command)                   # again and again, or it stops the vehicle
    guard.close()

It has its own thread, uses the monotonic clock, and imports no JAX. It stops the vehicle when no
fresh command came in time, when a watched thread hangs, on a command that is not a number, and when
told to. It repeats the stop until the vehicle has heard it, and again after anything that might
have undone it. Once tripped it does not arm again: to drive on, start a new drive. Only a vehicle
whose file says `resume: true` may drive on after a stop for being late, see `resume`.

A thread can't act while C code of the same process holds the interpreter, nor once the process is
gone: vehicles that can be moved have a guard in a process of its own (see `guard_process`) as well
as this one.
"""

import atexit
import math
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from jaxnav.drive.corrections import Corrections
from jaxnav.drive.interfaces import AnyVehicle, Resuming
from jaxnav.drive.limits import CommandLimits

TIMEOUT_S = 0.2
_LOOK_S = 0.02  # period of the watchdog
_LOCK_S = 0.02  # time that `trip` waits for a thread inside the driver
_AGAIN_S = 0.1  # time between two stops of a vehicle that has heard the first one
HEARD_WITHIN_S = 10.0  # time for which `close` repeats the stop to a vehicle that does not hear it


class Guard:
    """The watchdog of one vehicle. Thread-safe, but only one thread may call `write`.

    Attributes:
        reason: why the guard has tripped; None: it has not.
        unheard: why the last stop did not reach the vehicle; None: it did, or there was none.
        late: whether all that it has tripped for is something that did not come in time.
        tried_s: `time.monotonic()` at which the vehicle's `stop` last came back, well or not.
    """

    def __init__(
        self,
        vehicle: AnyVehicle,
        limits: CommandLimits,
        timeout_s: float = TIMEOUT_S,
        now_ns: Callable[[], int] = time.monotonic_ns,
        corrections: Corrections | None = None,
        resumes: bool = False,
    ):
        """Start disarmed: only commands to stand get through.

        Args:
            corrections: convert true angles to servo angles; by default they are the same.
            timeout_s: time from the last sign of life until the vehicle has been stopped.
            resumes: whether the vehicle's file allows it to drive on, see `resume`.
        """
        self._resumes, self.late = resumes, False
        self._vehicle, self._limits, self._now_ns = vehicle, limits, now_ns
        self._corrections = corrections or Corrections()
        self._timeout_ns = int((timeout_s - 1.5 * _LOOK_S) * 1e9)
        self._lock = threading.Lock()
        self._armed = False
        self.reason: str | None = None
        self._tripped = threading.Event()
        self._closed = threading.Event()
        # Time of each watched thread's last sign of life, and the thread's identifier.
        self._beats: dict[str, tuple[int, int]] = {}
        self._command, self._written_ns = limits.zero, now_ns()
        self._deadline_ns = self._written_ns
        self.unheard: str | None = None
        self._stopped_s = 0.0  # time of the last stop that reached it
        self.tried_s = 0.0  # when the vehicle's `stop` has last returned or raised
        self._thread = threading.Thread(target=self._watch, name="jaxnav-guard", daemon=True)
        self._thread.start()
        atexit.register(self._at_exit)

    @property
    def tripped(self) -> bool:
        """Whether the guard has stopped the vehicle: for good, unless it `pauses`."""
        return self._tripped.is_set()

    @property
    def pauses(self) -> bool:
        """Whether the guard has stopped the vehicle and may arm again."""
        return self.tripped and self.late and self._resumes

    @property
    def heard(self) -> bool:
        """Whether the vehicle has heard the last stop."""
        return self.unheard is None and self._stopped_s > 0

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the guard trips or the time is over; return whether it has tripped."""
        return self._tripped.wait(timeout_s)

    def arm(self) -> None:
        """Let commands through from now on, and require them to come in time."""
        with self._lock:
            now_ns = self._now_ns()
            self._written_ns = now_ns
            self._deadline_ns = now_ns + self._timeout_ns
            self._beats = {name: (now_ns, ident) for name, (_, ident) in list(self._beats.items())}
            self._armed = not self.tripped

    def beat(self, name: str) -> None:
        """Note a sign of life of the calling thread; the first one begins its watch."""
        self._beats[name] = self._now_ns(), threading.get_ident()

    def oldest_sign_ns(self) -> int | None:
        """When the drive last came back as a whole: the oldest of the last signs of life of its
        threads and of the commands; None while nothing has to come in time."""
        if not self._armed:
            return None
        return min([self._written_ns, *(beat_ns for beat_ns, _ in list(self._beats.values()))])

    def leave(self, name: str) -> None:
        """Stop watching a thread that ends normally."""
        self._beats.pop(name, None)

    def write(self, *command: float, deadline_ns: int | None = None) -> bool:
        """Write a command to the vehicle, clamped to the limits.

        Args:
            command: its numbers, as the vehicle's `write` takes them.
            deadline_ns: time by which the next command must come; by default now plus the guard's
                timeout. A command whose own deadline is over is not obeyed.

        Returns:
            Whether the vehicle took the command. A driver that fails to write gets the next one.
        """
        if not all(map(math.isfinite, command)):
            self.trip(f"the command was no number: {', '.join(map(str, command))}")
            return False
        if not self._thread.is_alive() and not self._closed.is_set():
            self.trip("the guard's own thread has ended")
        with self._lock:
            now_ns = self._now_ns()
            if self.tripped or (deadline_ns is not None and deadline_ns <= now_ns):
                return False
            elapsed_s = (now_ns - self._written_ns) / 1e9
            allowed = command if self._armed else self._limits.standing(command)
            allowed = self._limits.within(allowed, self._command, elapsed_s)
            try:
                self._vehicle.write(*self._corrections.command_for(allowed))
            except OSError:
                return False
            finally:
                if self.tripped:  # during the write: the last thing written must not be a throttle
                    self._stop()
            self._command, self._written_ns = allowed, now_ns
            self._deadline_ns = now_ns + self._timeout_ns if deadline_ns is None else deadline_ns
            return True

    def resume(self) -> bool:
        """Arm again after a stop for being late, once everything comes in time and the vehicle has
        heard the stop; return whether that was so."""
        with self._lock:
            now_ns = self._now_ns()
            beats = list(self._beats.values())
            if any(now_ns - beat_ns > self._timeout_ns for beat_ns, _ in beats):
                return False
            if not self.pauses or self.unheard is not None or self._closed.is_set():
                return False
            if isinstance(self._vehicle, Resuming) and not self._vehicle.resume():
                return False
            self.reason, self.late, self._stopped_s = None, False, 0.0
            self._tripped.clear()
            self._written_ns, self._deadline_ns = now_ns, now_ns + self._timeout_ns
            self._armed = True
            return True

    def trip(self, reason: str, late: bool = False) -> None:
        """Stop the vehicle, now and for good. May be called from any thread.

        Args:
            late: something did not come in time: see `resume`.
        """
        # A thread that hangs inside the driver holds the lock: then stop without it.
        held = self._lock.acquire(timeout=_LOCK_S)
        try:
            if self.reason is None or (self.pauses and not late):
                self.reason, self.late = reason, late
            self._armed = False
            self._tripped.set()
            self._stop()
        finally:
            if held:
                self._lock.release()

    def close(self, heard_within_s: float = HEARD_WITHIN_S) -> None:
        """Stop and release the vehicle. May be called any number of times.

        Args:
            heard_within_s: time for which the stop is repeated to a vehicle that does not hear it;
                then `unheard` says why.
        """
        if self._closed.is_set():
            return
        self.trip("closed")
        end_s = time.monotonic() + heard_within_s
        while self.unheard is not None and time.monotonic() < end_s:
            time.sleep(_LOOK_S)
            self._stop()
        self._closed.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(1.0)
        atexit.unregister(self._at_exit)
        with suppress(Exception):
            self._vehicle.close()
        with suppress(Exception):  # once more, for a driver that closes without stopping
            self._vehicle.stop()

    def _watch(self) -> None:
        while not self._closed.wait(self._until_next_look_s()):
            try:
                self._look()
            except Exception as error:  # a watchdog that dies silently watches nothing
                self.trip(f"the guard failed: {type(error).__name__}: {error}")

    def _until_next_look_s(self) -> float:
        if not self._armed or self.tripped:
            return _LOOK_S
        return min(max((self._deadline_ns - self._now_ns()) / 1e9, 0.001), _LOOK_S)

    def _look(self) -> None:
        if self.tripped:
            if self.unheard is not None or time.monotonic() - self._stopped_s > _AGAIN_S:
                held = self._lock.acquire(timeout=_LOCK_S)
                try:
                    if self.tripped:  # and has not resumed meanwhile
                        self._stop()
                finally:
                    if held:
                        self._lock.release()
            return
        if not self._armed:
            return
        now_ns = self._now_ns()
        if now_ns > self._deadline_ns:
            self.trip(f"no fresh command for {(now_ns - self._written_ns) / 1e9:.2f} s", late=True)
        for name, (beat_ns, ident) in list(self._beats.items()):
            if now_ns - beat_ns > self._timeout_ns:
                silent_s = (now_ns - beat_ns) / 1e9
                self.trip(f"{name} hangs for {silent_s:.2f} s{_where(ident)}", late=True)

    def _stop(self) -> None:
        """Tell the vehicle to stop once; `_look` and `close` repeat it until it is heard."""
        try:
            self._vehicle.stop()
        except Exception as error:  # whatever it is, all that can be done is to try again
            self.unheard = f"{type(error).__name__}: {error}"
        else:
            self.unheard, self._stopped_s = None, time.monotonic()
        self.tried_s = time.monotonic()

    def _at_exit(self) -> None:
        self.trip("the program ends")


def _where(ident: int) -> str:
    """The two innermost calls of a thread, of different files, to follow "it hangs"."""
    frame = sys._current_frames().get(ident)
    places: list[str] = []
    while frame is not None and len(places) < 2:
        path = Path(frame.f_code.co_filename)
        place = f"{path.parent.name}/{path.name}:{frame.f_lineno}"
        if not places or place.split(":")[0] != places[-1].split(":")[0]:
            places.append(place)
        frame = frame.f_back
    return f" at {', called from '.join(places)}" if places else ""
