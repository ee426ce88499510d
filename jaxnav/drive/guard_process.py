"""The process that owns the vehicle and stops it, whatever happens to the computing process.

    python -P -m jaxnav.drive.guard_process COMMANDS READINGS SPARE    # file descriptors of sockets

`moved_vehicle` starts it and talks to it. It imports no JAX and no OpenCV, is up in a fifth of a
second, and runs the plug-in behind a `Guard` with its limits and corrections. Each command carries
the deadline of the next one, on the clock that all processes of a machine share: a command that
comes too late is not obeyed, and when none comes in time the vehicle is stopped. It is stopped at
once when the computing process ends, however it ends, since that closes the sockets.

On the first connection orders and commands come in and events go out; on the second readings are
requested and sent. No objects of a plug-in are among them. Once it has tripped, it says ten times a
second whether the vehicle has heard the stop. A driver that holds the interpreter silences it, and
so does one that does not come back from `stop`.

At once it forks another process, the spare, which waits on the third socket. Where this one hangs
or dies the spare opens the vehicle and stops it: then nothing that may have run out is needed.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from jaxnav.drive import plugins
from jaxnav.drive.guard import Guard
from jaxnav.drive.interfaces import (
    MOST_TURNS,
    AnyVehicle,
    Ending,
    GyroReading,
    HasGyro,
    Setup,
    SharesProcess,
)
from jaxnav.drive.limits import Command
from jaxnav.drive.output import FreeOutput
from jaxnav.drive.priority import NICE, lower_nice
from jaxnav.errors import BadInput

HEARD_WITHIN_S = 600.0  # an orphan repeats the stop for this long to a vehicle that does not hear
_HEAVY = ("jax", "cv2")  # modules that the guard's process must not import
_PRIORITY = 20  # in the real-time class: above the computing process, below the kernel's threads
_SAYS_S = 0.1  # period at which it says whether a stop was heard; `moved_vehicle` waits for five
# A `stop` that lasts longer counts as no answer. With the longest wait for a command (0.2 s by
# default) and for an answer (0.5 s) it leaves 0.8 of 2 s for another one to open the vehicle.
_TRIES_S = 0.5


class CanNotMoveError(BaseException):
    """A vehicle needs the computing process; the message says why. A plug-in's `except Exception`
    does not catch it."""


class _Missing:
    """Placeholder for rig or markers, which the guard's process does not have."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, asked: str) -> Any:
        raise CanNotMoveError(f"it looks at setup.{self._name}")


