"""Clocks that stand: notice that one does, and let a simulation's wait for who is behind."""

import threading
import time
from collections.abc import Callable

# Longer than between two ticks of a slow simulation, shorter than the guard's timeout.
STANDS_S = 0.1


class StandingClock:
    """A watch on a clock, by the one that never stands. For one thread."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic):
        self._now_s = now_s
        self._last_ns: int | None = None
        self._moved_s = now_s()

    def stands(self, clock_ns: int) -> bool:
        """Whether the clock, which shows this now, has shown it for `STANDS_S`."""
        now_s = self._now_s()
        if clock_ns != self._last_ns:
            self._last_ns, self._moved_s = clock_ns, now_s
        return now_s - self._moved_s > STANDS_S


class WaitingClock:
    """The time of a simulated vehicle: real time, less what its drive could not keep up with.

    A busy computer may leave a thread without a core for longer than the guard of a real vehicle
    can wait. Nothing moves here but what this clock moves: it stands until the thread is back.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._now_ns = self._real_ns = time.monotonic_ns()
        self._limits: list[tuple[Callable[[], int | None], int]] = []

    def wait_for(self, since_ns: Callable[[], int | None], ahead_s: float) -> None:
        """From now on run no further than `ahead_s` beyond `since_ns`.

        Args:
            since_ns: time, on this clock, of the last sign of life of something that runs beside
                it; None while it need not be waited for.
        """
        self._limits.append((since_ns, int(ahead_s * 1e9)))

    def now_ns(self) -> int:
        """The time. While it waits it creeps: a `StandingClock` would take it for a paused one."""
        with self._lock:
            real_ns = time.monotonic_ns()
            now_ns = self._now_ns + real_ns - self._real_ns
            self._real_ns = real_ns
            for since_ns, ahead_ns in self._limits:
                if (since := since_ns()) is not None and since + ahead_ns < now_ns:
                    now_ns = max(since + ahead_ns, self._now_ns + 1)
            self._now_ns = now_ns
            return now_ns
