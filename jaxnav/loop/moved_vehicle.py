"""Run a vehicle in its guard's process, and give the loop a `Vehicle` that talks to it.

guarding = GuardProcess("qcar")                  # starts in parallel to other work
vehicle = guarding.open(setup, limits, timeout_s)        # None: it can't be moved, `stays` says why
vehicle.watch(guard.trip)                        # called when it was stopped there, or is dead
"""

from __future__ import annotations

import math
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, fields
from typing import Any

from jaxnav.errors import BadInput
from jaxnav.loop.corrections import Corrections
from jaxnav.loop.guard_process import (
    KIND_FAILED,
    KIND_READING,
    Link,
    command_frame,
    reading_from,
)
from jaxnav.loop.interfaces import GyroReading, Setup
from jaxnav.loop.limits import CommandLimits

_MODULE = "jaxnav.loop.guard_process"
_READ_S = 0.02  # timeout of a reading: a tick of the loop
_DEAF_S = 1.0  # no answer for this long: the process hangs, and another one stops the vehicle
_CLOSES_S = 15.0  # longer than its guard repeats the stop to a vehicle that answers now and then
_LATEST_S = 0.03  # the guard looks every 20 ms: its deadline is this much before the timeout


class GuardProcess:
    """A guard's process, from its start until it has a vehicle or is not needed.

    Attributes:
        stays: why the vehicle can't be moved; None: it can, or that is not known yet.
    """

    def __init__(self, name: str):
        """Start the process.

        Args:
            name: name of the vehicle, as `plugins.load_factory` takes it.

        Raises:
            OSError: the machine has no room for another process.
        """
        self.name = name
        self.stays: str | None = None
        self._opens = False
        ours, theirs = zip(socket.socketpair(), socket.socketpair(), strict=True)
        # OpenBLAS would allocate memory for a thread per core, and all of it would be locked.
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", _MODULE, *(str(end.fileno()) for end in theirs)],
            pass_fds=[end.fileno() for end in theirs],
            stdin=subprocess.DEVNULL,
            env=environment | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # signals from a terminal are for the computing process
        )
        for end in theirs:
            end.close()
        self.commands, self.readings = Link(ours[0]), Link(ours[1])
        self._order: dict[str, Any] = {"vehicle": name, "path": sys.path}
        self.commands.tell(**self._order)

    def prepare(self, check: Callable[[], None]) -> None:
        """Wait until the plug-in is imported there, or is known to stay here.

        Args:
            check: called during the wait; may raise.

        Raises:
            BadInput: the process has ended.
        """
        if "bad" in (answer := self._answer(check)):  # the caller found it here, so it runs here
            self.stays = f"there {answer['bad']}"

    def open(
        self,
        setup: Setup,
        limits: CommandLimits,
        timeout_s: float,
        check: Callable[[], None] = lambda: None,
        resumes: bool = False,
    ) -> MovedVehicle | None:
        """Open the vehicle there; None: it can't be moved after all, see `stays`.

        Args:
            timeout_s: time from the last command until the vehicle has been stopped.
            check: called during the wait; may raise.
            resumes: see `Guard`.

        Raises:
            BadInput: as `plugins.open_vehicle`.
        """
        if self.stays is not None:
            return None
        numbers = {
            field.name: float(getattr(setup.vehicle, field.name))
            for field in fields(setup.vehicle)
            if field.name not in ("sensor_sigma", "gyro")  # a driver has no use for them
        }
        changes = {
            "setup": {
                "vehicle": numbers,
                "start_pose": [float(value) for value in setup.start_pose],
                "seed": setup.seed,
                "options": dict(setup.options),
            },
            "limits": asdict(limits),  # type: ignore[call-overload]
            "corrections": asdict(Corrections.of(setup.vehicle)),
            "timeout_s": timeout_s,
            "resumes": resumes,
        }
        self._order |= changes
        self._opens = True
        self.commands.tell(**changes)
        answer = self._answer(check)
        if "bad" in answer:
            raise BadInput(*answer["bad"].split(": ", 1))
        if "opened" not in answer:
            return None
        return MovedVehicle(self, answer["opened"], answer["priority"], timeout_s)

    def rescue(self) -> bool:
        """After this process's death, open and stop the vehicle in another one; whether it worked.

        Waits until that has ended.
        """
        another = GuardProcess(self.name)
        try:
            another.prepare(lambda: None)
            another._opens = True
            another.commands.tell(**self._order, only_stop=True)
            return another.process.wait(_CLOSES_S) == 0
        except (BadInput, OSError, EOFError, subprocess.TimeoutExpired):
            return False
        finally:
            another.end()

    def end(self) -> None:
        """Release the process: it stops its vehicle, if it has one, and ends by itself."""
        if not self._opens:
            self.process.kill()
        for link in (self.commands, self.readings):
            link.socket.close()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(1.0)

    def _answer(self, check: Callable[[], None]) -> dict[str, Any]:
        while not select.select([self.commands.socket], [], [], 0.05)[0]:
            check()
        try:
            answer = self.commands.mapping()
        except (EOFError, OSError):
            raise BadInput(
                f"--car {self.name}", f"the guard's process {ending(self.process)}"
            ) from None
        self.stays = answer.get("stays")
        return answer


