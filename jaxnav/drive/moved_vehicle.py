"""Run a vehicle in its guard's process, and give the loop a `Vehicle` that talks to it.

guarding = GuardProcess("qcar")                  # starts in parallel to other work
vehicle = guarding.open(setup, limits, timeout_s)        # None: it can't be moved, `stays` says why
vehicle.watch(guard.trip)                        # called when it was stopped there, or is dead
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

from jaxnav.drive.corrections import Corrections
from jaxnav.drive.interfaces import GyroReading, Setup, reading_of
from jaxnav.drive.limits import CommandLimits
from jaxnav.drive.priority import before_siblings
from jaxnav.errors import BadInput

_MODULE = "jaxnav.drive.guard_process"
_READ_S = 0.02  # timeout of a reading: a tick of the loop
# No answer for so long, and the process hangs: another one then stops the vehicle.
_ANSWERS_S = 0.5  # to a stop; five of the periods at which it says whether that was heard
_DEAF_S = 1.0  # to a request for a reading while nothing is to be stopped
_CLOSES_S = 15.0  # for a driver to release what it has, and to hear a stop that it did not hear
_RECEIVES_S = 0.3  # for the spare to receive an order, before another one is started
_LOOK_S = 0.05
_LONGEST_LOOK_S = 0.1  # counted of one look: a pause of the whole machine is no silence
_LATEST_S = 0.03  # the guard looks every 20 ms: its deadline is this much before the timeout


class GuardProcess:
    """A guard's process, from its start until it has a vehicle or is not needed.

    Attributes:
        stays: why the vehicle can't be moved; None: it can, or that is not known yet.
        spare_pid: id of the spare; None: there is none.
    """

    def __init__(self, name: str, order: dict[str, Any] | None = None):
        """Start the process.

        Args:
            name: name of the vehicle, as `plugins.load_factory` takes it.
            order: all that it needs to stop the vehicle, for one that does nothing else.

        Raises:
            OSError: the machine has no room for another process.
        """
        self.name = name
        self.stays: str | None = None
        self._opens = False
        self._order: dict[str, Any] = {"vehicle": name, "path": import_path()} | (order or {})
        self.spare_pid: int | None = None
        ours, theirs = zip(*(Pipe() for _ in range(3)), strict=True)
        # OpenBLAS would allocate memory for a thread per core, and all of it would be locked.
        try:
            self.process = start_python(_MODULE, theirs, {"OPENBLAS_NUM_THREADS": "1"})
        except OSError:
            for end in ours:
                end.close()
            raise
        self.commands, self.readings, self.spare = ours
        self.commands.send(self._order)

    def prepare(self, check: Callable[[], None]) -> None:
        """Wait until the plug-in is imported there, or is known to stay here.

        Args:
            check: called during the wait; may raise.

        Raises:
            BadInput: the process has ended.
        """
        if "bad" in (answer := self._answer(check)):  # the caller found it here, so it runs here
            self.stays = f"there {answer['bad']}"
        self.spare_pid = answer.get("spare")

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
            "limits": limits,
            "corrections": Corrections.from_vehicle(setup.vehicle),
            "timeout_s": timeout_s,
            "resumes": resumes,
        }
        self._order |= changes
        self._opens = True
        self.commands.send(changes)
        answer = self._answer(check)
        if "bad" in answer:
            raise BadInput(*answer["bad"].split(": ", 1))
        if "opened" not in answer:
            return None
        return MovedVehicle(self, answer["opened"], answer["priority"], timeout_s)

    def rescue(self) -> str | None:
        """After this process's death let another one open and stop the vehicle.

        The spare does so, which is there already, else one that is started now.

        Returns:
            Why the vehicle has not heard the stop; None: it has.
        """
        order = self._order | {"only_stops": True}
        with suppress(Exception):
            self.spare.send(order)
            if self.spare.poll(_RECEIVES_S):
                self.spare.recv()
                return _unheard_by(self.spare)
            # It hangs as well: two that hold the vehicle may be one too many.
            if self.spare_pid:
                os.kill(self.spare_pid, signal.SIGKILL)
        try:
            another = GuardProcess(self.name, order)
        except OSError as error:
            return f"no other one can be started: {error.strerror or error}"
        try:
            return _unheard_by(another.commands)
        except Exception:
            return f"another one {ending(another.process)}"
        finally:
            another._opens = True  # it goes on until the vehicle hears it
            another.end()

    def end(self) -> None:
        """Release the process: it stops its vehicle, if it has one, and ends by itself."""
        if not self._opens:
            self.process.kill()
        for link in (self.commands, self.readings, self.spare):
            link.close()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(1.0)

    def _answer(self, check: Callable[[], None]) -> dict[str, Any]:
        while not self.commands.poll(_LOOK_S):
            check()
        try:
            answer: dict[str, Any] = self.commands.recv()
        except (EOFError, OSError):
            raise BadInput(
                f"--car {self.name}", f"the guard's process {ending(self.process)}"
            ) from None
        self.stays = answer.get("stays")
        return answer


class MovedVehicle:
    """A vehicle in another process. It sends commands without waiting, and requests readings.

    Attributes:
        timeout_s, over: see `Vehicle` and `Ending`; `over` as sent with the last reading.
        replaced: what befell the guard's process where another one had to stop the vehicle.
        unheard: for a person, after `close`: why the vehicle may not have stopped; None: it has.
    """

    def __init__(
        self, guarding: GuardProcess, own_timeout_s: float, priority: str, timeout_s: float
    ):
        """See `GuardProcess.open`."""
        self._guarding, self.priority = guarding, priority
        self.timeout_s = own_timeout_s if own_timeout_s > 0 else math.inf
        self._timeout_ns = int((timeout_s - _LATEST_S) * 1e9)
        self.replaced: str | None = None
        self.unheard: str | None = None
        self.over: str | None = None
        self._gyro: tuple[GyroReading, ...] = ()  # that came with readings, and were not asked for
        self._asked_s: float | None = None  # when the pending reading was requested
        self._stop_s: float | None = None  # when the first stop was
        self._close_s: float | None = None
        self._heard = False  # whether the vehicle has heard the stop
        self._closed = False
        self._dead: str | None = None
        self._report: Callable[[str, bool], None] = lambda reason, late: None
        self._late: Callable[[], bool] = lambda: False
        self._reason: tuple[str, bool] | None = None
        self._ended = threading.Event()
        threading.Thread(target=self._listen, name="jaxnav-events", daemon=True).start()

    @property
    def pid(self) -> int:
        """The id of the guard's process."""
        return self._guarding.process.pid

    def watch(
        self, report: Callable[[str, bool], None], late: Callable[[], bool] = lambda: False
    ) -> None:
        """Call this when the guard there has stopped the vehicle, or has died.

        Args:
            report: takes the reason, and whether it is that something was late.
            late: whether the guard here stops it for that reason alone.
        """
        self._report, self._late = report, late
        if self._reason is not None:
            report(*self._reason)

    def read(self) -> Any:
        """See `Vehicle` and `TwistVehicle`.

        Raises:
            OSError: no answer within a tick, or the plug-in's own error.
        """
        link = self._guarding.readings
        if self._asked_s is None:
            link.send("?")
            self._asked_s = time.monotonic()
        if not link.poll(_READ_S):
            raise OSError("no reading within a tick")
        try:
            answer = link.recv()
        except EOFError:
            raise OSError("the guard's process is gone") from None
        self._asked_s = None
        if isinstance(answer, str):
            raise OSError(answer)
        read, turns, over = answer
        self.over = over or None
        self._gyro += tuple(GyroReading(*turn) for turn in turns)
        return reading_of(*read)

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
        deadline_ns = time.monotonic_ns() + self._timeout_ns
        self._guarding.commands.send((deadline_ns, tuple(map(float, command))))

    def stop(self) -> None:
        """See `Vehicle`: the guard there trips, and repeats the stop until the vehicle hears it.

        It does not wait for the answer. Where none comes, another process stops the vehicle.

        Raises:
            OSError: the process is dead, and no other one has stopped the vehicle yet.
        """
        if self._closed:
            return
        if self._stop_s is None:
            self._stop_s, self._heard = time.monotonic(), False
        if self._dead:
            raise OSError(self._dead)
        with suppress(OSError):  # the process is ending: `_listen` sees to it
            self._guarding.commands.send({"stop": "told to stop", "late": self._late()})

    def resume(self) -> bool:
        """See `Resuming`: a refusal is reported as another stop."""
        with suppress(OSError):
            if not (self._dead or self._closed):
                self._guarding.commands.send({"resume": True})
                self._stop_s = self._reason = None  # an answer is due to the next stop
                return True
        return False

    def close(self) -> None:
        """See `Vehicle`. Waits until the vehicle has heard the stop, from whichever process; not
        for ever on one that answers that it does not hear, nor on one that does not answer."""
        if not self._closed:
            self._close_s = time.monotonic()
            self._stop_s = self._stop_s or self._close_s
            with suppress(OSError):
                self._guarding.commands.send({"close": True})
            self._ended.wait()
            self._closed = True
        self._guarding.end()

    def _listen(self) -> None:
        """Listen to the guard's process to its end, and put another in its place where it ends
        badly. In a thread of its own, so that nothing else in this process delays it."""
        try:
            with before_siblings():
                if (how := self._befallen()) is not None:
                    self._replace(how)
        finally:
            self._ended.set()

    def _befallen(self) -> str | None:
        """Receive events until the guard's process has closed the vehicle, or is left to a vehicle
        that does not hear; or what has befallen it."""
        link, process = self._guarding.commands, self._guarding.process
        due_s: float | None = None  # since when an answer is due
        silent_s, looked_s = 0.0, time.monotonic()
        try:
            while True:
                due_before_s, due_s = due_s, self._due_s()
                news = link.poll(_LOOK_S)
                now_s = time.monotonic()
                silent_s += min(now_s - looked_s, _LONGEST_LOOK_S)
                looked_s = now_s
                if news or due_s is None or due_s != due_before_s:
                    silent_s = 0.0
                if news and self._closes(link.recv()):
                    return None
                answers_s = _DEAF_S if self._stop_s is None else _ANSWERS_S
                if silent_s > (_CLOSES_S if self._heard else answers_s):
                    return f"the guard's process gave no answer for {silent_s:.1f} s"
                if self._close_s is not None and now_s - self._close_s > _CLOSES_S:
                    if self._heard:
                        return "the guard's process did not end"
                    self.unheard = f"{self.unheard}; the guard's process still tells it to stop"
                    return None
        except (EOFError, OSError):
            with suppress(subprocess.TimeoutExpired):
                process.wait(1.0)
            return f"the guard's process {ending(process)}"
        except Exception:  # whatever it is, nothing that it says can be relied on any more
            return "the guard's process sent what is no event"

    def _due_s(self) -> float | None:
        """Since when an answer is due: to the first stop, or to a request for a reading."""
        if self._stop_s is not None:
            return self._stop_s
        return None if self._guarding.readings.poll() else self._asked_s

    def _closes(self, said: dict[str, Any]) -> bool:
        """Take an event; return whether it is the last one."""
        if "tripped" in said:
            self._reason = said["tripped"], said["late"]
            self._report(*self._reason)
        if "unheard" in said:
            self.unheard = said["unheard"]
            self._heard = said.get("heard", self.unheard is None)
        return "closed" in said

    def _replace(self, how: str) -> None:
        """End the guard's process and let another one stop the vehicle."""
        process = self._guarding.process
        if process.poll() is None:
            process.kill()
            how += " and was killed"
        with suppress(subprocess.TimeoutExpired):  # it hangs in the kernel: no reason to wait
            process.wait(1.0)
        self._dead = self.unheard = how
        self._reason = how, False
        self._report(*self._reason)
        if (why := self._guarding.rescue()) is not None:
            self.unheard = f"{how}; {why}"
            return
        self.replaced, self._dead, self.unheard = how, None, None
        self._closed = True