def main(commands: int, readings: int | None, spare: int | None = None) -> None:
    """Serve until the vehicle can be released.

    Args:
        commands, readings: descriptors of the sockets; the spare has no use for the second.
        spare: id of the spare's process.
    """
    for name in ("SIGINT", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGTTOU", "SIGPIPE"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)  # the computing process handles them
    wakeup = os.pipe()
    os.set_blocking(wakeup[1], False)
    signal.set_wakeup_fd(wakeup[1], warn_on_full_buffer=False)
    signal.signal(signal.SIGTERM, lambda number, frame: None)  # sent when the machine shuts down
    link = Connection(commands)
    with suppress(EOFError, OSError):
        order = link.recv()
        only_stops = order.get("only_stops", False)  # in the place of one that hung or died
        if only_stops:
            link.send({"received": True})
            _preferred()  # before the plug-in is imported, as the vehicle may be driving
        try:
            factory = _factory(order["vehicle"], order["path"])
            if not only_stops:
                link.send({"ready": True, "spare": spare})
                order |= link.recv()
            vehicle = opened(factory, order)
        except CanNotMoveError as problem:
            link.send({"stays": str(problem)})
            return
        except BadInput as bad:
            link.send({"bad": str(bad)})
            return
        priority = _preferred()  # of this thread, and of the guard's thread, which it starts
        guard = Guard(
            vehicle,
            order["limits"],
            order["timeout_s"],
            corrections=order["corrections"],
            resumes=order["resumes"],
        )
        threading.Thread(target=_report, args=(guard, link), daemon=True).start()
        try:
            link.send({"opened": float(vehicle.timeout_s), "priority": priority})
            if readings is not None and not only_stops:
                asked = Connection(readings)  # which stays open until the vehicle is released
                _Server(vehicle, guard, link, asked, wakeup[0]).serve()
        finally:
            guard.close(HEARD_WITHIN_S)
            with suppress(OSError):
                link.send({"closed": True, "unheard": guard.unheard})


class _Server:
    """The server of both sockets, until it is told to close."""

    def __init__(
        self, vehicle: AnyVehicle, guard: Guard, link: Connection, asked: Connection, signals: int
    ):
        self._vehicle, self._guard = vehicle, guard
        self._link, self._asked, self._signals = link, asked, signals
        self._commanded = False

    def serve(self) -> None:
        """Serve commands before readings, since a reading may take as long as the driver does."""
        look = select.poll()
        for descriptor in (self._link, self._asked, self._signals):
            look.register(descriptor, select.POLLIN)
        try:
            while True:
                ready = {descriptor for descriptor, _ in look.poll()}
                if self._signals in ready:
                    self._guard.trip("the guard's process was told to end (SIGTERM)")
                    os.read(self._signals, 64)
                if self._link.fileno() in ready:
                    if not self._obey(self._link.recv()):
                        return
                elif self._asked.fileno() in ready:
                    self._asked.recv()
                    self._asked.send(self._reading())
        except (EOFError, OSError):
            self._guard.trip("the process that computes is gone")

    def _obey(self, said: dict[str, Any] | tuple[int, Command]) -> bool:
        """Execute an order, or a command with its deadline_ns; return False if it says to close."""
        if isinstance(said, dict):
            if "stop" in said:
                self._guard.trip(said["stop"], said["late"])
            if "resume" in said and not self._guard.resume():
                why = self._guard.reason or "it does not resume"
                self._link.send({"tripped": why, "late": False})
            return "close" not in said
        deadline_ns, command = said
        if not self._commanded:
            self._guard.arm()  # the first command: from now on commands must come in time
            self._commanded = True
        self._guard.write(*command, deadline_ns=deadline_ns)
        return True

    def _reading(self) -> tuple[Any, ...] | str:
        """The arguments of `reading_of`, those of the newest `GyroReading`s, and why the drive is
        over or nothing; or why there is none."""
        over = self._vehicle.over if isinstance(self._vehicle, Ending) else None
        try:
            read = self._vehicle.read()
            values = tuple(map(float, read.values))
            turns = [(int(t.stamp_ns), float(t.turn_radps)) for t in self._turns()[-MOST_TURNS:]]
            return (int(read.stamp_ns), values, bool(read.valid)), turns, str(over or "")
        except OSError as error:
            return str(error)[:1000]
        except Exception as error:  # its meaning is unknown: the vehicle stops
            self._guard.trip(f"the vehicle: {type(error).__name__}: {error}")
            return f"{type(error).__name__}: {error}"[:1000]

    def _turns(self) -> Sequence[GyroReading]:
        """The gyro's readings, of which none is no reason to go without the odometer."""
        with suppress(OSError):
            return self._vehicle.read_gyro() if isinstance(self._vehicle, HasGyro) else ()
        return ()


def _report(guard: Guard, link: Connection) -> None:
    """Report each trip at once, and then, until it resumes, again and again whether the vehicle has
    heard the stop: in a thread, since the main one may hang in the driver."""
    with suppress(OSError):
        while True:
            guard.wait()
            since_s = time.monotonic()
            reason = guard.reason
            link.send({"tripped": reason, "late": guard.late})
            while guard.tripped and guard.reason == reason:
                if guard.heard or time.monotonic() - max(since_s, guard.tried_s) < _TRIES_S:
                    link.send({"heard": guard.heard, "unheard": guard.unheard})
                time.sleep(_SAYS_S)


def _factory(name: str, path: list[str]) -> Any:
    sys.path[:] = path
    factory = plugins.load_factory("--car", plugins.VEHICLES, name)
    if isinstance(factory, SharesProcess) and factory.shares_process:
        raise CanNotMoveError("it shares its process")
    if modules := [module for module in _HEAVY if module in sys.modules]:
        raise CanNotMoveError(f"its module imports {' and '.join(modules)}")
    return factory


def opened(factory: Any, order: dict[str, Any]) -> AnyVehicle:
    """Open a vehicle without the computing process.

    Args:
        order: the name under `vehicle`; under `setup` the numbers of its file, and what else
            `Setup` has.

    Raises:
        BadInput: as `plugins.open_vehicle`.
        CanNotMoveError: it needs that process.
    """
    received: Any = order["setup"]
    missing: Any = _Missing
    numbers: Any = SimpleNamespace(**received["vehicle"])
    start: Any = tuple(received["start_pose"])
    setup = Setup(
        missing("rig"), missing("markers"), numbers, start, received["seed"], received["options"]
    )
    return plugins.open_vehicle(order["vehicle"], setup, factory)


def _preferred() -> str:
    """Raise the process's priority and lock its memory where permitted; describe the priority."""
    with suppress(OSError):  # killed last when memory runs out
        Path("/proc/self/oom_score_adj").write_text("-900")
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mlockall(1)  # MCL_CURRENT: the pages mapped now
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
        return "real-time priority"
    return "raised priority" if lower_nice(NICE) else "no priority: it may not be raised here"


if __name__ == "__main__":
    ends = [int(number) for number in sys.argv[1:]]
    child = None
    with suppress(OSError):  # without room there is no spare
        child = os.fork()  # before there is a thread
    for end in ends[:2] if child == 0 else ends[2:]:
        os.close(end)  # whoever is at the other end must notice this one's death
    with FreeOutput():  # a driver that prints errors must not wait for a reader
        main(ends[2], None) if child == 0 else main(ends[0], ends[1], child)
    os._exit(0)  # the vehicle is released: what else a plug-in has loaded needs no cleanup
