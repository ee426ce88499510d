"""Catch the signals that end a drive: note each one at once, act on it at the next step.

    with Signals() as signals:
        signals.check()                  # between the steps of a start: raises `Interrupted`
        signals.hold()                   # before a vehicle is opened
        signals.on_signal(stop)          # called by a separate thread, also if the main one is busy

Python's own handler raises KeyboardInterrupt wherever the interpreter happens to be, also inside a
library's callback, which swallows it. This handler raises nothing and loses no signal.
"""

import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

# The signals of a person, a shell, a closed terminal or a supervisor that would end or suspend a
# process without a handler. Ctrl-Z ends a drive: a car is not left half-way.
_NAMES = "SIGINT SIGTERM SIGHUP SIGQUIT SIGTSTP SIGUSR1 SIGUSR2 SIGALRM SIGVTALRM SIGPROF SIGXCPU"
_BY_HAND = ("SIGINT", "SIGTERM", "SIGQUIT", "SIGTSTP")  # taken over from any other handler
_LEAVES_S = 1.0  # after a signal, while nothing moves and the main thread compiles or imports
_FINISHES_S = 0.5  # for what must be finished before the process is ended
_ENDS_S = 60.0  # after a signal, while a vehicle is open: longer than closing it may take
EXIT = 128  # plus the signal's number, as shells report it
EXIT_STOPPED = 1  # not by a person


class Interrupted(BaseException):
    """A signal came: abandon what was begun. `except Exception` does not catch it."""

    def __init__(self, number: int):
        BaseException.__init__(self, signal.Signals(number).name)
        self.number = number


class Signals:
    """The handler of this process's signals. Outside the main thread it catches none.

    Attributes:
        number: number of the first signal that came; None: none has.
        unheard: whether a vehicle is open that may not have heard, from its own guard, that it must
            stop: then that is how the process has ended, whatever signal came.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.unheard = False
        self._held = self._over = False
        self._seen = threading.Event()  # set when the main thread has noticed the signal
        self._came = threading.Event()
        self._closed = threading.Event()
        self._listeners: list[Callable[[str], None]] = []
        self._finishes: list[Callable[[], object]] = [_say_interrupted]
        self._lock = threading.Lock()
        self._before: dict[int, Any] = {}
        self._pipe: tuple[int, int] | None = None
        if threading.current_thread() is threading.main_thread():
            self._take_over()

    def _take_over(self) -> None:
        for name in _NAMES.split():
            number = getattr(signal, name, None)
            if number is None:
                continue
            now = signal.getsignal(number)
            # `nohup` ignores SIGHUP on purpose; a plug-in may use other signals itself.
            if name in _BY_HAND or now is signal.SIG_DFL:
                self._before[number] = signal.signal(number, self._note)
        # A program in the background may write to its terminal, which would suspend it.
        self._before[signal.SIGTTOU] = signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        self._pipe = os.pipe()
        os.set_blocking(self._pipe[1], False)
        signal.set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
        threading.Thread(target=self._read, name="jaxnav-signals", daemon=True).start()
        threading.Thread(target=self._leave, name="jaxnav-leave", daemon=True).start()

    @property
    def name(self) -> str | None:
        """The name of the first signal that came."""
        return None if self.number is None else signal.Signals(self.number).name

    @property
    def exit_code(self) -> int | None:
        """The exit code of a process that a signal has ended; None: no signal came."""
        if self.number is None:
            return None
        return EXIT_STOPPED if self.unheard else EXIT + self.number

    def check(self) -> None:
        """Raise if a signal came. The main thread calls it at every step.

        Raises:
            Interrupted: a signal came.
        """
        if self.number is not None:
            self._seen.set()
            raise Interrupted(self.number)

    def hold(self) -> None:
        """Declare that something is open and must be closed: no signal ends the process at once.

        Raises:
            Interrupted: a signal came.
        """
        self._held = True
        self.check()

    def on_signal(self, tell: Callable[[str], None]) -> None:
        """Call a function with the signal's name when one comes, at once if one has come already.

        A thread of its own calls it, also while the main thread is inside a library.
        """
        with self._lock:
            self._listeners.append(tell)
            name = self.name
        if name is not None:
            tell(name)

    def before_leaving(self, finish: Callable[[], object]) -> None:
        """Call a function before the process is ended whose main thread does not answer.

        A thread of its own calls it and may be cut off after half a second.
        """
        self._finishes.append(finish)

    def ignore(self) -> None:
        """Ignore further signals: all is closed and the process ends."""
        for number in self._before:
            signal.signal(number, signal.SIG_IGN)

    def close(self) -> None:
        """Restore the handlers."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._seen.set()
        self._came.set()
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._pipe is not None:
            signal.set_wakeup_fd(-1)
            os.close(self._pipe[1])  # the thread then reads the end, and closes the other one

    def __enter__(self) -> "Signals":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _note(self, number: int, frame: FrameType | None = None) -> None:
        if self.number is None:
            self.number = number

    def _read(self) -> None:
        """Receive signals in a thread, also while the main thread runs no Python code."""
        assert self._pipe is not None
        while True:
            with suppress(OSError):
                numbers = os.read(self._pipe[0], 64)
                if not numbers:
                    os.close(self._pipe[0])
                    return
                for number in numbers:
                    if number in self._before and number != signal.SIGTTOU:
                        self._note(number)
                        self._tell()
                        self._came.set()

    def _tell(self) -> None:
        with self._lock:
            listeners = list(self._listeners)
        for tell in listeners:
            with suppress(Exception):  # one that fails must not keep the others from being called
                tell(self.name or "")

    def _leave(self) -> None:
        """End the process if its main thread does not: it may compile, or hang in a driver."""
        self._came.wait()
        if not self._seen.wait(_LEAVES_S) and not self._held:
            self._exit()
        if not self._closed.wait(_ENDS_S):
            self._exit()

    def _exit(self) -> None:
        if self._closed.is_set():
            return
        threads = [threading.Thread(target=finish, daemon=True) for finish in self._finishes]
        for thread in threads:
            thread.start()
        until_s = time.monotonic() + _FINISHES_S
        for thread in threads:  # neither a stuck terminal nor a stuck disk holds up the end
            thread.join(max(0.0, until_s - time.monotonic()))
        os._exit(self.exit_code or EXIT)


def _say_interrupted() -> None:
    with suppress(OSError):
        os.write(2, b"jaxnav: interrupted\n")