def _unheard_by(link: Connection) -> str | None:
    """Wait until a process that only stops says that the vehicle has heard it; else why not.

    Raises:
        EOFError: it has ended.
    """
    why, end_s = "no other one has opened it yet", time.monotonic() + _CLOSES_S
    while link.poll(max(end_s - time.monotonic(), 0.0)):
        said = link.recv()
        if said.get("heard") or ("closed" in said and said["unheard"] is None):
            return None
        why = said.get("unheard") or said.get("bad") or said.get("stays") or why
    return why


def import_path() -> list[str]:
    """The folders that this process imports from, to be handed on to a Python that it starts.

    The current folder, which `python -m` and `-c` put first, is not among them: anybody may have
    put a `json.py` there. Who has a plug-in there names the folder on PYTHONPATH.
    """
    path = [folder for folder in sys.path if folder]
    by_name = getattr(sys.modules["__main__"], "__spec__", None) is not None  # python -m
    if by_name and not sys.flags.safe_path:
        with suppress(OSError, ValueError):  # it is gone, or not there
            path.remove(str(Path.cwd()))
    return path


def start_python(
    module: str, ends: Sequence[Any], environment: Mapping[str, str]
) -> subprocess.Popen[bytes]:
    """Start a Python that runs a module and nothing of the current folder.

    Args:
        ends: of sockets or pipes, which it gets as arguments, and which are closed here.

    Raises:
        OSError: the machine has no room for another process.
    """
    descriptors = [end.fileno() for end in ends]
    path = {"PYTHONPATH": os.pathsep.join(import_path())}
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", module, *map(str, descriptors)],
            pass_fds=descriptors,
            stdin=subprocess.DEVNULL,
            env=os.environ | environment | path,
            start_new_session=True,  # signals from a terminal are for the computing process
        )
    finally:
        for end in ends:
            end.close()


def ending(process: subprocess.Popen[bytes]) -> str:
    """How a process ended, as text."""
    code = process.poll()
    if code is None:
        return "closed its connection"
    return f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