class MovedVehicle:
    """A vehicle in another process. It sends commands without waiting, and requests readings."""

    def __init__(
        self, guarding: GuardProcess, own_timeout_s: float, priority: str, timeout_s: float
    ):
        """See `GuardProcess.open`."""
        self._guarding, self._own_timeout_s, self.priority = guarding, own_timeout_s, priority
        self._timeout_ns = int((timeout_s - _LATEST_S) * 1e9)
        self._sequence = 0
        self._over: str | None = None
        self._gyro: tuple[GyroReading, ...] = ()  # that came with readings, and were not asked for
        self._asked_s: float | None = None  # when the pending reading was requested
        self._closing = self._closed = False
        self._dead: str | None = None
        self._unheard: str | None = None
        self._report: Callable[[str, bool], None] = lambda reason, late: None
        self._late: Callable[[], bool] = lambda: False
        self._ended = threading.Event()
        guarding.readings.socket.settimeout(_READ_S)
        self._thread = threading.Thread(target=self._listen, name="jaxnav-events", daemon=True)

    @property
    def pid(self) -> int:
        """The id of the guard's process."""
        return self._guarding.process.pid

    @property
    def timeout_s(self) -> float:
        """See `Vehicle`."""
        return self._own_timeout_s if self._own_timeout_s > 0 else math.inf

    @property
    def over(self) -> str | None:
        """See `Ending`; as sent with the vehicle's last reading."""
        return self._over

    def watch(
        self, report: Callable[[str, bool], None], late: Callable[[], bool] = lambda: False
    ) -> None:
        """Call this when the guard there has stopped the vehicle, or has died.

        Args:
            report: takes the reason, and whether it is that something was late.
            late: whether the guard here stops it for that reason alone.
        """
        self._report, self._late = report, late
        self._thread.start()

    def read(self) -> Any:
        """See `Vehicle` and `TwistVehicle`.

        Raises:
            OSError: no answer within a tick, or the plug-in's own error.
        """
        link = self._guarding.readings
        now_s = time.monotonic()
        if self._asked_s is None:
            link.send(b"?")
            self._asked_s = now_s
        elif now_s - self._asked_s > _DEAF_S:
            self._guarding.process.kill()  # `_listen` then notices its end
            raise OSError("the guard's process does not answer")
        try:
            answer = link.receive()
        except TimeoutError:
            raise OSError("no reading within a tick") from None
        except EOFError:
            raise OSError("the guard's process is gone") from None
        if not answer:
            raise OSError("no reading within a tick")
        self._asked_s = None
        kind = answer[-1][:1]
        if kind != KIND_READING:
            assert kind == KIND_FAILED
            raise OSError(answer[-1][1:].decode(errors="replace"))
        reading, gyro, over = reading_from(answer[-1])
        self._over = over or None
        self._gyro += gyro
        return reading

    def read_gyro(self) -> tuple[GyroReading, ...]:
        """See `HasGyro`: what came with the readings since; nothing of a vehicle without one."""
        gyro, self._gyro = self._gyro, ()
        return gyro

    def write(self, *command: float) -> None:
        """See `Vehicle` and `TwistVehicle`. Limits and corrections are applied there.

        Raises:
            OSError: the process is gone, or has not read for long.
        """
        if self._dead or self._closed:
            raise OSError(self._dead or "the vehicle is closed")
        self._sequence += 1
        deadline_ns = time.monotonic_ns() + self._timeout_ns
        self._guarding.commands.send(command_frame(self._sequence, deadline_ns, command))

    def stop(self) -> None:
        """See `Vehicle`: the guard there trips, and repeats the stop until the vehicle hears it.

        Raises:
            OSError: the process is dead, and no other one has stopped the vehicle yet.
        """
        if self._closed:
            return
        if self._dead:
            raise OSError(self._dead)
        with suppress(OSError):  # the process is ending: it stops the vehicle by itself
            self._guarding.commands.tell(stop="told to stop", late=self._late())

    def resume(self) -> bool:
        """See `Resuming`: a refusal is reported as another stop."""
        with suppress(OSError):
            if not (self._dead or self._closed):
                self._guarding.commands.tell(resume=True)
                return True
        return False

    def close(self) -> None:
        """See `Vehicle`. Waits until the vehicle has heard the stop."""
        if self._closed:  # or stopped by another process, after this one's death
            self._guarding.end()
            return
        self._closing = True
        with suppress(OSError):
            self._guarding.commands.tell(close=True)
        with suppress(subprocess.TimeoutExpired):
            self._guarding.process.wait(_CLOSES_S)
        self._ended.wait(_CLOSES_S if self._dead else 1.0)
        self._closed = True
        self._guarding.end()

    @property
    def unheard(self) -> str | None:
        """For a person, after `close`: why the vehicle may not have stopped; None: it has."""
        if self._guarding.process.poll() is None:
            return "the guard's process still tells it to stop"
        return self._unheard

    def _listen(self) -> None:
        """Receive the events of the guard there and notice its end. Runs in a thread."""
        link = self._guarding.commands
        try:
            while True:
                said = link.mapping()
                if "tripped" in said:
                    self._report(said["tripped"], said["late"])
                if "closed" in said:
                    self._unheard = said["unheard"]
        except (EOFError, OSError, ValueError):
            pass
        with suppress(subprocess.TimeoutExpired):
            self._guarding.process.wait(1.0)
        if not self._closing or self._guarding.process.returncode:
            how = f"the guard's process {ending(self._guarding.process)}"
            self._dead = self._unheard = how
            self._report(how, False)
            if self._guarding.rescue():
                self._dead = self._unheard = None
                self._closed = True
        self._ended.set()


def ending(process: subprocess.Popen[bytes]) -> str:
    """How a process ended, as text."""
    code = process.poll()
    if code is None:
        return "closed its connection"
    return f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
