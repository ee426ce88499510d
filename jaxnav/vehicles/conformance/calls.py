"""Call code that may hang, raise anything, or give stamps of another clock."""

import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from queue import SimpleQueue
from threading import Thread
from typing import Any

HANGS_S = 5.0  # a call of a plug-in that takes longer hangs
_OLD_NS = 1_000_000_000  # a stamp older than this is from another clock

Finish = Callable[[str, float], Any]


class Worker:
    """A thread, as the loop has for each part of a plug-in. It detects calls that hang."""

    def __init__(self) -> None:
        self._tasks: SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = SimpleQueue()
        Thread(target=self._run, name="jaxnav check", daemon=True).start()

    def begin(self, function: Callable[[], Any]) -> Finish:
        """Begin a call; the returned function (name of the call, timeout, s) awaits its result."""
        future: Future[Any] = Future()
        self._tasks.put((function, future))

        def finish(what: str, within_s: float = HANGS_S) -> Any:
            done, _ = wait([future], within_s)
            assert done, f"{what} did not return within {within_s:g} s"
            error = future.exception()
            if error is None:
                return future.result()
            if isinstance(error, OSError | AssertionError):
                raise error
            raise AssertionError(
                f"{what} raised {type(error).__name__}: {error}; only OSError is allowed"
            ) from error

        return finish

    def call(self, what: str, function: Callable[[], Any]) -> tuple[Any, OSError | None]:
        """Call a function; return (result, None), or (None, error) for an allowed OSError.

        Raises:
            AssertionError: the call hangs, or raises anything else.
        """
        try:
            return self.begin(function)(what, HANGS_S), None
        except OSError as error:
            return None, error

    def close(self) -> None:
        """End the thread after its last call."""
        self._tasks.put(None)

    def _run(self) -> None:
        while (task := self._tasks.get()) is not None:
            function, future = task
            try:
                future.set_result(function())
            except BaseException as error:
                future.set_exception(error)


def start_call(function: Callable[[], Any]) -> Finish:
    """Begin a call in a thread of its own; see `Worker.begin`."""
    worker = Worker()
    finish = worker.begin(function)
    worker.close()
    return finish


def check_stamp(what: str, stamp_ns: object) -> None:
    """Check that a stamp is from this machine's monotonic clock, and recent.

    Raises:
        AssertionError: it is not.
    """
    assert type(stamp_ns) is int, f"stamp_ns of {what} must be an int, not {stamp_ns!r}"
    age_ns = time.monotonic_ns() - stamp_ns
    assert age_ns >= 0, f"stamp_ns of {what} lies {-age_ns / 1e9:g} s in the future"
    assert age_ns < _OLD_NS, (
        f"stamp_ns of {what} is {age_ns / 1e9:g} s old: it must be of time.monotonic_ns()"
    )
